"""Types of the options of the commands: how the word of an option is read and checked, and what the help calls it.

This module imports nothing that takes long, so that the help of a command appears at once.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Annotated, Any

from cyclopts import Parameter


def _number(kind: Callable[[str], Any], is_valid: Callable[[Any], bool], expected: str) -> Callable:
    """Return the converter of an option whose value is a number."""

    def convert(hint: Any, tokens: Any) -> Any:
        text = tokens[0].value
        with contextlib.suppress(ValueError):
            if is_valid(value := kind(text)):
                return value
        raise ValueError(f"expected {expected}, got {text!r}.")

    return convert


def _refuse_empty(hint: Any, value: Any) -> None:
    if "" in (value if isinstance(value, tuple) else (value,)):
        raise ValueError("The value is empty.")


def _check_time_unit(hint: Any, unit: str | None) -> None:
    if unit is not None:
        from lfm_ppl.utils import calendar_time, checks

        checks.one_of("unit of time", unit, calendar_time.SECONDS)


def check_method(hint: Any, method: str | None) -> None:
    """Raise ValueError for an unknown method of integration."""
    if method is not None:
        from lfm_ppl.filtering.integrators.methods import METHODS
        from lfm_ppl.utils import checks

        checks.one_of("method", method, METHODS)


def integer_at_least(least: int) -> Callable:
    """Return the converter of an option whose value is a whole number."""
    return _number(int, lambda value: value >= least, f"a whole number of at least {least}")


def _real(end: float, expected: str) -> Callable:
    return _number(float, lambda value: 0 < value < end, expected)


Text = Annotated[str, Parameter(validator=_refuse_empty)]
File = Annotated[Text, Parameter(metavar="FILE")]
Folder = Annotated[Text, Parameter(metavar="DIR")]
Name = Annotated[Text, Parameter(metavar="NAME")]
TimeUnit = Annotated[str, Parameter(metavar="UNIT", validator=_check_time_unit)]
Names = Annotated[Text, Parameter(metavar="A,B,...")]
Pairs = Annotated[tuple[str, ...], Parameter(metavar="NAME=VALUE", validator=_refuse_empty)]
Count = Annotated[int, Parameter(metavar="N", converter=integer_at_least(1))]
CountOrZero = Annotated[int, Parameter(metavar="N", converter=integer_at_least(0))]
Positive = Annotated[float, Parameter(converter=_real(float("inf"), "a number above zero"))]
Fraction = Annotated[float, Parameter(converter=_real(1.0, "a number between 0 and 1"))]

Model = Annotated[Text, Parameter(help="a shipped model (see `lfm-ppl models`) or the path of a Python file")]
Result = Annotated[Text, Parameter(help="a results folder or a posterior.nc")]
Line = Annotated[tuple[str, ...], Parameter(parse=False)]
"""The words of the command line, which `lfm_ppl.cli.main` passes to a command."""
