"""Settings of the factors, and of the search for their fixed point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from lfm_ppl.utils import checks

METHODS = ("ep", "variational", "laplace")


class FactorSettings(NamedTuple):
    """How factors are refined; hashable, so that it can be a static argument of compiled code.

    Attributes:
        method: "ep", "variational" or "laplace".
        power: a of power EP, in (0, 1].
        damping: fraction of each new factor that is taken at first; it is halved where changes grow.
        sweeps: largest number of sweeps.
        relinearisations: sweeps in which the factors and the points of linearisation are refined together, before the
            points are held fixed; for non-linear models.
    """

    method: str = "ep"
    power: float = 1.0
    damping: float = 1.0
    sweeps: int = 200
    relinearisations: int = 8


@dataclass(frozen=True)
class FixedPointOptions:
    """Constants of the fixed-point iteration.

    Changes of a factor are measured in units of its marginal: nu times the standard deviation, tau times the variance.

    Attributes:
        tolerance: largest change of a converged factor.
        memory: sweeps that Anderson's acceleration uses; more do not save sweeps.
        coarse_change: change above which the first sweeps use a coarse quadrature.
        coarse_sweeps: largest number of such sweeps.
        growing_sweeps: first sweeps, in which changes may grow.
        linear_change: change below which the map of a sweep is nearly linear, and its steps are accelerated.
        sweeps_without_cavity: sweeps without any valid cavity after which the search restarts from empty factors.
        patience: sweeps after which the damping grows while changes are large.
        smallest_fraction: damped fraction below which the search ends.
    """

    tolerance: float = 1e-8
    memory: int = 3
    coarse_change: float = 5e-8
    coarse_sweeps: int = 12
    growing_sweeps: int = 4
    linear_change: float = 0.5
    sweeps_without_cavity: int = 3
    patience: int = 12
    smallest_fraction: float = 1e-4


def as_settings(factors: Any, iterations: int = 0) -> FactorSettings:
    """Return the settings of the factors.

    Args:
        factors: settings, the name of a method, or None for expectation propagation.
        iterations: number of posterior linearisations, the joint sweeps of a non-linear model; 0: that of the settings.

    Raises:
        ValueError, TypeError: an unknown method, or a number out of its range.
    """
    settings = factors if isinstance(factors, FactorSettings) else FactorSettings("ep" if factors is None else factors)
    checks.one_of("method of the factors", settings.method, METHODS)
    for name in ("power", "damping"):
        if not 0.0 < getattr(settings, name) <= 1.0:
            raise ValueError(f"{name} of the factors must lie in (0, 1], got {getattr(settings, name)}.")
    if settings.method != "ep" and settings.power != 1.0:
        raise ValueError(f"power={settings.power} applies to expectation propagation only; leave it out with method "
                         f"{settings.method!r}.")
    checks.positive_integer("sweeps", settings.sweeps)
    checks.positive_integer("relinearisations", settings.relinearisations)
    return settings._replace(relinearisations=iterations) if iterations else settings
