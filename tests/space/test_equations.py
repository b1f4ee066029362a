"""Heat and wave equations: dense algebra of space and time, closed solutions, rates of convergence, gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.model.simulate import simulate
from lfm_ppl.model.state_space import state_space
from tests.space import references

TIMES = np.array([0.0, 0.3, 0.4, 1.1, 2.0])
RECTANGLE = ((0.0, 1.0), (-1.0, 1.0))
PLACES = {1: np.array([0.05, 0.3, 0.62]), 2: np.array([[0.1, -0.5], [0.4, 0.2], [0.9, 0.95]])}
NEW_PLACES = {1: np.array([0.2, 0.99]), 2: np.array([[0.5, 0.0], [0.2, 0.7]])}
SPATIAL = {1: (lfm.Matern(1.3, 0.4, order=1), references.matern(1, 1.3, 0.4)),
           2: (lfm.SquaredExponential(1.3, 0.6), references.squared_exponential(1.3, 0.6))}


def functions(boundary, domain, modes, positions):
    """Eigenfunctions and wavenumbers of one dimension, by their definition."""
    (low, high), n = domain, np.arange(modes)
    x, length = positions[:, None] - low, high - low
    if boundary == "dirichlet":
        return np.sqrt(2 / length) * np.sin((n + 1) * np.pi * x / length), (n + 1) * np.pi / length
    if boundary == "neumann":
        return np.sqrt((2 - (n == 0)) / length) * np.cos(n * np.pi * x / length), n * np.pi / length
    w = 2 * np.pi * ((n + 1) // 2) / length
    return np.sqrt((2 - (n == 0)) / length) * np.where(n % 2 == 1, np.cos(w * x), np.where(n, np.sin(w * x), 1.0)), w


def expansion(boundary, dimension, modes, positions):
    """Eigenfunctions and wavenumbers of an interval or a rectangle, in any order."""
    if dimension == 1:
        return functions(boundary, (0.0, 1.0), modes, positions)
    (phi, v), (psi, w) = (functions(boundary, RECTANGLE[axis], modes, positions[:, axis]) for axis in (0, 1))
    return (phi[:, :, None] * psi[:, None, :]).reshape(len(positions), -1), np.hypot(v[:, None], w).ravel()


def equation(kind, boundary, dimension, modes=3, sensors=None, **options):
    basis = lfm.LaplaceBasis((0.0, 1.0) if dimension == 1 else RECTANGLE, (modes,) * dimension, boundary)
    source = lfm.SpectralField(basis, SPATIAL[dimension][0], lfm.Matern(1.0, 0.7, order=1))
    parameters = (0.05, 0.4) if kind == "heat" else (1.1, 0.3)
    return basis, source, getattr(lfm, kind)(source, *parameters, initial_time=0.0, covariance=0.02,
                                             sensors=PLACES[dimension] if sensors is None else sensors, **options)


def green(kind, wavenumber):
    """Response of a coefficient to an impulse."""
    if kind == "heat":
        return lambda t: np.exp(-(0.05 * wavenumber**2 + 0.4) * t)
    frequency = np.sqrt((1.1 * wavenumber)**2 - 0.15**2 + 0j)
    return lambda t: np.exp(-0.15 * t) * (t * np.sinc(frequency * t / np.pi)).real


@functools.cache
def coefficient_covariances(kind, boundary, dimension, modes=3):
    """Covariance (J, T, T) of the coefficients driven by the source."""
    _, wavenumbers = expansion(boundary, dimension, modes, PLACES[dimension])
    kernel, temporal = SPATIAL[dimension][1], references.matern(1, 1.0, 0.7)
    return np.array([[[references.spectral_density(kernel, w, dimension, 12.0)
                       * references.response_covariance(green(kind, w), temporal, t, s) for s in TIMES]
                      for t in TIMES] for w in wavenumbers])


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::lfm_ppl.ApproximationWarning")
@pytest.mark.parametrize(("kind", "boundary", "dimension"), [
    ("heat", "dirichlet", 1), ("heat", "neumann", 1), ("heat", "periodic", 1), ("heat", "neumann", 2),
    ("wave", "dirichlet", 1), pytest.param("wave", "periodic", 2, marks=pytest.mark.slow)])
def test_equals_dense_algebra(kind, boundary, dimension):
    basis, _, model = equation(kind, boundary, dimension)
    assert state_space(model).plan.has_exact_offset, "it takes exact transitions"
    y = np.random.default_rng(0).normal(size=(len(TIMES), 3))
    y[1, 2] = np.nan
    seen = np.isfinite(y).ravel()
    covariances = coefficient_covariances(kind, boundary, dimension)

    def covariance(first, second):
        phi, psi = (expansion(boundary, dimension, 3, positions)[0] for positions in (first, second))
        return np.einsum("aj,bj,jts->tasb", phi, psi, covariances).reshape(5 * len(first), 5 * len(second))

    positions, new = PLACES[dimension], NEW_PLACES[dimension]
    dense = covariance(positions, positions)[np.ix_(seen, seen)] + 0.02 * np.eye(seen.sum())
    mean, reduction, log_density = references.condition(covariance(new, positions)[:, seen], dense, y.ravel()[seen])
    assert float(lfm.MarginalLikelihood(model, TIMES).log_prob(y)) == pytest.approx(log_density, abs=1e-8)
    smoothed, modes = lfm.smooth(model, TIMES, y), len(basis.wavenumbers)
    weights = basis.functions(new)
    np.testing.assert_allclose((smoothed.mean[:, :modes] @ weights.T).ravel(), mean, atol=1e-8)
    variance = np.einsum("aj,tjk,ak->ta", weights, smoothed.covariance[:, :modes, :modes], weights)
    np.testing.assert_allclose(variance.ravel(), np.diagonal(covariance(new, new) - reduction), atol=1e-8)


def field(basis, model, times, positions):
    """The field (T, P) of a model without a source, from its filter; the state is known and ignores the data."""
    result = lfm.filter(model, times, np.zeros((len(times), len(model.output_names))))
    return np.asarray(result.predicted_mean[:, :len(basis.wavenumbers)] @ basis.functions(positions).T)


@pytest.mark.parametrize(("boundary", "sign"), [("dirichlet", -1.0), ("neumann", 1.0), ("periodic", 0.0)])
def test_an_initial_field_spreads_by_the_heat_kernel(boundary, sign):
    """A Gaussian bump stays one, of a growing variance; its images keep the boundary condition."""
    basis = lfm.LaplaceBasis((0.0, 2.0), 81, boundary)
    positions, times = np.linspace(0.0, 2.0, 9), np.array([0.0, 0.5, 3.0])

    def bump(r, t=0.0):
        variance = 0.07**2 + 2.0 * 0.02 * t
        images = [(1.0, 0.6 + (2.0 if boundary == "periodic" else 4.0) * m) for m in range(-8, 9)]
        images += [(sign, -0.6 + 4.0 * m) for m in range(-8, 9)]
        return np.exp(-0.3 * t) / np.sqrt(variance) * sum(
            a * np.exp(-0.5 * (r - centre)**2 / variance) for a, centre in images)

    start = lfm.Gaussian(basis.coefficients(bump), np.zeros(81))
    model = lfm.heat(basis, 0.02, 0.3, sensors=positions, covariance=1.0, initial=start)
    expected = np.array([bump(positions, t) for t in times])
    np.testing.assert_allclose(field(basis, model, times, positions), expected, atol=1e-8)


def test_a_plucked_string_moves_as_dalembert_says():
    basis = lfm.LaplaceBasis((0.0, 1.0), 90)
    positions, times, speed = np.linspace(0.0, 1.0, 11), np.array([0.0, 0.21, 0.77, 3.4]), 1.3

    def odd(r):
        r = np.mod(r + 1.0, 2.0) - 1.0
        return np.sign(r) * np.exp(-0.5 * ((np.abs(r) - 0.4) / 0.05)**2)

    start = lfm.Gaussian(jnp.concatenate([basis.coefficients(odd), jnp.zeros(90)]), np.zeros(180))
    model = lfm.wave(basis, speed, 0.0, sensors=positions, covariance=1.0, initial=start)
    expected = [0.5 * (odd(positions - speed * t) + odd(positions + speed * t)) for t in times]
    np.testing.assert_allclose(field(basis, model, times, positions), expected, atol=1e-8)


def test_a_mode_of_a_damped_rectangle_is_a_cosine():
    basis = lfm.LaplaceBasis(((0.0, 2.0), (0.0, 1.0)), (2, 3), "neumann")
    positions, times = np.array([[0.3, 0.2], [1.7, 0.9]]), np.linspace(0.0, 5.0, 6)
    frequency = 0.8 * np.hypot(np.pi / 2, 2 * np.pi)

    def shape(r):
        return np.cos(np.pi * r[:, 0] / 2) * np.cos(2 * np.pi * r[:, 1])

    start = lfm.Gaussian(jnp.concatenate([basis.coefficients(shape), jnp.zeros(6)]), np.zeros(12))
    model = lfm.wave(basis, 0.8, 0.4, sensors=positions, covariance=1.0, initial=start)
    damped = np.sqrt(frequency**2 - 0.04)
    amplitude = np.exp(-0.2 * times) * (np.cos(damped * times) + 0.2 / damped * np.sin(damped * times))
    np.testing.assert_allclose(field(basis, model, times, positions), amplitude[:, None] * shape(positions), atol=1e-8)


@pytest.mark.filterwarnings("ignore::lfm_ppl.ApproximationWarning")
@pytest.mark.parametrize(("order", "rate"), [(0, 1.0), (1, 3.0)])
def test_the_modes_converge_at_the_rate_of_the_spectral_density(order, rate):
    """S falls with w^-(2 p + 2): its sum beyond J functions falls with J^-(2 p + 1)."""
    lost = [float(lfm.SpectralField(lfm.LaplaceBasis((0.0, 1.0), modes), lfm.Matern(1.0, 0.5, order=order),
                                    lfm.Matern(1.0, 1.0)).lost_variance) for modes in (40, 80)]
    assert np.log2(lost[0] / lost[1]) == pytest.approx(rate, abs=0.1)


def test_away_from_the_edges_the_source_has_the_covariance_of_its_kernel():
    basis = lfm.LaplaceBasis((-2.0, 3.0), 200)
    positions = np.linspace(0.0, 1.0, 5)
    for kernel in (lfm.SquaredExponential(1.4, 0.2), lfm.Matern(1.4, 0.2, order=3)):
        weights, _ = lfm.SpectralField(basis, kernel, lfm.Matern(1.0, 1.0)).weights(positions)
        np.testing.assert_allclose(weights @ weights.T, kernel.covariance(positions[:, None], positions), atol=1e-5)


@pytest.mark.thorough
def test_sensors_may_move():
    basis, _, fixed_model = equation("heat", "dirichlet", 1, sensors=np.linspace(0.1, 0.9, 5))
    moving_model = equation("heat", "dirichlet", 1, sensors=lambda t: jnp.array([0.1 + 0.4 * t]))[2]
    y = np.random.default_rng(1).normal(size=(len(TIMES), 1))
    path = 0.1 + 0.4 * TIMES
    rows = np.full((len(TIMES), len(TIMES)), np.nan)
    np.fill_diagonal(rows, y)
    each_place = equation("heat", "dirichlet", 1, sensors=path)[2]
    expected = lfm.MarginalLikelihood(each_place, TIMES).log_prob(rows)
    assert float(lfm.MarginalLikelihood(moving_model, TIMES).log_prob(y)) == pytest.approx(float(expected), abs=1e-9)
    assert simulate(jax.random.key(0), moving_model, TIMES).y.shape == (5, 1)
    assert fixed_model.output_names[-1] == "sensor 4"
    outside_model = equation("heat", "dirichlet", 1, sensors=lambda t: [0.1 + 10.0 * t])[2]
    with pytest.warns(lfm.FilterWarning):
        assert lfm.MarginalLikelihood(outside_model, TIMES).log_prob(y) == -np.inf


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["heat", "wave"])
def test_gradients(kind):
    basis = lfm.LaplaceBasis((0.0, 1.0), 6)
    y = np.random.default_rng(2).normal(size=(len(TIMES), 3))

    def log_density(theta):
        first, second, scale, length, time, noise = theta
        source = lfm.SpectralField(basis, lfm.Matern(scale, length), lfm.Matern(1.0, time))
        model = getattr(lfm, kind)(source, first, second, sensors=PLACES[1], covariance=noise)
        return lfm.MarginalLikelihood(model, TIMES).log_prob(y)

    theta = jnp.array([0.3, 0.4, 1.3, 0.5, 0.7, 0.2])
    value = jax.jit(log_density)
    step = 1e-5 * np.eye(6)
    differences = [(value(theta + h) - value(theta - h)) / 2e-5 for h in step]
    np.testing.assert_allclose(jax.jit(jax.grad(log_density))(theta), differences, rtol=1e-6, atol=1e-6)


@pytest.mark.thorough
def test_a_stiff_or_smooth_expansion_has_finite_gradients():
    """Densities of the last modes underflow, and their rates are large."""
    basis = lfm.LaplaceBasis((0.0, 1.0), 40)

    def log_density(length, diffusivity):
        source = lfm.SpectralField(basis, lfm.SquaredExponential(1.0, length), lfm.Matern(1.0, 1.0))
        model = lfm.heat(source, diffusivity, 0.1, sensors=PLACES[1], covariance=0.01)
        return lfm.MarginalLikelihood(model, TIMES).log_prob(np.ones((len(TIMES), 3)))

    gradient = jax.jit(jax.grad(log_density, (0, 1)))(1.0, 10.0)
    assert np.isfinite(gradient).all() and np.abs(gradient).min() > 0


BASIS = lfm.LaplaceBasis((0.0, 1.0), 3)


@pytest.mark.parametrize(("make", "error", "words"), [
    (lambda: lfm.LaplaceBasis((1.0, 0.0), 3), ValueError, "domain"),
    (lambda: lfm.LaplaceBasis(((0.0, 1.0),) * 3, (3, 3, 3)), ValueError, "domain"),
    (lambda: lfm.LaplaceBasis((0.0, np.inf), 3), ValueError, "domain"),
    (lambda: lfm.LaplaceBasis((0.0, 1.0), 0), ValueError, "modes"),
    (lambda: lfm.LaplaceBasis((0.0, 1.0), 2.5), TypeError, "modes"),
    (lambda: lfm.LaplaceBasis(RECTANGLE, 3), ValueError, "modes"),
    (lambda: lfm.LaplaceBasis((0.0, 1.0), 4, "periodic"), ValueError, "odd"),
    (lambda: lfm.LaplaceBasis((0.0, 1.0), 4, "neuman"), ValueError, "neumann"),
    (lambda: BASIS.functions(np.array([0.5, 1.5])), ValueError, r"points\[1\]"),
    (lambda: BASIS.functions(np.ones((3, 2))), ValueError, "points"),
    (lambda: BASIS.functions(np.array([np.nan])), ValueError, "points"),
    (lambda: BASIS.coefficients(lambda r: 1.0), ValueError, "function"),
    (lambda: lfm.SpectralField(BASIS, lfm.Resonator(1.0, 1.0, 1.0), lfm.Matern(1.0, 1.0)), TypeError, "spatial_kernel"),
    (lambda: lfm.SpectralField(BASIS, lfm.Matern(1.0, 1.0), 3.0), TypeError, "temporal_force"),
    (lambda: lfm.SpectralField(3, lfm.Matern(1.0, 1.0), lfm.Matern(1.0, 1.0)), TypeError, "basis"),
    (lambda: lfm.SpectralField(BASIS, lfm.Matern(1.0, 1.0, mean=2.0), lfm.Matern(1.0, 1.0)), ValueError, "mean"),
    (lambda: lfm.heat("rod", 1.0, 1.0, sensors=PLACES[1], covariance=1.0), TypeError, "source"),
    (lambda: lfm.heat(BASIS, -1.0, 1.0, sensors=PLACES[1], covariance=1.0), ValueError, "diffusivity"),
    (lambda: lfm.heat(BASIS, np.ones(2), 1.0, sensors=PLACES[1], covariance=1.0), ValueError, "diffusivity"),
    (lambda: lfm.heat(BASIS, 1.0, 1.0, sensors=np.array([2.0]), covariance=1.0), ValueError, "domain"),
    (lambda: lfm.heat(BASIS, 1.0, 1.0, sensors=PLACES[1], sd=-1.0), ValueError, "sd"),
    (lambda: lfm.heat(BASIS, 1.0, 1.0, sensors=PLACES[1], covariance=np.ones(2)), ValueError, "covariance"),
    (lambda: lfm.wave(BASIS, 1.0, 1.0, sensors=PLACES[1], covariance=1.0, initial=lfm.Gaussian(np.zeros(3), np.eye(3))),
     ValueError, "initial"),
])
def test_malformed_input(make, error, words):
    with pytest.raises(error, match=words) as info:
        make()
    assert "\n" not in str(info.value)


def test_too_few_modes_are_reported():
    with pytest.warns(lfm.ApproximationWarning, match="3 forces of the field 'source'"):
        lfm.SpectralField(BASIS, lfm.Matern(1.0, 0.05), lfm.Matern(1.0, 1.0))
