"""Ways to learn the magnitudes of the small forces, compared on the same satellite with the same prior."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
from numpyro.infer import MCMC, init_to_value

from lfm_ppl import orbits
from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.gps import learning, magnitudes, prediction, problem, training
from lfm_ppl.experiments.gps.figures import METRE
from lfm_ppl.experiments.gps.learning import DRAWS, Target
from lfm_ppl.experiments.gps.magnitudes import Prior
from lfm_ppl.experiments.gps.problem import NOISE, Arc
from lfm_ppl.experiments.gps.training import Regression, Training, steps_of
from lfm_ppl.experiments.scores import mean_of, pair
from lfm_ppl.filtering.filter import filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.forces import Matern
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation

WAYS = ("held out, averaged", "held out, mode", "marginal likelihood, mode", "marginal likelihood, posterior",
        "smoothed forces, mode")
_SCALE, _LENGTHSCALE = 2.0, 3.0
"""Of the Matern model that smooths the forces: nm/s^2, hours."""
_APART = 1.0
"""Hours between the values of a smoothed force that count: neighbours say much the same."""
_WARMUP, _SAMPLES = 1_000, 1_000


def compare(one: Arc, paths: prediction.Deterministic, axes: str, prior: Prior, key: jax.Array) -> Result:
    """Return error (km) after training and coverage of every way, each (W,)."""
    frame = problem.axes_of(paths.fitted)
    near = prediction.surroundings(one, paths.orbit, axes)
    data = Training.of(one, paths.orbit, axes)
    target = learning.held_out(data, prior)
    mode = target.mode()
    likelihood = learning.likelihood(data, prior).mode()
    smoothed = Target(_of_smoothed_forces(data), prior).mode()
    vectors = (target.draws(mode, DRAWS), mode[None], likelihood[None], _posterior(data, prior, likelihood, key),
               smoothed[None])
    errors, coverage = [], []
    for vector in vectors:
        found = prediction.predict(one, near, vector)
        left, _, covered = prediction.judge(one, found.state[:, :3], found.covariance, frame)
        errors.append(np.sqrt(np.nanmean((left[one.train:] ** 2).sum(axis=1))))
        coverage.append(covered.mean())
    return {"error": np.array(errors), "coverage": np.array(coverage),
            "logarithms": np.array([vector.mean(axis=0) for vector in vectors])}


def _posterior(data: Training, prior: Prior, start: np.ndarray, key: jax.Array) -> np.ndarray:
    """Return draws (DRAWS, d) of the posterior of the logarithms given all positions of training, by RAM."""
    def model(known: Regression) -> None:
        logarithms = numpyro.sample("logarithms", dist.Normal(prior.mean, prior.sd).to_event(1))
        numpyro.factor("positions", training.log_likelihood(logarithms, known, data.axes))

    strategy = init_to_value(values={"logarithms": jnp.asarray(start)})
    kernel = RAM(model, initial_covariance=(0.1 * prior.sd) ** 2, init_strategy=strategy)
    chain = MCMC(kernel, num_warmup=_WARMUP, num_samples=_SAMPLES, progress_bar=False)
    chain.run(key, data.regression)
    return np.asarray(chain.get_samples()["logarithms"])[::_SAMPLES // DRAWS][:DRAWS]


def _of_smoothed_forces(data: Training) -> Callable[[np.ndarray], tuple[float, np.ndarray]]:
    """Return the log likelihood of the logarithms where forces that a Matern model smooths are the data."""
    thin = max(1, int(round(_APART / (data.times[1] - data.times[0]))))
    mean, sd = _smooth_forces(data.near, jnp.asarray(data.y), (tuple(data.times), data.axes))
    fixed = tuple(data.times[::thin]), data.axes

    def evidence(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = _score_forces(jnp.asarray(logarithms), mean[::thin], sd[::thin], data.near.period, fixed)
        return float(value), np.asarray(gradient)

    return evidence


@functools.partial(jax.jit, static_argnums=(2,))
def _smooth_forces(near: orbits.Neighbourhood, y: jax.Array, fixed: tuple) -> tuple[jax.Array, jax.Array]:
    times, axes = np.array(fixed[0]), fixed[1]
    forces = {name: Matern(_SCALE, _LENGTHSCALE, mean=orbits.SOLAR_PRESSURE if name == "solar" else 0.0)
              for name in orbits.small_forces(axes)}
    found = smooth(orbits.departure(near, forces, noise_sd=NOISE), times, y, rule=Taylor(),
                   steps=steps_of(times))
    return found.input_mean[:, 6:], jnp.sqrt(jnp.diagonal(found.input_covariance, axis1=1, axis2=2)[:, 6:])


@functools.partial(jax.jit, static_argnums=(4,))
@jax.value_and_grad
def _score_forces(logarithms: jax.Array, mean: jax.Array, sd: jax.Array, period: jax.Array, fixed: tuple
                  ) -> jax.Array:
    times, axes = np.array(fixed[0]), fixed[1]
    forces, white = magnitudes.forces(logarithms, axes, period)
    # A value stands for some time, over which white noise averages.
    errors = jax.vmap(jnp.diag)(sd**2 + white**2 / _APART)
    system = LatentForceModel(lambda x, u, t: jnp.zeros(1), forces, GaussianObservation(lambda x, u, t: u, errors),
                              Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))
    return filter(system, times, mean, steps=1).log_likelihood.sum()


def table(results: dict[str, Result]) -> pd.DataFrame:
    """Return one row a way to learn: means over satellites of error (m) and coverage."""
    if not results:
        return pd.DataFrame()
    rows = {}
    for index, way in enumerate(WAYS):
        errors = [result["error"][index] / METRE for result in results.values()]
        rows[way] = {"satellites": len(errors), **pair("error", mean_of(errors)), "median": float(np.median(errors)),
                     **pair("coverage", mean_of([result["coverage"][index] for result in results.values()]))}
    return pd.DataFrame.from_dict(rows, orient="index")
