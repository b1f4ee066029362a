"""Doses and resets against superposition, an accurate ODE solution and dense Gaussian algebra."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import special, stats
from scipy.integrate import solve_ivp

import lfm_ppl as lfm

TIMES = np.array([0.0, 1.0, 3.0, 7.0, 12.0, 13.5, 24.0, 30.0])
DOSES, AMOUNTS = np.array([0.0, 5.0, 6.0, 12.0, 26.0]), np.array([4.0, 2.0, 1.0, 3.0, 5.0])
ONES = np.ones((len(TIMES), 1))  # states without variance learn nothing from them
KNOWN = lfm.Gaussian(jnp.zeros(2), jnp.zeros((2, 2)))


def absorption(ka, ke, events, covariance=0.0, forces=None):
    """A one-compartment model with first-order absorption, exact and linear."""
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([-ka * x[0], ka * x[0] - ke * x[1] + (u[0] if forces else 0.0)]), forces or {},
        lfm.GaussianObservation(lambda x, u, t: x[1:], jnp.array([0.5])), KNOWN, state_names=("gut", "blood"),
        initial_time=0.0, events=events)


def bateman(t, ka, ke):
    """The blood after a unit dose at time zero."""
    return np.where(t > 0, ka / (ka - ke) * (np.exp(-ke * t) - np.exp(-ka * t)), 0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("lag", [pytest.param(0.0, marks=pytest.mark.thorough), 0.75])
def test_doses_of_a_linear_model_superpose(lag):
    ka, ke = 1.3, 0.2
    model = absorption(ka, ke, [lfm.Dose(DOSES, AMOUNTS, "gut", lag=lag)])
    exact = sum(a * bateman(TIMES - d - lag, ka, ke) for d, a in zip(DOSES, AMOUNTS, strict=True))
    np.testing.assert_allclose(lfm.smooth(model, TIMES, ONES).mean[:, 1], exact, atol=1e-10)
    np.testing.assert_allclose(lfm.filter(model, TIMES, ONES).predicted_mean[:, 1], exact, atol=1e-10)
    requested = np.array([0.5, 5.0, 5.5, 27.0, 40.0])
    exact = sum(a * bateman(requested - d - lag, ka, ke) for d, a in zip(DOSES, AMOUNTS, strict=True))
    np.testing.assert_allclose(lfm.smooth(model, TIMES, ONES, at=requested).mean[:, 1], exact, atol=1e-10)


def test_two_compartments_superpose():
    rates = jnp.array([[-1.1, 0.0, 0.0], [1.1, -0.7, 0.3], [0.0, 0.5, -0.3]])
    direction = np.array([0.8, 0.2, 0.0])  # a fifth of the dose enters the blood directly
    model = lfm.LatentForceModel(
        lambda x, u, t: rates @ x, {}, lfm.GaussianObservation(lambda x, u, t: x[1:2], jnp.array([0.1])),
        lfm.Gaussian(jnp.zeros(3), jnp.zeros((3, 3))), initial_time=0.0,
        events=[lfm.Dose(DOSES, AMOUNTS, direction)])
    values, vectors = np.linalg.eig(np.asarray(rates))
    weights = np.linalg.solve(vectors, direction)
    exact = sum(a * (vectors @ (np.exp(np.outer(values, TIMES - d)) * weights[:, None]) * (TIMES > d))
                for d, a in zip(DOSES, AMOUNTS, strict=True))
    np.testing.assert_allclose(lfm.smooth(model, TIMES, ONES).mean, exact.real.T, atol=1e-10)


@pytest.mark.thorough
def test_doses_with_saturated_elimination_follow_the_ode():
    def rates(x, xp=jnp):
        return xp.stack([-1.3 * x[0], 1.3 * x[0] - 1.5 * x[1] / (0.8 + x[1])])

    model = lfm.LatentForceModel(
        lambda x, u, t: rates(x), {}, lfm.GaussianObservation(lambda x, u, t: x[1:], jnp.array([0.04])), KNOWN,
        initial_time=0.0, events=[lfm.Dose(DOSES, AMOUNTS, "x0")])
    state, start, exact = np.zeros(2), 0.0, []
    for time, amount in sorted([*((t, None) for t in TIMES), *zip(DOSES, AMOUNTS, strict=True)],
                               key=lambda pair: (pair[0], pair[1] is not None)):
        if time > start:
            state = solve_ivp(lambda s, x: rates(x, np), (start, time), state, rtol=1e-11, atol=1e-12).y[:, -1]
        if amount is None:
            exact.append(state[1])
        else:
            state = state + np.array([amount, 0.0])
        start = time
    mean = lfm.smooth(model, TIMES, ONES, rule=lfm.Taylor(), steps=200).mean[:, 1]
    np.testing.assert_allclose(mean, exact, atol=1e-6)


def interval_sums():
    """Times, sums of a flow between them with a gap, and the dense joint moments of sums and flow."""
    t, y, noise = np.array([1.0, 2, 3, 5, 6, 9, 10]), np.array([1.0, 1.2, np.nan, 2.5, 1.0, 3.2, 0.9]), 0.1
    nodes, weights = np.polynomial.legendre.leggauss(60)

    def kernel(lag):
        scaled = np.sqrt(3) * np.abs(lag) / 2
        return (1 + scaled) * np.exp(-scaled)

    edges = np.append(0.0, t)
    middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    u = middle[:, None] + half[:, None] * nodes
    w = half[:, None] * weights
    sums = np.einsum("ia,jb,iajb->ij", w, w, kernel(u[:, :, None, None] - u))
    # Cells on the diagonal: the kernel has a kink there, and the double integral becomes a single one.
    lag = half[:, None] * (nodes + 1)
    sums[np.diag_indices(7)] = (2 * w * (2 * half[:, None] - lag) * kernel(lag)).sum(1)
    cross = np.einsum("ia,kia->ki", w, kernel(t[:, None, None] - u))
    return t, y, noise, sums, cross


def flow_meter(t, noise, observation_first=True):
    return lfm.LatentForceModel(
        lambda x, u, t: u, {"flow": lfm.Matern(1.0, 2.0)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([noise**2])),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), state_names=("meter",), initial_time=0.0,
        events=[lfm.Reset(t, "meter", observation_first=observation_first)])


@pytest.mark.thorough
def test_sums_between_reports_equal_dense_algebra():
    t, y, noise, sums, cross = interval_sums()
    model = flow_meter(t, noise)
    value = lfm.MarginalLikelihood(model, t).log_prob(y[:, None])
    np.testing.assert_allclose(value, -7.2181491, atol=1e-7)
    present = np.isfinite(y)
    gain = np.linalg.solve(sums[np.ix_(present, present)] + noise**2 * np.eye(present.sum()), cross[:, present].T).T
    smoothed = lfm.smooth(model, t, y[:, None], at=t)
    np.testing.assert_allclose(smoothed.mean[:, 1], gain @ y[present], atol=1e-8)
    np.testing.assert_allclose(smoothed.covariance[:, 1, 1], 1.0 - (gain * cross[:, present]).sum(1), atol=1e-8)
    within = smoothed.mean[present, 0] - y[present]
    left_out = np.asarray(smoothed.leave_one_out)[present]
    precision = np.linalg.inv(sums[np.ix_(present, present)] + noise**2 * np.eye(present.sum()))
    weighted, variance = precision @ y[present], 1 / np.diag(precision)
    np.testing.assert_allclose(left_out, -0.5 * (variance * weighted**2 + np.log(2 * np.pi * variance)), atol=1e-7)
    np.testing.assert_allclose(within, -noise**2 * weighted, atol=1e-8)


def test_a_reset_before_an_observation_leaves_nothing_to_observe():
    t, y, noise, _, _ = interval_sums()
    value = lfm.MarginalLikelihood(flow_meter(t, noise, observation_first=False), t).log_prob(y[:, None])
    present = y[np.isfinite(y)]
    np.testing.assert_allclose(value, dist.Normal(0.0, noise).log_prob(present).sum(), rtol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("is_linear", [True, False])
def test_gradients_of_amounts_and_lags_equal_finite_differences(is_linear):
    y = np.sin(TIMES)[:, None] + 2.0

    def log_prob(z):
        fraction, lag, value = z
        model = lfm.LatentForceModel(
            lambda x, u, t: jnp.stack([-x[0], x[0] - (0.3 * x[1] if is_linear else x[1] / (2.0 + x[1]**2)) + u[0]]),
            {"f": lfm.Matern(0.3, 4.0)}, lfm.GaussianObservation(lambda x, u, t: x[1:], jnp.array([0.3])),
            lfm.Gaussian(jnp.ones(2), 0.1 * jnp.eye(2)), initial_time=0.0, state_names=("gut", "blood"),
            events=[lfm.Dose(DOSES, fraction * AMOUNTS, "gut", lag=lag), lfm.Reset([9.0, 20.0], "blood", value)])
        return lfm.MarginalLikelihood(model, TIMES, steps=20, iterations=0).log_prob(y)

    z = jnp.array([0.7, 0.4, 0.5])
    value, gradient = jax.jit(jax.value_and_grad(log_prob))(z)
    run, step = jax.jit(log_prob), 1e-5
    differences = [(run(z.at[i].add(step)) - run(z.at[i].add(-step))) / (2 * step) for i in range(3)]
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-7)
    # A lag that is a number divides the time before compilation, one that is traced by sorting.
    concrete = log_prob(np.array([0.7, 0.4, 0.5]))
    np.testing.assert_allclose(value, concrete, atol=1e-8 if is_linear else 5e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("observation_first", [True, False])
@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0]])
def test_traced_lags_leave_the_order_of_events_as_it_is(observation_first, order):
    times = np.array([0.3, 4.0, 5.0])

    def moments(lag):
        events = [lfm.Dose([0.0, 4.0], 10.0, "c", lag=lag, observation_first=observation_first),
                  lfm.Reset([4.5, 0.8], "c", 1.0, lag=-0.5), lfm.Dose([4.0, 5.0], [3.0, 2.0], "c")]
        model = decay([events[index] for index in order])
        smoothed = lfm.smooth(model, times, np.ones((3, 1)), at=[0.0, 2.0, 4.0, 4.2, 5.0]).mean
        density = lfm.MarginalLikelihood(model, times).log_prob(np.ones((3, 1)))
        path = lfm.simulate(jax.random.key(0), model, times).state
        return jnp.append(jnp.concatenate([smoothed, path])[:, 0], density)

    np.testing.assert_allclose(jax.jit(moments)(0.0), moments(0.0), rtol=1e-12)


def decay(events):
    return lfm.LatentForceModel(
        lambda x, u, t: -0.1 * x, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), state_names=("c",), initial_time=0.0, events=events)


@pytest.mark.thorough
@pytest.mark.parametrize("lag", [-0.5, np.nan])
def test_an_event_before_the_initial_time_or_at_no_time_has_no_density(lag):
    times, y = np.array([1.0, 5.0]), np.ones((2, 1))

    def delayed(lag):
        return decay([lfm.Dose([0.0, 3.0], 10.0, "c", lag=lag), lfm.Reset([4.0], "c")])

    def log_prob(lag):
        panel = lfm.panel(delayed, jnp.stack([lag, jnp.abs(lag)]), np.array([times, times + 0.5]))
        return jnp.append(panel.log_prob(jnp.stack([y, y]))[0], lfm.MarginalLikelihood(delayed(lag), times).log_prob(y))

    value, slope = jax.jit(lambda lag: jax.vjp(log_prob, lag)[0:2])(lag)
    np.testing.assert_array_equal(value, -np.inf)
    assert slope(jnp.ones(2))[0] == 0.0

    def evaluate_other_methods(lag):
        particles = lfm.particle_filter(jax.random.key(0), delayed(lag), times, y, particles=10)
        return (lfm.filter(delayed(lag), times, y).log_likelihood.sum(), particles.log_likelihood.sum(),
                lfm.smooth(delayed(lag), times, y).log_likelihood.sum(),
                lfm.simulate(jax.random.key(0), delayed(lag), times).state.sum())

    *densities, state = jax.jit(evaluate_other_methods)(lag)
    np.testing.assert_array_equal(densities, -np.inf)
    assert np.isnan(state)


@pytest.mark.thorough
def test_a_filter_that_continues_includes_the_events_before_its_start():
    times, y = np.array([1.0, 4.0, 5.0]), np.ones((3, 1))

    def continued(lag):
        model = decay([lfm.Dose([0.0, 4.0], 10.0, "c", lag=lag), lfm.Dose([4.0], 2.0, "c", lag, False)])
        first = lfm.filter(model, times[:2], y[:2])
        return lfm.filter(model, times[2:], y[2:], start=first.state).predicted_mean

    np.testing.assert_allclose(jax.jit(continued)(0.0), continued(0.0), rtol=1e-12)


@pytest.mark.thorough
def test_simulation_without_noise_is_the_mean():
    model = absorption(1.3, 0.2, [lfm.Dose(DOSES, AMOUNTS, "gut"), lfm.Reset([7.0], "blood", 1.0)])
    state = lfm.simulate(jax.random.key(0), model, TIMES, steps=100).state
    np.testing.assert_allclose(state, lfm.smooth(model, TIMES, ONES).mean, atol=1e-6)
    dose_first_model = absorption(1.3, 0.2, [lfm.Dose(TIMES, 1.0, "blood", observation_first=False)])
    assert lfm.simulate(jax.random.key(0), dose_first_model, TIMES).state[0, 1] == 1.0
    assert lfm.filter(dose_first_model, TIMES, ONES).predicted_mean[0, 1] == 1.0


@pytest.mark.thorough
def test_particles_agree_with_the_filter():
    model = absorption(1.3, 0.2, [lfm.Dose(DOSES, AMOUNTS, "gut"), lfm.Reset([7.0], "blood", 1.0)],
                       forces={"f": lfm.Matern(0.3, 4.0)})
    y = lfm.simulate(jax.random.key(1), model, TIMES).y
    exact = lfm.filter(model, TIMES, y).log_likelihood.sum()
    result = lfm.particle_filter(jax.random.key(2), model, TIMES, y, particles=20_000)
    np.testing.assert_allclose(result.log_likelihood.sum(), exact, atol=0.05)


@pytest.mark.thorough
def test_the_estimate_under_loose_bounds_is_the_smoothed_mean():
    for model in (absorption(1.3, 0.2, [lfm.Dose(DOSES, AMOUNTS, "gut")], forces={"f": lfm.Matern(0.3, 4.0)}),
                  flow_meter(TIMES[1:], 0.2)):
        times = TIMES[1:]
        y = lfm.simulate(jax.random.key(1), model, times).y
        estimate = lfm.full_information(model, times, y, lower={model.force_names[0]: -50.0}, grid=times)
        smoothed = lfm.smooth(model, times, y, at=times)
        np.testing.assert_allclose(estimate.state_mean, smoothed.mean[:, :len(model.state_names)], atol=1e-6)


@pytest.mark.thorough
def test_iterated_linearisation_finds_the_most_probable_trajectory():
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([-x[0], x[0] - x[1] / (2.0 + x[1] ** 2) + u[0]]), {"f": lfm.Matern(0.5, 4.0)},
        lfm.GaussianObservation(lambda x, u, t: x[1:], jnp.array([0.3])), lfm.Gaussian(jnp.ones(2), 0.1 * jnp.eye(2)),
        initial_time=0.0, state_names=("gut", "blood"),
        events=[lfm.Dose(DOSES, AMOUNTS, "gut"), lfm.Reset([9.0, 20.0], "blood", 0.5)])
    y = lfm.simulate(jax.random.key(1), model, TIMES).y
    requested_times = np.arange(0.0, 30.5, 0.5)
    smoothed = lfm.smooth(model, TIMES, y, rule=lfm.Taylor(), iterations=30, steps=20, at=requested_times)
    estimate = lfm.full_information(model, TIMES, y, lower={"f": -50.0}, grid=requested_times, steps=20)
    np.testing.assert_allclose(estimate.state_mean, smoothed.mean[:, :2], atol=2e-3)


@pytest.mark.thorough
def test_a_continued_filter_equals_one_pass():
    events = [lfm.Dose(DOSES, AMOUNTS, "gut"), lfm.Dose([12.0], 1.0, "blood", observation_first=False)]
    model = absorption(1.3, 0.2, events, forces={"f": lfm.Matern(0.3, 4.0)})
    y = lfm.simulate(jax.random.key(1), model, TIMES).y
    full_result = lfm.filter(model, TIMES, y)
    first = lfm.filter(model, TIMES[:5], y[:5])  # ends at a time with two doses
    second = lfm.filter(model, TIMES[5:], y[5:], start=first.state)
    np.testing.assert_allclose(second.filtered_mean, full_result.filtered_mean[5:], atol=1e-9)


@pytest.mark.thorough
def test_series_of_a_panel_have_doses_of_their_own():
    amounts, lags = jnp.array([[1.0, 2.0], [3.0, 0.0]]), jnp.array([0.5, 1.0])

    def build(p):
        return absorption(1.3, p["ke"], [lfm.Dose([0.0, 8.0], p["amounts"], "gut", lag=p["lag"])])

    y = np.ones((2, len(TIMES), 1))
    ke = jnp.array([0.2, 0.3])
    panel = lfm.panel(build, {"ke": ke, "amounts": amounts, "lag": lags}, TIMES)
    alone = [lfm.MarginalLikelihood(build({"ke": ke[i], "amounts": amounts[i], "lag": lags[i]}), TIMES).log_prob(y[i])
             for i in range(2)]
    np.testing.assert_allclose(panel.log_prob(y), alone, rtol=1e-10)


@pytest.mark.thorough
@pytest.mark.parametrize("times", [[0.0, 0.2, 0.9], [0.0, 0.3, 0.9]])
@pytest.mark.parametrize("observation_first", [True, False])
def test_a_dose_of_a_panel_at_the_last_observation(times, observation_first):
    def build(p):
        return absorption(1.3, 0.2, [lfm.Dose(p, 2.0, "blood", observation_first=observation_first)])

    doses, times = np.array([[0.9], [0.9]]), np.array([times, times])
    panel = lfm.panel(build, doses, times)
    alone = lfm.MarginalLikelihood(build(doses[0]), times[0]).log_prob(np.ones((3, 1)))
    np.testing.assert_allclose(panel.log_prob(np.ones((2, 3, 1))), alone, rtol=1e-10)


def test_a_dose_before_the_start_of_a_series_is_refused():
    def build(p):
        return lfm.LatentForceModel(
            lambda x, u, t: -x, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.ones(1)),
            lfm.Gaussian(jnp.zeros(1), jnp.zeros(1)), events=[lfm.Dose(p, 1.0, "x0")])

    with pytest.raises(ValueError, match="series 1"):
        lfm.panel(build, np.array([[0.0], [4.0]]), np.array([[0.0, 1.0], [5.0, 6.0]]))
    with pytest.raises(ValueError, match="initial time"):
        lfm.simulate(jax.random.key(0), build(np.zeros(1)), np.array([1.0, 2.0]))


@pytest.mark.thorough
def test_fit_and_forecast_with_a_dose_after_the_data():
    times = np.arange(1.0, 9.0)
    doses = np.array([0.0, 4.0, 10.0])
    y = (bateman(times, 1.3, 0.4) + bateman(times - 4.0, 1.3, 0.4))[:, None]

    def model(times, y=None):
        ke = numpyro.sample("ke", dist.LogNormal(-1.0, 0.5))
        numpyro.sample("y", lfm.MarginalLikelihood(absorption(1.3, ke, [lfm.Dose(doses, 1.0, "gut")]), times), obs=y)

    result = lfm.fit(model, times, y, sampler="map", samples=20, progress=False)
    forecast = lfm.forecast(result, model, [9.0, 10.0, 11.0], progress=False)
    predictions = forecast["predictions"]["y"].mean(("chain", "draw")).to_numpy()[:, 0]
    rate = float(result["posterior"]["ke"].mean())
    exact = sum(bateman(np.array([9.0, 10.0, 11.0]) - d, 1.3, rate) for d in doses)
    np.testing.assert_allclose(predictions, exact, atol=0.6)


@pytest.mark.parametrize(("events", "message"), [
    ([lfm.Dose([-1.0], 1.0, "gut")], "initial time"),
    ([lfm.Dose([1.0], 1.0, "liver")], "liver"),
    ([lfm.Dose([1.0], 1.0, np.ones(3))], "gut, blood"),
])
def test_impossible_events_are_refused(events, message):
    with pytest.raises(ValueError, match=message):
        lfm.filter(absorption(1.0, 0.5, events), TIMES, ONES)


def test_wrong_arguments_of_events_are_refused():
    with pytest.raises(ValueError, match="amounts"):
        lfm.Dose([1.0, 2.0], [1.0, 2.0, 3.0], "gut")
    with pytest.raises(ValueError, match="finite"):
        lfm.Dose([1.0, np.nan], 1.0, "gut")
    with pytest.raises(TypeError, match="state"):
        lfm.Reset([1.0], 0)
    with pytest.raises(TypeError, match=r"lfm\.Dose"):
        absorption(1.0, 0.5, [(1.0, 2.0)])


@pytest.mark.thorough
def test_counts_of_a_state_that_is_zero_at_a_row():
    """The integral of an unknown constant rate, from zero at the first row on: log evidence and gradient by quadrature.

    The count at rate zero is zero with probability one, and any other count is impossible there.
    """
    times, counts = np.array([0.0, 1.0, 2.0, 4.0, 5.0]), np.array([0.0, 2.0, 5.0, 7.0, 1.0])
    gaps = np.diff(times, prepend=0.0)

    def log_density(mean, y=counts):
        model = lfm.LatentForceModel(
            lambda x, u, t: u, {"rate": lfm.Constant(0.5, mean=mean)},
            lfm.PoissonObservation(lambda x, u, t: x, "identity"),
            lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), initial_time=0.0, state_names=("n",),
            events=[lfm.Reset(times, "n")])
        return lfm.MarginalLikelihood(model, times).log_prob(jnp.asarray(y)[:, None])

    def exact(mean):
        rate = np.linspace(1e-9, 8.0, 4001)
        log_terms = stats.norm.logpdf(rate, mean, 0.5) + np.log(rate[1] - rate[0])
        for count, gap in zip(counts[1:], gaps[1:], strict=True):
            log_terms += stats.poisson.logpmf(count, gap * rate)
        return special.logsumexp(log_terms)

    value, gradient = jax.jit(jax.value_and_grad(log_density))(3.0)
    assert float(value) == pytest.approx(exact(3.0), abs=2e-3)
    assert float(gradient) == pytest.approx((exact(3.001) - exact(2.999)) / 0.002, abs=5e-3)
    with pytest.warns(lfm.FilterWarning, match="predictor 0"):
        assert log_density(3.0, [1.0, *counts[1:]]) == -np.inf
