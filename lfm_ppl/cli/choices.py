"""Values of options: rules, fixed parameters, bounds, known inputs."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from lfm_ppl.cli.options import RULES, Columns
from lfm_ppl.io.dosing import ROLES
from lfm_ppl.io.input_table import DOSE, ONCE, dosed_states
from lfm_ppl.io.loading import ModelFile
from lfm_ppl.utils import checks

FREE = "free"


def options(model: ModelFile, texts: Sequence[str]) -> dict[str, Any]:
    """Return the values of ``--option NAME=VALUE``, checked against the options of the model."""
    pairs = [_pair("--option", text) for text in texts]
    return {name: model.option(name, value) for name, value in pairs}


def fixed(texts: Sequence[str], anchors: Mapping[str, float], options: Collection[str] = ()) -> dict[str, Any]:
    """Return the parameters to fix: name -> value.

    Args:
        texts: ``NAME=VALUE``, ``NAME[ELEMENT]=VALUE``, ``NAME=V1,V2,...`` or ``NAME=free``.
        anchors: values that the model fixes for this data. A value of an element replaces the anchor of that element,
            a value of a parameter all its anchors.
        options: names of the model's options, which are no parameters.

    Raises:
        ValueError: a text of another form, or an option.
    """
    values_by_name = dict(anchors)
    for text in texts:
        name, value = _pair("--set", text)
        if (option := name.partition("[")[0]) in options:
            option_flag = f"--option {option}={'VALUE' if value == FREE else value}"
            raise ValueError(f"--set {text}: {option} is an option of the model, not a parameter: {option_flag}.")
        values_by_name = {anchor: number for anchor, number in values_by_name.items()
                          if name not in (anchor, anchor.partition("[")[0])}
        if value != FREE:
            values_by_name[name] = _number(name, value)
        elif not any(name in (anchor, anchor.partition("[")[0]) for anchor in anchors):
            anchor_names = ", ".join(anchors) or "none"
            raise ValueError(f"--set {text}: the model does not fix {name}; it fixes: {anchor_names}.")
    return values_by_name


def bounds(flag: str, texts: Sequence[str]) -> dict[str, float] | None:
    """Return the bounds ``NAME=VALUE`` of a flag, name -> bound; None without any."""
    bounds_by_name: dict[str, float] = {}
    for text in texts:
        name, value = _pair(flag, text)
        if name in bounds_by_name:
            raise ValueError(f"{flag} gives {name} two bounds, {bounds_by_name[name]:g} and {value}.")
        try:
            bounds_by_name[name] = float(value)
        except ValueError:
            raise ValueError(f"{flag} takes NAME=NUMBER, got {text!r}.") from None
    return bounds_by_name or None


def inputs(columns: Columns, model: ModelFile) -> dict[str, tuple[str, str]]:
    """Return the known inputs to read: name -> column of the file, interpolation.

    Columns of ``--inputs A,B:linear,C:zero`` are in the order of the model's inputs. Columns of ``--events
    A:STATE,STATE`` are doses, and ``B:CMT`` gives a column the role of one of `lfm_ppl.io.dosing.ROLES`. By default the
    columns have the names of the model's inputs.
    """
    functions = {name: way for name, way in model.inputs.items() if not way.startswith(DOSE)}
    doses = {name: way for name, way in model.inputs.items() if way.startswith(DOSE)}
    return _functions(columns.inputs, model, functions) | _doses(columns.events, doses)


def _doses(text: str | None, doses: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return the columns of doses, and of what describes them; doses of the model to the same states keep their name.

    Where no dose of the model has all these states, the one with the same first state gives the name.
    """
    if text is None:
        return {name: (name, way) for name, way in doses.items()}
    columns: dict[str, tuple[str, str]] = {}
    roles: dict[str, str] = {}
    for column, states in _event_columns(text).items():
        if (role := states.upper()) in ROLES:
            if role in roles:
                raise ValueError(f"--events names two columns for {role}: {roles[role]} and {column}. Name one of "
                                 "them.")
            roles[role] = column
            columns[column] = (column, role)
            continue
        first, _, _ = states.removesuffix(ONCE).partition(",")
        matches = [name for name, way in doses.items() if way.removesuffix(ONCE) == DOSE + states.removesuffix(ONCE)]
        matches += [name for name, way in doses.items() if dosed_states(way)[0] == first]
        name = next(iter(matches), column)
        if name in columns:
            raise ValueError(f"--events names two columns for the doses {name!r} to {states}: {columns[name][0]} and "
                             f"{column}. Write them in one column.")
        columns[name] = (column, DOSE + states)
    return columns


def _event_columns(text: str) -> dict[str, str]:
    """Return the columns of ``--events``: column -> its states, separated by commas, or its role."""
    columns: dict[str, str] = {}
    column = ""
    for part in text.split(","):
        words = [word.strip() for word in part.split(":")]
        # A state after the first one of its column, the last of them with or without ":once".
        is_once = len(words) > 1 and words[-1] == ONCE.removeprefix(":")
        is_state = bool(column) and len(words) == 1 + is_once
        if not all(words) or not is_state and len(words) != 2 and not (len(words) == 3 and is_once):
            raise ValueError(f"--events takes COLUMN:STATE, the column of the doses and the state that receives them, "
                             f"got {part!r}.")
        if is_state:
            if columns[column].endswith(ONCE) or columns[column].upper() in ROLES:
                raise ValueError(f"--events {text}: write the state {words[0]!r} after the other states of its column, "
                                 f"COLUMN:STATE,STATE, and {ONCE!r} after the last of them.")
            columns[column] += "," + ":".join(words)
            continue
        column = words[0]
        if column in columns:
            raise ValueError(f"--events names the column {column} twice; write its states in one list, "
                             f"{column}:STATE,STATE, in the order of a column CMT.")
        columns[column] = ":".join(words[1:])
    return columns


def _functions(columns_text: str | None, model: ModelFile,
               interpolations: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    if columns_text is None:
        return {name: (name, way) for name, way in interpolations.items()}
    columns = [tuple(part.strip() for part in text.partition(":")[::2]) for text in columns_text.split(",")]
    names = list(interpolations) or [column for column, _ in columns]
    if len(names) != len(columns) or len(set(columns)) < len(columns):
        raise ValueError(f"{model.name} takes {checks.counted(len(names), 'known input')} ({', '.join(names)}); "
                         f"--inputs names {checks.counted(len(columns), 'column')}, which must be as many, each of "
                         "them once.")
    return {name: (column, way or interpolations.get(name, "previous"))
            for name, (column, way) in zip(names, columns, strict=True)}


def rule(word: str | None) -> Any:
    """Return the linearisation rule of a name; None: the rule of the model."""
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
        raise ValueError(f"--set {name}: expected a number, numbers separated by commas, or {FREE!r}, got "
                         f"{text!r}.") from None
    checks.finite(f"--set {name}", np.array(values))
    return values[0] if len(values) == 1 else values
