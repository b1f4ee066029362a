"""The truth of simulated data, as a mapping and as a JSON file."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.io.data_set import Data
from lfm_ppl.utils import checks

_TRUE_PATHS = ("forces", "deterministics")

TRUTH = ("times", *_TRUE_PATHS, "state", "parameters")
"""Entries of a truth."""


def read_truth(path: str | Path) -> dict[str, Any]:
    """Read the truth in the form of `Data.truth`, as `write_truth` writes it; ValueError for any other file."""
    try:
        truth = json.loads(Path(path).read_text(encoding="utf-8"))
        if not isinstance(truth, dict):
            raise ValueError(f"expected a mapping of names to values, got a {type(truth).__name__}.")
        check_truth(truth)
    except ValueError as error:  # of JSON or of UTF-8, too
        raise ValueError(f"{path} is not a truth file, JSON such as `lfm-ppl simulate` writes: "
                         f"{str(error).rstrip('.')}.") from None
    return {name: {key: np.array(value, float) for key, value in entry.items()} if isinstance(entry, dict) else
            np.array(entry, float) for name, entry in truth.items() if entry is not None}


def check_truth(truth: Mapping[str, Any]) -> None:
    """Raise ValueError where the entries of a truth, in the form of `Data.truth`, do not fit together."""
    for name in truth:
        checks.one_of("entry", name, TRUTH)
    entries = {name: entry for name, entry in truth.items() if entry is not None}
    for kind in (*_TRUE_PATHS, "parameters"):
        if not isinstance(entries.get(kind, {}), Mapping):
            raise ValueError(f'"{kind}" must be a mapping of names to values, got a {type(entries[kind]).__name__}.')
    times = _numbers('"times"', entries.get("times", []))
    if times.ndim != 1 or not np.isfinite(times).all():
        raise ValueError(f'"times" must be finite numbers, one after the other, got shape {times.shape}.')
    for name, value in entries.get("parameters", {}).items():
        _numbers(f'"{name}" of "parameters"', value)
    paths = {f'"{name}" of "{kind}"': path for kind in _TRUE_PATHS for name, path in entries.get(kind, {}).items()}
    for name, path in {**paths, '"state"': entries.get("state", np.ones((len(times), 1)))}.items():
        shape, is_state = _numbers(name, path).shape, name == '"state"'
        if shape[:1] != times.shape or len(shape) != 1 + is_state:
            kind = "rows of states" if is_state else "values"
            raise ValueError(f'{name} must hold {len(times)} {kind}, one for each of "times", got shape {shape}.')


def _numbers(name: str, value: Any) -> np.ndarray:
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers, in rows of one length.") from None


def write_truth(data: Data, path: str | Path) -> None:
    """Write the truth of a simulated data set as JSON, for `read_truth`."""
    if data.truth is None:
        raise ValueError("this data set has no truth to write; only simulated data has one.")
    text = json.dumps(data.truth, default=lambda array: np.asarray(array).tolist(), indent=1)
    Path(path).write_text(text + "\n", encoding="utf-8")
