"""Diffusion in a double-well potential (Ginzburg-Landau), no latent force.

The state x follows the stochastic differential equation

    dx = -(alpha x + beta x^3) dt + sigma dB,        y_k = x(t_k) + e_k,    e_k ~ N(0, noise_sd^2),

whose potential alpha x^2 / 2 + beta x^4 / 4 has two minima, at +-sqrt(-alpha / beta), where alpha
is negative. The unknown parameters are alpha, beta and sigma; the standard deviation of the
observation noise is known, as in the source. The default data are simulated with alpha = -1,
beta = 0.1 and sigma = 2: the state starts in the right well, at 3.16, is observed every 2 units of
time, and jumps between the wells.

The sampled parameters are sigma, linear = alpha / sigma^2 and cubic = beta / sigma^2; alpha and beta
follow from them. The stationary density is proportional to exp(-linear x^2 - cubic x^4 / 2), so that
linear and cubic determine its shape, and sigma the time scale. Distant observations are independent
draws from this density: they determine its shape, but give no upper bound on sigma. The prior of
sigma gives this bound: 0.92 to 2.97 with probability 0.95. (For fast diffusions the Gaussian filter
assigns states to wells differently at neighbouring parameters, and NUTS diverges.) The priors are
for states of a few units and observations a few units of time apart; rescale other data.

The prior of the state at the first observation is N(0, 10), the width of the stationary density.

Sources: J. Hartikainen, Sequential Inference for Latent Temporal Gaussian Process Models (2013),
section 2.7.1; H. Singer, Parameter estimation of nonlinear stochastic differential equations,
Journal of Computational and Graphical Statistics 11 (2002).
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

OUTPUTS = ("x",)
UNITS: dict[str, str] = {}
OPTIONS = {"noise_sd": (0.1, float, "standard deviation of the observation noise, known")}
PARAMETERS = {
    "sigma": "dispersion of the Brownian motion, above zero (x/sqrt(time))",
    "linear": "alpha / sigma^2; below zero there are two wells (1/x^2)",
    "cubic": "beta / sigma^2, above zero (1/x^4)",
}
TRUTH = {"alpha": -1.0, "beta": 0.1, "sigma": 2.0}
GRID = np.linspace(0.0, 50.0, 501)
TARGET_ACCEPT = 0.95  # the Gaussian filter's likelihood falls abruptly for fast diffusions in deep wells
TOLERANCE = 5e-3  # of an integration step, in sds: the posterior includes slow and very fast, stiff diffusions
STEPS = 60  # equal steps, for methods without a tolerance: simulation, particles, iterations


def build(alpha, beta, sigma, noise_sd, units=None, start=None) -> lfm.LatentForceModel:
    """Return the double well with these parameters.

    Args:
        alpha: linear coefficient of the drift (1/time).
        beta: cubic coefficient of the drift (1/(time x^2)).
        sigma: dispersion (x/sqrt(time)).
        noise_sd: standard deviation of the observation noise.
        units: name -> unit.
        start: the initial state if it is known; None: N(0, 10).
    """
    is_unknown = start is None
    return lfm.LatentForceModel(
        dynamics=lambda x, u, t: -(alpha * x + beta * x**3),
        forces={},
        process_noise=sigma * jnp.ones((1, 1)),
        observation=lfm.GaussianObservation(lambda x, u, t: x, sd=noise_sd),
        initial_state=lfm.Gaussian([0.0 if is_unknown else start], [10.0 if is_unknown else 0.0]),
        state_names=("x",),
        output_names=OUTPUTS,
        units=units,
    )


def model(times, y=None, noise_sd: float = 0.1, units=None) -> None:
    """Sample alpha, beta and sigma, and score the observations.

    Args:
        times: observation times, shape (T,).
        y: observations of x, shape (T, 1); NaN is missing, None draws from the prior predictive.
        noise_sd: standard deviation of the observation noise.
        units: name -> unit, for plots.
    """
    sigma = numpyro.sample("sigma", dist.LogNormal(0.5, 0.3))
    linear = numpyro.sample("linear", dist.Normal(0.0, 0.5))
    cubic = numpyro.sample("cubic", dist.LogNormal(-3.0, 1.0))
    alpha = numpyro.deterministic("alpha", linear * sigma**2)
    beta = numpyro.deterministic("beta", cubic * sigma**2)
    system = build(alpha, beta, sigma, noise_sd, units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=STEPS, tolerance=TOLERANCE), obs=y)


def simulate(seed: int = 2, noise_sd: float = 0.1) -> lfm.Data:
    """Simulate t in [0, 50] with the source's parameters, observed every 2 units of time.

    Args:
        seed: random seed of path and noise; with the default seed the path visits both wells several times.
        noise_sd: standard deviation of the observation noise.
    """
    simulation = _simulator(float(noise_sd))(jax.random.key(seed))
    observed = np.arange(0, 501, 20)
    return lfm.Data(
        times=GRID[observed],
        y=np.asarray(simulation.y)[observed],
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": GRID, "forces": {}, "state": simulation.state, "parameters": _true_parameters()},
    )


@functools.cache
def _simulator(noise_sd: float) -> Callable[[jax.Array], lfm.Simulation]:
    """Return the simulator, compiled once for all seeds."""
    system = build(**TRUTH, noise_sd=noise_sd, start=np.sqrt(10.0))
    return jax.jit(lambda key: lfm.simulate(key, system, GRID, steps=10))


def _true_parameters() -> dict[str, float]:
    square = TRUTH["sigma"] ** 2
    return {**TRUTH, "linear": TRUTH["alpha"] / square, "cubic": TRUTH["beta"] / square}
