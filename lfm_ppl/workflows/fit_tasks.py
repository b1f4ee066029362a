"""The tasks of `lfm_ppl.fit_many`: one fit of a model to one data set."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.model_digest import model_digest
from lfm_ppl.inference.problem import signature
from lfm_ppl.inference.unbound_model import SharedModel
from lfm_ppl.io.data_set import Data
from lfm_ppl.io.input_table import model_keywords
from lfm_ppl.parallel.task import Task
from lfm_ppl.results.packing import pack_result
from lfm_ppl.storage.run_record import digest
from lfm_ppl.utils import checks
from lfm_ppl.workflows.fit import fit

WARNINGS = "warnings"
"""Attribute of a result: the warnings of `fit`, as a list in JSON."""


def seed_of(name: str, seed: int = 0) -> int:
    """Return the seed with which `fit_many` fits a data set.

    Example:
        >>> seed_of("plant-0") != seed_of("plant-1")
        True
    """
    return int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:4], "big") >> 1


def fit_task(model: Callable, name: str, value: Any, options: dict[str, Any], seed: int,
             digests: dict[Any, str]) -> Task:
    """Return the task of one data set, ``(times, y)`` or `lfm.Data`.

    ``options`` are arguments of `fit`; ``digests`` of the model for other data sets are extended here.
    """
    keywords = options.get("model_kwargs") or {}
    if isinstance(value, Data):
        times, y = value.times, value.y
        keywords = model_keywords(value.inputs, keywords)
    else:
        if isinstance(value, (list, tuple)) and value:  # the unit of dates depends on the gaps, and could differ
            checks.refuse_dates(f"data set {name!r}: times", value[0])
        try:
            times, y = (np.asarray(checks.unmask(part), float) for part in value)
        except (TypeError, ValueError):
            raise TypeError(f"data set {name!r} must be (times, y) or lfm.Data, got {type(value).__name__}.") from None
    options = {"name": getattr(model, "__name__", "model"), "seed": seed_of(name, seed), **options}
    fit_options = {key: option for key, option in options.items()
                   if key not in ("truth", "name", "seed", "model_kwargs")}
    settings = {"data": digest(times, y), "model": _model_digest(model, times, y, keywords, digests),
                "options": plain_value({**fit_options, "model_kwargs": keywords})}
    if isinstance(value, Data):
        settings["named"] = plain_value({"outputs": value.outputs, "units": dict(value.units), "origin": value.origin})
    data = (value, None) if isinstance(value, Data) else (times, y)
    return Task(file_name(name), seed, settings, (*data, options))


def _model_digest(model: Callable, times: np.ndarray, y: np.ndarray, keywords: Any, digests: dict[Any, str]) -> str:
    """Return a digest of the model, which changes with its code."""
    key = signature((times, y.shape, dict(keywords or {})))
    if key in digests:
        return digests[key]
    try:
        bound = bind(model, times, y, model_kwargs=keywords)
        value = model_digest(bound)
    except Exception:  # raised again by the fit of this data set
        return "none"
    if bound.problem.data is not None:  # else the model depends on the values of its data
        digests[key] = value
    return value


def plain_value(value: Any) -> Any:
    """Return a value in types of JSON; an object without such a form as its name."""
    if isinstance(value, Mapping):
        return {str(key): plain_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_value(item) for item in value]
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else repr(value)
    if hasattr(value, "tolist"):
        return plain_value(np.asarray(value).tolist())
    leaves = jax.tree_util.tree_leaves(value)
    if not (len(leaves) == 1 and leaves[0] is value):  # a known input
        return [type(value).__name__, *map(plain_value, leaves)]
    return re.sub(r" at 0x[0-9a-f]+", "", getattr(value, "__qualname__", repr(value)))


def file_name(name: str) -> str:
    """Return a valid file name; a changed name gets a digest, so that two names never share a file."""
    safe = re.sub(r"[^A-Za-z0-9_.()-]", "_", name)[:80]
    safe = safe if safe.strip(".") else f"_{safe}"
    return safe if safe == name else f"{safe}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


@dataclasses.dataclass(frozen=True)
class FitDataSet:
    """Function from a task to the result of its fit as arrays; all tasks of a process have the same programs."""

    model: SharedModel

    def __call__(self, task: Task) -> dict[str, Any]:
        """Return the result of `fit` with its warnings as attribute `WARNINGS`."""
        times, y, options = task.data
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            result = fit(self.model, times, y, progress=False, **options)
        messages = [str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)]
        return pack_result(result, {WARNINGS: json.dumps(messages)})
