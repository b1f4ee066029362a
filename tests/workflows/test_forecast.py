"""Forecasts against dense Gaussian process algebra, the Fokker-Planck equation, and data that were simulated."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import systems
import xarray as xr
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl.io.input_table import InputTable
from lfm_ppl.results import arviz_data
from lfm_ppl.results.inputs import to_dataset
from lfm_ppl.results.predictions import noise_free_interval, summary
from lfm_ppl.results.result_view import ResultView
from tests.inference import linear_motif as motif

NEAR = 1e-7
"""Relative width of priors that make the parameters all but known."""

AT = np.array([0.7, 4.6, 5.1, 7.0])
DRAWS = 2000


def well(times, y=None, iterations=3):
    a = numpyro.sample("a", dist.LogNormal(0.0, NEAR))
    system = systems.double_well(a=-a, noise=0.0025, dispersion=DISPERSION)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, iterations=iterations), obs=y)


def predictions(result):
    return ResultView.of(result).group("predictions")


@pytest.fixture(scope="module")
def known_fit():
    """Many draws of parameters that are all but known, and no trajectories."""
    return lfm.fit(motif.model, motif.TIMES, motif.data(), sampler="map", samples=DRAWS, trajectory_draws=0, seed=3,
                   model_kwargs={"spread": NEAR}, progress=False, coords={"output": ["left", "right"]})


@pytest.fixture(scope="module")
def forecast(known_fit):
    return lfm.forecast(known_fit, motif.model, AT, model_kwargs={"spread": NEAR}, draws=DRAWS, seed=5)


@pytest.fixture(scope="module")
def exact():
    """Exact mean and covariance of x(AT) given the data."""
    mean, covariance = motif.posterior(motif.data(), AT, **motif.THETA)
    start = 2 * len(motif.TIMES) + len(AT)
    return mean[start:], covariance[start:, start:]


@pytest.mark.thorough
def test_moments_of_a_linear_model_are_exact(forecast, exact):
    mean, covariance = exact
    result = predictions(forecast)
    free = np.sqrt(np.diag(covariance)).reshape(-1, 2)
    np.testing.assert_allclose(result["y_mean"].values[0], np.tile(mean.reshape(-1, 2), (DRAWS, 1, 1)), atol=2e-6)
    np.testing.assert_allclose(result["y_sd"][0, 0], np.hypot(free, motif.THETA["noise_sd"]), rtol=2e-6)
    np.testing.assert_allclose(result["outputs_sd"][0, 0], free, rtol=2e-6)
    low, high = noise_free_interval(result)
    np.testing.assert_allclose(high - low, 2 * stats.norm.ppf(0.975) * free, rtol=1e-5)


def test_new_data_of_a_linear_model_are_exact_jointly_in_time(forecast, exact):
    mean, covariance = exact
    result = predictions(forecast)
    for name, noise in (("outputs", 0.0), ("y", motif.THETA["noise_sd"] ** 2)):
        draws = result[name].values[0].reshape(DRAWS, -1)
        root = np.linalg.cholesky(covariance + (noise + 1e-12) * np.eye(len(mean)))
        white = np.linalg.solve(root, (draws - mean).T)
        assert np.abs(white.mean(axis=1)).max() < 4.5 / np.sqrt(DRAWS)
        assert np.abs(white @ white.T / DRAWS - np.eye(len(mean))).max() < 4.5 * np.sqrt(2 / DRAWS)


def test_groups_coordinates_and_units(forecast, known_fit):
    result = predictions(forecast)
    assert "predictions" not in ResultView.of(known_fit).groups  # a new object
    assert set(ResultView.of(forecast).groups) == {*ResultView.of(known_fit).groups, "predictions"}
    assert result["y"].dims == ("chain", "draw", "time", "output")
    assert result["forces"].dims == ("chain", "draw", "time", "force")
    np.testing.assert_array_equal(result["time"], AT)
    assert result["output"].values.tolist() == ["left", "right"] and result["y"].attrs["units"] == "nM"
    assert result.attrs["last_observation"] == motif.TIMES[-1]
    table = summary(result)
    wide, narrow = table["q97.5"] - table["q2.5"], table["noise_free_q97.5"] - table["noise_free_q2.5"]
    assert (wide > narrow).all()


DISPERSION = 0.5
LATER = np.array([3.0, 5.0])
AROUND = 1.0 + np.array([-1e-6, 0.0, 1e-6])


LAST_SEEN = np.array([0.0, 0.5, 1.0]), np.array([[-0.8], [-0.4], [0.05]])
"""A double well on its way from one well to the other."""


def fitted(draws, **keywords):
    return lfm.fit(well, *LAST_SEEN, sampler="map", samples=draws, trajectory_draws=0, progress=False,
                   model_kwargs=keywords)


@pytest.fixture(scope="module")
def between_the_wells():
    return fitted(DRAWS)


@pytest.mark.slow
def test_after_the_data_a_nonlinear_model_has_its_own_distribution(between_the_wells):
    """Two wells, as the Fokker-Planck equation has them; Gaussian moments would fill the gap between."""
    times, y = LAST_SEEN
    result = predictions(lfm.forecast(between_the_wells, well, LATER, draws=DRAWS))
    model = systems.double_well(noise=0.0025, dispersion=DISPERSION)
    grid = lfm.fokker_planck(model, np.concatenate([times, LATER]), np.concatenate([y, np.full((2, 1), np.nan)]),
                             cells=500)
    gaussian = lfm.smooth(model, times, y, at=LATER)
    edges = np.append(grid.x - 0.5 * grid.grid.width, grid.x[-1] + 0.5 * grid.grid.width)
    for k in range(2):
        mass = np.asarray(grid.filtered[3 + k])
        below = np.concatenate([[0.0], np.cumsum(mass) / mass.sum()])
        distance = stats.kstest(result["states"].values[0, :, k, 0], lambda x, below=below: np.interp(x, edges, below))
        # Critical value at 0.1%, and 0.01 for the Gaussian at the last observation.
        bound = 1.95 / np.sqrt(DRAWS) + 0.01
        assert distance.statistic < bound
        moments = stats.norm.cdf(edges, gaussian.mean[k, 0], np.sqrt(gaussian.covariance[k, 0, 0]))
        assert np.abs(moments - below).max() > bound  # which the Gaussian moments, without any Monte Carlo error, miss
        np.testing.assert_allclose(result["y_sd"], 0.05)
        np.testing.assert_array_equal(result["y_mean"], result["outputs"])


@pytest.mark.thorough
def test_one_path_goes_through_the_last_observation():
    """The simulated path starts where the smoothed one ends: neighbouring times stay near each other."""
    settings = {"model_kwargs": {"iterations": 0}, "draws": 200}
    states = predictions(lfm.forecast(fitted(200, iterations=0), well, AROUND, **settings))["states"].values[0, :, :, 0]
    assert np.abs(np.diff(states, axis=1)).max() < 5 * DISPERSION * np.sqrt(1e-6)
    assert states.std(axis=0).min() > 0.03


@pytest.mark.slow
def test_a_far_forecast_alone_is_that_of_many_times(between_the_wells):
    """Steps are as short as between the data, however long the way to the first time that was asked for."""
    alone = predictions(lfm.forecast(between_the_wells, well, [21.0], draws=DRAWS))["states"].values[0, :, 0, 0]
    # The stationary density exp(-2 V / g^2), with V = x^4/4 - x^2/2.
    x = np.linspace(-2.5, 2.5, 2001)
    density = np.exp(-2 * (x**4 / 4 - x**2 / 2) / DISPERSION**2)
    below = np.cumsum(density) / density.sum()
    # By symmetry, the distance from the middle does not remember which well it started from.
    distance = stats.kstest(np.abs(alone), lambda v: np.interp(v, x, below) - np.interp(-v, x, below))
    assert distance.statistic < 1.95 / np.sqrt(DRAWS) + 0.01


@pytest.mark.thorough
def test_another_model_and_impossible_times_are_refused(known_fit):
    keywords = {"model_kwargs": {"spread": NEAR}}
    for times, name in (([5.0, 4.0], "entry 1"), ([-1.0], "initial time"), ([], "at least one"), ([np.nan], "finite")):
        with pytest.raises(ValueError, match=name):
            lfm.forecast(known_fit, motif.model, times, **keywords)
    with pytest.raises(ValueError, match="y must have one row"):
        lfm.forecast(known_fit, well, AT)  # of one output

    def louder(times, y=None):
        decay = numpyro.sample("decay", dist.LogNormal(jnp.zeros(2), 1.0).to_event(1))
        lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.0, 1.0))
        noise_sd = numpyro.sample("noise_sd", dist.LogNormal(0.0, 1.0))
        numpyro.sample("y", lfm.MarginalLikelihood(motif.build(decay, lengthscale, 2 * noise_sd), times), obs=y)

    with pytest.raises(ValueError, match="log likelihood"):
        lfm.forecast(known_fit, louder, AT, draws=2)


@pytest.mark.slow
def test_a_known_input_must_reach_the_forecast():
    def driven(times, y=None, heat=None):
        gain = numpyro.sample("gain", dist.LogNormal(0.0, NEAR))
        system = lfm.LatentForceModel(
            lambda x, u, t: gain * heat(t) - x, {}, lfm.GaussianObservation(systems.whole_state, jnp.array([0.01])),
            lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.array([[0.1]]))
        numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)

    times = np.arange(4.0)
    short = lfm.Input(times, np.ones(4), interpolation="previous", outside="error")
    result = lfm.fit(driven, times, np.ones((4, 1)), sampler="map", samples=20, trajectory_draws=0, progress=False,
                     model_kwargs={"heat": short})
    with pytest.raises(ValueError, match="input"):
        lfm.forecast(result, driven, [30.0], model_kwargs={"heat": short})
    longer = lfm.Input([*times, 4.0, 30.0], [1.0, 1.0, 1.0, 1.0, 7.0, 7.0], interpolation="previous", outside="error")
    computed = predictions(lfm.forecast(result, driven, [30.0], inputs={"heat": longer}))
    np.testing.assert_allclose(computed["y_mean"], 7.0, atol=1e-4)


@pytest.mark.slow
def test_noise_of_rows_and_a_missing_keyword_are_named():
    def model(times, y=None, variances=None):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        system = lfm.LatentForceModel(
            lambda x, u, t: 0.0 * x, {}, lfm.GaussianObservation(lambda x, u, t: x, variances + 0.01 * jnp.eye(1)),
            lfm.Gaussian(jnp.reshape(level, (1,)), jnp.eye(1)))
        numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)

    times, keywords = np.arange(4.0), {"variances": np.linspace(0.1, 0.4, 4)[:, None, None]}
    with pytest.warns(UserWarning, match="cannot be predicted"):
        result = lfm.fit(model, times, np.ones((4, 1)), sampler="map", samples=10, trajectory_draws=0, progress=False,
                         model_kwargs=keywords, at=[5.0])
    for model_kwargs, error, message in ((None, TypeError, r"needs variances: pass model_kwargs=\{'variances': ...\}"),
                                         (keywords, ValueError, "differs between rows"),
                                         ({"variances": np.ones((2, 1, 1))}, ValueError, "2 rows.* 4 times")):
        with pytest.raises(error, match=message):
            lfm.forecast(result, model, [5.0], model_kwargs=model_kwargs, progress=False)


def dosed(times, y=None, events=()):
    rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.3))
    system = lfm.LatentForceModel(
        lambda x, u, t: -rate * x, {}, lfm.GaussianObservation(systems.whole_state, jnp.array([0.01])),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), state_names=("drug",), initial_time=0.0, events=events)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


@pytest.mark.thorough
def test_later_events_follow_those_of_the_fit():
    rate = np.array([[[0.4], [0.6]]])
    observed = xr.Dataset({"y": (("time", "output"), [[1.0], [0.5]])}, {"time": [1.0, 2.0], "output": ["drug"]})
    result = arviz_data.build({
        "posterior": xr.Dataset({"rate": (("chain", "draw"), rate[..., 0])}), "data": observed,
        "constant_data": to_dataset({"AMT": InputTable(np.array([0.0]), np.array([2.0]), "dose:drug")})})
    superposition = 2 * np.exp(-5 * rate) + 3 * np.exp(-2 * rate)
    doses = [lfm.Reset([2.5], "drug"), lfm.Dose([3.0], 3.0, "drug")]
    for options, expected in (({"inputs": {"AMT": ([3.0], [3.0], "dose:drug")}}, superposition),
                              ({"events": doses}, 3 * np.exp(-2 * rate))):
        forecast = predictions(lfm.forecast(result, dosed, [5.0], progress=False, **options))
        np.testing.assert_allclose(forecast["outputs"][..., 0], expected, rtol=1e-8)
    for options, words in (({"events": [lfm.Dose([1.5], 3.0, "drug")]}, "a dose at time 1.5"),
                           ({"inputs": {"AMT": ([0.0, 1.5], [2.0, 3.0])}}, "'AMT' .* at time 1.5"),
                           ({"inputs": {"AMD": ([3.0], [3.0])}}, "'AMD'.*AMT")):
        with pytest.raises(ValueError, match=words):
            lfm.forecast(result, dosed, [5.0], progress=False, **options)


def rowwise(times, y=None, R=None):
    """A level that drifts, with noise given by row; a panel where the data have three dimensions."""
    decay = numpyro.sample("decay", dist.LogNormal(0.0, 1.0))

    def build(parameters):
        return lfm.LatentForceModel(
            lambda x, u, t: u - parameters["decay"] * x, {"f": lfm.Matern(1.0, 2.0)},
            lfm.GaussianObservation(lambda x, u, t: x, parameters["R"]), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))

    if np.ndim(R) == 3:
        numpyro.sample("y", lfm.MarginalLikelihood(build({"decay": decay, "R": R}), times), obs=y)
    else:
        with numpyro.plate("series", 2):
            numpyro.sample("y", lfm.panel(build, {"decay": jnp.repeat(decay, 2), "R": R}, times), obs=y)


@pytest.mark.thorough
@pytest.mark.parametrize("lead", [(), pytest.param((2,), marks=pytest.mark.slow)], ids=["series", "panel"])
def test_noise_of_rows_is_continued_or_constant(lead):
    times, rng = np.arange(4.0), np.random.default_rng(0)
    y, rows = rng.normal(size=(*lead, 4, 1)), rng.uniform(0.1, 1.0, (*lead, 4, 1, 1))
    posterior = xr.Dataset({"decay": (("chain", "draw"), np.full((1, 3), 0.7))})
    dims = ("series",) * len(lead)
    result = arviz_data.build({"posterior": posterior, "data": xr.Dataset(
        {"y": ((*dims, "time", "output"), y)}, {"time": times, "output": ["a"]})})
    later = rng.uniform(0.1, 1.0, (*lead, 2, 1, 1))

    def expected(R, noise, series):
        system = lfm.LatentForceModel(
            lambda x, u, t: u - 0.7 * x, {"f": lfm.Matern(1.0, 2.0)},
            lfm.GaussianObservation(lambda x, u, t: x, R[series]), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        smoothed = lfm.smooth(system, times, y[series], at=np.array([4.5, 7.0]))
        return smoothed.mean[:, 0], np.sqrt(smoothed.covariance[:, 0, 0] + noise[series].ravel())

    constant_rows = np.broadcast_to(rows[..., :1, :, :], rows.shape)
    for R, inputs, noise in ((rows, {"R": later}, later), (constant_rows, None, constant_rows[..., :2, :, :])):
        forecast = predictions(lfm.forecast(result, rowwise, [4.5, 7.0], inputs=inputs, model_kwargs={"R": R},
                                            progress=False))
        for series in np.ndindex(lead):
            mean, sd = expected(R, noise, series)
            np.testing.assert_allclose(forecast["y_mean"].values[(0, 0, *series)][:, 0], mean, atol=1e-8)
            np.testing.assert_allclose(forecast["y_sd"].values[(0, 0, *series)][:, 0], sd, rtol=1e-8)
    for inputs, requested_times, words in ((None, [4.5, 7.0], "differs between rows"),
                                           ({"R": later[..., :1, :, :]}, [4.5, 7.0], "'R'"),
                                           ({"R": later}, [1.5, 7.0], "after the data")):
        with pytest.raises(ValueError, match=words):
            lfm.forecast(result, rowwise, requested_times, inputs=inputs, model_kwargs={"R": rows}, progress=False)


@pytest.mark.thorough
def test_a_panel_is_forecast_series_by_series():
    def model(times, y=None):
        decay = numpyro.sample("decay", dist.LogNormal(jnp.log(jnp.array([0.5, 1.2])), NEAR).to_event(1))
        with numpyro.plate("series", 2):
            def build(p):
                return motif.build(p["decay"][None], 1.5, 0.2)

            numpyro.sample("y", lfm.panel(build, {"decay": decay}, times), obs=y)

    times, y = np.array([0.0, 1.0, 2.0]), np.random.default_rng(0).normal(size=(2, 3, 1))
    result = lfm.fit(model, times, y, sampler="map", samples=30, trajectory_draws=0, progress=False)
    forecast = lfm.forecast(result, model, [3.0, 5.0])
    computed = predictions(forecast)
    assert computed["y"].dims == ("chain", "draw", "series", "time", "output")
    for series, decay in enumerate((0.5, 1.2)):
        system = motif.build(jnp.array([decay]), 1.5, 0.2)
        smoothed = lfm.smooth(system, times, y[series], at=np.array([3.0, 5.0]))
        np.testing.assert_allclose(computed["y_mean"].values[0, 0, series], smoothed.mean[:, :1], atol=1e-5)
    assert lfm.score(forecast, np.zeros((2, 2, 1))).loc["a", "n"] == 4


def softplus_motif(times, y=None):
    """One gene, unknown decay and noise, and a force."""
    decay = numpyro.sample("decay", dist.LogNormal(jnp.log(0.8), 0.3))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(jnp.log(0.1), 0.3))
    system = systems.motif(systems.softplus, decay, noise_sd=noise_sd, genes=1, variance=0.1)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=5), obs=y)


@pytest.mark.slow
def test_bands_cover_new_data_over_40_runs():
    """Parameters, force, state and data from the prior; fit to 25 rows, predict the 10 after them."""
    times, data_rows, runs = np.linspace(0.0, 14.0, 35), 25, 40
    prior = numpyro.infer.Predictive(softplus_motif, num_samples=runs)(jax.random.key(1), times)["y"]
    past = np.where(np.arange(35)[:, None] < data_rows, prior, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lfm.ConvergenceWarning)
        fits = list(lfm.fit_many(softplus_motif, {str(run): (times, past[run]) for run in range(runs)}, sampler="nuts",
                                 chains=1, warmup=200, samples=400, trajectory_draws=400, at=times, progress=False))
    covered, pit = [], []
    for y, fitted in zip(np.asarray(prior), fits, strict=True):
        computed = predictions(fitted.result).isel(time=slice(data_rows, None))
        mean, sd = (computed[name].values.reshape(-1, 10) for name in ("y_mean", "y_sd"))
        share = stats.norm.cdf((y[data_rows:, 0] - mean) / sd).mean(axis=0)
        pit.append(share)
        covered.append((share > 0.025) & (share < 0.975))
    covered = np.array(covered)
    rate, error = covered.mean(), covered.mean(axis=1).std() / np.sqrt(runs)
    half = (np.abs(np.array(pit) - 0.5) < 0.25).mean()
    print(f"\n95% bands cover {100 * rate:.1f}% (se {100 * error:.1f}), "
          f"first row {100 * covered[:, 0].mean():.1f}%, last row {100 * covered[:, -1].mean():.1f}%; 50% bands "
          f"{100 * half:.1f}%")
    assert abs(rate - 0.95) < 0.03


def elimination(times, y=None, limit=50.0, start=3000.0, **options):
    """Elimination that saturates: the rate is the limit over 2 once the drug is gone, and slow before."""
    half = numpyro.sample("half", dist.LogNormal(np.log(2.0), NEAR))
    system = lfm.LatentForceModel(
        lambda x, u, t: -limit * x / (half + x), {}, lfm.GaussianObservation(systems.whole_state, jnp.array([0.01])),
        lfm.Gaussian(jnp.array([start]), jnp.zeros((1, 1))), state_names=("drug",), initial_time=0.0)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, iterations=0, **options), obs=y)


@pytest.mark.thorough
def test_a_decay_that_is_fast_after_the_data_only():
    """Two time constants and more in an explicit step of the simulation."""
    times = np.arange(6.0, 37.0, 6.0)
    data = 3000.0 - 50.0 * times[:, None] + 0.2
    result = lfm.fit(elimination, times, data, sampler="map", samples=4, trajectory_draws=0, progress=False)
    forecast = predictions(lfm.forecast(result, elimination, [72.0], progress=False))
    np.testing.assert_allclose(forecast["states"].sel(time=72.0), 0.0, atol=1e-2)


@pytest.mark.slow
def test_a_stiff_fit_has_a_stiff_forecast():
    options = {"limit": 6000.0, "start": 0.5, "method": "exponential"}
    times = np.array([2.0, 4.0, 6.0])
    result = lfm.fit(elimination, times, np.zeros((3, 1)), sampler="map", samples=4, trajectory_draws=0, progress=False,
                     model_kwargs=options)
    forecast = predictions(lfm.forecast(result, elimination, [8.0, 200.0], progress=False, model_kwargs=options))
    np.testing.assert_allclose(forecast["states"], 0.0, atol=1e-8)
