"""Counts of events with an unknown rate: a log-Gaussian Cox process.

The number of events in a bin of width w about the time t_k is

    rate(t) = exp(level + u(t)),    y_k ~ Poisson(w rate(t_k)),

with u a Gaussian process of mean zero, Matern-5/2 covariance, standard deviation `scale` and lengthscale `lengthscale`.
The model has no dynamics: the observation depends on the force alone. The likelihood is approximated by expectation
propagation.

Times are the midpoints of the bins. All bins have the width `width`, by default the median distance between times. The
function `count` converts dates of events to counts. The default data are simulated: 112 one-year bins, with about two
events per year at first and fewer later, like the disasters in British coal mines with ten deaths or more.

Sources: R. G. Jarrett, A note on the intervals between coal-mining disasters, Biometrika 66 (1979); J. Moller,
A. R. Syversveen and R. P. Waagepetersen, Log Gaussian Cox processes, Scandinavian Journal of Statistics 25 (1998).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("disasters",)
UNITS = {"time": "year"}
OPTIONS = {"width": (0.0, float, "width of a bin (year); 0: the median distance between two times")}
PARAMETERS = {
    "level": "mean of the logarithm of the rate (log(1/year))",
    "scale": "standard deviation of the logarithm of the rate about its mean (1)",
    "lengthscale": "lengthscale of the logarithm of the rate (year)",
}
TRUTH = {"level": 0.4, "scale": 0.8, "lengthscale": 25.0}


def count(dates, first: float, last: float, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Count events in bins of equal width.

    Args:
        dates: dates of the events (years).
        first: start of the first bin.
        last: end of the last bin.
        bins: number of bins.

    Returns:
        Midpoints of the bins (bins,), and counts (bins, 1).
    """
    counts, edges = np.histogram(np.asarray(dates, float), bins, (first, last))
    return 0.5 * (edges[:-1] + edges[1:]), counts[:, None].astype(float)


def build(level, scale, lengthscale, width, units=None) -> lfm.LatentForceModel:
    """Return the process with these parameters, for bins of a common width, or of widths (T, 1)."""
    return lfm.LatentForceModel(
        dynamics=lambda x, u, t: jnp.zeros(0),
        forces={"log rate": lfm.Matern(scale=scale, lengthscale=lengthscale, order=2)},
        observation=lfm.PoissonObservation(lambda x, u, t: level + u, exposure=width),
        initial_state=lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))),
        output_names=OUTPUTS,
        units=units,
    )


def _usual_distance(times) -> float:
    """Return the median distance between different times; 1 if there is only one time."""
    gaps = np.diff(times)
    return float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 1.0


def model(times, y=None, width: float = 0.0, units=None) -> None:
    """Sample the parameters of the rate, and score the counts.

    Args:
        times: midpoints of the bins, shape (T,).
        y: counts, shape (T, 1); NaN is missing, None draws from the prior predictive.
        width: width of the bins; 0: the median distance between times.
        units: name -> unit, for plots.
    """
    if width < 0:
        raise ValueError(f"width must be zero or positive, got {width:g}.")
    level = numpyro.sample("level", dist.Normal(0.0, 1.5))
    scale = numpyro.sample("scale", dist.LogNormal(-0.3, 0.6))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(3.0, 0.7))
    system = build(level, scale, lengthscale, width or _usual_distance(times), units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def simulate(seed: int = 0, width: float = 0.0) -> lfm.Data:
    """Simulate counts of 112 bins of a year, from 1851 on."""
    width = width or 1.0
    times = 1851.0 + width * (0.5 + np.arange(112))
    simulation = lfm.simulate(jax.random.key(seed), build(**TRUTH, width=width), times)
    return lfm.Data(
        times=times,
        y=np.asarray(simulation.y),
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": times, "forces": simulation.forces, "state": simulation.state, "parameters": TRUTH},
    )
