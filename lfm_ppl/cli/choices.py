"""What the user's words stand for: rules, samplers, fixed parameters, options."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from lfm_ppl.io.loading import ModelFile
from lfm_ppl.utils import checks

# word on the command line -> name in lfm_ppl; its defaults are what the word stands for
RULES = {
    "cubature": "Cubature",
    "taylor": "Taylor",
    "unscented": "Unscented",
    "gauss-hermite": "GaussHermite",
    "central-difference": "CentralDifference",
    "monte-carlo": "MonteCarlo",
}
REFERENCES = ("auto", "grid", "particles")
FREE = "free"
MOST_JOBS = 4
"""Processes that compute where nothing else is asked for; each takes one or two GiB."""


def options(model: ModelFile, given: Sequence[str]) -> dict[str, Any]:
    """Return the values of ``--option NAME=VALUE``, checked against what the model offers."""
    pairs = [_pair("--option", text) for text in given]
    return {name: model.option(name, value) for name, value in pairs}


def fixed(given: Sequence[str], anchors: Mapping[str, float], options: Collection[str] = ()) -> dict[str, Any]:
    """Return the parameters to fix: name -> value.

    Args:
        given: ``NAME=VALUE``, ``NAME[ELEMENT]=VALUE``, ``NAME=V1,V2,...`` or ``NAME=free``.
        anchors: what the model fixes for this data. What the user says of an element replaces the
            anchor of that element, what the user says of a whole parameter all anchors of it.
        options: of the model, which are no parameters.

    Raises:
        ValueError: for what does not have one of these forms, and for an option.
    """
    chosen = dict(anchors)
    for text in given:
        name, value = _pair("--set", text)
        if (option := name.partition("[")[0]) in options:
            chosen_by = f"--option {option}={'VALUE' if value == FREE else value}"
            raise ValueError(f"--set {text}: {option} is an option of the model, and no parameter: {chosen_by}.")
        for anchor in list(chosen):
            if anchor == name or anchor.partition("[")[0] == name:
                del chosen[anchor]
        if value != FREE:
            chosen[name] = _number(name, value)
        elif not any(anchor == name or anchor.partition("[")[0] == name for anchor in anchors):
            known = ", ".join(anchors) or "none"
            raise ValueError(f"--set {text}: the model does not fix {name}; it fixes: {known}.")
    return chosen


def bounds(flag: str, given: Sequence[str]) -> dict[str, float] | None:
    """Return the bounds ``NAME=VALUE`` of a flag, name -> bound; None without any."""
    found: dict[str, float] = {}
    for text in given:
        name, value = _pair(flag, text)
        if name in found:
            raise ValueError(f"{flag} gives {name} two bounds, {found[name]:g} and {value}.")
        try:
            found[name] = float(value)
        except ValueError:
            raise ValueError(f"{flag} takes NAME=NUMBER, got {text!r}.") from None
    return found or None


def inputs(given: str | None, model: ModelFile) -> dict[str, tuple[str, str]]:
    """Return the known inputs to read: name -> column of the file, interpolation.

    Args:
        given: ``A,B:linear,C:zero``, columns in the order of the model's inputs; None: columns of these names.
        model: what takes them.
    """
    if given is None:
        return {name: (name, way) for name, way in model.inputs.items()}
    columns = [tuple(part.strip() for part in text.partition(":")[::2]) for text in given.split(",")]
    names = list(model.inputs) or [column for column, _ in columns]
    if len(names) != len(columns) or len(set(columns)) < len(columns):
        known = ", ".join(names)
        raise ValueError(f"{model.name} takes {checks.counted(len(names), 'known input')} ({known}); --inputs names "
                         f"{checks.counted(len(columns), 'column')}, which must be as many, each of them once.")
    return {name: (column, way or model.inputs.get(name, "previous"))
            for name, (column, way) in zip(names, columns, strict=True)}


def rule(word: str | None) -> Any:
    """Return the linearisation rule that a word stands for; None: the model's own."""
    import lfm_ppl

    return None if word is None else getattr(lfm_ppl, RULES[word])()


def _pair(flag: str, text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name.strip() or not value.strip():
        raise ValueError(f"{flag} takes NAME=VALUE, got {text!r}.")
    return name.strip(), value.strip()


def _number(name: str, text: str) -> Any:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(
            f"--set {name}: expected a number, numbers separated by commas, or {FREE!r}, got {text!r}."
        ) from None
    checks.finite(f"--set {name}", np.array(values))
    return values[0] if len(values) == 1 else values


def workers(jobs: int | None, scheduler: str | None) -> int | str:
    """Return what computes, as `lfm_ppl.engine.run.run_tasks` takes it, for ``--jobs`` and ``--scheduler``.

    Raises:
        ValueError: both are given.
    """
    from lfm_ppl.engine.cluster import available, check_workers

    if scheduler is None:
        return jobs or min(available(), MOST_JOBS)
    if jobs is not None:
        raise ValueError("--jobs is the number of processes on this machine; a scheduler has workers of its own. Give "
                         "one of --jobs and --scheduler.")
    check_workers(scheduler)
    return scheduler
