"""What every force must satisfy; the list of forces is in conftest.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

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
    kinds = {value.__name__ for value in public if isinstance(value, type) and issubclass(value, forces.Force)}
    missing = kinds - {"Force"} - {type(build(SCALE, LENGTHSCALE)).__name__ for build in every_force.values()}
    assert not missing, f"add a line to FORCES in tests/forces/conftest.py for {missing}"


def test_state_space_form(build, exact_step):
    """Shapes; steps equal the Taylor series in high precision, also none or two of them; the noise is definite.

    A stationary covariance stays what it is.
    """
    force = build(SCALE, LENGTHSCALE)
    n, s = force.state_dim, force.noise_dim
    for method, arguments, shape in (
            ("initial_covariance", (), (n, n)), ("feedback", (), (n, n)), ("dispersion", (), (n, s)),
            ("transition", (0.1,), (n, n)), ("process_noise", (0.1,), (n, n)), ("measurement", (0.0,), (n,)),
            ("mean_at", (0.0,), ())):
        result = jax.eval_shape(getattr(force, method), *arguments)
        assert (result.shape, result.dtype) == (shape, jnp.float64), method
    for index in range(len(force.jump_times)):
        assert [m.shape for m in force.jump(index)] == [(n, n), (n, n)]
    with pytest.raises(IndexError):
        force.jump(len(force.jump_times))

    f, column, p = map(np.asarray, (force.feedback(), force.dispersion(), force.initial_covariance()))
    dts = LENGTHSCALE * np.array([1e-8, 1e-3, 0.1, 0.5, 3.0])
    for dt, transition, noise in zip(dts, *steps(force, dts), strict=True):
        expected_transition, expected_noise = exact_step(f, column, dt)
        assert_allclose(transition, expected_transition, atol=1e-13 * n)
        assert entrywise_error(noise, expected_noise) < 1e-12
    (transition,), (noise,) = steps(force, np.zeros(1))
    assert_array_equal(transition, np.eye(n))
    assert_array_equal(noise, np.zeros((n, n)))
    for first, second in ((1e-6, 1e-7), (0.3, 0.4), (0.5, 40.0)):
        (a, b, full_step), (qa, qb, q) = steps(force, np.array([first, second, first + second]))
        assert_allclose(b @ a, full_step, atol=1e-13 * max(1.0, np.abs(full_step).max()))
        assert entrywise_error(b @ qa @ b.T + qb, q) < 1e-12
    for lengthscale in EXTREME_LENGTHSCALES:
        transition, noise = map(np.asarray, steps(build(SCALE, lengthscale), lengthscale * np.logspace(-8, 6, 57)))
        assert np.isfinite(transition).all()
        assert_array_equal(noise, noise.mT)
        eigenvalues = np.linalg.eigvalsh(noise)
        assert (eigenvalues[:, 0] >= -1e-13 * eigenvalues[:, -1]).all()
        if force.stationary:
            assert_allclose(transition @ p @ transition.mT + noise, np.broadcast_to(p, noise.shape), atol=1e-13)
    if force.stationary:
        lyapunov = f @ p + p @ f.T + column @ column.T
        assert np.abs(lyapunov).max() <= 1e-14 * np.abs(f).max() * np.abs(p).max() * n


def test_derivatives(build_to_differentiate):
    """In both modes: finite everywhere, and equal to differences where these are accurate."""
    build = build_to_differentiate

    def parts(point):
        scale, ell, dt = point
        force = build(scale, ell)
        return *force.discretise(dt), force.initial_covariance()

    h = 1e-5
    extreme = [(SCALE, lengthscale, lengthscale * dt) for lengthscale in EXTREME_LENGTHSCALES
               for dt in (0.0, 1e-8, 1.0, 30.0, 1e3, 1e6)]
    # Among the steps are some on either side of where the Matern noise changes its formula.
    points = np.array([[SCALE, LENGTHSCALE, x * LENGTHSCALE] for x in (0.01, 0.6, 4.0, 9.0)])
    shifted = np.stack([points + sign * h * unit for unit in np.eye(3) for sign in (1, -1)]).reshape(-1, 3)
    values, forward, reverse = jax.tree.map(np.asarray, jax.jit(jax.vmap(
        lambda point: (parts(point), jax.jacfwd(parts)(point), jax.jacrev(parts)(point))))(
            np.concatenate([points, extreme, shifted])))
    assert all(np.isfinite(derivative).all() for derivative in (*forward, *reverse))
    # Built from traced parameters and from numbers.
    for value, expected in zip(values[:2], steps(build(SCALE, LENGTHSCALE), points[:, 2]), strict=True):
        assert_allclose(value[:4], expected, rtol=1e-12, atol=1e-14)
    for gradient, backward, value in zip(forward[:2], reverse[:2], values[:2], strict=True):
        # Of a matrix with large entries small ones are rounded as their sums are.
        assert_allclose(gradient[:4], backward[:4], rtol=1e-12, atol=1e-14 * max(1.0, np.abs(gradient[:4]).max()))
        for i, (upper, lower) in enumerate(value[-24:].reshape(3, 2, *gradient[:4].shape[:-1])):
            assert_allclose(gradient[:4, ..., i], (upper - lower) / (2 * h), rtol=1e-6, atol=3e-7)


def test_covariance_of_the_sde_is_the_closed_form(build, has_exact_covariance):
    """Its gradient is finite at lag zero."""
    if not has_exact_covariance:
        return
    t, s = np.meshgrid(LENGTHSCALE * np.array([0.0, 1e-6, 0.1, 0.5, 1.0, 3.0, 20.0]), [0.0, 0.4, 2.0])

    @jax.jit
    def covariances(scale, ell, t, s):
        force = build(scale, ell)
        slopes = jax.vmap(jax.grad(lambda scale, ell, lag: build(scale, ell).covariance(lag), (0, 1, 2)),
                          (None, None, 0))(scale, ell, jnp.array([0.0, 1e6]) * ell)
        return force.covariance(t, s), force.sde_covariance(t, s), force.covariance(s, t), slopes, (
            force.covariance(t - s) if force.stationary else force.covariance(t, s))

    covariance, of_sde, mirrored, slopes, of_lag = covariances(SCALE, LENGTHSCALE, t, s)
    assert_allclose(of_sde, covariance, rtol=1e-12, atol=1e-12)
    assert_allclose(mirrored, covariance, rtol=1e-13)
    assert_allclose(of_lag, covariance, rtol=1e-12)
    assert all(np.isfinite(slope).all() for slope in slopes)
