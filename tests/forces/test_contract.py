"""What every force must satisfy; the list of forces is in conftest.py."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm

from lfm_ppl import forces

SCALE, LENGTHSCALE = 1.3, 0.7
EXTREME_LENGTHSCALES = (1e-8, 1.0, 1e8)


def steps(force, dts):
    """Transitions and noises over several steps, in one compiled program per kind of force."""
    transition, noise = _steps(force, np.resize(dts, 64))
    return transition[: len(dts)], noise[: len(dts)]


@jax.jit
def _steps(force, dts):
    return jax.vmap(force.discretise)(dts)


def entrywise_error(noise, expected):
    """The error of each covariance relative to its own two standard deviations."""
    sd = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    sd = np.where(sd > 0, sd, 1.0)
    return np.abs((noise - expected) / sd[..., :, None] / sd[..., None, :]).max()


def test_every_public_force_is_in_the_list(every_force):
    public = [getattr(forces, name) for name in forces.__all__]
    kinds = {one.__name__ for one in public if isinstance(one, type) and issubclass(one, forces.Force)} - {"Force"}
    missing = kinds - {type(build(SCALE, LENGTHSCALE)).__name__ for build in every_force.values()}
    assert not missing, f"add a line to FORCES in tests/forces/conftest.py for {missing}"


def test_shapes(build):
    force = build(SCALE, LENGTHSCALE)
    n, s = force.state_dim, force.noise_dim
    for method, arguments, shape in (
        ("initial_covariance", (), (n, n)),
        ("feedback", (), (n, n)),
        ("dispersion", (), (n, s)),
        ("transition", (0.1,), (n, n)),
        ("process_noise", (0.1,), (n, n)),
        ("measurement", (0.0,), (n,)),
        ("mean_at", (0.0,), ()),
    ):
        result = jax.eval_shape(getattr(force, method), *arguments)
        assert (result.shape, result.dtype) == (shape, jnp.float64), method
    for index in range(len(force.jump_times)):
        assert [m.shape for m in force.jump(index)] == [(n, n), (n, n)]
    with pytest.raises(IndexError):
        force.jump(len(force.jump_times))


def test_transition_is_the_matrix_exponential(build):
    force = build(SCALE, LENGTHSCALE)
    dts = np.array([1e-3, 0.2, 1.0, 5.0])
    for dt, transition in zip(dts, steps(force, dts)[0], strict=True):
        assert_allclose(transition, expm(np.asarray(force.feedback()) * dt), atol=1e-12)


def test_step_equals_the_taylor_series_in_high_precision(build, exact_step):
    force = build(SCALE, LENGTHSCALE)
    feedback, dispersion = force.feedback(), force.dispersion()
    dts = LENGTHSCALE * np.array([1e-8, 1e-3, 0.1, 0.5, 3.0])
    transitions, noises = steps(force, dts)
    for dt, transition, noise in zip(dts, transitions, noises, strict=True):
        expected_transition, expected_noise = exact_step(feedback, dispersion, dt)
        assert_allclose(transition, expected_transition, atol=1e-13 * force.state_dim)
        assert entrywise_error(noise, expected_noise) < 1e-12


def test_no_time_no_change(build):
    force = build(SCALE, LENGTHSCALE)
    transition, noise = steps(force, np.zeros(1))
    assert_array_equal(transition[0], np.eye(force.state_dim))
    assert_array_equal(noise[0], np.zeros((force.state_dim, force.state_dim)))


def test_two_steps_are_one(build):
    force = build(SCALE, LENGTHSCALE)
    for first, second in ((1e-6, 1e-7), (0.3, 0.4), (0.5, 40.0)):
        (a, b, whole), (qa, qb, q) = steps(force, np.array([first, second, first + second]))
        assert_allclose(b @ a, whole, atol=1e-13 * max(1.0, np.abs(whole).max()))
        assert entrywise_error(b @ qa @ b.T + qb, q) < 1e-12


def test_stationary_covariance(build_stationary):
    force = build_stationary(SCALE, LENGTHSCALE)
    p, f, column = force.initial_covariance(), force.feedback(), force.dispersion()
    lyapunov = f @ p + p @ f.T + column @ column.T
    assert np.abs(lyapunov).max() <= 1e-14 * np.abs(f).max() * np.abs(p).max() * force.state_dim
    dts = LENGTHSCALE * np.logspace(-8, 6, 29)
    transition, noise = steps(force, dts)
    assert_allclose(
        transition @ p @ transition.mT + noise, np.broadcast_to(p, noise.shape), atol=1e-13
    )


def test_process_noise_is_semidefinite(build):
    for lengthscale in EXTREME_LENGTHSCALES:
        force = build(SCALE, lengthscale)
        transition, noise = steps(force, lengthscale * np.logspace(-8, 6, 57))
        assert np.isfinite(transition).all()
        assert_array_equal(noise, noise.mT)
        eigenvalues = np.linalg.eigvalsh(noise)
        assert (eigenvalues[:, 0] >= -1e-13 * eigenvalues[:, -1]).all()


@functools.cache
def _derivatives(build):
    def parts(point):
        scale, ell, dt = point
        force = build(scale, ell)
        return *force.discretise(dt), force.initial_covariance()

    return jax.jit(jax.vmap(lambda point: (parts(point), jax.jacfwd(parts)(point), jax.jacrev(parts)(point))))


def derivatives(build, points):
    """Transition, noise and initial covariance at points (n, 3) of (scale, lengthscale, step), n <= 24.

    Returns:
        Values, derivatives in forward mode, derivatives in reverse mode: one compiled program for a force.
    """
    result = _derivatives(build)(np.resize(points, (24, 3)))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:len(points)], result)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_gradients_are_finite(build, mode):
    points = [(SCALE, lengthscale, lengthscale * dt) for lengthscale in EXTREME_LENGTHSCALES
              for dt in (0.0, 1e-8, 1.0, 30.0, 1e3, 1e6)]
    _, forward, reverse = derivatives(build, np.array(points))
    for derivative in forward if mode == "forward" else reverse:
        assert np.isfinite(derivative).all()


def test_gradient_equals_finite_differences(build):
    h = 1e-5
    # Among the steps are some on either side of where the Matern noise changes its formula.
    points = np.array([[SCALE, LENGTHSCALE, x * LENGTHSCALE] for x in (0.01, 0.6, 4.0, 9.0)])
    _, forward, reverse = derivatives(build, points)
    shifted = np.stack([points + sign * h * unit for unit in np.eye(3) for sign in (1, -1)])
    values, _, _ = derivatives(build, shifted.reshape(-1, 3))
    for gradient, backward, value in zip(forward[:2], reverse[:2], values[:2], strict=True):
        assert_allclose(gradient, backward, rtol=1e-12, atol=1e-14)
        for i, (ahead, behind) in enumerate(value.reshape(3, 2, *gradient.shape[:-1])):
            assert_allclose(gradient[..., i], (ahead - behind) / (2 * h), rtol=1e-6, atol=3e-7)


def test_covariance_of_the_sde_is_the_closed_form(build_exact):
    force = build_exact(SCALE, LENGTHSCALE)
    t, s = np.meshgrid(
        LENGTHSCALE * np.array([0.0, 1e-6, 0.1, 0.5, 1.0, 3.0, 20.0]), [0.0, 0.4, 2.0]
    )
    covariance = force.covariance(t, s)
    assert_allclose(force.sde_covariance(t, s), covariance, rtol=1e-12, atol=1e-12)
    assert_allclose(force.covariance(s, t), covariance, rtol=1e-13)
    if force.stationary:
        assert_allclose(force.covariance(t - s), covariance, rtol=1e-12)


def test_covariance_has_a_finite_gradient_at_lag_zero(build_exact):
    def covariance(scale, ell, lag):
        return build_exact(scale, ell).covariance(lag)

    gradient = jax.jit(jax.vmap(jax.grad(covariance, (0, 1, 2)), (None, None, 0)))
    for derivative in gradient(SCALE, LENGTHSCALE, jnp.array([0.0, 1e6 * LENGTHSCALE])):
        assert np.isfinite(derivative).all()


def test_jit_and_vmap_over_parameters(build):
    scales, lengthscales = jnp.array([0.5, 2.0]), jnp.array([0.3, 4.0])
    forces = jax.vmap(build)(scales, lengthscales)
    noise = jax.jit(jax.vmap(lambda force: force.process_noise(0.6)))(forces)
    for i in range(2):
        expected = build(scales[i], lengthscales[i]).process_noise(0.6)
        assert_allclose(noise[i], expected, rtol=1e-12, atol=1e-15)


def test_constructors_take_tracers_of_any_value(build):
    value = jax.jit(lambda s, ell: build(s, ell).initial_covariance())(-1.0, jnp.nan)
    assert value.ndim == 2
