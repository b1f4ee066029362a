"""Data simulated from a model whose measurements are counts, with what serves the target on reentry, too."""

import jax.numpy as jnp
import numpy as np
import pytest

from lfm_ppl import loading
from lfm_ppl.engine.task import Task
from lfm_ppl.experiments.scores import Z
from lfm_ppl.experiments.simulated import states
from lfm_ppl.experiments.simulated.problem import Problem, drawn_record, record, true_likelihood, true_z

EPIDEMICS = Problem("epidemic", ("r0", "scale", "lengthscale", "concentration"), ("log transmission",), ("",),
                    medians=(2.0, 0.3, 15.0, 10.0), steps=10)


@pytest.mark.slow
def test_a_record_is_what_the_model_simulates():
    file = loading.load("epidemic")
    one, data = record(EPIDEMICS, 1), file.simulate(seed=1)
    at = np.isin(data.truth["times"], data.times)
    np.testing.assert_array_equal(one.y, data.y)
    np.testing.assert_array_equal(one.paths[0], np.asarray(data.truth["forces"]["log transmission"])[at])
    assert np.exp(one.z) == pytest.approx([2.0, 0.3, 15.0, 10.0])
    np.testing.assert_array_equal(one.z, true_z(EPIDEMICS))
    drawn, again = drawn_record(EPIDEMICS, 1), drawn_record(EPIDEMICS, 1, seed=1)
    assert drawn.y.shape == one.y.shape and drawn.paths.shape == one.paths.shape
    assert (drawn.z != one.z).all() and (drawn.z != again.z).all()


@pytest.mark.slow
def test_a_force_is_tracked_by_counts():
    found = states.gaussian(EPIDEMICS, Task("track/cubature/0", 0, {"method": "cubature", "first": 0, "last": 1}))
    for index in (0, 1):
        one = record(EPIDEMICS, index)
        force = true_likelihood(EPIDEMICS).smooth(jnp.asarray(one.y)).force("log transmission")
        error = np.asarray(force.mean) - one.paths[0]
        np.testing.assert_allclose(found["smoother_rmse"][index, 0], np.sqrt(np.mean(error**2)), rtol=1e-8)
        assert found["smoother_coverage"][index, 0] == np.mean(np.abs(error) <= Z * np.asarray(force.sd))
    assert found["filter_rmse"].shape == (2, 1) and found["mean"].shape == (1, 60)
    assert (found["smoother_rmse"] < found["filter_rmse"]).all()
