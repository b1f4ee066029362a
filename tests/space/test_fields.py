"""Separable fields: the dense Kronecker process, kriging, ranks, gradients, and counts in space and time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from tests.space import references

TIMES = np.array([0.0, 0.3, 0.4, 1.1, 2.0])
RNG = np.random.default_rng(0)
POINTS = {1: np.array([0.0, 0.4, 0.5, 1.3]), 2: RNG.uniform(size=(6, 2))}
NEW = {1: np.array([0.2, 0.4, 3.0]), 2: np.array([[0.5, 0.5], [2.0, 0.0]])}


def observed(field, function=None, **options):
    """A model that observes a field at its points."""
    function = function or (lambda x, u, t: field(u))
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.zeros(0), field.forces,
        options.get("observation", lfm.GaussianObservation(function, 0.05 * jnp.ones(len(field.points)))),
        lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))


@pytest.mark.thorough
@pytest.mark.parametrize("dimension", [1, 2])
@pytest.mark.parametrize(("kernel", "reference"), [
    (lfm.Matern(1.4, 0.6, order=1), references.matern(1, 1.4, 0.6)),
    (lfm.SquaredExponential(0.7, 0.3), references.squared_exponential(0.7, 0.3))])
def test_equals_a_dense_process_and_its_kriging(dimension, kernel, reference):
    points, new, temporal = POINTS[dimension], NEW[dimension], references.matern(2, 1.0, 0.8)
    field = lfm.SeparableField(points, kernel, lfm.Matern(1.0, 0.8, order=2))
    y = np.random.default_rng(1).normal(size=(len(TIMES), len(points)))

    def covariance(first, second):
        first, second = (r.reshape(len(r), -1) for r in (first, second))
        space = reference(np.sqrt(((first[:, None] - second)**2).sum(-1)))
        return np.kron(temporal(TIMES[:, None] - TIMES), space)

    dense = covariance(points, points) + 0.05 * np.eye(y.size)
    mean, reduction, log_density = references.condition(covariance(new, points), dense, y.ravel())
    model = observed(field)
    assert float(lfm.MarginalLikelihood(model, TIMES).log_prob(y)) == pytest.approx(log_density, abs=1e-8)
    smoothed = lfm.smooth(model, TIMES, y)
    weights, residual = field.weights(new)
    np.testing.assert_allclose((smoothed.input_mean @ weights.T).ravel(), mean, atol=1e-8)
    variance = np.einsum("aj,tjk,ak->ta", weights, smoothed.input_covariance, weights) + residual
    np.testing.assert_allclose(variance.ravel(), np.diagonal(covariance(new, new) - reduction), atol=1e-8)
    np.testing.assert_allclose(field.weights(points)[0], field.root, atol=1e-8)


@pytest.mark.thorough
def test_a_low_rank_is_enough_for_a_smooth_field():
    points = np.linspace(0.0, 1.0, 40)
    field = lfm.SeparableField(points, lfm.SquaredExponential(2.0, 0.4), lfm.Matern(1.0, 1.0), rank=8)
    full = field.spatial_kernel.covariance(points[:, None], points)
    assert 0 <= float(field.lost_variance) < 1e-6
    np.testing.assert_allclose(field.root @ field.root.T, full, atol=1e-4)
    weights, residual = field.weights(points)
    np.testing.assert_allclose((weights**2).sum(1) + residual, 4.0, atol=1e-12)
    with pytest.warns(lfm.ApproximationWarning, match="2 forces of the field 'field'"):
        lfm.SeparableField(points, lfm.SquaredExponential(2.0, 0.4), lfm.Matern(1.0, 1.0), rank=2)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::lfm_ppl.ApproximationWarning")
@pytest.mark.parametrize("rank", [3, 6, 9])
def test_gradients(rank):
    """Also of a singular covariance: three points are given twice."""
    points = np.concatenate([POINTS[2], POINTS[2][:3]])
    y = np.random.default_rng(2).normal(size=(len(TIMES), 9))

    def log_density(theta):
        field = lfm.SeparableField(points, lfm.Matern(theta[0], theta[1]), lfm.Matern(1.0, theta[2]), rank)
        weights, residual = field.weights(NEW[2])
        return lfm.MarginalLikelihood(observed(field), TIMES).log_prob(y) + weights.sum() + residual.sum()

    theta, value = jnp.array([1.3, 0.5, 0.7]), jax.jit(log_density)
    differences = [(value(theta + h) - value(theta - h)) / 2e-5 for h in 1e-5 * np.eye(3)]
    np.testing.assert_allclose(jax.jit(jax.grad(log_density))(theta), differences, rtol=1e-5, atol=1e-5)


def test_equal_points_of_a_grid_keep_their_order():
    """Otherwise rounding errors choose among points that are equal by symmetry, differently for each parameter."""
    side = np.linspace(0.1, 0.9, 5)
    points = np.stack([grid.ravel() for grid in np.meshgrid(side, side, indexing="ij")], axis=1)
    fields = [lfm.SeparableField(points, lfm.SquaredExponential(1.0, length), lfm.Matern(1.0, 1.0), rank=8)
              for length in 0.5 * (1.0 + 1e-6 * np.arange(5))]
    for field in fields[1:]:
        assert field.pivots.tolist() == fields[0].pivots.tolist()
        np.testing.assert_allclose(field.root, fields[0].root, atol=1e-3)


@pytest.mark.thorough
def test_counts_in_cells_and_times():
    """A log-Gaussian Cox process: the evidence of a few counts against importance sampling from the posterior."""
    points, times, area = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0]]), np.arange(4.0), 0.5
    field = lfm.SeparableField(points, lfm.Matern(0.8, 1.0), lfm.Matern(1.0, 2.0))
    model = observed(field, observation=lfm.PoissonObservation(lambda x, u, t: 1.0 + field(u), exposure=area))
    y = np.random.default_rng(3).poisson(2.0, size=(4, 3)).astype(float)
    evidence = float(lfm.MarginalLikelihood(model, times).log_prob(y))
    covariance = np.kron(references.matern(1, 1.0, 2.0)(times[:, None] - times),
                         references.matern(1, 0.8, 1.0)(np.sqrt(((points[:, None] - points)**2).sum(-1))))
    # Laplace's proposal with heavier tails, written here once more.
    f, prior = np.zeros(12), np.linalg.inv(covariance)
    for _ in range(50):
        rate = area * np.exp(1.0 + f)
        f = f + np.linalg.solve(prior + np.diag(rate), y.ravel() - rate - prior @ f)
    precision = prior + np.diag(area * np.exp(1.0 + f))
    factor = np.linalg.cholesky(np.linalg.inv(precision) * 1.1)
    z = np.random.default_rng(4).normal(size=(200_000, 12))
    draws = f + z @ factor.T
    proposal = -0.5 * (z**2).sum(1) - np.log(np.diagonal(factor)).sum()
    target = (-0.5 * np.einsum("si,ij,sj->s", draws, prior, draws) - 0.5 * np.linalg.slogdet(covariance)[1]
              + jax.scipy.stats.poisson.logpmf(y.ravel(), area * np.exp(1.0 + draws)).sum(1))
    exact = float(jax.scipy.special.logsumexp(jnp.asarray(target - proposal)) - np.log(len(z)))
    assert evidence == pytest.approx(exact, abs=0.01)


@pytest.mark.parametrize(("make", "error", "words"), [
    (lambda: lfm.SeparableField(np.ones((2, 2, 2)), lfm.Matern(1.0, 1.0), lfm.Matern(1.0, 1.0)), ValueError, "points"),
    (lambda: lfm.SeparableField(np.array([0.0, np.nan]), lfm.Matern(1.0, 1.0), lfm.Matern(1.0, 1.0)), ValueError,
     "points"),
    (lambda: lfm.SeparableField(POINTS[1], lfm.Matern(1.0, 1.0), lfm.Matern(1.0, 1.0), 5), ValueError, "rank"),
    (lambda: lfm.SeparableField(POINTS[1], lfm.Matern(1.0, 1.0), lfm.Matern(1.0, 1.0), 2.0), TypeError, "rank"),
    (lambda: lfm.SeparableField(POINTS[1], lfm.Constant(1.0), lfm.Matern(1.0, 1.0)), TypeError, "spatial_kernel"),
    (lambda: lfm.SeparableField(POINTS[1], lfm.Matern(1.0, 1.0), lfm.WienerVelocity(1.0)), ValueError, "stationary"),
    (lambda: lfm.SeparableField(POINTS[1], lfm.Matern(1.0, 1.0), lfm.Matern(1.0, 1.0))(jnp.ones(3)), ValueError,
     "4 forces"),
    (lambda: lfm.SeparableField(POINTS[2], lfm.Matern(1.0, 1.0), lfm.Matern(1.0, 1.0)).weights(POINTS[1]), ValueError,
     r"\(P, 2\)"),
])
def test_malformed_input(make, error, words):
    with pytest.raises(error, match=words):
        make()
