"""Figures: what is drawn equals what was computed independently, and can be read."""

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from scipy import stats

from lfm_ppl.io.data_set import InputTable
from lfm_ppl.results import arviz_data
from lfm_ppl.results.inputs import to_dataset
from lfm_ppl.results.plots import (
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

FIGURES = [plot_fit, plot_forces, plot_states, plot_trace, plot_pairs, plot_residuals]
OKABE_ITO = "#000000 #E69F00 #56B4E9 #009E73 #F0E442 #0072B2 #D55E00 #CC79A7".split()
PALETTE = {*OKABE_ITO, style.GREY}


def line(axes, colour, *, dashed=False):
    """The one line of that colour."""
    (result,) = [
        line
        for line in axes.lines
        if to_hex(line.get_color()).upper() == colour
        and line.is_dashed() is dashed
        and line.get_linestyle() != "None"
    ]
    return result


def points(axes, marker):
    return [line for line in axes.lines if line.get_marker() == marker]


def edges(band):
    """Lower and upper edge of a filled band, by x."""
    vertices = band.get_paths()[0].vertices
    return {
        x: (vertices[vertices[:, 0] == x, 1].min(), vertices[vertices[:, 0] == x, 1].max())
        for x in np.unique(vertices[:, 0])
    }


def bands(axes):
    return [collection for collection in axes.collections if isinstance(collection, PolyCollection)]


def legend_texts(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.parametrize("width", ["column", "full"])
@pytest.mark.parametrize("plot", FIGURES)
def test_readable_at_the_widths_of_a_paper(result, readable, plot, width):
    before = dict(matplotlib.rcParams)
    figure = plot(result, width=width)
    readable(figure)
    assert figure.get_figwidth() == {"column": 3.4, "full": 7.0}[width]
    assert figure.get_figheight() < 10.0
    assert dict(matplotlib.rcParams) == before
    assert not plt.get_fignums()
    for line in (line for axes in figure.axes for line in axes.lines):
        assert to_hex(line.get_color()).upper() in PALETTE


@pytest.mark.parametrize("width", ["column", "full"])
@pytest.mark.parametrize("plot", [plot_fit, plot_trace, plot_pairs, plot_residuals])
def test_readable_when_crowded(crowded, readable, plot, width):
    readable(plot(crowded, width=width))


def test_the_readers_own_style_does_not_leak_in(result):
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black", "lines.linewidth": 9}):
        figure = plot_forces(result)
    assert max(text.get_fontsize() for text in figure.axes[0].get_yticklabels()) == 7.0
    assert to_hex(figure.axes[0].get_facecolor()) == "#ffffff"
    # Ticks made after the style has gone, as when a notebook zooms in.
    figure.axes[0].set_yticks(np.linspace(0, 12, 25))
    figure.draw_without_rendering()
    assert max(text.get_fontsize() for text in figure.axes[0].get_yticklabels()) == 7.0


def test_forces_go_on_with_their_forecast(datasets):
    rng = np.random.default_rng(2)
    place = ("chain", "draw", "time", "force")
    ahead = rng.normal(size=(4, 25, 40, 2))
    time = np.linspace(12.0, 30.0, 40)
    predictions = xr.Dataset({"forces": (place, ahead)}, {"time": time, "force": datasets["trajectories"]["force"]},
                             {"last_observation": 12.0})
    figure = plot_forces(arviz_data.build({**datasets, "predictions": predictions}))
    later = time >= datasets["trajectories"]["at"].values[-1]
    for index, axes in enumerate(figure.axes):
        drawn = edges(bands(axes)[-1])
        low, high = np.quantile(ahead[..., index].reshape(-1, 40), (0.025, 0.975), axis=0)[:, later]
        np.testing.assert_allclose([drawn[x] for x in time[later]], np.stack([low, high], axis=-1))
        (end,) = [line for line in axes.lines if np.array_equal(line.get_xdata(), [12.0, 12.0])]
        assert end.is_dashed()
    assert legend_texts(figure)[-1] == "last observation"
    few = arviz_data.build({**datasets, "predictions": predictions.isel(time=[0, -1])})
    collections = plot_forces(few).axes[0].collections
    (bars,) = [collection for collection in collections if isinstance(collection, LineCollection)]
    np.testing.assert_allclose(bars.get_segments()[0][:, 0], 30.0)


def test_the_truth_is_drawn_as_far_as_the_trajectories(datasets):
    at, truth = datasets["trajectories"]["at"].values, datasets["truth"]
    later = truth.assign_coords(at_truth=truth["at_truth"].values + 0.5 * np.ptp(at))
    for axes in plot_forces(arviz_data.build({**datasets, "truth": later})).axes:
        (drawn,) = [line for line in axes.lines if line.get_color() == style.BLACK and line.is_dashed()]
        assert 0 < len(drawn.get_xdata()) < truth.sizes["at_truth"]
        assert at.min() <= drawn.get_xdata().min() and drawn.get_xdata().max() <= at.max()


def test_an_input_is_drawn_as_it_is_held_to_the_end_of_a_forecast(result, readable):
    table = InputTable(np.array([0.0, 6.0]), np.array([0.0, 2.0]), "linear")
    known = arviz_data.add_group(result, "constant_data", to_dataset({"heater": table}))
    predictions = xr.Dataset({"y": ("time", np.zeros(2))}, {"time": [8.0, 9.0]}, {"last_observation": 7.0})
    figure = plot_inputs(arviz_data.add_group(known, "predictions", predictions))
    readable(figure)
    read, held, end = figure.axes[0].lines
    np.testing.assert_array_equal(held.get_xydata(), [[6.0, 2.0], [9.0, 2.0]])
    assert held.is_dashed() and set(end.get_xdata()) == {7.0}
    assert legend_texts(figure) == ["known input", "held beyond its table", "last observation"]


def test_known_inputs_are_drawn_as_they_are_read(result, readable):
    tables = {"heater": InputTable(np.array([0.0, 6.0, 22.0]), np.array([0.0, 1.0, 0.0]), "previous"),
              "outside": InputTable(np.array([0.0, 24.0]), np.array([3.0, 5.0]), "linear")}
    with pytest.raises(ValueError, match="holds no known inputs"):
        plot_inputs(result)
    known = arviz_data.add_group(result, "constant_data", to_dataset(tables, {"outside": "degC"}))
    figure = plot_inputs(known, width="full")
    readable(figure)
    assert [axes.get_ylabel() for axes in figure.axes] == ["heater", "outside (degC)"]
    assert [axes.lines[0].get_drawstyle() for axes in figure.axes] == ["steps-post", "default"]
    np.testing.assert_array_equal(figure.axes[0].lines[0].get_ydata(), [0.0, 1.0, 0.0])
    longer = {"heater": InputTable(np.array([0.0, 30.0]), np.array([0.0, 2.0]), "previous")}
    ahead = arviz_data.add_group(known, "predictions_constant_data", to_dataset(longer))
    (axes,) = plot_inputs(ahead, "heater").axes
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [0.0, 30.0])
    assert legend_texts(axes.figure) == ["known input"]
    with pytest.raises(ValueError, match="unknown input 'heatre'. Did you mean 'heater'"):
        plot_inputs(known, "heatre")


def test_shows_itself_in_a_notebook(result):
    assert plot_forces(result)._repr_png_().startswith(b"\x89PNG")


def test_fit_draws_data_means_and_quantiles(result, datasets):
    figure = plot_fit(result)
    observed, outputs = datasets["observed_data"]["y"], datasets["trajectories"]["outputs"]
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "CDKN1A (a.u.)", "SESN1 (a.u.)", "TNFRSF10b (nM)",
    ]  # fmt: skip
    assert [axes.get_xlabel() for axes in figure.axes] == ["", "", "time (h)"]
    assert legend_texts(figure) == [
        "data", "posterior mean", "95%, noise-free", "95%, new data", "missing",
    ]  # fmt: skip
    for index, axes in enumerate(figure.axes):
        y = observed.values[:, index]
        (data,), (missing,) = points(axes, "o"), points(axes, "x")
        np.testing.assert_array_equal(data.get_xdata(), observed["time"].values[~np.isnan(y)])
        np.testing.assert_array_equal(data.get_ydata(), y[~np.isnan(y)])
        np.testing.assert_array_equal(missing.get_xdata(), observed["time"].values[np.isnan(y)])
        draws = outputs.values[..., index].reshape(200, -1)
        mean = line(axes, style.BLUE)
        np.testing.assert_allclose(mean.get_ydata(), draws.mean(axis=0))
        np.testing.assert_array_equal(mean.get_xdata(), outputs["at"].values)
        inner = edges(bands(axes)[1])
        expected = np.quantile(draws, [0.025, 0.975], axis=0)
        for x, low, high in zip(outputs["at"].values, *expected, strict=True):
            np.testing.assert_allclose(inner[x], [low, high])


def test_fit_draws_predictive_quantiles_of_pooled_replicates(result, datasets):
    predictive = datasets["posterior_predictive"]["y"]
    for index, axes in enumerate(plot_fit(result).axes):
        outer = edges(bands(axes)[0])
        assert (min(outer), max(outer)) == (0.0, 12.0)
        for time in np.unique(predictive["time"].values):
            draws = predictive.values[:, :, predictive["time"].values == time, index]
            np.testing.assert_allclose(outer[time], np.quantile(draws, [0.025, 0.975]))


def test_fit_draws_the_noise_free_truth(datasets):
    truth = datasets["truth"]
    outputs = np.sin(truth["at_truth"].values)[:, None] * [1.0, 2.0]
    datasets["truth"] = truth.assign(outputs=(("at_truth", "output"), outputs)).assign_coords(
        output=["CDKN1A", "TNFRSF10b"])
    figure = plot_fit(arviz_data.build(datasets))
    assert "truth" in legend_texts(figure)
    first, second, third = figure.axes
    for axes, column in ((first, 0), (third, 1)):
        true = line(axes, style.BLACK, dashed=True)
        np.testing.assert_array_equal(true.get_xdata(), truth["at_truth"].values)
        np.testing.assert_array_equal(true.get_ydata(), outputs[:, column])
    assert not [line for line in second.lines if line.is_dashed() and to_hex(line.get_color()) == style.BLACK]


def test_fit_of_chosen_outputs_and_without_predictive_draws(datasets):
    del datasets["posterior_predictive"]
    figure = plot_fit(arviz_data.build(datasets), ["SESN1"])
    (axes,) = figure.axes
    assert axes.get_ylabel() == "SESN1 (a.u.)"
    assert len(bands(axes)) == 1
    assert "95%, new data" not in legend_texts(figure)


@pytest.mark.parametrize(
    ("plot", "kind", "colour"),
    [(plot_forces, "force", style.GREEN), (plot_states, "state", style.BLUE)],
)
def test_forces_and_states_draw_means_bands_and_truth(result, datasets, plot, kind, colour):
    figure = plot(result)
    variable, truth = datasets["trajectories"][f"{kind}s"], datasets["truth"][f"{kind}s"]
    assert len(figure.axes) == variable.sizes[kind]
    assert legend_texts(figure) == ["posterior mean", "95%", "truth"]
    for index, axes in enumerate(figure.axes):
        draws = variable.values[..., index].reshape(200, -1)
        np.testing.assert_allclose(line(axes, colour).get_ydata(), draws.mean(axis=0))
        true = line(axes, style.BLACK, dashed=True)
        np.testing.assert_array_equal(true.get_xdata(), truth["at_truth"].values)
        np.testing.assert_array_equal(true.get_ydata(), truth.values[:, index])
        (band,) = bands(axes)
        expected = np.quantile(draws, [0.025, 0.975], axis=0)
        for x, low, high in zip(variable["at"].values, *expected, strict=True):
            np.testing.assert_allclose(edges(band)[x], [low, high])


def test_bands_are_those_of_the_summary_where_there_is_one(datasets):
    paths = datasets["trajectories"]
    ends = np.stack([np.full((paths.sizes["at"], 2), value) for value in (0.5, -1.0, 2.0)])
    datasets["trajectories"] = paths.assign(forces_summary=(("statistic", "at", "force"), ends, paths["forces"].attrs))
    axes = plot_forces(arviz_data.build(datasets)).axes[1]
    np.testing.assert_array_equal(line(axes, style.GREEN).get_ydata(), np.full(paths.sizes["at"], 0.5))
    (band,) = bands(axes)
    assert set(map(tuple, map(sorted, edges(band).values()))) == {(-1.0, 2.0)}


def test_new_data_have_their_band_at_all_times_where_their_density_is_known(datasets):
    paths = datasets["trajectories"]
    ends = np.stack([np.full((paths.sizes["at"], 3), value) for value in (0.5, -1.0, 2.0)])
    datasets["trajectories"] = paths.assign(new_data_summary=(("statistic", "at", "output"), ends))
    outer, _ = bands(plot_fit(arviz_data.build(datasets)).axes[0])
    assert set(edges(outer)) == set(paths["at"].values)
    assert set(map(tuple, map(sorted, edges(outer).values()))) == {(-1.0, 2.0)}


def test_held_out_data_are_marked(datasets):
    y = xr.DataArray([[1.0, 2.0, 3.0], [1.5, np.nan, 2.5]], dims=("time", "output"))
    named = {"time": [13.0, 13.5], "output": datasets["observed_data"]["output"]}
    datasets["held_out_data"] = xr.Dataset({"y": y}, named)
    figure = plot_fit(arviz_data.build(datasets))
    assert "held-out data" in legend_texts(figure)
    (marks,) = [line for line in figure.axes[1].lines if to_hex(line.get_markerfacecolor()) == "#ffffff"]
    np.testing.assert_array_equal(marks.get_ydata(), [2.0, np.nan])
    np.testing.assert_array_equal(marks.get_xdata(), [13.0, 13.5])


def test_deterministics_have_a_figure(datasets):
    renamed = datasets["trajectories"][["forces"]].rename(forces="deterministics", force="deterministic")
    datasets["truth"] = datasets["truth"][["forces"]].rename(forces="deterministics", force="deterministic")
    datasets["trajectories"] = datasets["trajectories"].merge(renamed)
    figure = plot_deterministics(arviz_data.build(datasets), ["stress"])
    (axes,) = figure.axes
    assert axes.get_ylabel() == "stress (K)" and legend_texts(figure) == ["posterior mean", "95%", "truth"]
    draws = renamed["deterministics"].values[..., 1].reshape(200, -1)
    np.testing.assert_allclose(line(axes, style.ORANGE).get_ydata(), draws.mean(axis=0))
    with pytest.raises(ValueError, match="unknown deterministic 'p35'.*p53"):
        plot_deterministics(arviz_data.build(datasets), ["p35"])


def test_units_on_force_and_state_axes(result):
    assert [axes.get_ylabel() for axes in plot_forces(result).axes] == ["p53 (1/h)", "stress (K)"]
    labels = [axes.get_ylabel() for axes in plot_states(result).axes]
    assert labels == ["CDKN1A_mRNA (nM)", "SESN1_mRNA (nM)", "TNFRSF10b_mRNA\n(nM)"]


def test_forces_without_truth(datasets):
    del datasets["truth"]
    figure = plot_forces(arviz_data.build(datasets))
    assert legend_texts(figure) == ["posterior mean", "95%"]
    datasets["truth"] = xr.Dataset(
        {"forces": (("at_truth", "force"), np.zeros((2, 1)))},
        coords={"at_truth": [0.0, 1.0], "force": ["stress"]},
    )
    without, with_truth = plot_forces(arviz_data.build(datasets)).axes
    assert len(without.lines) == 1 and len(with_truth.lines) == 2


def test_long_lists_are_cut_and_say_so(crowded):
    figure = plot_fit(crowded)
    assert len(figure.axes) == 12
    note = figure._supxlabel.get_text().replace("\n", " ")
    assert note == "The first 12 of 15 outputs; choose others with outputs=[...]."
    assert len(plot_fit(crowded, [f"sensor_{k}_temperature" for k in range(13)]).axes) == 13
    assert not plot_fit(crowded, ["sensor_14_temperature"])._supxlabel
    figure = plot_trace(crowded)
    assert len(figure.axes) == 2 * 8
    assert "The first 8 of 22 parameters" in figure._supxlabel.get_text()


def test_powers_of_ten_stand_in_the_label(crowded):
    figure = plot_fit(crowded, ["sensor_3_temperature"])
    (axes,) = figure.axes
    assert axes.get_ylabel().endswith("(10⁻⁴ kg m/s²)")
    assert axes.get_xlabel() == "time (10⁴ s)"
    assert [text.get_text() for text in axes.get_yticklabels()][1:4] == ["−1", "0", "1"]


@pytest.mark.parametrize(
    ("limits", "power", "labels"),
    [
        ((0.0, 1.0), "", {"0.0", "0.2", "0.4", "0.6", "0.8", "1.0"}),
        ((0.0, 1000.0), "", {"0", "200", "400", "600", "800", "1000"}),
        ((0.0, 0.05), "", {"0.00", "0.01", "0.02", "0.03", "0.04", "0.05"}),
        ((-2e7, 2e7), "10⁷", {"−2", "−1", "0", "1", "2"}),
        ((1e5, 1e5 + 2.0), "10⁵", {"1.000000", "1.000005", "1.000010", "1.000015", "1.000020"}),
    ],
)
def test_tick_labels_are_short_and_distinct(limits, power, labels):
    figure = style.new_figure("column", 2.0)
    axes = figure.add_subplot()
    style.tidy(axes)
    axes.set_ylim(*limits)
    axes.set_xlim(*limits)
    assert style.scale(axes.xaxis) == power
    figure.draw_without_rendering()
    shown = [text.get_text() for text in axes.get_xticklabels()]
    assert len(set(shown)) == len(shown)
    assert labels <= set(shown)


def test_trace_and_ranks(result, datasets):
    figure = plot_trace(result)
    labels = ["decay[CDKN1A]", "decay[SESN1]", "decay[TNFRSF10b]", "lengthscale", "noise_sd"]
    assert len(figure.axes) == 2 * len(labels)  # the constant is not drawn
    titles = [axes.get_title(loc="left") for axes in figure.axes[::2]]
    assert titles == [
        "decay[CDKN1A] (1/h)", "decay[SESN1] (1/h)", "decay[TNFRSF10b] (1/h)",
        "lengthscale (h)", "noise_sd",
    ]  # fmt: skip
    assert (figure.axes[-2].get_xlabel(), figure.axes[-1].get_xlabel()) == ("draw", "rank")
    assert legend_texts(figure) == [
        "chain 0", "chain 1", "chain 2", "chain 3", "truth", "divergent",
    ]  # fmt: skip
    trace, ranks = figure.axes[2:4]
    draws = datasets["posterior"]["decay"].values[:, :, 1]
    for chain in range(4):
        np.testing.assert_array_equal(trace.lines[chain].get_ydata(), draws[chain])
    (diverged,) = points(trace, "|")
    assert list(diverged.get_xdata()) == [10, 50, 99]
    assert line(trace, style.BLACK, dashed=True).get_ydata()[0] == 0.4
    bars = [patch.get_data() for patch in ranks.patches]
    assert [bar.baseline for bar in bars] == [0, 1, 2, 3]
    heights = np.array([bar.values - bar.baseline for bar in bars])
    order = stats.rankdata(draws).reshape(4, 100)
    counts = np.array([np.histogram(one, 10, (0.5, 400.5))[0] for one in order])
    np.testing.assert_allclose(heights / heights.sum(), counts / 400)
    level = ranks.lines[0].get_ydata()[0]
    np.testing.assert_allclose(level, heights.mean())
    assert heights.max() < 1.0


def test_trace_of_chosen_parameters(result):
    figure = plot_trace(result, ["noise_sd", "decay[SESN1]"])
    assert [axes.get_title(loc="left") for axes in figure.axes[::2]] == [
        "noise_sd", "decay[SESN1] (1/h)",
    ]  # fmt: skip
    assert len(plot_trace(result, "anchor").axes) == 2  # a constant too, when asked for


def test_pairs(result, datasets):
    figure = plot_pairs(result, ["decay", "noise_sd"])
    assert len(figure.axes) == 4 * 5 // 2
    grid = {}
    for number, (row, column) in enumerate(zip(*np.tril_indices(4), strict=True)):
        grid[row, column] = figure.axes[number]
    draws = datasets["posterior"]["decay"].values
    cloud, divergent = grid[2, 0].lines[:2]
    np.testing.assert_array_equal(cloud.get_xdata(), draws[..., 0].ravel())
    np.testing.assert_array_equal(cloud.get_ydata(), draws[..., 2].ravel())
    diverging = datasets["sample_stats"]["diverging"].values
    np.testing.assert_array_equal(divergent.get_xdata(), draws[..., 0][diverging])
    np.testing.assert_array_equal(divergent.get_ydata(), draws[..., 2][diverging])
    vertical, horizontal = grid[2, 0].lines[2:]
    assert (vertical.get_xdata()[0], horizontal.get_ydata()[0]) == (0.8, 1.1)
    assert grid[3, 0].get_xlabel() == "decay[CDKN1A]\n(1/h)"
    assert grid[3, 0].get_ylabel() == "noise_sd"
    assert [grid[k, k].get_ylabel() for k in range(4)] == [""] * 4
    assert legend_texts(figure) == ["draw", "divergent", "truth"]


def test_pairs_thin_many_draws_evenly(crowded):
    figure = plot_pairs(crowded, ["offset", "a_parameter_with_a_long_name"])
    (cloud,) = figure.axes[1].lines
    assert cloud.get_xdata().size == 2000
    assert not figure.legends


def test_pairs_refuse_what_does_not_fit(crowded):
    with pytest.raises(ValueError, match=r"20 parameters.*7 inches; name at most 8, or.*width=17"):
        plot_pairs(crowded, ["sensitivity"])
    assert len(plot_pairs(crowded, width="column").axes) == 3 * 4 // 2


def test_residuals(result, datasets):
    figure = plot_residuals(result)
    assert len(figure.axes) == 9
    over_time, quantiles, lags = figure.axes[3:6]
    mean = datasets["one_step_ahead"]["residual"].values[..., 1].mean(axis=(0, 1))
    there = mean[~np.isnan(mean)]
    np.testing.assert_allclose(points(over_time, "o")[0].get_ydata(), mean)
    (dots,) = points(quantiles, "o")
    np.testing.assert_allclose(dots.get_ydata(), np.sort(there))
    n = len(there)
    median = stats.norm.ppf(stats.beta.ppf(0.5, np.arange(1, n + 1), np.arange(n, 0, -1)))
    np.testing.assert_allclose(dots.get_xdata(), median)
    first = bands(quantiles)[0].get_paths()[0].vertices
    # The smallest of n uniform values has the quantile function 1 - (1 - p)^(1/n).
    low = stats.norm.ppf(1 - 0.975 ** (1 / n))
    np.testing.assert_allclose(first[first[:, 0] == first[:, 0].min(), 1].min(), low)
    assert over_time.get_title(loc="left") == "SESN1"
    p = stats.kstest(there, "norm").pvalue
    assert quantiles.get_title(loc="left") == f"KS p = {p:.2g}"
    assert lags.get_title(loc="left").startswith("Ljung-Box p = 0.")
    assert (over_time.get_xlabel(), lags.get_xlabel()) == ("time (h)", "lag (observations)")


def test_bars_of_residuals_are_drawn_whole(datasets):
    residual = datasets["one_step_ahead"]["residual"]
    seen = int(np.flatnonzero(residual.notnull().all(["chain", "draw"])[:, 0])[0])
    residual[:, ::2, seen, 0] = -9.0  # of half of the draws
    (bars,) = [collection for collection in plot_residuals(arviz_data.build(datasets)).axes[0].collections
               if isinstance(collection, LineCollection)]
    ends = np.concatenate([segment[:, 1] for segment in bars.get_segments() if len(segment)])  # none where missing
    low, high = bars.axes.get_ylim()
    assert ends.min() == -9.0
    assert low < ends.min() and high == -low


def test_derived_parameters_are_drawn_where_they_are_named(datasets):
    posterior = datasets["posterior"]
    square = posterior["noise_sd"] ** 2
    square.attrs["derived"] = 1
    result = arviz_data.build({**datasets, "posterior": posterior.assign(variance=square)})
    assert "variance" not in [axes.get_title(loc="left") for axes in plot_trace(result).axes]
    assert "variance" not in [axes.get_xlabel() for axes in plot_pairs(result).axes]
    assert plot_trace(result, ["variance"]).axes[0].get_title(loc="left") == "variance"


def test_residuals_of_few_or_no_observations(datasets, readable, recwarn):
    residual = datasets["one_step_ahead"]["residual"]
    residual[:, :, 3:, 0] = np.nan
    residual[:, :, 1:, 1] = np.nan
    residual[..., 2] = np.nan
    figure = plot_residuals(arviz_data.build(datasets))
    readable(figure)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles.count("KS: few data") == 3
    assert not recwarn.list


@pytest.mark.parametrize(
    ("plot", "group", "source"),
    [
        (plot_fit, "observed_data", "lfm.fit"),
        (plot_fit, "trajectories", "trajectory_draws above zero"),
        (plot_forces, "trajectories", "trajectory_draws above zero"),
        (plot_states, "trajectories", "trajectory_draws above zero"),
        (plot_trace, "posterior", "lfm.fit"),
        (plot_pairs, "posterior", "lfm.fit"),
        (plot_residuals, "one_step_ahead", "lfm.fit"),
    ],
)
def test_a_missing_group_is_named_with_its_source(datasets, plot, group, source):
    del datasets[group]
    with pytest.raises(ValueError, match=rf"no group '{group}'.*{source}"):
        plot(arviz_data.build(datasets))


def test_a_model_without_forces_has_no_force_figure(datasets):
    datasets["trajectories"] = datasets["trajectories"].drop_dims("force")
    with pytest.raises(
        ValueError, match="no force trajectories; its group trajectories has states"
    ):
        plot_forces(arviz_data.build(datasets))


@pytest.mark.parametrize(
    ("plot", "wrong", "kind", "near"),
    [
        (plot_fit, "CDKN1", "output", "CDKN1A"),
        (plot_forces, "P53", "force", "p53"),
        (plot_states, "SESN1_mrna", "state", "SESN1_mRNA"),
        (plot_trace, "lengthscal", "parameter", "lengthscale"),
        (plot_pairs, "decay[SESN]", "parameter", r"decay\[SESN1\]"),
        (plot_residuals, "TNFRSF10B", "output", "TNFRSF10b"),
    ],
)
def test_an_unknown_name_gets_the_nearest_one(result, plot, wrong, kind, near):
    with pytest.raises(ValueError, match=rf"unknown {kind} '.*Did you mean .*'{near}'"):
        plot(result, [wrong])


def test_impossible_widths(result):
    with pytest.raises(ValueError, match="width must be 'column' or 'full' or a number"):
        plot_forces(result, width="wide")
    with pytest.raises(ValueError, match="at least 2 inches, got 0.5"):
        plot_forces(result, width=0.5)
    assert plot_forces(result, width=5).get_figwidth() == 5.0


def test_nothing_to_draw(result, datasets):
    with pytest.raises(ValueError, match="outputs is empty; name at least one of CDKN1A"):
        plot_fit(result, [])
    constant = arviz_data.build({"posterior": datasets["posterior"][["anchor"]]})
    with pytest.raises(ValueError, match="no parameter varies"):
        plot_trace(constant)
