"""Data simulated from a model whose measurements are counts, with what serves the target on reentry, too."""

import dataclasses
import pickle

import jax.numpy as jnp
import numpy as np
import pytest

from lfm_ppl.experiments.ballistic import experiment
from lfm_ppl.experiments.ballistic.problem import TARGETS
from lfm_ppl.experiments.scores import Z
from lfm_ppl.experiments.simulated import parameters, states
from lfm_ppl.experiments.simulated.problem import (
    SimulationProblem,
    model_file,
    simulate_record,
    simulate_record_from_prior,
    true_likelihood,
    true_z,
)
from lfm_ppl.io import loading
from lfm_ppl.parallel.task import Task

EPIDEMICS = SimulationProblem("epidemic", ("r0", "scale", "lengthscale", "concentration"), ("log transmission",), ("",),
                    medians=(2.0, 0.3, 15.0, 10.0), steps=10)


@pytest.mark.slow
def test_a_record_is_what_the_model_simulates():
    file = loading.load("epidemic")
    one, data = simulate_record(EPIDEMICS, 1), file.simulate(seed=1)
    at = np.isin(data.truth["times"], data.times)
    np.testing.assert_array_equal(one.y, data.y)
    np.testing.assert_array_equal(one.paths[0], np.asarray(data.truth["forces"]["log transmission"])[at])
    assert np.exp(one.z) == pytest.approx([2.0, 0.3, 15.0, 10.0])
    np.testing.assert_array_equal(one.z, true_z(EPIDEMICS))
    drawn, again = simulate_record_from_prior(EPIDEMICS, 1), simulate_record_from_prior(EPIDEMICS, 1, seed=1)
    assert drawn.y.shape == one.y.shape and drawn.paths.shape == one.paths.shape
    assert (drawn.z != one.z).all() and (drawn.z != again.z).all()


@pytest.mark.slow
def test_a_force_is_tracked_by_counts():
    found = states.run_gaussian(EPIDEMICS, Task("track/cubature/0", 0, {"method": "cubature", "first": 0, "last": 1}))
    for index in (0, 1):
        one = simulate_record(EPIDEMICS, index)
        force = true_likelihood(EPIDEMICS).smooth(jnp.asarray(one.y)).force("log transmission")
        error = np.asarray(force.mean) - one.paths[0]
        np.testing.assert_allclose(found["smoother_rmse"][index, 0], np.sqrt(np.mean(error**2)), rtol=1e-8)
        assert found["smoother_coverage"][index, 0] == np.mean(np.abs(error) <= Z * np.asarray(force.sd))
    assert found["filter_rmse"].shape == (2, 1) and found["mean"].shape == (1, 60)
    assert (found["smoother_rmse"] < found["filter_rmse"]).all()


@pytest.mark.slow
def test_parameters_are_found_from_counts():
    """What is drawn from the prior lies among the weighted draws, and particles agree about the force."""
    task = Task("drawn/0", 0, {"first": 0, "last": 1, "draws": 200, "paths": 10})
    found = parameters.estimate_all(EPIDEMICS, task, from_prior=True)
    assert found["posterior_mean"].shape == found["below"].shape == (2, 4) and found["draws"].shape == (4, 200)
    assert (found["k"] < 0.7).all() and (found["ess"] > 50).all()
    truth = np.stack([simulate_record_from_prior(EPIDEMICS, index).z for index in (0, 1)])
    assert (np.abs(found["posterior_mean"] - truth) < 4 * found["posterior_sd"]).all()
    assert ((found["below"] > 0) & (found["below"] < 1)).all()
    task = Task("particles/0", 0, {"index": 0, "particles": 500, "steps": 2, "draws": 200})
    few = states.run_particles(EPIDEMICS, task)
    force = true_likelihood(EPIDEMICS).smooth(jnp.asarray(simulate_record(EPIDEMICS, 0).y)).force("log transmission")
    late = few["distinct"] > 100
    assert late.any() and few["mean"].shape == (1, 60)
    assert np.sqrt(np.mean(((few["mean"][0] - force.mean) / force.sd)[late] ** 2)) < 0.5


def test_wrong_names_are_refused():
    with pytest.raises(ValueError, match="unknown parameter 'r1'"):
        true_z(dataclasses.replace(EPIDEMICS, names=("r1",)))


def test_kinds_reach_the_workers():
    for kind in experiment.STUDY.kinds.values():
        again = pickle.loads(pickle.dumps(kind.compute))
        assert again.func is kind.compute.func and again.args == kind.compute.args and again.args[0] == TARGETS
    assert model_file("epidemic") is model_file("epidemic")
