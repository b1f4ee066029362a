import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from compiled_programs import compilations
from jax.flatten_util import ravel_pytree
from numpyro.infer import init_to_uniform
from scipy.special import gammaln

from lfm_ppl.inference.curvature import decompose
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.map import map_estimate
from lfm_ppl.inference.optimise import Objective, newton, quasi_newton

RNG = np.random.default_rng(0)
DESIGN = RNG.normal(size=(12, 3))
DATA = RNG.normal(size=12)
PRIOR_SD = np.array([0.5, 2.0, 1.0])


def regression(design, y=None, noise=0.3):
    """Linear and Gaussian: two sites, a scalar and a vector, whose posterior is normal."""
    slope = numpyro.sample("slope", dist.Normal(jnp.zeros(2), PRIOR_SD[1:]).to_event(1))
    level = numpyro.sample("level", dist.Normal(0.0, PRIOR_SD[0]))
    mean = numpyro.deterministic("fit", level * design[:, 0] + design[:, 1:] @ slope)
    numpyro.sample("y", dist.Normal(mean, noise), obs=y)


def regression_posterior(noise=0.3):
    """Return mean, covariance and log evidence, in flat order: level, slope[0], slope[1]."""
    covariance = np.linalg.inv(DESIGN.T @ DESIGN / noise**2 + np.diag(PRIOR_SD**-2.0))
    marginal = DESIGN @ np.diag(PRIOR_SD**2) @ DESIGN.T + noise**2 * np.eye(12)
    _, log_det = np.linalg.slogdet(2 * np.pi * marginal)
    evidence = -0.5 * (log_det + DATA @ np.linalg.solve(marginal, DATA))
    return covariance @ DESIGN.T @ DATA / noise**2, covariance, evidence


def rate_model(counts):
    """Posterior of rate: Gamma(a, b) with a = 2 + sum of counts, b = 1 + number of counts."""
    rate = numpyro.sample("rate", dist.Gamma(2.0, 1.0))
    numpyro.sample("counts", dist.Poisson(rate), obs=counts)


COUNTS = jnp.array([3, 7, 4, 6])
A, B = 22.0, 5.0


@pytest.mark.parametrize("options", [{}, {"jacobian": False}, {"forward_mode": True},
                                     {"hessian": "finite-differences"}, {"model_kwargs": {"noise": 0.05}}], ids=str)
def test_a_gaussian_posterior_is_found_exactly(options):
    mean, covariance, evidence = regression_posterior(**options.get("model_kwargs", {}))
    result = map_estimate(regression, DESIGN, DATA, restarts=2, **options)
    assert result.converged and result.message == "converged" and result.unidentified == ()
    assert result.coordinates == ("level", "slope[0]", "slope[1]")
    np.testing.assert_allclose(result.mode, mean, rtol=1e-7)
    np.testing.assert_allclose(result.parameters["level"], mean[0], rtol=1e-7)
    np.testing.assert_allclose(result.parameters["slope"], mean[1:], rtol=1e-7)
    np.testing.assert_allclose(result.deterministic["fit"], DESIGN @ mean, rtol=1e-6)
    np.testing.assert_allclose(result.covariance, covariance, atol=1e-6 * covariance.max())
    # a Gaussian: evidence = density at the mode / posterior density at the mode
    assert result.log_evidence == pytest.approx(evidence, abs=1e-6)
    _, log_det = np.linalg.slogdet(2 * np.pi * covariance)
    assert result.log_density == pytest.approx(evidence - 0.5 * log_det, abs=1e-6)


def test_a_mode_and_its_covariance_start_a_chain():
    result = map_estimate(regression, DESIGN, DATA, restarts=1)
    kernel = RAM(regression, initial_covariance=result.covariance)
    start = jax.tree.map(jnp.asarray, result.unconstrained)
    state = kernel.init(jax.random.key(0), 10, start, (DESIGN, DATA), {})
    np.testing.assert_array_equal(ravel_pytree(state.z)[0], result.mode)
    assert state.potential_energy == pytest.approx(-result.log_density)
    proposal = state.chol_proposal @ state.chol_proposal.T
    np.testing.assert_allclose(proposal, 2.38**2 / 3 * result.covariance, rtol=1e-10)


def test_the_mode_of_the_unconstrained_density_is_not_that_of_the_constrained_one():
    # Gamma(a, b): mode a / b of log rate, whose curvature is a; mode (a - 1) / b of the rate
    # and, by Stirling, the Laplace evidence of the integral gamma(a) / b^a in either space
    constant = -float(gammaln(COUNTS + 1.0).sum()) - float(gammaln(2.0))
    unconstrained = map_estimate(rate_model, COUNTS, restarts=2)
    assert unconstrained.parameters["rate"] == pytest.approx(A / B, rel=1e-7)
    assert unconstrained.covariance[0, 0] == pytest.approx(1 / A, rel=1e-7)
    expected = A * math.log(A / B) - A + 0.5 * math.log(2 * math.pi / A)
    assert unconstrained.log_evidence == pytest.approx(constant + expected, abs=1e-7)
    constrained = map_estimate(rate_model, COUNTS, restarts=2, jacobian=False)
    mode = (A - 1) / B
    assert constrained.parameters["rate"] == pytest.approx(mode, rel=1e-7)
    # variance of the rate is mode^2 / (a - 1); of its logarithm 1 / (a - 1)
    assert constrained.covariance[0, 0] == pytest.approx(1 / (A - 1), rel=1e-6)
    expected = (A - 1) * math.log(mode) - (A - 1) + 0.5 * math.log(2 * math.pi * (A - 1) / B**2)
    assert constrained.log_evidence == pytest.approx(constant + expected, abs=1e-7)


def test_draws_follow_the_laplace_approximation():
    mean, covariance, _ = regression_posterior()
    n = 20_000
    result = map_estimate(regression, DESIGN, DATA, restarts=1)
    draws = result.sample(jax.random.key(0), n)
    assert draws["fit"].shape == (n, 12)
    flat = np.column_stack([draws["level"], draws["slope"]])
    np.testing.assert_allclose(draws["fit"], flat @ DESIGN.T, atol=1e-10)
    sd = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(flat.mean(0) - mean) < 4 * sd / math.sqrt(n))
    # Var of a sample covariance entry: (C_ii C_jj + C_ij^2) / n
    error = np.sqrt((np.outer(sd**2, sd**2) + covariance**2) / n)
    assert np.all(np.abs(np.cov(flat.T) - covariance) < 4 * error)

    rates = np.log(map_estimate(rate_model, COUNTS).sample(jax.random.key(1), n)["rate"])
    assert abs(rates.mean() - math.log(A / B)) < 4 / math.sqrt(A * n)
    assert abs(rates.std() - 1 / math.sqrt(A)) < 4 / math.sqrt(2 * A * n)


@pytest.mark.thorough
def test_sites_with_a_constraint_of_another_dimension():
    """Dirichlet-multinomial on the simplex; two unconstrained coordinates for three values."""

    def model(counts):
        share = numpyro.sample("share", dist.Dirichlet(jnp.array([2.0, 3.0, 4.0])))
        numpyro.sample("counts", dist.Multinomial(10, share), obs=counts)

    result = map_estimate(model, jnp.array([5, 3, 2]), jacobian=False, restarts=1)
    np.testing.assert_allclose(result.parameters["share"], np.array([6, 5, 5]) / 16, rtol=1e-7)
    assert result.coordinates == ("share[0]", "share[1]")
    draws = np.asarray(result.sample(jax.random.key(0), 100)["share"])
    np.testing.assert_allclose(draws.sum(1), 1.0)


def two_modes():
    x = numpyro.sample("x", dist.Normal(0.0, 10.0))
    mixture = jnp.logaddexp(-0.5 * (x + 4) ** 2, 3.0 - 0.5 * (x - 4) ** 2)
    numpyro.factor("mixture", mixture)


def test_the_best_of_several_restarts_is_taken():
    stuck = map_estimate(two_modes, init={"x": -5.0}, restarts=1)
    assert stuck.parameters["x"] == pytest.approx(-4 * 100 / 101, abs=1e-6)
    best = map_estimate(two_modes, init={"x": -5.0}, restarts=8)
    assert best.parameters["x"] == pytest.approx(4 * 100 / 101, abs=1e-6)
    assert best.restart_log_densities[0] == pytest.approx(stuck.log_density)
    assert best.restart_log_densities.max() == pytest.approx(best.log_density)
    assert map_estimate(two_modes, init=init_to_uniform(radius=0.5), restarts=1).converged


def partly_impossible():
    x = numpyro.sample("x", dist.Normal(0.0, 1.0))
    wall = jnp.where(x > 1.0, -10.0 * (x - 1.5) ** 2, jnp.where(x > 0.0, jnp.nan, -jnp.inf))
    numpyro.factor("wall", wall)


def test_regions_without_density_are_walls():
    result = map_estimate(partly_impossible, restarts=6)
    assert result.converged
    assert result.parameters["x"] == pytest.approx(30 / 21, rel=1e-8)
    assert result.covariance[0, 0] == pytest.approx(1 / 21, rel=1e-8)


def test_flat_directions_are_named_and_the_covariance_stays_definite():
    def model(y):
        unbounded = dist.ImproperUniform(dist.constraints.real, (), ())
        total = numpyro.sample("a", unbounded) + numpyro.sample("b", unbounded)
        numpyro.sample("c", dist.Normal(1.0, 2.0))
        numpyro.sample("y", dist.Normal(total, 1.0), obs=y)

    with pytest.warns(UserWarning, match="a, b"):
        result = map_estimate(model, 3.0)
    assert result.unidentified == ("a", "b")
    assert result.parameters["a"] + result.parameters["b"] == pytest.approx(3.0)
    assert np.linalg.eigvalsh(result.covariance).min() > 0
    # what the data do determine is right: Var(a + b) = 1, Var(c) = 4
    total = np.array([1.0, 1.0, 0.0])
    assert total @ result.covariance @ total == pytest.approx(1.0, rel=1e-3)
    assert result.covariance[2, 2] == pytest.approx(4.0)


def test_wide_and_narrow_posteriors_are_not_flat():
    def model(y):
        a = numpyro.sample("a", dist.Normal(0.0, 1e5))
        b = numpyro.sample("b", dist.Normal(0.0, 1.0))
        c = numpyro.sample("c", dist.Normal(0.0, 1.0))
        numpyro.sample("y", dist.Normal(b + c, 1e-4), obs=y)
        numpyro.deterministic("d", a)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = map_estimate(model, 1.0, init={"a": 3.0})
    expected = 0.5 * np.array([[1.0, -1.0], [-1.0, 1.0]])  # up to the noise of 1e-4
    np.testing.assert_allclose(result.covariance[1:, 1:], expected, atol=1e-6)
    assert result.covariance[0, 0] == pytest.approx(1e10)


def test_a_mode_at_infinity_is_reported():
    def model():
        x = numpyro.sample("x", dist.ImproperUniform(dist.constraints.real, (), ()))
        numpyro.sample("z", dist.Normal())
        numpyro.factor("slope", 0.1 * x)

    with pytest.warns(UserWarning, match="converge"):
        result = map_estimate(model, restarts=1, max_iterations=20)
    assert not result.converged and result.message != "converged"


def test_forward_mode_serves_loops_that_have_no_reverse_mode():
    def model(y):
        x = numpyro.sample("x", dist.Normal(0.0, 1.0))
        halved = jax.lax.while_loop(lambda v: v[1] < 3, lambda v: (v[0] / 2, v[1] + 1), (x, 0))[0]
        numpyro.sample("y", dist.Normal(8 * halved, 1.0), obs=y)

    for hessian in ("autodiff", "finite-differences"):
        result = map_estimate(model, 3.0, forward_mode=True, hessian=hessian)
        assert result.parameters["x"] == pytest.approx(1.5, rel=1e-7)
        assert result.covariance[0, 0] == pytest.approx(0.5, rel=1e-7)


# Optimisation on its own


def test_narrow_valley():
    def rosenbrock(z):
        return jnp.sum(100 * (z[1:] - z[:-1] ** 2) ** 2 + (1 - z[:-1]) ** 2)

    objective = Objective.of(rosenbrock)
    end = quasi_newton(objective, np.array([-1.2, 1.0, -1.0, 1.5]), 1000)
    minimum = newton(objective, end.point)
    np.testing.assert_allclose(minimum.point, 1.0, atol=1e-9)


def counted(function):
    """Return an objective in NumPy's terms, and the points where it is evaluated."""
    points = []

    def program(z):
        points.append(np.array(z))
        return function(np.asarray(z))

    return Objective(program), points


def test_a_search_evaluates_nothing_of_its_own_and_stays_within_bounds():
    objective, points = counted(lambda z: (float((z - 3.0) @ (z - 3.0)), 2 * (z - 3.0)))
    end = quasi_newton(objective, np.array([0.5, 9.0]), bounds=np.array([[0.0, 1.0], [2.0, 8.0]]))
    np.testing.assert_allclose(end.point, [1.0, 3.0], atol=1e-9)
    assert end.value == pytest.approx(4.0) and objective.evaluations == len(points)
    assert len({tuple(point) for point in points}) == len(points)
    np.testing.assert_array_equal(points[0], [0.5, 8.0])
    assert all(0.0 <= first <= 1.0 and 2.0 <= second <= 8.0 for first, second in points)
    loose, points = counted(lambda z: (float(z @ z), 2 * z))
    end = quasi_newton(loose, np.array([5.0, -9.0]), options={"gtol": 100.0})
    assert len(points) == 1 and end.value == 106.0


def test_a_search_turns_back_from_where_there_is_no_value_or_no_gradient():
    for bad in ((np.nan, np.zeros(1)), (-np.inf, np.zeros(1)), (-9.0, np.full(1, np.nan))):
        objective, points = counted(lambda z, bad=bad: bad if z[0] < -1.0 else (0.5 * float(z @ z), z))
        end = quasi_newton(objective, np.array([40.0]), bounds=np.array([[-50.0, 50.0]]))
        assert end.point == pytest.approx([0.0], abs=1e-6) and end.value == pytest.approx(0.0, abs=1e-12)
    objective, points = counted(lambda z: (np.nan, np.zeros(2)))
    end = quasi_newton(objective, np.ones(2))
    assert end.value == np.inf and len(points) == 1
    np.testing.assert_array_equal(end.point, np.ones(2))


def test_a_saddle_point_has_negative_curvature():
    minimum = newton(Objective.of(lambda z: z[0] ** 2 - z[1] ** 2 + z[1] ** 4), np.zeros(2))
    negative = minimum.curvature.values < 0
    assert list(minimum.curvature.coordinates(negative)) == [1]
    minimum = newton(
        Objective.of(lambda z: z[0] ** 2 - z[1] ** 2 + z[1] ** 4), np.array([0.3, 0.1])
    )
    np.testing.assert_allclose(minimum.point, [0.0, math.sqrt(0.5)], atol=1e-8)


def test_curvature_does_not_depend_on_units():
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(4, 4))
    hessian = factor @ factor.T
    units = np.diag([1e-6, 1.0, 1e5, 1e2])
    curvature = decompose(units @ hessian @ units, 1e-12)
    assert not curvature.flat.any()
    inverse = curvature.factor @ curvature.factor.T
    np.testing.assert_allclose(units @ inverse @ units, np.linalg.inv(hessian), rtol=1e-8)
    assert curvature.log_determinant == pytest.approx(
        np.linalg.slogdet(hessian)[1] + 2 * math.log(1e-6 * 1e5 * 1e2)
    )


@pytest.mark.parametrize("last, definite", [(3.0, True), (1e-9, False), (-3.0, False)])
def test_only_positive_curvature_in_all_directions_is_definite(last, definite):
    rotation = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    assert decompose(rotation @ np.diag([1.0, 2.0, last]) @ rotation.T, 1e-7).definite is definite


# Errors


def discrete():
    numpyro.sample("class", dist.Bernoulli(0.3))


def impossible():
    x = numpyro.sample("x", dist.Normal())
    numpyro.factor("never", jnp.where(x > 1e9, 0.0, -jnp.inf))


@pytest.mark.parametrize(("model", "options", "name"), [
    (two_modes, {"hessian": "autodif"}, "'autodif'"), (two_modes, {"restarts": 0}, "restarts"),
    (two_modes, {"max_iterations": 0}, "max_iterations"), (two_modes, {"init": {"y": 1.0}}, "'y'"),
    (two_modes, {"init": {"x": [1.0, 2.0]}}, "'x'"), (partly_impossible, {"init": {"x": -1.0}}, "init="),
    (impossible, {}, "finite density"), (discrete, {}, "'class'"),
])
def test_bad_input_is_named(model, options, name):
    with pytest.raises(ValueError, match=name):
        map_estimate(model, **options)


def test_derivatives_that_do_not_exist_are_reported():
    @jax.custom_jvp
    def rough(x):
        return x**2

    @rough.defjvp
    def rough_jvp(primals, tangents):
        return rough(*primals), jnp.nan * tangents[0]

    def model():
        numpyro.factor("rough", -rough(numpyro.sample("x", dist.Normal())))

    with pytest.warns(UserWarning, match="derivatives are not finite"):
        result = map_estimate(model, restarts=1)
    assert not result.converged
    assert np.isnan(result.log_evidence)
    with pytest.raises(ValueError, match="no Laplace approximation to draw from"):
        result.sample(jax.random.key(0), 3)


@pytest.mark.parametrize("restarts", [2, 7])
def test_starts_and_draws_compile_few_programs(restarts):
    """The model, its priors and the search; random keys, signs and draws take none of each number of starts."""
    map_estimate(regression, DESIGN, DATA, restarts=3)
    with compilations() as names:
        result = map_estimate(regression, DESIGN, DATA, restarts=restarts)
        draws = result.sample(jax.random.key(0), 5)
    assert draws["slope"].shape == (5, 2)
    assert len(names) <= 6, names
