"""A climate with two regimes that change abruptly, and an unexplained drift within them.

The oxygen isotopes of Greenland's ice are a measure of temperature. In the last glacial they jumped often between a
cold regime (stadials) and a warm one (interstadials). The regime r(t) is a Markov chain in continuous time, and the
isotopes x relax to its level, which an unexplained drift u shifts:

    x' = rate (level_r + u(t) - x),    level_cold = level,    level_warm = level + difference,
    p(r(t + dt) = warm | r(t) = cold) = to_warm dt,    p(r(t + dt) = cold | r(t) = warm) = to_cold dt,
    y_k = x(t_k) + e_k,    e_k ~ N(0, noise_sd^2).

The drift is a Gaussian process with a Matern-1/2 covariance. The regime is constant between two observations. The
difference is positive, so that the regimes cannot exchange their names. The likelihood merges the states of the regimes
by their moments.

A data file has the columns time (kyr) and d18O. Time runs forward: it is minus the age before present.

Sources: North Greenland Ice Core Project members, High-resolution record of Northern Hemisphere climate extending into
the last interglacial period, Nature 431 (2004); P. D. Ditlevsen, Observation of alpha-stable noise induced millennial
climate changes from an ice-core record, Geophysical Research Letters 26 (1999), for jumps between two levels.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("d18O",)
UNITS = {"time": "kyr", "d18O": "permille", "isotopes": "permille", "drift": "permille"}
OPTIONS: dict[str, Any] = {}
PARAMETERS = {
    "level": "level of the isotopes in the cold regime (permille)",
    "difference": "level of the warm regime above it (permille)",
    "rate": "rate at which the isotopes approach the level (1/kyr)",
    "to_warm": "rate of the transitions from cold to warm (1/kyr)",
    "to_cold": "rate of the transitions from warm to cold (1/kyr)",
    "scale": "standard deviation of the drift (permille)",
    "lengthscale": "lengthscale of the drift (kyr)",
    "noise_sd": "standard deviation of an observation (permille)",
}
TRUTH = {"level": -43.0, "difference": 3.0, "rate": 15.0, "to_warm": 0.6, "to_cold": 0.8, "scale": 0.8,
         "lengthscale": 2.0, "noise_sd": 0.5}
TIMES = np.arange(-200, 1) / 10.0  # of the default data (kyr)
START_SD = 3.0  # of the isotopes at the first time, about the level of each regime (permille)


def build(level, rate, scale, lengthscale, noise_sd, units=None) -> lfm.LatentForceModel:
    """Return the climate of one regime, with its level."""
    return lfm.LatentForceModel(
        dynamics=lambda x, u, t: rate * (level + u - x),
        forces={"drift": lfm.Matern(scale=scale, lengthscale=lengthscale, order=0)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, sd=noise_sd),
        initial_state=lfm.Gaussian(jnp.reshape(level, (1,)), START_SD**2 * jnp.eye(1)),
        state_names=("isotopes",),
        output_names=OUTPUTS,
        units=units,
    )


def switching(times, level, difference, rate, to_warm, to_cold, scale, lengthscale, noise_sd,
              units=None) -> lfm.Switching:
    """Return the distribution of the isotopes at these times; the first regime is that of a long past."""
    climate = functools.partial(build, rate=rate, scale=scale, lengthscale=lengthscale, noise_sd=noise_sd, units=units)
    return lfm.Switching(
        {"cold": climate(level), "warm": climate(level + difference)},
        rates=jnp.array([[0.0, to_warm], [to_cold, 0.0]]),
        times=times,
        initial=jnp.array([to_cold, to_warm]) / (to_cold + to_warm),
    )


def model(times, y=None, units=None) -> None:
    """Sample levels, rates and drift, and score the isotopes.

    Args:
        times: kyr, shape (T,), which increase towards the present.
        y: isotopes (permille), shape (T, 1); NaN is missing, None draws from the prior predictive.
        units: name -> unit, for plots.
    """

    def positive(name, median, spread):
        return numpyro.sample(name, dist.LogNormal(jnp.log(median), spread))

    parameters = {
        "level": numpyro.sample("level", dist.Normal(-42.0, 4.0)),
        "difference": positive("difference", 4.0, 0.4),
        "rate": positive("rate", 15.0, 0.7),
        "to_warm": positive("to_warm", 0.5, 0.8),
        "to_cold": positive("to_cold", 0.5, 0.8),
        "scale": positive("scale", 0.7, 0.7),
        "lengthscale": positive("lengthscale", 2.0, 0.7),
        "noise_sd": positive("noise_sd", 0.5, 0.7),
    }
    numpyro.sample("y", switching(times, **parameters, units=units), obs=y)


def simulate(seed: int = 0) -> lfm.Data:
    """Simulate 20 kyr with an observation every 0.1 kyr."""
    states, y = _simulator()(jax.random.key(seed))
    return lfm.Data(
        times=TIMES,
        y=np.asarray(y),
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": TIMES, "forces": {"drift": states[:, 3]}, "state": states[:, :3], "parameters": TRUTH},
    )


@functools.cache
def _simulator():
    """Return the simulator, compiled once for all seeds."""
    return jax.jit(switching(TIMES, **TRUTH).simulate)
