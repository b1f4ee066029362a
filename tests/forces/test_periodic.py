"""Periodic and quasi-periodic forces against their kernels, quadrature and Monte Carlo."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.special import ive

import lfm_ppl as lfm
from lfm_ppl import forces
from lfm_ppl.forces.basis import fourier_coefficients
from lfm_ppl.forces.eigenspace import leading_eigenvectors
from lfm_ppl.forces.quasi_periodic import significant_functions
from lfm_ppl.studies.periodic_kernels.resonators import resonators
from lfm_ppl.studies.periodic_kernels.sparse_spectrum import SparseSpectrum, random_frequencies

# Few functions make small tests.
pytestmark = pytest.mark.filterwarnings("ignore:a periodic force keeps")

LAG = np.linspace(0.0, 20.0, 401)
POINTS = (10.0, 20.0, 30.0)


def squared_exponential(lengthscale=1.0, period=10.0, scale=1.0):
    return forces.PeriodicSquaredExponential(scale, lengthscale, period)


def test_kernels_are_the_published_ones():
    chord = np.abs(np.sin(np.pi * LAG / 10.0))
    assert_allclose(squared_exponential(0.7, scale=1.5)(LAG), 1.5**2 * np.exp(-(chord**2) / 0.7**2), rtol=1e-12)
    for order, polynomial in enumerate((lambda x: 1 + 0 * x, lambda x: 1 + x, lambda x: 1 + x + x**2 / 3)):
        x = np.sqrt(2 * order + 1) * chord / 0.7
        expected = 1.5**2 * polynomial(x) * np.exp(-x)
        assert_allclose(forces.PeriodicMatern(1.5, 0.7, 10.0, order)(LAG + 3.0, 3.0), expected, rtol=1e-11)
        moderated = forces.ModeratedPeriodicMatern(1.5, 0.7, 10.0, 0.3, order)
        distance = np.abs(LAG - 10 * np.round(LAG / 10))
        assert_allclose(moderated(LAG, 0.0), expected * np.exp(-0.3 * distance), rtol=1e-11)
        assert_allclose(moderated(LAG + 10.0, 3.0), moderated(LAG, -7.0), rtol=1e-11)


def test_fourier_coefficients_are_bessel_functions():
    """exp(-sin^2(x) / l^2) = exp(-b) sum_j (2 - [j = 0]) I_j(b) cos(2 j x), b = 1 / (2 l^2)."""
    order = np.arange(30)
    for lengthscale in (0.15, 1.0, 5.0):
        expected = ive(order, 0.5 / lengthscale**2) * np.where(order == 0, 1, 2)
        assert_allclose(fourier_coefficients(squared_exponential(lengthscale), 29), expected, atol=1e-13)


@pytest.mark.parametrize("order", range(3))
def test_fourier_coefficients_of_rough_kernels_are_their_integrals(order):
    kernel = forces.PeriodicMatern(1.3, 0.4, 7.0, order)
    result = fourier_coefficients(kernel, 12)
    for j in (0, 1, 5, 12):
        x = np.sqrt(2 * order + 1) / 0.4

        def value(lag, x=x):
            y = x * np.sin(np.pi * lag / 7.0)
            return 1.3**2 * np.exp(-y) * (1, 1 + y, 1 + y + y * y / 3)[order]

        integral = quad(value, 0.0, 3.5, weight="cos", wvar=2 * np.pi * j / 7.0, epsabs=1e-12)[0]
        assert_allclose(result[j], integral * (2 if j else 1) / 3.5, atol=1e-10)


@pytest.mark.parametrize("order", [0, 1, 2, "se"])
def test_the_error_is_the_spectral_mass_left_out(order, functions=9):
    kernel = squared_exponential(0.5) if order == "se" else forces.PeriodicMatern(1.0, 0.5, 10.0, order)
    force = lfm.Periodic(kernel, functions=functions)
    error = np.abs(force.sde_covariance(LAG) - force.covariance(LAG))
    # By an independent transform, of which a kernel with a kink needs a fine grid.
    spectrum = np.fft.rfft(np.asarray(kernel(np.linspace(0.0, 10.0, 2**17, endpoint=False)))).real / 2**17
    left_out = 2.0 * spectrum[functions // 2 + 1:-1].sum()
    assert error.max() == pytest.approx(error[0], abs=1e-13)
    assert error[0] == pytest.approx(left_out, abs=1e-4 if order == 0 else 1e-8)
    assert error[0] == pytest.approx(1.0 - float(force.eigenvalues().sum()), abs=1e-13)


@pytest.mark.thorough
@pytest.mark.parametrize(("order", "largest"), [
    ("se", 0.01), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((0, 0.064),))])
def test_the_default_is_as_good_as_documented(order, largest):
    """At all lengthscales; the largest errors are where a pair is only just left out."""
    errors = []
    for lengthscale in (0.06, 0.11, 0.2, 0.5, 1.0, 1.34, 2.0, 3.5, 5.03, 6.46, 7.14, 15.0):
        matern = None if order == "se" else forces.PeriodicMatern(1.0, lengthscale, 10.0, order)
        kernel = matern or squared_exponential(lengthscale)
        force = lfm.Periodic(kernel)
        assert force.functions == significant_functions(kernel)
        harmonics = force.functions // 2
        # By an independent transform: the variance of the level, and of each pair together.
        variance = np.fft.rfft(np.asarray(kernel(np.linspace(0.0, 10.0, 2**14, endpoint=False)))).real / 2**14
        variance[1:] *= 2.0
        assert variance[harmonics] > 0.01 * variance.max() > variance[harmonics + 1:].max()
        errors.append(1.0 - float(force.eigenvalues().sum()))
        assert errors[-1] == pytest.approx(variance[harmonics + 1:].sum(), abs=1e-4)
    assert 0.6 * largest < max(errors) < largest
    kernel = squared_exponential(5.03)
    assert lfm.Periodic(kernel).functions == significant_functions(kernel) == 3


@pytest.mark.thorough
def test_the_error_goes_to_zero():
    for kernel, gammas, last in ((squared_exponential(0.3), (1e-2, 1e-6, 1e-13), 1e-11),
                                 (forces.PeriodicMatern(1.0, 1.0, 10.0, 0), (1e-2, 1e-3, 1e-5), 2.1e-3)):
        errors = [1.0 - float(lfm.Periodic(kernel, gamma=gamma).eigenvalues().sum()) for gamma in gammas]
        assert errors[0] > errors[1] > errors[2] and errors[2] < last


@pytest.mark.slow
def test_nystrom_is_the_paper_s_formula():
    """Equation 30, orthonormal eigenfunctions, and a mean error of the eigenvalues left out."""
    kernel, count = forces.ModeratedPeriodicMatern(1.2, 0.8, 10.0, 0.2, 1), 7
    force = lfm.Periodic(kernel, functions=count, points=100)
    points = np.asarray(force.basis.points)
    gram = np.asarray(kernel(points[:, None], points[None, :]))
    values, vectors = np.linalg.eigh(gram)
    values, vectors = values[::-1], vectors[:, ::-1]
    t = np.array([0.3, 4.4, 9.9, 13.0])
    phi = np.sqrt(100) / values[:count] * (np.asarray(kernel(t[:, None], points)) @ vectors[:, :count])
    assert_allclose(force.sde_covariance(t[:, None], t), phi * values[:count] / 100 @ phi.T, atol=1e-12)
    assert_allclose(force.eigenvalues(), values[:count] / 100, rtol=1e-10)
    assert_allclose(np.abs(force.eigenfunctions(t)), np.abs(phi), atol=1e-9)
    on_grid = np.asarray(force.eigenfunctions(points))
    assert_allclose(on_grid.T @ on_grid / 100, np.eye(count), atol=1e-10)
    error = np.diag(gram) - np.asarray(force.sde_covariance(points, points))
    assert (error > -1e-12).all()
    assert error.mean() == pytest.approx(values[count:].sum() / 100, rel=1e-9)
    assert significant_functions(kernel) == (values > 0.01 * values[0]).sum()


@pytest.mark.thorough
def test_both_treatments_agree_where_both_apply():
    kernel = squared_exponential(0.8)
    general = forces.PeriodicKernel(lambda t, s: jnp.exp(-(jnp.sin(jnp.pi * (t - s) / 10.0) / 0.8) ** 2), 10.0)
    stationary = forces.PeriodicKernel(general.function, 10.0, stationary=True, start=2.0)
    first, second, third = (lfm.Periodic(k, functions=9).sde_covariance(LAG, 1.7)
                            for k in (kernel, general, stationary))
    assert_allclose(second, first, atol=1e-9)
    assert_allclose(third, first, atol=1e-12)


@pytest.mark.slow
def test_the_published_comparison():
    """A squared exponential of scale 10 on a window of 130: 22 eigenfunctions against random frequencies."""
    window = np.linspace(0.0, 130.0, 131)[:-1]
    prior = lfm.SquaredExponential(1.0, 10.0)
    exact = np.exp(-0.5 * ((window[:, None] - window) / 10.0) ** 2)

    def error(functions, points):
        kernel = forces.PeriodicKernel(lambda t, s: jnp.exp(-0.5 * ((t - s) / 10.0) ** 2), 130.0)
        force = lfm.Periodic(kernel, functions=functions, points=points)
        return np.abs(np.asarray(force.sde_covariance(window[:, None], window)) - exact).max()

    assert error(22, 200) < 1e-4
    assert error(20, 20) > 5e-3  # with as few points as the source names, there are no 22 eigenfunctions
    for count in (22, 88):
        off = []
        for seed in range(10):
            frequencies = random_frequencies(jax.random.key(seed), prior, count)
            random = SparseSpectrum(1.0, frequencies).covariance(window)
            off.append(np.abs(np.asarray(random) - exact[0]).max())
        assert np.mean(off) > 0.1


@pytest.mark.thorough
def test_random_frequencies_have_the_kernel_as_their_mean():
    lag, count = np.array([0.0, 0.7, 3.0, 11.0]), 100_000
    periodic = forces.PeriodicMatern(1.0, 0.7, 8.0, 1)
    for prior in (lfm.Matern(1.0, 2.0, 0), lfm.Matern(1.0, 2.0, 2), lfm.SquaredExponential(1.0, 2.0), periodic):
        w = np.asarray(random_frequencies(jax.random.key(1), prior, count))
        exact = periodic(lag) if prior is periodic else prior.covariance(lag)
        waves = np.cos(lag[:, None] * w)
        error = waves.std(axis=1) / np.sqrt(count)
        assert (np.abs(waves.mean(axis=1) - exact) <= 4 * error + 1e-7).all()
        assert_allclose(SparseSpectrum(1.0, w[:50]).covariance(lag), waves[:, :50].mean(axis=1), atol=1e-12)


def kernels(p):
    return {"stationary": forces.PeriodicMatern(p[0], p[1], p[2], 1),
            "moderated": forces.ModeratedPeriodicMatern(p[0], p[1], p[2], p[3], 1),
            "function": forces.PeriodicKernel(
                lambda t, s: p[0] ** 2 * jnp.exp(-(((t - s) / p[1]) ** 2) / 20) * (1 + p[3] * jnp.cos(t) * jnp.cos(s)),
                p[2])}


@pytest.mark.parametrize("kind", ["stationary", pytest.param("moderated", marks=pytest.mark.slow)])
def test_derivatives_by_all_parameters_are_finite_differences(kind):
    """First and second ones, the period among the parameters."""
    t = np.array([0.4, 3.1, 8.8, 17.0, 31.0])

    def total(p):
        force = lfm.QuasiPeriodic(kernels(p)[kind], forces.SQM(p[4], POINTS), functions=5, points=40)
        return (force.sde_covariance(t[:, None], t) * jnp.cos(jnp.arange(25.0)).reshape(5, 5)).sum()

    point, h = jnp.array([1.2, 0.8, 10.1, 0.3, 2.5]), 1e-5
    value, gradient = jax.jit(total), jax.jit(jax.grad(total))
    along = h * np.eye(5)
    difference = [(value(point + step) - value(point - step)) / (2 * h) for step in along]
    assert_allclose(gradient(point), difference, rtol=1e-7, atol=1e-8)
    second = [(gradient(point + step) - gradient(point - step)) / (2 * h) for step in along]
    assert_allclose(jax.jit(jax.hessian(total))(point), second, rtol=1e-6, atol=1e-6)


@pytest.mark.thorough
def test_repeated_eigenvalues_have_finite_derivatives():
    """All eigenvalues of a circulant matrix but the first come in pairs; the space of three does not split one."""
    angle = 2 * np.pi * np.arange(12) / 12
    weight = np.cos(np.arange(144.0)).reshape(12, 12)

    def projector(p):
        lag = angle[:, None] - angle
        matrix = jnp.exp(p[0] * jnp.cos(lag)) + p[1] * jnp.cos(angle[:, None] + angle)
        vectors = leading_eigenvectors(matrix, 3)
        return (weight * (vectors @ vectors.T)).sum()

    point, h = jnp.array([1.3, 0.0]), 1e-5
    difference = [(projector(point + step) - projector(point - step)) / (2 * h) for step in h * np.eye(2)]
    assert_allclose(jax.grad(projector)(point), difference, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("evolution", [forces.CQM(12.0), forces.WQM(0.4, POINTS)], ids=["CQM", "WQM"])
def test_simulated_weights_have_the_published_covariance(evolution):
    t, draws = np.array([3.0, 8.0, 20.0, 22.0, 37.0]), 20_000
    model = lfm.LatentForceModel(lambda x, u, t: x, {"a": evolution}, lfm.GaussianObservation(
        lambda x, u, t: u, jnp.array([1e-12])), lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))), initial_time=0.0)
    weights = np.asarray(jax.jit(jax.vmap(lambda key: lfm.simulate(key, model, t, steps=2).forces["a"]))(
        jax.random.split(jax.random.key(0), draws)))
    cycle = np.array([0, 0, 2, 2, 3])  # a change point at an observation comes before it
    later, earlier = np.maximum(*np.meshgrid(cycle, cycle)), np.minimum(*np.meshgrid(cycle, cycle))
    exact = {"CQM": np.exp(-np.abs(t[:, None] - t) / 12.0), "SQM": np.exp(-(later - earlier) / 1.5),
             "WQM": 1.0 + 0.4 * earlier}[type(evolution).__name__]
    assert_allclose(evolution.covariance(t[:, None], t), exact, rtol=1e-12)
    result = weights.T @ weights / draws
    error = np.sqrt((np.outer(np.diag(exact), np.diag(exact)) + exact**2) / draws)
    assert (np.abs(result - exact) < 4 * error).all()


def test_change_points_before_the_initial_time_do_not_count():
    steps = forces.WQM(0.5, POINTS) + lfm.Constant(1.0)
    assert float(steps.covariance_in_model(25.0, 35.0, 12.0)) == 1.0 + 0.5 + 1.0
    assert float(forces.SQM(2.0, POINTS).covariance_in_model(25.0, 35.0, 22.0)) == pytest.approx(np.exp(-0.5))


def test_a_sum_with_jumps_has_the_covariances_of_its_terms():
    force = lfm.QuasiPeriodic(squared_exponential(), forces.SQM(2.0, POINTS), functions=5)
    t = np.array([3.0, 8.0, 20.0, 37.0])
    result = (force + lfm.Matern(2.0, 3.0)).sde_covariance(t[:, None], t)
    expected = force.sde_covariance(t[:, None], t) + lfm.Matern(2.0, 3.0).covariance(t[:, None], t)
    assert_allclose(result, expected, atol=1e-12)


@pytest.mark.thorough
def test_the_covariance_of_the_state_space_form_is_that_of_the_basis():
    t = np.array([0.0, 1.2, 7.0, 13.0])
    for kernel in (squared_exponential(), forces.ModeratedPeriodicMatern(1.0, 1.0, 10.0, 0.1)):
        force = lfm.QuasiPeriodic(kernel, lfm.Matern(1.0, 9.0, order=2), functions=5)
        assert force.state_dim == 15
        assert_allclose(lfm.Force.sde_covariance(force, t[:, None], t), force.sde_covariance(t[:, None], t), atol=1e-12)
        assert_allclose(force.covariance(t, 2.0), kernel(t, 2.0) * lfm.Matern(1.0, 9.0, 2).covariance(t - 2.0))


@pytest.mark.slow
def test_resonators_carry_the_kernel():
    kernel = forces.PeriodicMatern(1.3, 0.7, 24.0, 1)
    result = resonators(kernel, functions=9, mean=2.0)
    exact = lfm.Periodic(kernel, functions=9).sde_covariance(LAG[:, None], LAG)
    assert_allclose(result.covariance(LAG[:, None], LAG), exact, atol=1e-12)
    assert [float(force.period) for force in result.forces[1:]] == [24.0, 12.0, 8.0, 6.0]
    assert float(result.mean_at(5.0)) == 2.0
    noisy = resonators(kernel, functions=3, noise=0.1, damping=0.02)
    scale = float(noisy.forces[1].scale)
    assert float(noisy.forces[1].noise) == pytest.approx(0.1 * scale) and float(noisy.forces[1].damping) == 0.02

    def kernel(p):
        return forces.PeriodicMatern(1.0, 0.7, p)

    gradient = jax.grad(lambda p: resonators(kernel(p), functions=5).covariance(7.0))(24.0)
    expected = jax.grad(lambda p: lfm.Periodic(kernel(p), functions=5).sde_covariance(7.0))(24.0)
    assert float(gradient) == pytest.approx(float(expected), rel=1e-10)


@pytest.mark.parametrize("make, functions", [
    (lambda: lfm.Periodic(forces.PeriodicMatern(2.0, 1.0, 24.0, 1), functions=3), "functions=7"),
    (lambda: lfm.QuasiPeriodic(forces.PeriodicMatern(1.0, 1.0, 24.0, 0), forces.CQM(30.0)), "functions=65"),
    (lambda: resonators(forces.PeriodicMatern(1.0, 1.0, 24.0, 1), functions=5), "functions=7"),
    (lambda: lfm.Periodic(forces.ModeratedPeriodicMatern(1.0, 1.0, 10.0, 0.5), functions=2), "functions=5"),
    (lambda: lfm.Periodic(forces.PeriodicMatern(1.0, 0.001, 24.0, 0), functions=3), "2049"),
])
def test_functions_that_keep_too_little_of_the_variance(make, functions):
    with pytest.warns(lfm.ApproximationWarning, match=functions):
        make()


def test_functions_that_keep_enough():
    kernel = forces.PeriodicMatern(2.0, 1.0, 24.0, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        force = lfm.Periodic(kernel, functions=7)
        lfm.Periodic(kernel, functions=3, explained_variance=0.9)
        resonators(forces.PeriodicMatern(1.0, 1.0, 24.0, 0), functions=3, explained_variance=0.0)
        jax.jit(lambda ell: lfm.Periodic(forces.PeriodicMatern(1.0, ell, 24.0, 0), functions=3).eigenvalues())(1.0)
    assert float(force.eigenvalues().sum()) > 0.99 * 4.0 > float(force.eigenvalues()[jnp.array([0, 1, 2, 4, 5])].sum())


def test_a_kernel_that_is_not_positive_definite_is_named():
    def box(t, s):
        return jnp.where(jnp.abs(jnp.sin(jnp.pi * (t - s) / 5.0)) < 0.6, 1.0, 0.0)

    for stationary in (True, False):
        for options in ({}, {"functions": 9}):
            with pytest.raises(ValueError, match="'box'"):
                lfm.Periodic(forces.PeriodicKernel(box, 5.0, stationary=stationary), **options)

    def kernel(p):
        return forces.PeriodicKernel(box, p, stationary=True)

    assert np.isnan(jax.jit(lambda p: lfm.Periodic(kernel(p), functions=9).eigenvalues())(5.0)).any()
    covariance = jax.jit(lambda ell: forces.SQM(ell, forces.change_points(24.0, 0.0, 50.0)).covariance(0.0, 49.0))
    assert float(covariance(2.0)) == pytest.approx(np.exp(-1.0))
