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


def name_in(line: Sequence[str], common: argparse.ArgumentParser, study_names: Sequence[str]) -> str | None:
    """Return the name of the study; None if no word can be one.

    Args:
        line: the arguments after ``compare``.
        common: parser of the options that all studies share; the other words are the name, the options of the study
            and their values.
        study_names: names of the studies.
    """
    _, other_words = common.parse_known_args(list(line))
    free = [word for previous_word, word in zip(["", *other_words], other_words, strict=False)
            if not word.startswith("-") and not (previous_word.startswith("--") and "=" not in previous_word)]
    return next((word for word in free if word.replace("_", "-") in study_names), next(iter(free), None))


def add(command: Any, settings: type[StudySettings], name: str) -> None:
    """Add an option for each setting of a study."""
    from lfm_ppl.experiments.study import options

    group = command.add_argument_group(f"options of {name}")
    for option in options(settings):
        about, kind = option.declaration, _converter(option)
        format_options: dict[str, Any] = {
            "metavar": about.metavar or ("N" if option.value_type is int else option.name.upper())
        }
        if about.parts:
            format_options = {"nargs": len(about.parts), "metavar": tuple(part.upper() for part in about.parts)}
        elif option.is_sequence:
            format_options["nargs"] = "+"
        elif about.choices:
            format_options["metavar"] = "|".join(about.choices)
        group.add_argument(*option.flags, dest=_DESTINATION + option.name, type=kind, default=argparse.SUPPRESS,
                           help=f"{about.help}{_default(option)}".replace("%", "%%"), **format_options)


def given_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the settings that a user gave, by name."""
    return {name.removeprefix(_DESTINATION): tuple(value) if isinstance(value, list) else value
            for name, value in vars(arguments).items() if name.startswith(_DESTINATION)}


def _converter(option: SettingOption) -> Callable[[str], Any]:
    if option.value_type is int:
        return values.integer(option.declaration.least)
    if option.value_type is float:
        return values.positive
    return values.one_of("value", option.declaration.choices) if option.declaration.choices else str


def _default(option: SettingOption) -> str:
    if option.default is None or "default:" in option.declaration.help:
        return ""
    several = option.default if isinstance(option.default, tuple) else (option.default,)
    choices = option.declaration.choices
    has_all_choices = option.is_sequence and choices is not None and several == tuple(choices)
    also = f"; any of: {shlex.join(choices)}" if option.is_sequence and choices and not has_all_choices else ""
    return f" (default: {shlex.join(map(str, several))}{also})"
