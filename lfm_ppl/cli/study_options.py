"""The options of ``lfm-ppl compare NAME``, made from the settings that the study NAME declares."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from lfm_ppl.cli import values

if TYPE_CHECKING:  # experiments, which take seconds to import
    from lfm_ppl.experiments.study import SettingOption, StudySettings

_DESTINATION = "study setting "


def name_in(line: Sequence[str], common: argparse.ArgumentParser, known: Sequence[str]) -> str | None:
    """Return the word that names the study; None where no word can.

    Args:
        line: the arguments after ``compare``.
        common: parser of the options that all studies share; what it leaves over are the name, the options of the
            study, and their values.
        known: names of the studies.
    """
    _, left = common.parse_known_args(list(line))
    free = [word for before, word in zip(["", *left], left, strict=False)
            if not word.startswith("-") and not (before.startswith("--") and "=" not in before)]
    return next((word for word in free if word.replace("_", "-") in known), next(iter(free), None))


def add(command: Any, settings: type[StudySettings], name: str) -> None:
    """Add an option for each setting of a study."""
    from lfm_ppl.experiments.study import options

    group = command.add_argument_group(f"options of {name}")
    for one in options(settings):
        about, kind = one.declaration, _converter(one)
        shown: dict[str, Any] = {"metavar": about.metavar or ("N" if one.value_type is int else one.name.upper())}
        if about.parts:
            shown = {"nargs": len(about.parts), "metavar": tuple(part.upper() for part in about.parts)}
        elif one.is_sequence:
            shown["nargs"] = "+"
        elif about.choices:
            shown["metavar"] = "|".join(about.choices)
        group.add_argument(*one.flags, dest=_DESTINATION + one.name, type=kind, default=argparse.SUPPRESS,
                           help=f"{about.help}{_default(one)}".replace("%", "%%"), **shown)


def given(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the settings that a user gave, by name."""
    return {name.removeprefix(_DESTINATION): tuple(value) if isinstance(value, list) else value
            for name, value in vars(arguments).items() if name.startswith(_DESTINATION)}


def _converter(one: SettingOption) -> Callable[[str], Any]:
    if one.value_type is int:
        return values.whole(one.declaration.least)
    if one.value_type is float:
        return values.positive
    return values.one_of("value", one.declaration.choices) if one.declaration.choices else str


def _default(one: SettingOption) -> str:
    if one.default is None or "default:" in one.declaration.help:
        return ""
    several = one.default if isinstance(one.default, tuple) else (one.default,)
    choices = one.declaration.choices
    every = one.is_sequence and choices is not None and several == tuple(choices)
    also = f"; any of: {shlex.join(choices)}" if one.is_sequence and choices and not every else ""
    return f" (default: {shlex.join(map(str, several))}{also})"
