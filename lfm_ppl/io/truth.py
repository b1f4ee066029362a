"""The truth of simulated data, as a mapping and as a JSON file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.io.data_set import Data, number_array
from lfm_ppl.utils import checks


def read_truth(path: str | Path) -> dict[str, Any]:
    """Read the truth in the form of :attr:`Data.truth`, as :func:`write_truth` writes it.

    Raises:
        ValueError: the file is not JSON, or holds something else, see :func:`check_truth`.
    """
    try:
        raw = json.loads(Path(path).read_text(encoding="utf-8"))
        if not isinstance(raw, dict):
            raise ValueError(f"it holds a {type(raw).__name__}, not a mapping of names to values")
    except ValueError as error:  # of JSON or of UTF-8
        reason = str(error).rstrip(".")
        raise ValueError(f"{path} is not a truth file, JSON such as `lfm-ppl simulate` writes: {reason}.") from None
    try:
        check_truth(raw)
    except ValueError as error:
        raise ValueError(f"{path} is not a truth file: {error}") from None
    return {key: {k: np.array(v, float) for k, v in value.items()} if isinstance(value, dict) else
            np.array(value, float) for key, value in raw.items() if value is not None}


_TRUE_PATHS = ("forces", "deterministics")


TRUTH = ("times", *_TRUE_PATHS, "state", "parameters")
"""What may be known of the truth."""


def check_truth(truth: Mapping[str, Any]) -> None:
    """Raise ValueError where a truth, in the form of :attr:`Data.truth`, does not fit together.

    Its names are not compared with the names of a model.
    """
    for name in truth:
        checks.one_of("entry", name, TRUTH)
    entries = {name: value for name, value in truth.items() if value is not None}
    for kind in (*_TRUE_PATHS, "parameters"):
        if not isinstance(entries.get(kind, {}), Mapping):
            raise ValueError(f'"{kind}" must be a mapping of names to values, got a {type(entries[kind]).__name__}.')
    paths = {f'"{name}" of "{kind}"': value for kind in _TRUE_PATHS for name, value in entries.get(kind, {}).items()}
    paths |= {'"state"': entries["state"]} if "state" in entries else {}
    if paths and "times" not in entries:
        raise ValueError(f'{next(iter(paths))} needs "times", at which it was.')
    times = number_array('"times"', entries.get("times", []))
    if times.ndim != 1 or not np.all(np.isfinite(times)):
        raise ValueError(f'"times" must be finite numbers, one after the other, got shape {times.shape}.')
    for name, value in paths.items():
        size, state = number_array(name, value).shape, name == '"state"'
        if size[:1] != times.shape or len(size) != 1 + state:
            raise ValueError(f'{name} must hold {len(times)} {"rows of states" if state else "values"}, one for each '
                             f'of "times", got shape {size}.')
    for name, value in entries.get("parameters", {}).items():
        number_array(f'"{name}" of "parameters"', value)


def write_truth(data: Data, path: str | Path) -> None:
    """Write the truth of a simulated data set as JSON, for :func:`read_truth`."""
    if data.truth is None:
        raise ValueError("this data set has no truth to write; only simulated data has one.")
    text = json.dumps(data.truth, default=lambda array: np.asarray(array).tolist(), indent=1)
    Path(path).write_text(text + "\n", encoding="utf-8")
