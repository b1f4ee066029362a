"""Types of options, as argparse calls them; the message of an error follows the name of the option."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from lfm_ppl.utils import checks


def one_of(kind: str, choices: Any, **likeness: float) -> Callable[[str], str]:
    """Return the type of an option with choices; for ``likeness`` see `checks.unknown`."""
    def convert(text: str) -> str:
        if text not in choices:
            raise argparse.ArgumentTypeError(checks.unknown(kind, text, choices, **likeness))
        return text

    return convert


def integer(least: int) -> Callable[[str], int]:
    """Return the type of a whole number of at least ``least``."""
    def convert(text: str) -> int:
        if not text.isascii() or not text.isdigit() or int(text) < least:
            message = f"expected a whole number of at least {least}, got {text!r}"
            raise argparse.ArgumentTypeError(message)
        return int(text)

    return convert


def positive(text: str) -> float:
    """Return a number above zero."""
    return _between(text, float("inf"), "a number above zero")


def fraction(text: str) -> float:
    """Return a number between zero and one."""
    return _between(text, 1.0, "a number between 0 and 1")


def _between(text: str, end: float, expected: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < end:
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}")
    return value
