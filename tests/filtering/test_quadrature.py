"""Where only the forces bend the dynamics, prediction is a quadrature of the order of the Runge-Kutta step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import whole_state

import lfm_ppl as lfm
from lfm_ppl.filtering.dynamics import Dynamics
from lfm_ppl.filtering.integrators.exact import ExactTransition
from lfm_ppl.filtering.integrators.integrator import Section
from lfm_ppl.filtering.integrators.methods import DEFAULT_METHOD, choose_integrator
from lfm_ppl.filtering.integrators.quadrature import Quadrature
from lfm_ppl.filtering.integrators.runge_kutta import RungeKutta
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.transition import linear_part
from lfm_ppl.model.state_space import Span, state_space

DECAY = jnp.array([0.4, 0.9, 0.6])
SENSITIVITY = jnp.array([1.0, 0.5, 0.7])


def one_force(genes, link):
    return lambda x, u, t: 0.1 + SENSITIVITY[:genes] * link(u[0]) - DECAY[:genes] * x


def two_forces(genes, link):
    return lambda x, u, t: SENSITIVITY[:genes] * link(u[0]) * jnp.tanh(u[1]) + 0.3 * u[1] - DECAY[:genes] * x


def in_a_chain(genes, link):
    """Each gene moves the next one, the second force enters linearly."""
    return lambda x, u, t: link(u[0]) + 0.5 * u[1] + 0.2 * jnp.roll(x, 1) - DECAY[:genes] * x


def in_time(genes, link):
    return lambda x, u, t: (1.0 + 0.5 * jnp.sin(t)) * link(u[0]) + jnp.cos(t) * u[1] - DECAY[:genes] * x


def noise_of_force(x, u, t):
    return 0.1 * (1.0 + u[0] ** 2) * (1.0 + t) * jnp.ones((1, 1))


CASES = {
    "softplus": (one_force, 1, jax.nn.softplus, 1, None),
    "exp, three genes": (one_force, 3, jnp.exp, 1, None),
    "softplus, three genes, two forces": (two_forces, 3, jax.nn.softplus, 2, None),
    "exp, chain": (in_a_chain, 3, jnp.exp, 2, 0.2 * jnp.eye(3)),
    "exp, time": (in_time, 1, jnp.exp, 2, None),
    "softplus, noise of the force": (one_force, 1, jax.nn.softplus, 1, noise_of_force),
}
RULES = {"cubature": lfm.Cubature(), "taylor": lfm.Taylor()}


def case(name):
    dynamics, genes, link, count, noise = CASES[name]
    forces = {"first": lfm.Matern(1.0, 1.5, order=1), "second": lfm.Matern(0.7, 0.8, order=0)}
    return state_space(lfm.LatentForceModel(
        dynamics(genes, link), dict(list(forces.items())[:count]),
        lfm.GaussianObservation(whole_state, 0.01 * jnp.ones(genes)),
        lfm.Gaussian(jnp.ones(genes), jnp.zeros((genes, genes))), process_noise=noise))


def starts(ssm):
    """A known physical state, one of which nothing is known, and one that depends on the forces."""
    mean, covariance = ssm.initial()
    mean = mean + 0.3 * jnp.arange(1.0, ssm.state_dim + 1)
    size = ssm.physical_dim
    mixed = np.eye(ssm.state_dim) + 0.2 * np.tri(ssm.state_dim)
    return Moments(jnp.stack([mean] * 3), jnp.stack([
        covariance, covariance + jnp.diag(jnp.where(jnp.arange(ssm.state_dim) < size, 100.0, 0.0)),
        jnp.asarray(mixed @ mixed.T)]))


def nodes(ssm, steps):
    """Moments at the ends of the steps, to linearise about."""
    wave = jnp.sin(jnp.linspace(0.0, 3.0, steps + 1))
    mean = jnp.linspace(-0.5, 0.5, ssm.state_dim) + wave[:, None]
    return Moments(mean, (0.3 + 0.2 * wave**2)[:, None, None] * (jnp.eye(ssm.state_dim) + 0.1))


def integrator_of(ssm, rule=None):
    return choose_integrator(ssm, lfm.Cubature() if rule is None else rule, DEFAULT_METHOD, None)


def predictions(integrator, ssm, rule, steps):
    """Of a row from all starts, about the filter's own moments and about given ones."""
    dynamics, length = Dynamics(ssm, rule, linear_part(ssm, jnp.zeros(()))), jnp.asarray(1.5)
    table = integrator.tabulate(dynamics, length, steps, is_shared=steps != 3)

    def row(moments, about):
        interval = Section(Span.between(0.7, 2.2, 1.5), length, moments, about)
        return [integrator.predict(dynamics, table, interval, steps, record)
                for record in (Record.SMOOTHER, Record.LINEARIZATION)]

    def predict_both(moments):
        return row(moments, None), row(moments, nodes(ssm, steps))

    return jax.tree_util.tree_map(np.asarray, jax.jit(jax.vmap(predict_both))(starts(ssm)))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_quadrature_converges_to_runge_kutta_in_the_fourth_order(name):
    ssm = case(name)
    rule = RULES["taylor" if name == "softplus" else "cubature"]
    assert integrator_of(ssm, rule) == Quadrature()

    def difference(steps):
        result, expected = (predictions(integrator, ssm, rule, steps) for integrator in (Quadrature(), RungeKutta()))
        return max(np.abs(leaf - expected_leaf).max(initial=0.0) / np.abs(expected_leaf).max(initial=1.0)
                   for leaf, expected_leaf in zip(*map(jax.tree_util.tree_leaves, (result, expected)), strict=True))

    coarse, fine = difference(4), difference(8)
    assert coarse < 1e-3
    assert fine < max(coarse / 14.0, 1e-12)


@pytest.mark.parametrize("dynamics", [
    lambda x, u, t: u - x**3, lambda x, u, t: u * x, lambda x, u, t: u - (1.0 + t) * x,
    lambda x, u, t: jnp.where(x > 0.0, u, -u)])
def test_other_structures_keep_runge_kutta(dynamics):
    model = lfm.LatentForceModel(dynamics, {"u": lfm.Matern(1.0, 1.0)},
                                 lfm.GaussianObservation(whole_state, jnp.ones(1)),
                                 lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
    assert integrator_of(state_space(model)) == RungeKutta()


def test_points_in_the_whole_state_keep_runge_kutta():
    assert integrator_of(case("softplus"), lfm.Cubature(full_state=True)) == RungeKutta()
    noisy = lfm.LatentForceModel(one_force(1, jnp.exp), {"u": lfm.Matern(1.0, 1.0)},
                                 lfm.GaussianObservation(whole_state, jnp.ones(1)),
                                 lfm.Gaussian(jnp.zeros(1), jnp.eye(1)),
                                 process_noise=lambda x, u, t: x[None])
    assert integrator_of(state_space(noisy)) == RungeKutta()


@pytest.mark.slow
def test_without_forces():
    """Linear dynamics with a noise that varies with time: there are no nodes to linearise about."""
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.cos(t) - x, {}, lfm.GaussianObservation(whole_state, jnp.array([0.1])),
        lfm.Gaussian(jnp.ones(1), jnp.eye(1)), process_noise=lambda x, u, t: (1.0 + t) * jnp.ones((1, 1)))
    assert integrator_of(state_space(model)) == ExactTransition()
    once, twice = (lfm.MarginalLikelihood(model, np.arange(4.0), steps=3, iterations=count).log_prob(jnp.ones((4, 1)))
                   for count in (0, 2))
    np.testing.assert_allclose(once, twice, rtol=1e-12)
    assert lfm.smooth(model, np.arange(4.0), np.ones((4, 1)), at=[0.5, 3.5], steps=3, iterations=2).mean.shape == (2, 1)
