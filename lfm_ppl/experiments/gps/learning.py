"""Ways to choose the magnitudes of the small forces, compared on the same satellite.

Published positions are smoothed by a dynamic model, so that they scatter far less than they are wrong, and the
marginal likelihood of positions has the forces explain what is left. The alternatives to holding out positions are
the marginal likelihood itself, its posterior average, and what the source does: smooth the forces with a Matern model
first, and learn the resonators on these.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy.special import logsumexp

from lfm_ppl import orbits
from lfm_ppl.experiments.gps import prediction, problem
from lfm_ppl.experiments.gps.figures import METRE
from lfm_ppl.experiments.gps.prediction import Arc, Deterministic
from lfm_ppl.experiments.gps.problem import CANDIDATES, NOISE, Magnitudes
from lfm_ppl.experiments.scores import mean_of, pair
from lfm_ppl.experiments.tasks import Result
from lfm_ppl.filtering.filter import filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.forces import Matern
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import Gaussian, GaussianObservation

WAYS = ("held out", "marginal likelihood", "posterior average", "smoothed forces")
_SCALE, _LENGTHSCALE = 2.0, 3.0
"""Of the Matern model that smooths the forces: nm/s^2, hours."""
_KEPT = 1e-3
_THINNED = 4


def compare(one: Arc, paths: Deterministic, axes: str) -> Result:
    """Return error (km) after training and coverage of every way, each (W,), and the candidates that were chosen."""
    orbit, frame = paths.orbit, problem.axes_of(paths.fitted)
    validation = prediction.validate(one, orbit, axes)
    likelihood = prediction.likelihoods(one, orbit, axes)
    smoothed = _on_smoothed_forces(one, orbit, axes)
    weights = np.exp(likelihood - logsumexp(likelihood))
    mixtures = [_only(np.argmax(validation.score)), _only(np.argmax(likelihood)),
                {int(k): float(weights[k]) for k in np.flatnonzero(weights > _KEPT)}, _only(np.argmax(smoothed))]
    found = {index: prediction.predict(one, orbit, CANDIDATES[index], axes)
             for index in sorted({index for mixture in mixtures for index in mixture})}
    errors, coverage = [], []
    for mixture in mixtures:
        total = sum(mixture.values())
        mean = np.sum([w / total * found[k].state[:, :3] for k, w in mixture.items()], axis=0)
        covariance = np.zeros((len(one.times), 3, 3))
        for k, w in mixture.items():
            away = found[k].state[:, :3] - mean
            covariance += w / total * (found[k].covariance + away[:, :, None] * away[:, None, :])
        left, _, covered = prediction.judge(one, mean, covariance, frame)
        errors.append(np.sqrt(np.nanmean((left[one.train:] ** 2).sum(axis=1))))
        coverage.append(covered.mean())
    return {"error": np.array(errors), "coverage": np.array(coverage), "score": validation.score,
            "likelihood": likelihood, "smoothed": smoothed,
            "candidates": np.array([max(mixture, key=mixture.__getitem__) for mixture in mixtures])}


def _only(index: Any) -> dict[int, float]:
    return {int(index): 1.0}


def _on_smoothed_forces(one: Arc, orbit: orbits.Orbit, axes: str) -> np.ndarray:
    """Return the log likelihood of each candidate (C,) where the smoothed forces are its data, as in the source."""
    steps = prediction.steps_of(one)
    times = tuple(one.times[:one.train])
    mean, sd = map(np.asarray, _smooth_forces(one.environment, orbits.wide_start(orbit.state),
                                              jnp.asarray(one.positions[:one.train]), (times, axes, steps)))
    # Neighbouring values of a smoothed force say much the same; one an hour stands for them.
    magnitudes = Magnitudes(*jnp.asarray(CANDIDATES, float).T)
    return np.asarray(_score_forces(jnp.asarray(mean[::_THINNED]), jnp.asarray(sd[::_THINNED]), magnitudes,
                                    (times[::_THINNED], axes)))


@functools.partial(jax.jit, static_argnums=(3,))
def _smooth_forces(environment: orbits.Environment, start: Gaussian, y: jax.Array, fixed: tuple
                   ) -> tuple[jax.Array, jax.Array]:
    times, axes, steps = fixed
    names = orbits.small_forces(axes)
    forces = {name: Matern(_SCALE, _LENGTHSCALE, mean=orbits.SOLAR_PRESSURE if name == "solar" else 0.0)
              for name in names}
    system = orbits.satellite(environment, start, forces, axes, noise_sd=NOISE)
    found = smooth(system, np.array(times), y, rule=Taylor(), steps=steps)
    return found.input_mean[:, 6:], jnp.sqrt(jnp.diagonal(found.input_covariance, axis1=1, axis2=2)[:, 6:])


@functools.partial(jax.jit, static_argnums=(3,))
def _score_forces(mean: jax.Array, sd: jax.Array, magnitudes: Magnitudes, fixed: tuple) -> jax.Array:
    times, axes = fixed

    def score(one: Magnitudes) -> jax.Array:
        forces = orbits.small_forces(axes, one.amplitude, one.wander, one.drift)
        count = len(forces)
        errors = jax.vmap(jnp.diag)(sd**2 + one.white**2)
        system = LatentForceModel(lambda x, u, t: jnp.zeros(1), forces,
                                  GaussianObservation(lambda x, u, t: u[:count], errors),
                                  Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))
        return filter(system, np.array(times), mean, steps=1).log_likelihood.sum()

    return jax.lax.map(score, magnitudes)


def table(results: dict[str, Result]) -> pd.DataFrame:
    """Return one row a way to choose: means over satellites of error (m) and coverage."""
    if not results:
        return pd.DataFrame()
    rows = {}
    for index, way in enumerate(WAYS):
        errors = [result["error"][index] / METRE for result in results.values()]
        rows[way] = {"satellites": len(errors), **pair("error", mean_of(errors)), "median": float(np.median(errors)),
                     **pair("coverage", mean_of([result["coverage"][index] for result in results.values()]))}
    return pd.DataFrame.from_dict(rows, orient="index")
