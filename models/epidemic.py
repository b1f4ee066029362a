"""Reported cases of an epidemic with an unknown transmission rate.

In a population of N, the share s is susceptible and the share i infectious. With the transmission rate
beta(t) = r0 recovery exp(u(t)),

    d log s / dt = -beta(t) i,
    d log i / dt = beta(t) s - recovery,
    y_k ~ NB(reporting N beta(t_k) s(t_k) i(t_k) w, concentration),

with u a Gaussian process of mean zero, Matern-3/2 covariance, standard deviation `scale` and lengthscale
`lengthscale`, which represents contacts, weather, masks. This is the SIR model in the logarithms of the shares, so that
Gaussian approximations keep the shares positive, and the logarithm of the expected reports is linear in states and
force. NB is the negative binomial distribution with variance mu + mu^2 / concentration; w is the time that a report
covers, and the rate is evaluated at its middle.

The logarithm of the initial infectious share is N(log(start / N), 1). Reports alone do not identify the share of
reported cases and the size of the population, or the rates of recovery and transmission: `reporting` and `recovery`
are fixed at 0.5 and 0.2 per day unless they are set otherwise or freed, for example by

    lfm-ppl fit epidemic --set recovery=free

Times are the midpoints of the reports. A report covers the time `width`, by default the median distance between times.
The default data are simulated: 60 daily reports.

Sources: W. O. Kermack and A. G. McKendrick, A contribution to the mathematical theory of epidemics, Proc. R. Soc. A 115
(1927); J. Dureau, K. Kalogeropoulos and M. Baguelin, Capturing the time-varying drivers of an epidemic using stochastic
dynamical systems, Biostatistics 14 (2013).
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("cases",)
UNITS = {"time": "day"}
OPTIONS = {
    "population": (100_000.0, float, "size N of the population (persons)"),
    "start": (30.0, float, "infectious persons at the first time, known up to a factor of about three"),
    "width": (0.0, float, "time that a report covers (day); 0: the median distance between times"),
}
PARAMETERS = {
    "r0": "infections by one person in a susceptible population, at the mean transmission (1)",
    "scale": "standard deviation of the logarithm of the transmission rate (1)",
    "lengthscale": "lengthscale of the logarithm of the transmission rate (day)",
    "concentration": "concentration of the reports, whose variance is mu + mu^2 / concentration (1)",
    "recovery": "rate at which infection ends (1/day)",
    "reporting": "share of cases that is reported (1)",
}
KNOWN = {"recovery": 0.2, "reporting": 0.5}
TRUTH = {"r0": 2.0, "scale": 0.3, "lengthscale": 15.0, "concentration": 10.0, **KNOWN}
FORCE = "log transmission"
START_SD = 1.0
DAYS = 60
STEPS = 1
FACTORS = lfm.FactorSettings(relinearisations=2)  # log likelihood within 0.01 of 8 relinearisations or shorter steps


def build(r0, scale, lengthscale, concentration, recovery, reporting, population=100_000.0, start=30.0, width=1.0,
          units=None, observe=None) -> lfm.LatentForceModel:
    """Return the epidemic with these parameters.

    Args:
        r0: see PARAMETERS.
        scale: see PARAMETERS.
        lengthscale: see PARAMETERS.
        concentration: see PARAMETERS.
        recovery: see PARAMETERS.
        reporting: see PARAMETERS.
        population: N.
        start: infectious persons at the first time.
        width: time that a report covers (day).
        units: name -> unit.
        observe: function that maps the function for the logarithm of the expected reports to an observation; None:
            negative binomial counts.
    """
    def dynamics(x, u, t):
        log_s, log_i = x
        log_beta = jnp.log(r0 * recovery) + u[0]
        return jnp.stack([-jnp.exp(log_beta + log_i), jnp.exp(log_beta + log_s) - recovery])

    def log_reports(x, u, t):
        return jnp.log(reporting * population * width * r0 * recovery) + u + x[0] + x[1]

    observe = observe or (lambda function: lfm.NegativeBinomialObservation(function, concentration))
    share = start / population
    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={FORCE: lfm.Matern(scale=scale, lengthscale=lengthscale, order=1)},
        observation=observe(log_reports),
        initial_state=lfm.Gaussian(jnp.array([-share, jnp.log(share)]), jnp.diag(jnp.array([0.0, START_SD**2]))),
        state_names=("log susceptible", "log infectious"),
        output_names=OUTPUTS,
        units=units,
        deterministics={"reproduction number": lambda x, u, t: r0 * jnp.exp(u[0] + x[0])},
    )


def parameters() -> dict[str, jax.Array]:
    """Sample the parameters."""
    priors = {
        "r0": dist.LogNormal(jnp.log(2.0), 0.4),
        "scale": dist.LogNormal(jnp.log(0.3), 0.5),
        "lengthscale": dist.LogNormal(jnp.log(15.0), 0.5),
        "concentration": dist.LogNormal(jnp.log(10.0), 0.7),
        "recovery": dist.LogNormal(jnp.log(KNOWN["recovery"]), 0.3),
        "reporting": dist.Beta(2.0, 2.0),
    }
    return {name: numpyro.sample(name, prior) for name, prior in priors.items()}


def _usual_distance(times) -> float:
    """Return the median distance between different times; 1 if there is only one time."""
    gaps = np.diff(times)
    return float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 1.0


def _check(population: float, start: float, width: float) -> None:
    if not 0 < start < population or width < 0:
        raise ValueError("population must be larger than start, which is positive, and width zero or positive; got "
                         f"population={population:g}, start={start:g}, width={width:g}.")


def model(times, y=None, population: float = 100_000.0, start: float = 30.0, width: float = 0.0, units=None) -> None:
    """Sample the parameters of the epidemic, and score the reports.

    Args:
        times: midpoints of the reports (day), shape (T,).
        y: reported cases, shape (T, 1); NaN is missing, None draws from the prior predictive.
        population: N.
        start: infectious persons at the first time, known up to a factor of about three.
        width: time that a report covers; 0: the median distance between times.
        units: name -> unit, for plots.
    """
    _check(population, start, width)
    width = width or _usual_distance(times)
    system = build(**parameters(), population=population, start=start, width=width, units=units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=STEPS, factors=FACTORS), obs=y)


def anchors(data: lfm.Data) -> dict[str, float]:
    """Return the rate of recovery and the share of reported cases, which are fixed unless they are freed."""
    return dict(KNOWN)


def simulate(seed: int = 0, population: float = 100_000.0, start: float = 30.0, width: float = 0.0) -> lfm.Data:
    """Simulate 60 reports.

    Args:
        seed: random seed of force, initial state and reports.
        population: N.
        start: infectious persons at the first time, known up to a factor of about three.
        width: time that a report covers (day); 0: one day.
    """
    _check(population, start, width)
    width = width or 1.0
    times = width * np.arange(DAYS)
    simulation = _simulator(float(population), float(start), float(width))(jax.random.key(seed))
    return lfm.Data(
        times=times,
        y=np.asarray(simulation.y),
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": times, "forces": simulation.forces, "state": simulation.state, "parameters": TRUTH},
    )


@functools.cache
def _simulator(population: float, start: float, width: float) -> Callable[[jax.Array], lfm.Simulation]:
    """Return the simulator, compiled once for all seeds."""
    system = build(**TRUTH, population=population, start=start, width=width)
    return jax.jit(lambda key: lfm.simulate(key, system, width * np.arange(DAYS), steps=10))
