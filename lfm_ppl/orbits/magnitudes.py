"""Magnitudes of the small forces: a vector of logarithms, its prior, and the resulting forces."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.forces import Force
from lfm_ppl.orbits.satellite import HARMONICS, small_forces

_SUNLIGHT = 10.0
"""Standard deviation of the sunlight's acceleration (nm/s^2), which positions determine much better."""
_LEAST_SD = 0.5
"""Smallest standard deviation of the logarithms, if estimated from a few satellites."""
FEW = 5
"""Least number of satellites for an estimated prior."""
# Median, and standard deviation of the logarithm, in nm/s^2 and hours; amplitudes are divided by n.
_LEVEL, _DRIFT, _AMPLITUDE, _SHARE, _WHITE = (1.0, 2.0), (1e-3, 2.0), (0.1, 1.5), (0.01, 2.0), (0.01, 2.0)


class Prior(NamedTuple):
    """A normal prior of the logarithms, independent: mean (d,) and standard deviation (d,)."""

    mean: np.ndarray
    sd: np.ndarray


def names(axes: str) -> tuple[str, ...]:
    """Return the names of the entries.

    Example:
        >>> names("DYB")[:3], len(names("DYB"))
        (('level of panel', 'level of remaining', 'drift of solar'), 21)
    """
    return tuple(name for name, _ in _entries(axes))


def wide(axes: str) -> Prior:
    """Return the prior without data."""
    entries = [entries for _, entries in _entries(axes)]
    return Prior(np.log([median for median, _ in entries]), np.array([sd for _, sd in entries]))


def common(learnt: list[np.ndarray], axes: str) -> Prior:
    """Return the prior from several satellites, the predicted one included: mean and scatter.

    Args:
        learnt: vectors (d,), one per satellite; fewer than `FEW` give the wide prior.
        axes: axes of the small forces.
    """
    if len(learnt) < FEW:
        return wide(axes)
    return Prior(np.mean(learnt, axis=0), np.maximum(np.std(learnt, axis=0), _LEAST_SD))


def _entries(axes: str) -> Iterator[tuple[str, tuple[float, float]]]:
    harmonics = HARMONICS[axes]
    for name in harmonics:
        if name != "solar":
            yield f"level of {name}", _LEVEL
    for name in harmonics:
        yield f"drift of {name}", _DRIFT
    for name, multiples in harmonics.items():
        for n in multiples:
            yield f"amplitude of {name} {n}", (_AMPLITUDE[0] / n, _AMPLITUDE[1])
    for name in harmonics:
        yield f"wander of {name} over amplitude", _SHARE
    yield "white", _WHITE


def forces(logarithms: jax.Array, axes: str, period: Any) -> tuple[dict[str, Force], jax.Array]:
    """Return the small forces, and the dispersion of white noise; the logarithms (d,) may be traced.

    Args:
        logarithms: (d,) of the magnitudes.
        axes: of the small forces.
        period: of the orbit (h).
    """
    value = dict(zip(names(axes), jnp.exp(logarithms), strict=True))
    harmonics = HARMONICS[axes]
    amplitude = {name: [value[f"amplitude of {name} {n}"] for n in multiples] for name, multiples in harmonics.items()}
    wander = {name: [value[f"wander of {name} over amplitude"] * size for size in sizes]
              for name, sizes in amplitude.items()}
    level: dict[str, Any] = {"solar": _SUNLIGHT} | {
        name: value[f"level of {name}"] for name in harmonics if name != "solar"}
    drift = {name: value[f"drift of {name}"] for name in harmonics}
    return small_forces(axes, amplitude, wander, drift, level, period=period), value["white"]
