"""Eager checks of user input.

1. `concrete` converts a value to NumPy; tracers of compiled code have no value, and no check applies to them. There, an
   invalid value gives a log likelihood of minus infinity instead.
2. Each check names the argument, what was expected, what was passed and what to do.
3. `refuse_dates`, `refuse_durations`, `positive`, `positive_integer`, `sizes`, `finite`, `random_key`, `time_vector`
   and `covariance_matrix` check numbers, shapes and order.
4. `one_of` checks names; `unknown` and `nearest` suggest similar names.
5. `warn` attributes a warning to the first line outside of the library.
"""

from __future__ import annotations

import difflib
import sys
import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np
from numpyro.util import is_prng_key

from lfm_ppl.utils import calendar_time

_LIKENESS = 0.4
"""Default similarity above which `unknown` suggests a name, on the scale of difflib from 0 to 1."""

ABBREVIATIONS = 0.6
"""The similarity to pass to `unknown` for abbreviations, which share letters by chance."""


def concrete(value: Any) -> np.ndarray | None:
    """Return ``value`` as a NumPy array with NaN for masked entries, or None if it contains a tracer."""
    return None if traced(value) else np.asarray(unmask(value))


def unmask(value: Any) -> Any:
    """Return an array with NaN for masked entries, also within lists; other values are unchanged.

    NumPy's and JAX's ``asarray`` drop the mask and use the masked values as data.

    Example:
        >>> unmask(np.ma.masked_array([1, -999], mask=[False, True]))
        array([ 1., nan])
    """
    if isinstance(value, np.ma.MaskedArray):
        mask, data = np.ma.getmaskarray(value), np.ma.getdata(value)
        if not mask.any():
            return data
        if data.dtype.kind in "mM":
            return np.where(mask, np.array("NaT", data.dtype), data)
        return np.where(mask, np.nan, data.astype(float))
    if isinstance(value, (list, tuple)) and _holds_mask(value):
        return [unmask(entry) for entry in value]
    return value


def _holds_mask(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return any(_holds_mask(entry) for entry in value)
    return isinstance(value, np.ma.MaskedArray)


def refuse_dates(name: str, value: Any) -> None:
    """Raise TypeError for dates or durations in place of numbers: NumPy would choose their unit."""
    if calendar_time.holds_dates(value):
        raise TypeError(f"{name} must be numbers in the model's unit of time, got dates. lfm.fit and "
                        "lfm.Data(times=...) convert dates; elsewhere subtract the origin and divide by the unit, as "
                        "in (dates - dates[0]) / np.timedelta64(1, 'h').")
    refuse_durations(name, value)


def refuse_durations(name: str, value: Any) -> None:
    """Raise TypeError for durations in place of numbers: NumPy would choose their unit."""
    if calendar_time.holds_durations(value):
        raise TypeError(f"{name} must be numbers in the model's unit of time, got durations (timedelta). Divide them "
                        "by the unit, as in durations / np.timedelta64(1, 'h').")


def traced(tree: Any) -> bool:
    """Return whether a leaf of ``tree`` is a tracer."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(tree))


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the innermost line outside of the library and the frameworks that call it."""
    level, frame = 2, sys._getframe(1)
    internal_modules = ("lfm_ppl.", "equinox.", "jax.", "functools", "numpyro.")
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(internal_modules):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def positive(name: str, value: Any, remedy: str = "") -> None:
    """Raise ValueError unless every entry of ``value`` is finite and above zero."""
    array = _numeric(name, value)
    if array is not None and not np.all(np.isfinite(array) & (array > 0)):
        raise ValueError(_message(name, "finite and greater than zero", array, remedy))


def positive_integer(name: str, value: Any, remedy: str = "") -> None:
    """Raise TypeError or ValueError unless ``value`` is a whole number of at least one."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name} must be a whole number, got {value!r}. {remedy}".strip())
    if value < 1:
        raise ValueError(_message(name, "at least 1", value, remedy))


def random_key(key: Any) -> None:
    """Raise TypeError unless ``key`` is one JAX random key."""
    if not is_prng_key(key):
        got = repr(key) if isinstance(key, (int, np.integer)) else type(key).__name__
        if shape := getattr(key, "shape", ()):
            got += f" of shape {shape}"
        raise TypeError(f"key, the first argument, must be a JAX random key, such as jax.random.key(0), got {got}.")


def sizes(name: str, value: Any, meaning: Sequence[str]) -> None:
    """Raise unless ``value`` is a tuple of whole numbers of at least one, described by ``meaning`` in order."""
    if not isinstance(value, tuple) or len(value) != len(meaning):
        expected = f"{', '.join(meaning[:-1])} and {meaning[-1]}"
        raise ValueError(f"{name} must be {expected}, got {value!r}.")
    for description, count in zip(meaning, value, strict=True):
        positive_integer(f"{name}: {description}", count)


def finite(name: str, value: Any, remedy: str = "") -> None:
    """Raise ValueError that names the first entry of ``value`` that is NaN or infinite."""
    array = _numeric(name, value)
    if array is not None and not np.all(np.isfinite(array)):
        row = np.argwhere(~np.isfinite(array))[0].tolist()
        where = f" at index {row}" if row else ""
        raise ValueError(_message(name, f"finite{where}", array, remedy))


def time_vector(name: str, value: Any, earliest: float | None = None, order: str = "", remedy: str = "") -> np.ndarray:
    """Return times (K,) as float64, K >= 1; a number becomes a vector of one time.

    Args:
        name: name of the argument, for messages.
        value: the times; they must be concrete.
        earliest: the initial time, before which no time is allowed; None: any time is allowed.
        order: "non-decreasing" or "increasing"; empty: any order.
        remedy: end of the message for a time before ``earliest``.

    Raises:
        ValueError: the times are traced, not a vector, empty, not finite, too early or not in order.
    """
    refuse_dates(name, value)
    concrete_times = concrete(value)
    if concrete_times is None:
        raise ValueError(f"{name} must be known before compilation; pass a NumPy array.")
    times = np.atleast_1d(concrete_times).astype(float)
    if times.ndim != 1 or times.size == 0:
        raise ValueError(f"{name} must be a vector (K,) of at least one time, got shape {times.shape}.")
    finite(name, times)
    if order:
        gaps = np.diff(times)
        disordered = np.flatnonzero(gaps < 0 if order == "non-decreasing" else gaps <= 0)
        if disordered.size:
            row = int(disordered[0]) + 1
            rule = "must not go back" if order == "non-decreasing" else "must increase"
            raise ValueError(f"{name} {rule}: entry {row} is {times[row]:g} after {times[row - 1]:g}. Sort them.")
    if earliest is not None and times.min() < earliest:
        raise ValueError(f"{name}[{int(times.argmin())}] = {times.min():g} lies before the initial time {earliest:g}"
                         f"{remedy}.")
    return times


def one_of(name: str, value: str, choices: Iterable[str], likeness: float = _LIKENESS) -> None:
    """Raise ValueError unless ``value`` is among ``choices``; the message suggests similar names, see `unknown`."""
    choices = list(choices)
    if value not in choices:
        raise ValueError(unknown(name, value, choices, likeness))


def unknown(kind: str, value: str, choices: Iterable[str], likeness: float = _LIKENESS) -> str:
    """Return the message for an unknown name, with suggestions of similar names.

    Args:
        kind: kind of the named object, for the message.
        value: the unknown name.
        choices: the valid names.
        likeness: least similarity, from 0 to 1, of a suggested name. Abbreviations need a higher value, since they
            share letters by chance ("mcmc" and "pmmh").
    """
    choices = list(choices)
    return f"unknown {kind} {value!r}.{nearest(value, choices, likeness)} Known: {', '.join(choices) or 'none'}."


def nearest(value: str, choices: Sequence[str], likeness: float = _LIKENESS) -> str:
    """Return " Did you mean ...?" with the most similar choices, or an empty string; see `unknown`."""
    suggestions = difflib.get_close_matches(str(value), choices, n=3, cutoff=likeness)
    return f" Did you mean {' or '.join(map(repr, suggestions))}?" if suggestions else ""


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the singular or plural: "1 column", "2 columns"."""
    return f"{number} {noun}{'s' * (number != 1)}"


def covariance_matrix(name: str, value: Any) -> None:
    """Raise ValueError unless ``value`` is a symmetric, positive semi-definite matrix or a vector of variances."""
    array = _numeric(name, value)
    if array is None:
        return
    finite(name, array)
    if array.ndim == 1:
        if np.any(array < 0):
            index = int(np.argmin(array))
            raise ValueError(f"{name} has a negative variance {array[index]:g} at index {index}; variances are >= 0.")
        return
    if array.ndim != 2 or array.shape[0] != array.shape[1]:
        raise ValueError(f"{name} must be a vector of variances (D,) or a matrix (D, D), got shape {array.shape}.")
    scale = np.abs(array).max(initial=0.0)
    if np.abs(array - array.T).max(initial=0.0) > 1e-8 * scale:
        raise ValueError(f"{name} is not symmetric: the largest |C - C'| is {np.abs(array - array.T).max():g}. "
                         "Use 0.5 * (C + C.T) if the difference is rounding.")
    smallest = np.linalg.eigvalsh(array).min(initial=0.0)
    if smallest < -1e-8 * scale:
        raise ValueError(f"{name} is not positive semi-definite: its smallest eigenvalue is {smallest:g}.")


def _numeric(name: str, value: Any) -> np.ndarray | None:
    refuse_dates(name, value)
    array = concrete(value)
    if array is not None and array.dtype.kind not in "biuf":
        text = " ".join(repr(value).split())
        raise TypeError(f"{name} must be numeric, got {text} of type {type(value).__name__}.")
    return array


def _message(name: str, expected: str, got: Any, remedy: str) -> str:
    # A matrix in one line.
    text = " ".join(np.array2string(np.asarray(got), threshold=6, precision=6).split()) if np.ndim(got) else (
        f"{got:.6g}" if isinstance(got, (float, np.floating)) else str(got))
    return f"{name} must be {expected}, got {text}. {remedy}".strip()
