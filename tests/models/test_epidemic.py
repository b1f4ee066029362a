"""The epidemic: its equations against SciPy's, its settings, and how often its posterior holds the truth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lfm_ppl as lfm
from lfm_ppl.experiments import scores
from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.log_posterior import LogPosterior
from lfm_ppl.inference.optimise import newton, quasi_newton
from lfm_ppl.io import loading
from lfm_ppl.results.importance_at_modes import weighted_posterior

EPIDEMICS = 100
NAMES = ("r0", "scale", "lengthscale", "concentration")


@pytest.fixture(scope="module")
def file():
    return loading.load("epidemic")


@pytest.fixture(scope="module")
def functions(file):
    return file.definitions


@pytest.fixture(scope="module")
def simulated(functions):
    """From key, parameters and times to a simulated epidemic; one program."""
    return jax.jit(lambda key, theta, times: lfm.simulate(key, functions["build"](*theta, 0.2, 0.5), times, steps=10))


def test_dynamics_are_those_of_the_sir_model(functions):
    """The logarithms against shares, integrated by DOP853, with a transmission that does not change."""
    system = functions["build"](2.5, 0.3, 10.0, 10.0, 0.2, 0.5)
    ours = solve_ivp(lambda t, x: np.asarray(system.dynamics(jnp.asarray(x), jnp.zeros(1), t)), (0.0, 60.0),
                     np.asarray(system.initial_state.mean), rtol=1e-10, atol=1e-10)
    shares = np.exp(ours.y[:, 0])
    sir = solve_ivp(lambda t, x: [-0.5 * x[0] * x[1], 0.5 * x[0] * x[1] - 0.2 * x[1]], (0.0, 60.0), shares,
                    method="DOP853", rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(np.exp(ours.y[:, -1]), sir.y[:, -1], rtol=1e-6)
    # What is reported of the new infections beta s i N of a day.
    expected = np.log(0.5 * 100_000 * 0.5 * sir.y[0, -1] * sir.y[1, -1])
    result = system.observation.function(jnp.asarray(ours.y[:, -1]), jnp.zeros(1), 60.0)
    assert float(result[0]) == pytest.approx(expected, abs=1e-6)


def test_known_rates_are_fixed_unless_freed(file):
    data = file.simulate()
    assert data.y.shape == (60, 1) and np.all(data.y == np.round(data.y))
    assert file.anchors(data) == {"recovery": 0.2, "reporting": 0.5}


@pytest.mark.slow
def test_the_posterior_covers_the_truth(file, functions, simulated):
    """Epidemics with parameters of the prior: weighted draws about the mode of each posterior.

    Nominal rates hold on average over the prior; three standard errors of 100 epidemics are allowed.
    """
    times = np.arange(60.0)
    bound = bind(file.model, times, np.ones((60, 1))).fix(functions["KNOWN"])
    posterior = LogPosterior(bound, NAMES)
    truths = _prior_draws(EPIDEMICS)
    smooth = jax.jit(lambda z, y: posterior.likelihood(z, y).smooth(y).force(functions["FORCE"]))
    ranks, of_r0, of_rate, pareto = [], [], [], []
    for index, theta in enumerate(truths):
        drawn = simulated(jax.random.key(1000 + index), theta, times)
        y = np.asarray(drawn.y)
        objective = posterior.objective(y)
        mode = newton(objective, quasi_newton(objective, np.log(np.array([2.0, 0.3, 15.0, 10.0]))).point)
        result = weighted_posterior(posterior, y, [mode], 300, index)
        share = result.weight
        pareto.append(float(result.weights.k))
        rank = float(share @ (result.draws[:, 0] < np.log(theta[0])))
        ranks.append(rank)
        of_r0.append(0.025 < rank < 0.975)
        chosen = np.random.default_rng(index).choice(len(share), 40, p=share / share.sum())
        moments = [smooth(result.draws[one], y) for one in chosen]
        # log beta less the logarithm of the known rate of recovery
        mean = np.array([np.asarray(m) + result.draws[one, 0] for one, (m, _) in zip(chosen, moments, strict=True)])
        sd = np.array([np.asarray(s) for _, s in moments])
        mean, sd = scores.total_moments(mean, sd**2)
        truth = np.asarray(drawn.forces[functions["FORCE"]]) + np.log(theta[0])
        of_rate.append(scores.interval_coverage(*scores.interval(mean, sd), truth))
    half = [0.25 < rank < 0.75 for rank in ranks]
    print("R0", scores.estimate_rate(of_r0), "half", scores.estimate_rate(half), "transmission",
          scores.estimate_mean(of_rate), "Pareto k", np.quantile(pareto, (0.5, 0.9, 1.0)).round(2))
    for held, nominal in ((of_r0, 0.95), (half, 0.5)):
        assert abs(np.mean(held) - nominal) < 3 * np.sqrt(nominal * (1 - nominal) / EPIDEMICS)
    rate = scores.estimate_mean(of_rate)
    assert abs(rate.value - 0.95) < 3 * rate.error


def _prior_draws(count):
    """Return draws (count, 4) of the prior of `NAMES`."""
    rng = np.random.default_rng(0)
    return np.exp(np.log([2.0, 0.3, 15.0, 10.0]) + np.array([0.4, 0.5, 0.5, 0.7]) * rng.normal(size=(count, 4)))
