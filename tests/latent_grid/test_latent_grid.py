"""Forces on a grid: the explicit solution against an ODE solver, the posterior against the Kalman smoother."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lfm_ppl as lfm
from lfm_ppl.latent_grid.latent_grid import LatentGrid

TIMES = np.array([0.0, 0.7, 1.3, 1.3, 2.9, 4.0])
DECAY = np.array([0.0, 0.8, 30.0])
COUPLED = np.array([[0.0, 1.0], [-2.0, -0.3]])


def path(t):
    """A smooth force."""
    return np.sin(1.3 * t) + 0.4 * t


def link(u):
    return jnp.exp(0.7 * u)


def genes(initial_variance=0.0, noise=0.01, function=link, **changes):
    """Three decays, one of them none and one fast compared with the cells."""
    arguments = {
        "dynamics": lambda x, u, t: 0.3 + jnp.array([1.0, 0.5, 20.0]) * function(u[0]) * (1 + 0.1 * t) - DECAY * x,
        "forces": {"u": lfm.Matern(1.0, 1.5, order=1)},
        "observation": lfm.GaussianObservation(lambda x, u, t: x, noise * jnp.ones(3)),
        "initial_state": lfm.Gaussian(jnp.array([0.2, 0.1, 0.5]), initial_variance * jnp.eye(3)),
    } | changes
    return lfm.LatentForceModel(**arguments)


def oscillator(**changes):
    """Two coupled states pushed by two forces."""
    arguments = {
        "dynamics": lambda x, u, t: jnp.asarray(COUPLED) @ x + jnp.array([0.0, 1.0]) * (link(u[0]) + jnp.tanh(u[1])),
        "forces": {"u": lfm.Matern(1.0, 1.5, order=1), "v": lfm.Matern(0.5, 0.7, order=0, mean=0.2)},
        "observation": lfm.GaussianObservation(lambda x, u, t: x[:1] ** 2 + u[1], jnp.array([0.1])),
        "initial_state": lfm.Gaussian(jnp.array([1.0, 0.0]), jnp.zeros(2)),
    } | changes
    return lfm.LatentForceModel(**arguments)


def state(latent, u):
    return jax.jit(lambda u: latent.state(u))(u)


# The linear quadrature is exact below.


def solved(model, forces, start):
    """The state at TIMES by an ODE solver of high order."""
    dynamics = jax.jit(lambda x, u, t: model.dynamics(x, u, t))

    def slope(t, x):
        return np.asarray(dynamics(x, np.array([float(f(t)) for f in forces]), t))

    solution = solve_ivp(slope, (TIMES[0], TIMES[-1]), start, t_eval=np.unique(TIMES), rtol=1e-10, atol=1e-12,
                         method="LSODA")
    return solution.y.T[np.searchsorted(np.unique(TIMES), TIMES)]


@pytest.mark.parametrize("build, forces, quadrature, order", [
    (genes, [path], "riemann", 1.0), *(
        pytest.param(oscillator, [path, lambda t: np.cos(t)], quadrature, 2.0, marks=pytest.mark.slow)
        for quadrature in ("trapezoid", "linear"))])
def test_the_state_converges_to_that_of_an_ode_solver(build, forces, quadrature, order):
    """On grids that do not hold the observation times, so that the last cell is cut."""
    model = build()
    start = np.asarray(model.initial_state.mean)
    exact = solved(model, forces, start)
    errors = []
    for points in (174, 347, 693):
        grid = np.linspace(TIMES[0], TIMES[-1], points)
        u = np.stack([np.broadcast_to(f(grid), grid.shape) for f in forces])
        state = jax.jit(lambda u, grid=grid: LatentGrid(model, TIMES, grid, quadrature).state(u))(u)
        errors.append(np.abs(np.asarray(state) - exact)[1:].max(axis=0))
    slowest = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))[-1]
    assert np.all(slowest > order - 0.15), (errors, slowest)
    # The fast decay of 30 on cells of 4/692: half of 30 h in the first order, (30 h)^2 / 12 in the second.
    assert np.all(errors[-1] / np.abs(exact).max(axis=0) < (0.1 if order == 1 else 3e-3))


@pytest.mark.thorough
@pytest.mark.parametrize("build, forces", [(genes, 1), pytest.param(oscillator, 2, marks=pytest.mark.slow)])
def test_the_linear_rule_is_exact_for_a_production_linear_in_each_cell(build, forces):
    """Whatever the width of the cells: four of them, uneven, and a link that is the identity."""
    model = build(function=lambda u: u) if build is genes else build(
        dynamics=lambda x, u, t: jnp.asarray(COUPLED) @ x + jnp.array([0.5, 1.0]) * (u[0] - 2 * u[1]))
    if build is genes:
        model = genes(dynamics=lambda x, u, t: 0.3 + jnp.array([1.0, 0.5, 20.0]) * u[0] - DECAY * x)
    grid = np.array([0.0, 0.4, 1.1, 2.0, 4.2])
    values = np.random.default_rng(0).normal(size=(forces, 5))
    latent = LatentGrid(model, TIMES, grid, "linear")
    force_functions = [lambda t, row=row: np.interp(t, grid, row) for row in values]
    start = np.array([0.7, -0.2, 0.4])[: model.initial_state.mean.shape[0]]
    state_at_times = np.asarray(latent.state(jnp.asarray(values), jnp.asarray(start)))
    # From kink to kink, so that the solver keeps its order.
    breaks = np.unique(np.concatenate([grid[:-1], TIMES]))
    state, states = start, {0.0: start}
    for start_time, end_time in zip(breaks[:-1], breaks[1:], strict=True):
        def slope(t, x):
            return np.asarray(model.dynamics(jnp.asarray(x), jnp.asarray([f(t) for f in force_functions]), t))
        state = solve_ivp(slope, (start_time, end_time), state, rtol=1e-11, atol=1e-13, method="LSODA").y[:, -1]
        states[end_time] = state
    assert np.allclose(state_at_times, [states[t] for t in TIMES], rtol=1e-7, atol=1e-8)


@pytest.mark.slow
def test_a_linear_link_has_the_posterior_of_the_kalman_smoother():
    """The dense Gaussian posterior on the grid against the exact smoother: likelihood, mean and standard deviation."""
    model = genes(initial_variance=0.04, dynamics=lambda x, u, t: 0.3 + jnp.array([1.0, 0.5, 2.0]) * u[0]
                  - jnp.array([0.0, 0.8, 3.0]) * x)
    y = np.random.default_rng(1).normal(size=(len(TIMES), 3))
    y[2, 0] = y[4] = np.nan
    latent = LatentGrid(model, TIMES, 601, "linear")
    present = np.isfinite(y).ravel()
    jacobian, by_start = (np.asarray(part).reshape(y.size, -1) for part in jax.jit(jax.jacobian(
        latent.state, argnums=(0, 1)))(latent.mean, jnp.zeros(3)))
    prior = np.asarray(latent.root)[0] @ np.asarray(latent.root)[0].T
    mean_state = np.asarray(latent.state(latent.mean, latent.ssm.model.initial_state.mean)).ravel()
    a, residual = jacobian[present], (y.ravel() - mean_state)[present]
    covariance = a @ prior @ a.T + by_start[present] @ by_start[present].T * 0.04 + 0.01 * np.eye(present.sum())
    gain = prior @ a.T @ np.linalg.inv(covariance)
    mean, sd = gain @ residual, np.sqrt(np.diag(prior - gain @ a @ prior))
    log_marginal = -0.5 * (residual @ np.linalg.solve(covariance, residual) + np.linalg.slogdet(covariance)[1]
                           + present.sum() * np.log(2 * np.pi))
    exact = lfm.smooth(model, TIMES, y, at=latent.grid)
    on_grid = np.searchsorted(np.asarray(exact.times), latent.grid)
    assert abs(log_marginal - float(lfm.MarginalLikelihood(model, TIMES).log_prob(y))) < 2e-3
    assert np.allclose(mean, np.asarray(exact.force("u").mean)[on_grid], atol=2e-3)
    assert np.allclose(sd, np.asarray(exact.force("u").sd)[on_grid], atol=2e-3)


@pytest.mark.thorough
def test_the_likelihood_leaves_out_what_is_missing_and_wraps_angles():
    latent = LatentGrid(oscillator(), TIMES, 61)
    lag = np.abs(latent.grid[:, None] - latent.grid)
    assert np.allclose(latent.root[1] @ latent.root[1].T, 0.25 * np.exp(-lag / 0.7), atol=1e-9)
    assert np.allclose(latent.mean, [[0.0], [0.2]])
    u = latent.force(jax.random.normal(jax.random.key(0), (2, 61)))
    y = np.linspace(-1.0, 2.0, len(TIMES))[:, None]
    y[2] = np.nan
    predicted = np.asarray(latent.state(u))[:, :1] ** 2 + np.interp(TIMES, latent.grid, np.asarray(u[1]))[:, None]
    expected = -0.5 * np.nansum((y - predicted) ** 2 / 0.1 + np.log(2 * np.pi * 0.1) + 0 * y)
    assert np.isclose(latent.log_likelihood(u, jnp.asarray(y)), expected, rtol=1e-12)
    turned = LatentGrid(oscillator(observation=lfm.GaussianObservation(
        lambda x, u, t: x[:1] ** 2 + u[1] + 4 * jnp.pi, jnp.array([0.1]), angular=(0,))), TIMES, 61)
    shifted = jnp.asarray(predicted + 0.1)
    assert np.isclose(turned.log_likelihood(u, shifted), latent.log_likelihood(u, shifted), rtol=1e-10)


def test_gradients_in_the_parameters_are_those_of_finite_differences():
    grid = np.linspace(0.0, 4.0, 31)
    white = jax.random.normal(jax.random.key(1), (1, 31))
    y = jnp.ones((len(TIMES), 3))

    def value(theta):
        decay, scale, lengthscale = theta
        model = genes(dynamics=lambda x, u, t: link(u[0]) - jnp.array([0.0, 1.0, 30.0]) * decay * x,
                      forces={"u": lfm.Matern(scale, lengthscale, order=1)})
        latent = LatentGrid(model, TIMES, grid, "linear")
        return latent.log_likelihood(latent.force(white), y)

    theta = jnp.array([0.7, 1.1, 1.4])
    slope, value = np.asarray(jax.jit(jax.grad(value))(theta)), jax.jit(value)
    for index in range(3):
        step = np.zeros(3)
        step[index] = 1e-5
        assert np.isclose(slope[index], (value(theta + step) - value(theta - step)) / 2e-5, rtol=1e-5)


def test_errors():
    no_state = lfm.LatentForceModel(
        lambda x, u, t: x, {"u": lfm.Matern(1.0, 1.5, order=1)},
        lfm.GaussianObservation(lambda x, u, t: u, jnp.ones(1)), lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
    for change, name in (
            ({"points": 1}, "points"), ({"points": [0.0, 1.0, 3.0]}, "3.* 4"), ({"points": [0.5, 1.0, 5.0]}, "0.5"),
            ({"points": [0.0, 3.0, 2.0, 5.0]}, "increase"), ({"quadrature": "simpson"}, "'simpson'"),
            ({"model": genes(process_noise=jnp.eye(3))}, "process_noise"),
            ({"model": genes(dynamics=lambda x, u, t: u[0] - x**2)}, "x0, x1, x2"),
            ({"model": genes(dynamics=lambda x, u, t: -u[0] * x)}, "x0, x1, x2"),
            ({"model": genes(forces={}, dynamics=lambda x, u, t: -x)}, "forces"),
            ({"model": genes(noise=0.0)}, "'y0'"), ({"model": genes(function=lambda u: jnp.log(u + 1.0))}, "finite"),
            ({"times": [0.0, 2.0, 1.0]}, "back"), ({"model": no_state}, "state")):
        arguments = {"model": genes(), "times": TIMES, "points": 31} | change
        with pytest.raises(ValueError, match=name):
            LatentGrid(arguments.pop("model"), arguments.pop("times"), arguments.pop("points"), **arguments)
    with pytest.raises(TypeError, match="str"):
        LatentGrid("model", TIMES)
    latent = LatentGrid(genes(), TIMES, 31)
    u, y = jnp.zeros((1, 31)), jnp.zeros((6, 3))
    for wrong, shape in ((lambda: latent.state(jnp.zeros((2, 31))), r"\(2, 31\)"),
                         (lambda: latent.state(u, jnp.zeros(2)), r"\(3,\)"),
                         (lambda: latent.log_likelihood(u, y[:, :2]), r"\(6, 2\)"),
                         (lambda: latent.force(jnp.zeros(31)), r"\(31,\)")):
        with pytest.raises(ValueError, match=shape):
            wrong()


@pytest.mark.slow
@pytest.mark.parametrize("build", [genes, oscillator])
def test_many_observations_are_those_of_few(build, monkeypatch):
    """Above a number of observations the grid loops over them; with gaps, repeats, and one at the start."""
    times = np.sort(np.concatenate([np.linspace(0.0, 1.0, 16), [1.0, 3.7, 3.7, 4.0]]))
    model = build()
    monkeypatch.setattr("lfm_ppl.latent_grid.latent_grid.FEW", 10)
    looped = LatentGrid(model, times, 31)
    monkeypatch.setattr("lfm_ppl.latent_grid.latent_grid.FEW", 100)
    single = LatentGrid(model, times, 31)
    assert looped.transitions is None and (single.transitions is None) == (build is oscillator)
    u = looped.force(jax.random.normal(jax.random.key(0), looped.mean.shape))
    assert np.allclose(state(looped, u), state(single, u), rtol=1e-12, atol=1e-12)
    longer = LatentGrid(model, times, 3001)  # many points: the forces are cut out, not what they produce
    few = LatentGrid(build(initial_time=0.0), times[-4:], longer.grid)
    u = longer.force(jax.random.normal(jax.random.key(1), longer.mean.shape))
    assert np.allclose(state(longer, u)[-4:], state(few, u), rtol=1e-9, atol=1e-9)
