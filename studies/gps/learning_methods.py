"""Comparison of methods that learn the magnitudes of the small forces, on one satellite with one prior."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import xarray as xr
from numpyro.infer import init_to_value

import lfm_ppl as lfm
from lfm_ppl import orbits
from lfm_ppl.orbits import learning, prediction, training
from lfm_ppl.orbits.arc import Arc
from lfm_ppl.orbits.frames import rtn_along
from lfm_ppl.orbits.learning import DRAWS
from lfm_ppl.orbits.magnitudes import Prior
from lfm_ppl.orbits.training import Regression, Training
from lfm_ppl.parallel.task import Result, Task

from .. import chains
from ..datasets import DATASET, Column, number, row
from .figures import METRE
from .satellite import restore_training

METHODS = ("held out, averaged", "held out, mode", "marginal likelihood, mode", "marginal likelihood, posterior",
           "smoothed forces, mode")
_WARMUP, _SAMPLES = 1_000, 1_000


def compare(arc: Arc, task: Task) -> Result:
    """Return error (km) after training and coverage of every method, (W,) each, and logarithms of magnitudes."""
    orbit, data, prior = restore_training(arc, task)
    directions = rtn_along(orbits.propagate(arc.environment, orbit, arc.times))
    neighbourhood = prediction.surroundings(arc, orbit, data.axes)
    target = learning.held_out(data, prior)
    mode = target.mode()
    likelihood = learning.likelihood(data, prior).mode()
    smoothed = learning.smoothed_forces(data, prior).mode()
    vectors = (target.draws(mode, DRAWS), mode[None], likelihood[None],
               _posterior(data, prior, likelihood, task.key), smoothed[None])
    errors, coverage = [], []
    for vector in vectors:
        error, _, covered = prediction.judge(arc, prediction.predict(arc, neighbourhood, vector), directions)
        errors.append(np.sqrt(np.nanmean((error[arc.train:] ** 2).sum(axis=1))))
        coverage.append(covered.mean())
    return {"error": np.array(errors), "coverage": np.array(coverage),
            "logarithms": np.array([vector.mean(axis=0) for vector in vectors])}


def _posterior(data: Training, prior: Prior, start: np.ndarray, key: jax.Array) -> np.ndarray:
    """Return draws (DRAWS, d) from the posterior of the logarithms given all training positions, by RAM."""
    def model(regression: Regression) -> None:
        logarithms = numpyro.sample("logarithms", dist.Normal(prior.mean, prior.sd).to_event(1))
        numpyro.factor("positions", training.log_likelihood(logarithms, regression, data.axes))

    strategy = init_to_value(values={"logarithms": jnp.asarray(start)})
    kernel = lfm.RAM(model, initial_covariance=(0.1 * prior.sd) ** 2, init_strategy=strategy)
    chain = chains.sampler(kernel, 1, _WARMUP, _SAMPLES)
    chain.run(key, data.regression)
    return np.asarray(chain.get_samples()["logarithms"])[::_SAMPLES // DRAWS][:DRAWS]


def method_rows(dataset: xr.Dataset) -> dict[str, Any]:
    """Return one row for each learning method: means over satellites of error (m) and coverage."""
    columns: dict[str, Column] = {
        "satellites": lambda results: results.sizes[DATASET], "error": lambda results: results.error / METRE,
        "median": lambda results: number(np.median, results.error / METRE), "coverage": "coverage"}
    dataset = dataset.rename(satellite=DATASET)
    return {method: row(dataset.isel(method=index), columns) for index, method in enumerate(METHODS)}
