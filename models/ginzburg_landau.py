"""Ginzburg-Landau: diffusion in a double-well potential, no latent force.

The state x follows the stochastic differential equation

    dx = -(alpha x + beta x^3) dt + sigma dB,        y_k = x(t_k) + e_k,    e_k ~ N(0, noise_sd^2),

whose potential alpha x^2 / 2 + beta x^4 / 4 has two minima, at +-sqrt(-alpha / beta), where alpha
is negative. The unknown parameters are alpha, beta and sigma; the standard deviation of the
observation noise is known, as in the source. What is sampled is sigma, alpha / sigma^2 and
beta / sigma^2: the latter two are the shape of the stationary density exp(-(2 alpha x^2 + beta x^4)
/ (2 sigma^2)) and sigma the speed of time, and the data tell them apart much better than alpha and
beta, which follow. The default data are simulated with alpha = -1,
beta = 0.1 and sigma = 2: the state starts in the right well, at 3.16, is observed every 2 units of
time, and jumps between the wells.

The priors, alpha ~ N(0, 1), beta ~ LogNormal(-2, 0.8) and sigma ~ LogNormal(0.5, 0.5), are for
states of a few units that move within a few units of time: rescale data of another size. They are
narrow enough to say that the state relaxes between observations at a rate of order one. Without
them the data would not: when the relaxation is fast, observations are independent draws from the
stationary density, and only alpha / sigma^2 and beta / sigma^2 are identified.

The prior of the state at the first observation is N(0, 10), the width of the stationary density.

Sources: J. Hartikainen, Sequential Inference for Latent Temporal Gaussian Process Models (2013),
section 2.7.1; H. Singer, Parameter estimation of nonlinear stochastic differential equations,
Journal of Computational and Graphical Statistics 11 (2002).
"""

from __future__ import annotations

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
STEPS = 40  # between observations: after one that lies outside the wells, the mean moves fast


def build(alpha, beta, sigma, noise_sd, start=None) -> lfm.LatentForceModel:
    """Return the double well with these parameters.

    Args:
        alpha: linear coefficient of the drift (1/time).
        beta: cubic coefficient of the drift (1/(time x^2)).
        sigma: dispersion (x/sqrt(time)).
        noise_sd: standard deviation of the observation noise.
        start: the initial state where it is known; None: N(0, 10).
    """
    unknown = start is None
    return lfm.LatentForceModel(
        dynamics=lambda x, u, t: -(alpha * x + beta * x**3),
        forces={},
        process_noise=sigma * jnp.ones((1, 1)),
        observation=lfm.GaussianObservation(lambda x, u, t: x, noise_sd**2 * jnp.ones(1)),
        initial_state=lfm.Gaussian([0.0 if unknown else start], [10.0 if unknown else 0.0]),
        state_names=("x",),
        output_names=OUTPUTS,
    )


def model(times, y=None, noise_sd: float = 0.1) -> None:
    """Sample alpha, beta and sigma, and score the observations.

    Args:
        times: observation times, shape (T,).
        y: observations of x, shape (T, 1); NaN is missing, None draws from the prior predictive.
        noise_sd: standard deviation of the observation noise.
    """
    sigma = numpyro.sample("sigma", dist.LogNormal(0.5, 0.5))
    linear = numpyro.sample("linear", dist.Normal(0.0, 0.5))
    cubic = numpyro.sample("cubic", dist.LogNormal(-3.0, 1.0))
    alpha = numpyro.deterministic("alpha", linear * sigma**2)
    beta = numpyro.deterministic("beta", cubic * sigma**2)
    system = build(alpha, beta, sigma, noise_sd)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=STEPS), obs=y)


def simulate(seed: int = 2, noise_sd: float = 0.1) -> lfm.Data:
    """Simulate t in [0, 50] with the source's parameters, observed every 2 units of time.

    Args:
        seed: of the path and the noise; with the default one it visits both wells several times.
        noise_sd: standard deviation of the observation noise.
    """
    grid = np.linspace(0.0, 50.0, 501)
    observed = np.arange(0, 501, 20)
    system = build(**TRUTH, noise_sd=noise_sd, start=np.sqrt(10.0))
    drawn = lfm.simulate(jax.random.key(seed), system, grid, steps=10)
    return lfm.Data(
        times=grid[observed],
        y=np.asarray(drawn.y)[observed],
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": grid, "forces": {}, "state": drawn.state, "parameters": _true_parameters()},
    )


def _true_parameters() -> dict[str, float]:
    square = TRUTH["sigma"] ** 2
    return {**TRUTH, "linear": TRUTH["alpha"] / square, "cubic": TRUTH["beta"] / square}
