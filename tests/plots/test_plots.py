"""Figures: what is drawn equals what was computed independently, and can be read."""

import json

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from scipy import stats

from lfm_ppl.io.input_table import InputTable
from lfm_ppl.plots import (
    forecasts,
    plot_deterministics,
    plot_fit,
    plot_forces,
    plot_inputs,
    plot_pairs,
    plot_residuals,
    plot_states,
    plot_trace,
    style,
)
from lfm_ppl.results import arviz_data
from lfm_ppl.results.inputs import to_dataset
from lfm_ppl.results.predictions import PERIODS
from lfm_ppl.results.result_view import ResultView

FIGURES = [plot_fit, plot_forces, plot_states, plot_trace, plot_pairs, plot_residuals]


def lines(axes, label):
    return [line for line in axes.lines if line.get_label() == label]


def the_line(axes, label):
    (line,) = lines(axes, label)
    return line


def edges(band):
    """Lower and upper edge of a filled band, by x."""
    vertices = band.get_paths()[0].vertices
    return {x: (vertices[vertices[:, 0] == x, 1].min(), vertices[vertices[:, 0] == x, 1].max())
            for x in np.unique(vertices[:, 0])}


def bands(axes):
    return [collection for collection in axes.collections if isinstance(collection, PolyCollection)]


def legend_texts(figure):
    return {text.get_text() for text in figure.legends[0].get_texts()}


def predictions(datasets, time, last):
    """Predictions of outputs and forces at ``time``, with random draws."""
    rng = np.random.default_rng(2)
    outputs, forces = datasets["trajectories"]["output"], datasets["trajectories"]["force"]
    sample_dims = ("chain", "draw", "time")
    draws = {"forces": ((*sample_dims, "force"), rng.normal(size=(4, 25, len(time), len(forces))))}
    for name in ("y", "outputs"):
        draws[name] = ((*sample_dims, "output"), rng.normal(size=(4, 25, len(time), len(outputs))))
    return xr.Dataset(draws, {"time": time, "force": forces, "output": outputs}, {"last_observation": last})


@pytest.mark.parametrize("plot", FIGURES)
def test_readable_in_a_column_of_a_paper(result, readable, plot):
    settings = dict(matplotlib.rcParams)
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black"}):
        figure = plot(result, width="column")
    readable(figure)
    assert figure.get_figwidth() == 3.4 and figure.get_figheight() < 10.0
    assert to_hex(figure.axes[0].get_facecolor()) == "#ffffff"
    assert dict(matplotlib.rcParams) == settings and not plt.get_fignums()
    assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.parametrize("plot", [plot_fit, plot_trace, plot_pairs, plot_residuals])
def test_readable_when_crowded(crowded, readable, plot):
    readable(plot(crowded, width="column"))


def test_long_lists_are_cut_and_say_so(crowded):
    figure = plot_fit(crowded)
    assert len(figure.axes) == 12 and "12 of 15 outputs" in figure._supxlabel.get_text().replace("\n", " ")
    assert len(plot_fit(crowded, [f"sensor_{k}_temperature" for k in range(13)]).axes) == 13


@pytest.mark.parametrize("limits, power, labels", [
    ((0.0, 1.0), "", {"0.0", "0.2", "1.0"}),
    ((0.0, 12000.0), "", {"0", "2500", "7500"}),
    ((-2e7, 2e7), "10⁷", {"−2", "−1", "0", "1", "2"}),
    ((1e5, 1e5 + 2.0), "10⁵", {"1.000000", "1.000005", "1.000020"})])
def test_tick_labels_are_short_and_distinct(limits, power, labels):
    figure = style.new_figure("column", 2.0)
    axes = figure.add_subplot()
    style.tidy(axes)
    axes.set_xlim(*limits)
    assert style.scale(axes.xaxis) == power
    figure.draw_without_rendering()
    tick_labels = [text.get_text() for text in axes.get_xticklabels()]
    assert len(set(tick_labels)) == len(tick_labels) and labels <= set(tick_labels)


def test_names_are_whole():
    with style.in_style():
        axes = style.new_figure("column", 2.0).add_subplot()
        style.label_values(axes, "outdoor_temperature_of_roof", "degC")
    assert (axes.get_title(loc="left"), axes.get_ylabel()) == ("outdoor_temperature_of_roof", "degC")
    style.label_values(axes, "basal_rate[CDKN1A]", "nM")
    assert axes.get_ylabel() == "basal_rate[CDKN1A]\n(nM)"


def test_fit_draws_data_means_and_quantiles(result, datasets):
    figure = plot_fit(result)
    observed, outputs = datasets["data"]["y"], datasets["trajectories"]["outputs"]
    predictive = datasets["posterior_predictive"]["y"]
    assert figure.axes[0].get_ylabel() == "CDKN1A (a.u.)" and figure.axes[-1].get_xlabel() == "time (h)"
    assert legend_texts(figure) == {"data", "posterior mean", "95%, noise-free", "95%, new data", "missing"}
    for index, axes in enumerate(figure.axes):
        y, time = observed.values[:, index], observed["time"].values
        data, missing = the_line(axes, "data"), the_line(axes, "missing")
        np.testing.assert_array_equal(data.get_xdata(), time[~np.isnan(y)])
        np.testing.assert_array_equal(data.get_ydata(), y[~np.isnan(y)])
        np.testing.assert_array_equal(missing.get_xdata(), time[np.isnan(y)])
        draws = outputs.values[..., index].reshape(200, -1)
        mean = the_line(axes, "posterior mean")
        np.testing.assert_allclose(mean.get_ydata(), draws.mean(axis=0))
        np.testing.assert_array_equal(mean.get_xdata(), outputs["time"].values)
        outer, inner = map(edges, bands(axes))
        for x, low, high in zip(outputs["time"].values, *np.quantile(draws, [0.025, 0.975], axis=0), strict=True):
            np.testing.assert_allclose(inner[x], [low, high])
        assert (min(outer), max(outer)) == (0.0, 12.0)
        for instant in np.unique(time):  # replicates are pooled
            is_drawn = (predictive["time"] == instant) & (predictive["output"] == observed["output"][index].item())
            if not is_drawn.any():
                continue
            new = predictive.values[:, :, is_drawn.values]
            np.testing.assert_allclose(outer[instant], np.quantile(new, [0.025, 0.975]))


def test_band_of_new_data_keeps_to_the_values_that_the_family_has(datasets):
    predictive = datasets["posterior_predictive"]
    counts = np.random.default_rng(0).poisson(0.5 + 4 * (predictive["time"].values > 6), predictive["y"].shape)
    for values, kind in ((counts, "whole"), (counts + 0.001 * predictive["y"] ** 2, "positive")):
        new = predictive.assign(y=(predictive["y"].dims, np.asarray(values, float)))
        axes = plot_fit(arviz_data.build({**datasets, "posterior_predictive": new})).axes[0]
        bounds = np.array(list(edges(bands(axes)[0]).values()))
        assert bounds.min() >= 0.0
        assert kind == "positive" or np.all(bounds == np.round(bounds))


def test_fit_of_one_row_and_without_predictive_draws(datasets):
    del datasets["posterior_predictive"]
    datasets["data"] = datasets["data"].isel(time=[0])
    figure = plot_fit(arviz_data.build(datasets), ["SESN1"])
    (axes,) = figure.axes
    assert len(bands(axes)) == 1 and len(the_line(axes, "data").get_xdata()) == 1


@pytest.mark.parametrize("plot, kind", [(plot_forces, "force"), (plot_states, "state"),
                                        (plot_deterministics, "deterministic")])
def test_forces_states_and_deterministics_draw_means_bands_and_truth(datasets, plot, kind):
    for group in ("trajectories", "truth"):
        renamed = datasets[group][["forces"]].rename(forces="deterministics", force="deterministic")
        datasets[group] = datasets[group].merge(renamed)
    figure = plot(arviz_data.build(datasets))
    variable, truth = datasets["trajectories"][f"{kind}s"], datasets["truth"][f"{kind}s"]
    assert len(figure.axes) == variable.sizes[kind]
    for index, axes in enumerate(figure.axes):
        draws = variable.values[..., index].reshape(200, -1)
        np.testing.assert_allclose(the_line(axes, "posterior mean").get_ydata(), draws.mean(axis=0))
        true = the_line(axes, "truth")
        np.testing.assert_array_equal(true.get_xdata(), truth["time"].values)
        np.testing.assert_array_equal(true.get_ydata(), truth.values[:, index])
        (band,) = bands(axes)
        for x, low, high in zip(variable["time"].values, *np.quantile(draws, [0.025, 0.975], axis=0), strict=True):
            np.testing.assert_allclose(edges(band)[x], [low, high])


def test_the_truth_is_drawn_where_it_is_known_as_far_as_the_trajectories(datasets):
    path_times, truth = datasets["trajectories"]["time"].values, datasets["truth"].sel(force=["stress"])
    later = truth.assign_coords(time=truth["time"].values + 0.5 * np.ptp(path_times))
    without, axes = plot_forces(arviz_data.build({**datasets, "truth": later})).axes
    assert not lines(without, "truth")
    truth_times = the_line(axes, "truth").get_xdata()
    assert 0 < len(truth_times) < truth.sizes["time"]
    assert path_times.min() <= truth_times.min() and truth_times.max() <= path_times.max()


def test_bands_are_those_of_the_summary_where_there_is_one(datasets):
    paths = datasets["trajectories"]
    for name, kind, plot, band_index in (("forces", "force", plot_forces, 0), ("new_data", "output", plot_fit, 0)):
        bounds = np.stack([np.full((paths.sizes["time"], paths.sizes[kind]), value) for value in (0.5, -1.0, 2.0)])
        summary = paths.assign({f"{name}_summary": (("statistic", "time", kind), bounds)})
        axes = plot(arviz_data.build({**datasets, "trajectories": summary})).axes[1]
        band = edges(bands(axes)[band_index])
        assert set(band) == set(paths["time"].values)
        assert set(map(tuple, map(sorted, band.values()))) == {(-1.0, 2.0)}


def test_a_force_that_repeats_often_shows_its_last_periods(datasets):
    paths = datasets["trajectories"]
    paths["forces"].attrs[PERIODS] = json.dumps({"stress": 1.0})
    p53, stress = plot_forces(arviz_data.build(datasets)).axes
    end = paths["time"].values[-1]
    assert the_line(p53, "posterior mean").get_xdata()[0] == paths["time"].values[0]
    assert end - 3.0 <= the_line(stress, "posterior mean").get_xdata()[0] < end - 2.5
    forecast = predictions(datasets, np.linspace(13.0, 30.0, 80), 12.0)
    stress = plot_forces(arviz_data.build({**datasets, "predictions": forecast})).axes[1]
    assert max(line.get_xdata()[-1] for line in lines(stress, "posterior mean")) <= end + 3.0


def test_forecasts_continue_mean_and_bands_as_curves_or_bars(datasets):
    time = np.linspace(12.0, 30.0, 80)
    forecast = predictions(datasets, time, 12.0)
    figure = plot_forces(arviz_data.build({**datasets, "predictions": forecast}))
    later = time > datasets["trajectories"]["time"].values[-1]
    for index, axes in enumerate(figure.axes):
        band_edges = edges(bands(axes)[-1])
        bounds = np.quantile(forecast["forces"].values[..., index].reshape(-1, 80), (0.025, 0.975), axis=0)[:, later]
        np.testing.assert_allclose([band_edges[x] for x in time[later]], bounds.T)
        assert set(the_line(axes, "last observation").get_xdata()) == {12.0}
    for plot in (plot_forces, plot_fit):
        axes = plot(arviz_data.build({**datasets, "predictions": forecast.isel(time=[0, -1])})).axes[0]
        bars = [collection for collection in axes.collections if isinstance(collection, LineCollection)]
        assert all(np.all(segment[:, 0] == 30.0) for bar in bars for segment in bar.get_segments()) and bars
    alone = {name: datasets[name] for name in ("data",)}
    axes = plot_fit(arviz_data.build({**alone, "predictions": forecast})).axes[0]
    np.testing.assert_array_equal(the_line(axes, "posterior mean").get_xdata(), time)


def test_a_short_forecast_shows_the_last_rows_and_held_out_data(datasets):
    last, end = 12.0, 14.0
    paths = datasets["trajectories"]
    datasets["trajectories"] = paths.sel(time=paths["time"] <= last)
    forecast = predictions(datasets, np.linspace(12.5, end, 5), last)
    y = xr.DataArray([[1.0, 2.0, 3.0], [1.5, np.nan, 2.5]], dims=("time", "output"))
    held_out = xr.Dataset({"y": y}, {"time": [13.0, 13.5], "output": datasets["data"]["output"]})
    result = arviz_data.build({**datasets, "predictions": forecast, "held_out_data": held_out})
    axes = plot_fit(result).axes[1]
    data_times = the_line(axes, "data").get_xdata()
    assert 0 < data_times.min() <= last - 2 * (end - last) and data_times.max() == last
    marks = the_line(axes, "held-out data")
    np.testing.assert_array_equal(marks.get_xydata(), [[13.0, 2.0], [13.5, np.nan]])
    assert marks.get_linestyle() == "None"
    fit_axes = plot_fit(forecasts.without_forecast(ResultView.of(result))).axes[1]
    assert not lines(fit_axes, "last observation") and the_line(fit_axes, "data").get_xdata().min() == 0.0


def test_doses_are_marked_and_their_rows_are_not_missing(datasets):
    y = datasets["data"]["y"]
    times, empty = y["time"].values, y.copy()
    empty.values[[0, 3]] = np.nan
    datasets["data"] = datasets["data"].assign(y=empty)
    dose = InputTable(times[[0, 2]], np.array([4.0, 2.0]), "dose:gut", np.array([0.0, 1e3]), None, times[[3]])
    heater = InputTable(times[[0, 3]], np.array([0.0, 2.0]))
    plain = plot_fit(arviz_data.build({**datasets, "constant_data": to_dataset({"heater": heater})})).axes[0]
    marked = plot_fit(arviz_data.build({**datasets, "constant_data": to_dataset({"dose": dose, "heater": heater})}))
    missing, without = (the_line(axes, "missing").get_xdata() for axes in (plain, marked.axes[0]))
    np.testing.assert_array_equal(np.setdiff1d(missing, without), times[[0, 3]])
    assert {"dose", "infusion", "reset"} <= legend_texts(marked)
    np.testing.assert_array_equal(the_line(marked.axes[0], "dose").get_xdata(), times[[0]])
    np.testing.assert_array_equal(the_line(marked.axes[0], "reset").get_xdata(), times[[3]])
    assert marked.axes[0].get_xlim() == plain.get_xlim()


@pytest.mark.parametrize("count", [1, 2, 5])
def test_curves_at_few_times_are_bars_and_lines(datasets, count):
    paths = datasets["trajectories"].isel(time=np.arange(count))
    keep = {name: datasets[name] for name in ("data", "observed_data", "posterior_predictive") if name in datasets}
    for plot in (plot_fit, plot_forces):
        axes = plot(arviz_data.build({**keep, "trajectories": paths})).axes[0]
        mean = the_line(axes, "posterior mean")
        bars = [collection for collection in axes.collections if isinstance(collection, LineCollection)]
        assert len(bars[-1].get_segments()) == count
        joined = [line for line in axes.lines if len(line.get_xdata()) == count and line.get_linestyle() == "-"]
        joined = [line for line in joined if line is not mean]
        assert len(joined) == (count > 1)
        assert count == 1 or np.allclose(joined[0].get_ydata(), mean.get_ydata()[np.isfinite(mean.get_ydata())])


def test_known_inputs_are_drawn_as_they_are_read_and_held(result):
    tables = {"heater": InputTable(np.array([0.0, 6.0]), np.array([0.0, 2.0]), "previous"),
              "outside": InputTable(np.array([0.0, 24.0]), np.array([3.0, 5.0]), "linear")}
    with pytest.raises(ValueError, match="known inputs"):
        plot_inputs(result)
    with_inputs = arviz_data.add_group(result, "constant_data", to_dataset(tables, {"outside": "degC"}))
    figure = plot_inputs(with_inputs)
    assert [axes.get_ylabel() for axes in figure.axes] == ["heater", "outside (degC)"]
    assert [axes.lines[0].get_drawstyle() for axes in figure.axes] == ["steps-post", "default"]
    forecast = xr.Dataset({"y": ("time", np.zeros(2))}, {"time": [8.0, 9.0]}, {"last_observation": 7.0})
    axes = plot_inputs(arviz_data.add_group(with_inputs, "predictions", forecast)).axes[0]
    np.testing.assert_array_equal(axes.lines[0].get_xydata(), [[0.0, 0.0], [6.0, 2.0]])
    np.testing.assert_array_equal(the_line(axes, "held beyond its table").get_xydata(), [[6.0, 2.0], [9.0, 2.0]])
    with pytest.raises(ValueError, match="heatre.*heater"):
        plot_inputs(with_inputs, "heatre")


def test_trace_and_ranks(result, datasets):
    figure = plot_trace(result)
    assert len(figure.axes) == 2 * 5  # the constant is not drawn
    assert figure.axes[2].get_title(loc="left") == "decay[SESN1] (1/h)"
    trace, ranks = figure.axes[2:4]
    draws = datasets["posterior"]["decay"].values[:, :, 1]
    for chain in range(4):
        np.testing.assert_array_equal(trace.lines[chain].get_ydata(), draws[chain])
    (diverged,) = [line for line in trace.lines if line.get_marker() == "|"]
    assert list(diverged.get_xdata()) == [10, 50, 99]
    assert the_line(trace, "truth").get_ydata()[0] == 0.4
    bars = [patch.get_data() for patch in ranks.patches]
    assert [bar.baseline for bar in bars] == [0, 1, 2, 3]
    heights = np.array([bar.values - bar.baseline for bar in bars])
    counts = np.array([np.histogram(chain, 10, (0.5, 400.5))[0] for chain in stats.rankdata(draws).reshape(4, 100)])
    np.testing.assert_allclose(heights / heights.sum(), counts / 400)
    np.testing.assert_allclose(ranks.lines[0].get_ydata()[0], heights.mean())
    assert len(plot_trace(result, "anchor").axes) == 2  # a constant too, when asked for


def test_derived_parameters_are_drawn_where_they_are_named(datasets):
    square = datasets["posterior"]["noise_sd"] ** 2
    square.attrs["derived"] = 1
    result = arviz_data.build({**datasets, "posterior": datasets["posterior"].assign(variance=square)})
    assert len(plot_trace(result).axes) == 2 * 5
    assert plot_trace(result, ["variance"]).axes[0].get_title(loc="left") == "variance"


def test_pairs(result, datasets, crowded):
    figure = plot_pairs(result, ["decay", "noise_sd"])
    assert len(figure.axes) == 4 * 5 // 2
    grid = dict(zip(zip(*np.tril_indices(4), strict=True), figure.axes, strict=True))
    draws, diverging = datasets["posterior"]["decay"].values, datasets["sample_stats"]["diverging"].values
    axes = grid[2, 0]
    cloud, divergent = the_line(axes, "draw"), the_line(axes, "divergent")
    np.testing.assert_array_equal(cloud.get_xydata(), np.stack([draws[..., 0].ravel(), draws[..., 2].ravel()], axis=1))
    np.testing.assert_array_equal(divergent.get_xdata(), draws[..., 0][diverging])
    np.testing.assert_array_equal(divergent.get_ydata(), draws[..., 2][diverging])
    vertical, horizontal = lines(axes, "truth")
    assert (vertical.get_xdata()[0], horizontal.get_ydata()[0]) == (0.8, 1.1)
    assert [grid[k, k].texts[0].get_text() for k in (0, 3)] == ["decay[CDKN1A] (1/h)", "noise_sd"]
    thinned = plot_pairs(crowded, ["offset", "a_parameter_with_a_long_name"])
    assert the_line(thinned.axes[1], "draw").get_xdata().size == 2000
    with pytest.raises(ValueError, match="20 parameters.*width=17"):
        plot_pairs(crowded, ["sensitivity"])


def test_residuals(result, datasets):
    figure = plot_residuals(result)
    assert len(figure.axes) == 9
    over_time, quantiles, lags = figure.axes[3:6]
    mean = datasets["one_step_ahead"]["residual"].values[..., 1].mean(axis=(0, 1))
    present = mean[~np.isnan(mean)]
    np.testing.assert_allclose(over_time.lines[-1].get_ydata(), mean)
    dots, n = quantiles.lines[-1], len(present)
    np.testing.assert_allclose(dots.get_ydata(), np.sort(present))
    median = stats.norm.ppf(stats.beta.ppf(0.5, np.arange(1, n + 1), np.arange(n, 0, -1)))
    np.testing.assert_allclose(dots.get_xdata(), median)
    first = bands(quantiles)[0].get_paths()[0].vertices
    # The smallest of n uniform values has the quantile function 1 - (1 - p)^(1/n).
    low = stats.norm.ppf(1 - 0.975 ** (1 / n))
    np.testing.assert_allclose(first[first[:, 0] == first[:, 0].min(), 1].min(), low)
    assert quantiles.get_title(loc="left") == f"KS p = {stats.kstest(present, 'norm').pvalue:.2g}"
    assert lags.get_title(loc="left").startswith("Ljung-Box p = 0.")


def test_residuals_of_every_second_row_few_or_no_observations(datasets, readable, recwarn):
    residual = datasets["one_step_ahead"]["residual"]
    residual[:, ::2, 1, 1] = -9.0  # of half of the draws: the bar over the draws is drawn whole
    residual[:, :, ::2, 1] = np.nan
    residual[:, :, 3:, 0] = np.nan
    residual[..., 2] = np.nan
    figure = plot_residuals(arviz_data.build(datasets))
    readable(figure)
    assert [axes.get_title(loc="left") for axes in figure.axes].count("KS: few data") == 2
    (envelope,) = [patch for patch in figure.axes[5].patches if hasattr(patch, "get_data")]
    assert np.nanmax(envelope.get_data().values) < 1.5  # no stripes over the whole height
    assert figure.axes[3].get_ylim()[0] < -9.0
    assert not recwarn.list


@pytest.mark.parametrize("plot, group", [(plot_fit, "data"), (plot_states, "trajectories"),
                                         (plot_trace, "posterior"), (plot_residuals, "one_step_ahead")])
def test_a_missing_group_is_named_with_its_source(datasets, plot, group):
    del datasets[group]
    with pytest.raises(ValueError, match=rf"'{group}'.*lfm.fit"):
        plot(arviz_data.build(datasets))


@pytest.mark.parametrize("plot, wrong, nearest", [
    (plot_fit, "CDKN1", "CDKN1A"), (plot_forces, "P53", "p53"), (plot_trace, "lengthscal", "lengthscale")])
def test_an_unknown_name_gets_the_nearest_one(result, plot, wrong, nearest):
    with pytest.raises(ValueError, match=rf"{wrong}.*'{nearest}'"):
        plot(result, [wrong])
