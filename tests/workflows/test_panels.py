"""Results of panels: one series of them equals a result of one series."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from matplotlib import pyplot

import lfm_ppl as lfm
from lfm_ppl.plots import plot_fit, plot_forces, plot_residuals, plot_states
from lfm_ppl.results import arviz_data, rebuilding
from lfm_ppl.results.result_view import ResultView

TIMES = np.array([[0.0, 1.0, 2.5, 4.0], [0.0, 0.5, 3.0, 3.0]])
Y = np.array([[1.0, 0.7, 0.5, 0.1], [1.2, 0.9, 0.4, np.nan]])[..., None]
"""The last row of the second series pads it."""

RATES, LABELS = np.array([0.4, 0.9]), ["Ann", "Bo"]


def build(rate):
    return lfm.LatentForceModel(
        lambda x, u, t: u - rate * x, {"drive": lfm.Matern(0.3, 1.3)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.05])), lfm.Gaussian(jnp.ones(1), 0.2 * jnp.eye(1)),
        output_names=["x"], units={"time": "h"})


def model(times, y=None):
    with numpyro.plate("patient", 2):
        rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.3))
        numpyro.sample("y", lfm.panel(build, rate, times), obs=y)


@pytest.fixture(scope="module")
def result():
    """Four draws of the same parameters, so that each mixture over the draws is one normal distribution."""
    draws = {"rate": np.tile(RATES, (1, 4, 1))}
    with pytest.warns(lfm.ConvergenceWarning):
        return lfm.to_arviz(draws, model, TIMES, Y, coords={"patient": LABELS}, trajectory_draws=4)


def smoothed(series, times):
    rows = np.isfinite(Y[series, :, 0])
    return lfm.smooth(build(RATES[series]), TIMES[series, rows], Y[series, rows], at=times)


@pytest.mark.thorough
def test_the_plate_is_a_dimension_of_every_group(result):
    for name in ("posterior", "data", "one_step_ahead", "trajectories"):
        assert ResultView.of(result).group(name)["patient"].values.tolist() == LABELS, name
    series, rows, _ = np.nonzero(np.isfinite(Y))
    for name in ("observed_data", "log_likelihood", "posterior_predictive"):
        np.testing.assert_array_equal(ResultView.of(result).group(name)["patient"], np.array(LABELS)[series])
        np.testing.assert_array_equal(ResultView.of(result).group(name)["time"], TIMES[series, rows])
    assert ResultView.of(result).group("data")["times"].dims == ("patient", "time")
    assert ResultView.of(result).group("trajectories")["times"].dims == ("patient", "time")


@pytest.mark.thorough
@pytest.mark.parametrize("series", [0, 1])
def test_a_selected_series_is_smoothed_as_if_alone(result, series):
    view = lfm.select_series(result, LABELS[series])
    observed, paths = ResultView.of(view).group("data"), ResultView.of(view).group("trajectories")
    rows = np.isfinite(Y[series, :, 0])
    np.testing.assert_array_equal(observed["time"], TIMES[series, rows])
    np.testing.assert_array_equal(observed["y"], Y[series, rows])
    assert observed["time"].attrs["units"] == "h"
    assert paths["time"].size > 100 and (np.diff(paths["time"]) > 0).all()
    expected = smoothed(series, paths["time"].values).force("drive")
    mean, _, high = paths["forces_summary"].sel(force="drive").values
    np.testing.assert_allclose(mean, expected.mean, atol=1e-9)
    np.testing.assert_allclose(high - mean, 1.959964 * expected.sd, rtol=1e-3)
    alone = lfm.smooth(build(RATES[series]), TIMES[series, rows], Y[series, rows])
    np.testing.assert_allclose(ResultView.of(view).group("log_likelihood")["y"][0, 0], alone.leave_one_out, rtol=1e-9)
    assert ResultView.of(view).posterior["rate"].dims == ("chain", "draw")


@pytest.mark.thorough
@pytest.mark.parametrize("times", [[6.0, 7.0], [[1.5, 7.0], [3.5, 9.0]]])
def test_a_forecast_is_that_of_each_series(result, times):
    forecast = lfm.forecast(result, model, times, progress=False)
    for series, requested in enumerate(np.broadcast_to(times, (2, 2))):
        predicted = ResultView.of(lfm.select_series(forecast, series)).group("predictions")
        assert predicted["y"].dims == ("chain", "draw", "time", "output")
        np.testing.assert_array_equal(predicted["time"], requested)
        expected = smoothed(series, requested)
        np.testing.assert_allclose(predicted["y_mean"][0, 0, :, 0], expected.mean[:, 0], atol=1e-9)
        sd = np.sqrt(expected.covariance[:, 0, 0] + 0.05)
        np.testing.assert_allclose(predicted["y_sd"][0, 0, :, 0], sd, rtol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("times", [[6.0, 7.0], [1.5, 3.5, 9.0]])
def test_a_forecast_of_a_selected_series_is_that_of_the_panel(result, times, tmp_path):
    forecast = lfm.forecast(result, model, times, progress=False)
    for series in ("Bo", 0):
        view = lfm.select_series(result, series)
        lfm.save(view, tmp_path / f"{series}.nc")
        for stored in (view, lfm.load(tmp_path / f"{series}.nc")):
            alone = lfm.forecast(stored, model, times, progress=False)
            predicted, expected = (ResultView.of(part).group("predictions")
                                   for part in (alone, lfm.select_series(forecast, series)))
            xr.testing.assert_allclose(predicted, expected)
            assert predicted.attrs == expected.attrs
        assert set(ResultView.of(alone).groups) == {*ResultView.of(view).groups, "predictions"}
        assert lfm.plot_fit(alone) is not None
        assert lfm.score(alone, np.zeros((len(times), 1))).loc["all", "n"] == len(times)


@pytest.mark.thorough
def test_the_likelihood_of_a_selected_series_is_that_of_the_panel(result):
    with pytest.raises(ValueError, match="selected from"):
        rebuilding.problem(lfm.select_series(result, "Bo"), model)


@pytest.mark.thorough
def test_a_nonlinear_forecast_follows_the_dynamics(result):
    """dx/dt = -x^3 without noise: x(t) = (x(0)^-2 + 2 t)^-1/2, between the rows and after them."""

    def cubic(times, y=None):
        scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.1))
        with numpyro.plate("patient", 2):
            numpyro.sample("y", lfm.panel(lambda start: lfm.LatentForceModel(
                lambda x, u, t: -scale * x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])),
                lfm.Gaussian(start[None], 1e-12 * jnp.eye(1)), process_noise=1e-12 * jnp.eye(1)),
                jnp.array([1.0, 2.0]), times, steps=20), obs=y)

    draws = xr.Dataset({"scale": (("chain", "draw"), np.ones((1, 2)))})
    result = arviz_data.build({"posterior": draws, "data": ResultView.of(result).group("data")})
    times = np.array([[1.5, 5.0, 9.0], [0.2, 3.5, 4.0]])
    states = ResultView.of(lfm.forecast(result, cubic, times, progress=False)).group("predictions")["states"]
    exact = (np.array([[1.0], [2.0]]) ** -2 + 2 * times) ** -0.5
    np.testing.assert_allclose(states[0, 0, ..., 0], exact, rtol=1e-4)


def test_figures_have_axes_for_each_series(result):
    for plot in (plot_fit, plot_forces, plot_states, plot_residuals):
        figure = plot(result)
        assert [axes.get_title(loc="left") for axes in figure.axes] == ["patient Ann", "patient Bo"], plot
        assert all(axes.get_ylabel() for axes in figure.axes) and figure.axes[-1].get_xlabel() == "time (h)"
        assert len(plot(result, series="Bo").axes) == (3 if plot is plot_residuals else 1)
    assert not pyplot.get_fignums()
    with pytest.raises(ValueError, match="'Bob'"):
        plot_fit(result, series=["Bob"])
    with pytest.raises(ValueError, match="series"):
        plot_fit(lfm.select_series(result, 0), series=0)


@pytest.mark.thorough
def test_the_report_shows_the_series(result, tmp_path):
    forecast = lfm.forecast(result, model, [[1.5, 7.0], [3.5, 9.0]], progress=False)
    page = lfm.save_report(forecast, tmp_path).read_text()
    assert "patient Ann" in page and "could not be drawn" not in page
    page = lfm.save_report(lfm.select_series(forecast, "Bo"), tmp_path / "b.html").read_text()
    assert "could not be drawn" not in page


def test_wrong_times_and_series_are_refused(result):
    for times, part in (([[6.0], [-1.0]], "series 1"), (np.ones((3, 1)), r"\(2, K\)"), ([[1.0, 0.5]] * 2, "go back")):
        with pytest.raises(ValueError, match=part):
            lfm.forecast(result, model, times, progress=False)
    for name in ("Bob", 7):
        with pytest.raises(ValueError, match=str(name)):
            lfm.select_series(result, name)
    with pytest.raises(ValueError, match="one series"):
        lfm.select_series(lfm.select_series(result, 1), 0)


