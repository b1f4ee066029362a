"""Steps of the particles: their strong order, and agreement with an independent solver on the same Brownian path."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import double_well, softplus

import lfm_ppl as lfm
from lfm_ppl.model.state_space import Span, state_space
from lfm_ppl.particles.stochastic_steps import choose_scheme, euler, milstein, srk, step_constants
from lfm_ppl.utils.semidefinite import semidefinite_root

PATHS, FINEST = 1500, 256
END = 1.0


def observed(x, u, t):
    return x[:1]


OBSERVATION = lfm.GaussianObservation(observed, jnp.array([0.1]))


def well():
    return state_space(double_well(mean=0.3, dispersion=0.7))


def varying():
    """Two states, noise whose dispersion depends on time, explicit time in the drift."""
    return state_space(lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([x[1], -jnp.sin(x[0]) - 0.3 * x[1] + jnp.cos(2 * t)]), {}, OBSERVATION,
        lfm.Gaussian(jnp.array([0.5, 0.0]), jnp.zeros(2)),
        process_noise=lambda x, u, t: jnp.array([[0.2, 0.0], [0.3, 0.5 * (1 + jnp.sin(3 * t))]])))


def pushed(order):
    """A non-linear decay pushed by a force through a link, with noise of its own."""
    return state_space(lfm.LatentForceModel(
        lambda x, u, t: softplus(2.0 * u) - 0.5 * x**3, {"u": lfm.Matern(1.0, 0.7, order)}, OBSERVATION,
        lfm.Gaussian(jnp.array([0.4]), jnp.zeros(1)), process_noise=jnp.array([[0.4]])))


def growth():
    """Geometric Brownian motion."""
    return state_space(lfm.LatentForceModel(
        lambda x, u, t: 0.5 * x, {}, OBSERVATION, lfm.Gaussian(jnp.array([1.0]), jnp.zeros(1)),
        process_noise=lambda x, u, t: 0.8 * x[:, None]))


def brownian(ssm, seed=0):
    """Increments and integrals (paths, steps, S) of Brownian motion, and force noise, on the finest steps."""
    h = END / FINEST
    sources = jax.eval_shape(lambda w: ssm.dispersion(w, 0.0), jnp.zeros(ssm.input_dim)).shape[1]
    generator = np.random.default_rng(seed)
    change = np.sqrt(h) * generator.standard_normal((PATHS, FINEST, sources))
    integral = 0.5 * h * change + np.sqrt(h**3 / 12) * generator.standard_normal((PATHS, FINEST, sources))
    root = np.asarray(step_constants(ssm, "srk", jnp.asarray(END), FINEST).root)
    kicks = generator.standard_normal((PATHS, FINEST, root.shape[0])) @ root.T
    return change, integral, kicks


def coarser(ssm, noise, factor):
    """The same path on steps that are ``factor`` times as long."""
    change, integral, kicks = (a.reshape(PATHS, FINEST // factor, factor, a.shape[-1]) for a in noise)
    h = END / FINEST
    path = np.cumsum(change, axis=2) - change
    size = ssm.force_dim
    if size:
        constants = step_constants(ssm, "srk", jnp.asarray(END), FINEST)
        transition, average = np.asarray(constants.transition), np.asarray(constants.integral)
        z, q = np.zeros((*kicks.shape[:2], size)), np.zeros((*kicks.shape[:2], kicks.shape[-1] - size))
        for step in range(factor):
            q = q + z @ average.T + kicks[:, :, step, size:]
            z = z @ transition.T + kicks[:, :, step, :size]
        kicks = np.concatenate([z, q], axis=-1)
    else:
        kicks = kicks[:, :, 0]
    return change.sum(axis=2), (integral + h * path).sum(axis=2), kicks


def final_states(ssm, step, noise, start=None):
    """The states (paths, n) at the end."""
    change, integral, kicks = (jnp.asarray(a) for a in noise)
    steps = change.shape[1]
    h = END / steps
    # What `srk` is given: standard normals from which it forms the increment and the average of the path.
    first = change / jnp.sqrt(h)
    second = (integral / h - 0.5 * change) / jnp.sqrt(h / 12.0)
    constants = step_constants(ssm, "srk" if step is srk else "euler", jnp.asarray(END), steps)
    mean, _ = ssm.initial()
    mean = mean if start is None else start

    def path(first, second, kicks):
        def take_step(s, inputs):
            index, a, b, kick = inputs
            span = Span.between(index * h, (index + 1) * h, h)
            return step(ssm, constants, h, span, s, (a, b), kick), None

        return jax.lax.scan(take_step, mean, (jnp.arange(steps), first, second, kicks))[0]

    return np.asarray(jax.jit(jax.vmap(path))(first, second, kicks))


def observed_order(ssm, step, reference=None, factors=(8, 32)):
    """The slope of the root mean square error between two step lengths."""
    noise = brownian(ssm)
    exact = final_states(ssm, srk, noise) if reference is None else reference(noise)
    errors = [np.sqrt(np.mean((final_states(ssm, step, coarser(ssm, noise, f)) - exact)[:, :ssm.physical_dim] ** 2))
              for f in factors]
    return np.log(errors[1] / errors[0]) / np.log(factors[1] / factors[0])


@pytest.mark.slow
@pytest.mark.parametrize("ssm", [varying(), pushed(0)], ids=["time-varying noise", "rough force"])
def test_the_runge_kutta_scheme_has_strong_order_one_and_a_half(ssm):
    assert observed_order(ssm, srk) > 1.4


@pytest.mark.slow
def test_euler_has_strong_order_one_for_additive_noise():
    assert 0.9 < observed_order(well(), euler) < 1.2


@pytest.mark.parametrize("step, low, high", [
    (milstein, 0.9, 1.1), pytest.param(euler, 0.4, 0.6, marks=pytest.mark.slow)], ids=["Milstein", "Euler"])
def test_orders_for_multiplicative_noise(step, low, high):
    """Against the closed form of geometric Brownian motion."""

    def exact(noise):
        return np.exp((0.5 - 0.32) * END + 0.8 * noise[0].sum(axis=1))

    assert low < observed_order(growth(), step, exact, factors=(2, 16)) < high


@pytest.mark.slow
def test_milstein_with_several_sources():
    """Two independent geometric Brownian motions as one system, whose noise is diagonal and so commutes."""
    rates = jnp.array([0.8, 0.3])
    ssm = state_space(lfm.LatentForceModel(
        lambda x, u, t: 0.5 * x, {}, OBSERVATION, lfm.Gaussian(jnp.ones(2), jnp.zeros(2)),
        process_noise=lambda x, u, t: jnp.diag(rates * x)))

    def exact(noise):
        return np.exp((0.5 - 0.5 * np.asarray(rates) ** 2) * END + np.asarray(rates) * noise[0].sum(axis=1))

    assert choose_scheme(ssm, "auto") == "euler" and choose_scheme(ssm, "milstein") == "milstein"
    assert observed_order(ssm, milstein, exact, factors=(2, 16)) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("solver, order_of_error", [
    pytest.param(diffrax.SRA1(), 1e-10, id="SRA1"), pytest.param(diffrax.ShARK(), 2e-3, id="ShARK")])
def test_agreement_with_diffrax(solver, order_of_error):
    """The same Brownian paths: to rounding with the same scheme, to its error with another of the same order."""
    steps, h = 64, END / 64
    grid = h * np.arange(steps)

    def brownian_path(key):
        return diffrax.VirtualBrownianTree(0.0, END, tol=h / 4, shape=(1,), key=key,
                                           levy_area=diffrax.SpaceTimeLevyArea)

    def reference_solution(key):
        path = brownian_path(key)
        terms = diffrax.MultiTerm(diffrax.ODETerm(lambda t, x, a: x - x**3),
                                  diffrax.ControlTerm(lambda t, x, a: jnp.array([[0.7]]), path))
        theirs = diffrax.diffeqsolve(terms, solver, 0.0, END, None, jnp.array([0.3]),
                                     stepsize_controller=diffrax.StepTo(h * jnp.arange(steps + 1))).ys[-1]
        area = jax.vmap(lambda t: path.evaluate(t, t + h, use_levy=True))(grid)
        return theirs, area.W, h * (0.5 * area.W + area.H)

    theirs, change, integral = jax.jit(jax.vmap(reference_solution))(jax.random.split(jax.random.key(0), 50))
    ours = final_states(well(), srk, (change, integral, np.zeros((50, steps, 0))))
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < order_of_error


def test_force_noise_is_exact():
    """State and average of a force at the end of a step, jointly, against quadrature of the covariance function."""
    force, h = lfm.Matern(1.3, 0.7, 0), 0.4
    ssm = state_space(lfm.LatentForceModel(
        lambda x, u, t: u**2, {"u": force}, OBSERVATION, lfm.Gaussian(jnp.zeros(1), jnp.zeros(1))))
    constants = step_constants(ssm, "srk", jnp.asarray(h), 1)
    start = np.asarray(force.initial_covariance())
    moved = np.concatenate([constants.transition, constants.integral])
    joint_cov = moved @ start @ moved.T + np.asarray(constants.root) @ np.asarray(constants.root).T
    nodes, weights = np.polynomial.legendre.leggauss(40)
    nodes, weights = 0.5 * h * (nodes + 1), 0.5 * h * weights
    # The kernel has a kink where its arguments meet, so the double integral is taken in closed form.
    rate = 1 / 0.7
    double = 2 * 1.69 * (h / rate - (1 - np.exp(-rate * h)) / rate**2)
    cross = (weights * np.asarray(force.covariance(h - nodes))).sum()
    assert np.allclose(joint_cov, [[1.69, cross], [cross, double]], rtol=1e-10)


def test_a_step_of_no_length_moves_nothing():
    ssm = pushed(1)
    constants = step_constants(ssm, "srk", jnp.zeros(()), 1)
    s = jnp.array([0.3, -0.2, 0.5])
    instant = Span.between(jnp.ones(()), jnp.ones(()), jnp.zeros(()))
    moved = srk(ssm, constants, jnp.zeros(()), instant, s, (jnp.ones(1), jnp.ones(1)), jnp.zeros(3))
    assert np.allclose(moved, s)
    assert np.allclose(semidefinite_root(jnp.zeros((3, 3))), 0.0)


def test_the_scheme_that_auto_stands_for():
    linear = state_space(lfm.LatentForceModel(
        lambda x, u, t: -x, {}, OBSERVATION, lfm.Gaussian(jnp.zeros(1), jnp.ones(1)), process_noise=jnp.eye(1)))
    assert [choose_scheme(s, "auto") for s in (linear, well(), varying(), pushed(1), growth())] == \
        ["exact", "srk", "srk", "srk", "milstein"]
    for ssm, scheme in ((growth(), "srk"), (well(), "exact")):
        with pytest.raises(ValueError, match=scheme):
            choose_scheme(ssm, scheme)
