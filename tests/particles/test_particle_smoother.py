"""Trajectories of the particle smoother against exact smoothers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import Kicked, double_well, first_state

import lfm_ppl as lfm
from lfm_ppl.fokker_planck_grid.fokker_planck import fokker_planck

TIMES = np.array([0.0, 0.7, 0.7, 2.0, 3.1])
Y = np.array([[0.3], [0.5], [0.1], [np.nan], [-0.4]])
AT = np.array([0.0, 0.35, 0.7, 2.5, 3.1, 4.0])


def decay(x, u, t):
    return u - 0.8 * x


def linear(force=None):
    """A decay pushed by a force, of which the force alone has noise: over an interval it reaches both states."""
    return lfm.LatentForceModel(
        decay, {"u": force or lfm.Matern(1.0, 1.3, 0)},
        lfm.GaussianObservation(first_state, jnp.array([0.05])), lfm.Gaussian(jnp.zeros(1), jnp.array([0.5])))


def assert_close(result, mean, sd, draws, share=0.1):
    """Means within five standard errors of ``draws`` independent trajectories, standard deviations within a share."""
    assert np.all(np.abs(result.mean - mean) < 5.0 * sd / np.sqrt(draws))
    assert np.allclose(np.sqrt(np.asarray(result.covariance)[:, 0, 0]), sd[:, 0], rtol=share)


@pytest.mark.slow
def test_backward_simulation_of_a_linear_model():
    """Against the Rauch-Tung-Striebel smoother, before, between and after the observations."""
    exact = lfm.smooth(linear(), TIMES, Y, at=AT)
    result = lfm.particle_smoother(jax.random.key(0), linear(), TIMES, Y, particles=3000, draws=1500, at=AT)
    assert (result.method, result.scheme) == ("backward simulation", "exact")
    sd = np.sqrt(np.asarray(exact.covariance)[:, [0, 1], [0, 1]])
    assert_close(result, exact.mean, sd, 1500 / 2)
    force = result.force("u")
    assert np.allclose(force.mean, result.mean[:, 1]) and result.trajectories.forces["u"].shape == (1500, 6)
    assert np.all(np.abs(force.mean - exact.force("u").mean) < 5.0 * exact.force("u").sd / np.sqrt(750))
    # Two states of one trajectory: the covariance of the exact joint distribution, too.
    exact_draws = exact.sample(jax.random.key(1), 4000).state[:, :, 0]
    ours = np.corrcoef(np.asarray(result.draws)[:, :, 0].T)
    assert np.abs(ours - np.corrcoef(np.asarray(exact_draws).T)).max() < 5.0 / np.sqrt(750)


@pytest.mark.thorough
def test_ancestor_tracing_of_a_linear_model():
    exact = lfm.smooth(linear(), TIMES, Y)
    result = lfm.particle_smoother(jax.random.key(0), linear(), TIMES, Y, particles=5000, draws=1000,
                                   method="ancestor tracing")
    assert result.method == "ancestor tracing"
    assert np.all(np.diff(result.distinct) >= 0)  # going back, trajectories meet
    sd = np.sqrt(np.asarray(exact.covariance)[:, [0, 1], [0, 1]])
    assert_close(result, exact.mean, sd, float(result.distinct.min()) / 4)


@pytest.mark.slow
def test_the_double_well_agrees_with_the_grid():
    """Both methods; Euler's steps of 1/50 leave an error below the Monte Carlo error."""
    model, times = double_well(mean=0.0), np.array([0.0, 1.5, 3.0, 4.0])
    y = np.array([[0.8], [0.1], [-0.9], [-0.8]])
    grid = np.array([0.75, 1.5, 2.25, 4.0])
    exact = fokker_planck(model, times, y, at=grid)
    for method, particles, draws in (("backward simulation", 3000, 1000), ("ancestor tracing", 40_000, 4000)):
        result = lfm.particle_smoother(jax.random.key(2), model, times, y, particles=particles, draws=draws, at=grid,
                                       steps=75, method=method)
        assert result.method == method
        count = draws / 2 if method.startswith("back") else float(result.distinct.min()) / 4
        assert_close(result, np.asarray(exact.smoothed_mean)[:, None], np.asarray(exact.smoothed_sd)[:, None], count)


@pytest.mark.slow
def test_replicates_share_the_state():
    """Between observations at one time nothing moves: a trajectory has one value there."""
    result = lfm.particle_smoother(jax.random.key(0), double_well(), TIMES, Y, particles=200, draws=50, steps=5)
    assert result.method == "backward simulation" and result.scheme == "euler"
    assert np.array_equal(result.draws[:, 1], result.draws[:, 2])


@pytest.mark.slow
@pytest.mark.parametrize("model, reason", [
    (linear(lfm.Constant(1.0)), "not every state of this linear model"),
    (lfm.LatentForceModel(lambda x, u, t: u - x**3, {"u": lfm.Constant(1.0)},
                          lfm.GaussianObservation(first_state, jnp.array([0.1])),
                          lfm.Gaussian(jnp.zeros(1), jnp.ones(1)), process_noise=jnp.eye(1)), "states without noise"),
    (lfm.LatentForceModel(lambda x, u, t: u - x**3, {"u": Kicked(0.3, (0.6,), 1.0, 1.3, 0)},
                          lfm.GaussianObservation(first_state, jnp.array([0.1])),
                          lfm.Gaussian(jnp.zeros(1), jnp.ones(1)), process_noise=jnp.eye(1)), "a force jumps"),
], ids=["linear", "constant", "jumps"])
def test_models_without_a_transition_density_are_traced(model, reason):
    with pytest.raises(ValueError, match=reason):
        lfm.particle_smoother(jax.random.key(0), model, TIMES, Y, method="backward simulation")
    result = lfm.particle_smoother(jax.random.key(0), model, TIMES, Y, particles=50, draws=10, steps=3)
    assert result.method == "ancestor tracing" and np.all(np.isfinite(result.draws))


def test_errors():
    for change, name in (
            ({"draws": 0}, "draws"), ({"method": "backwards"}, "'backward simulation'"),
            ({"particles": 0}, "particles"),
            ({"particles": 50_000_000}, "GiB"), ({"at": [-3.0]}, "-3"),
            ({"method": "backward simulation", "scheme": "srk"}, "srk")):
        with pytest.raises(ValueError, match=name):
            lfm.particle_smoother(jax.random.key(0), double_well(), TIMES, Y, **change)


@pytest.mark.slow
def test_an_unknown_force_is_named():
    result = lfm.particle_smoother(jax.random.key(0), linear(), TIMES, Y, particles=20, draws=5)
    with pytest.raises(ValueError, match="'v'"):
        result.force("v")
    assert np.array_equal(result.trajectories.state, result.draws[:, :, :1])
