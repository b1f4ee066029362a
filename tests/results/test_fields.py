"""Fields of a result: moments from the draws, the truth, and figures that show them."""

import numpy as np
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.plots import save_figures
from lfm_ppl.results.arviz_data import add_group, build
from lfm_ppl.results.fields import add_fields
from lfm_ppl.results.result_view import ResultView

BASIS = lfm.LaplaceBasis((0.0, 2.0), 3)
TIMES = np.linspace(0.0, 4.0, 9)


def source(parameters):
    return lfm.SpectralField(BASIS, lfm.Matern(parameters["scale"], 0.8), lfm.Matern(1.0, 1.0))


def separable(parameters):
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.4, 1.0]])
    return lfm.SeparableField(points, lfm.Matern(parameters["scale"], 0.8), lfm.Matern(1.0, 1.0), 2, name="source")


@pytest.fixture
def result():
    rng = np.random.default_rng(0)
    scale = xr.Dataset({"scale": (("chain", "draw"), rng.uniform(0.5, 1.0, (2, 40)))}, {"draw": np.arange(40)})
    names = {"state": list(BASIS.names), "force": [f"source {index}" for index in range(3)]}
    trajectories = xr.Dataset({f"{kind}s": (("chain", "draw", "time", kind), rng.normal(size=(2, 20, 9, 3)))
                               for kind in names}, {"time": TIMES, "draw": np.arange(0, 40, 2), **names})
    truth = xr.Dataset({f"{kind}s": (("time", kind), rng.normal(size=(5, 3))) for kind in names},
                       {"time": TIMES[::2], **names}).assign(scale=0.7)
    return build({"posterior": scale, "trajectories": trajectories, "truth": truth})


def test_moments_are_those_of_the_draws_with_their_parameters(result):
    positions = np.array([0.3, 1.1])
    evaluated = lfm.evaluate_field(result, source, positions)
    draws = []
    for chain in range(2):
        for draw in range(20):
            scale = result["posterior"]["scale"].values[chain, 2 * draw]
            draws.append(result["trajectories"]["forces"].values[chain, draw]
                         @ np.asarray(source({"scale": scale}).weights(positions)[0]).T)
    np.testing.assert_allclose(evaluated["draws"].values.reshape(40, 9, 2), draws, atol=1e-12)
    np.testing.assert_allclose(evaluated["mean"], np.mean(draws, axis=0), atol=1e-12)
    np.testing.assert_allclose(evaluated["sd"], np.std(draws, axis=0), atol=1e-12)
    true = result["truth"]["forces"].values @ np.asarray(source({"scale": 0.7}).weights(positions)[0]).T
    np.testing.assert_allclose(evaluated["truth"].values[::2], true, atol=1e-12)


def test_fixed_parameters_are_those_of_the_fit(result):
    fixed = build({"posterior": ResultView.of(result).posterior.rename(scale="decay"),
                   "trajectories": ResultView.of(result).group("trajectories")}, {"fixed": '{"scale": 0.7}'})
    expected = lfm.evaluate_field(fixed, source({"scale": 0.7}), [0.3])
    np.testing.assert_allclose(lfm.evaluate_field(fixed, source, [0.3])["mean"], expected["mean"], atol=1e-12)


@pytest.mark.thorough
def test_the_sd_contains_the_variance_beyond_the_forces(result):
    position = np.array([[5.0, 5.0]])  # far from the points
    evaluated = lfm.evaluate_field(result, separable, position)
    scale = result["posterior"]["scale"].values[:, ::2]
    np.testing.assert_allclose(evaluated["sd"], np.sqrt((scale**2).mean()), rtol=0.02)


@pytest.mark.parametrize(("field", "sensors"), [
    (BASIS, np.array([0.3, 1.1])), (source, lambda t: np.array([0.1 * t])),
    (separable, np.array([[0.5, 0.5]])), (lfm.LaplaceBasis(((0.0, 1.0), (0.0, 2.0)), (1, 3), "neumann"), None)])
@pytest.mark.parametrize("width", ["column", "full"])
def test_figures_have_labels_and_their_numbers(result, field, sensors, width):
    figure = lfm.plot_field(result, field, sensors=sensors, name="heat", unit="K", length_unit="m", width=width)
    labels = {text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel())}
    assert {"heat, mean (K)", "heat, sd (K)", "heat, truth (K)"} <= labels
    assert labels & {"place (m)", "x (m)"}
    assert "t = 2" in {axes.get_title(loc="left") for axes in figure.axes}


def test_stored_fields_are_drawn_with_the_figures(result, tmp_path):
    add_fields(result, {"heat": {"field": BASIS, "sensors": np.array([0.4]), "unit": "K"}})
    assert "field_heat" in ResultView.of(result).groups
    lfm.save(result, tmp_path / "posterior.nc")
    paths = save_figures(lfm.load(tmp_path / "posterior.nc"), tmp_path)
    assert "field-heat.png" in {path.name for path in paths}


def test_malformed_input(result):
    with pytest.raises(ValueError, match="other 0"):
        lfm.evaluate_field(result, lfm.SpectralField(BASIS, lfm.Matern(1.0, 1.0), lfm.Matern(1.0, 1.0), "other"))
    with pytest.raises(ValueError, match="domain"):
        lfm.evaluate_field(result, BASIS, [3.0])
    with pytest.raises(ValueError, match="field_heat"):
        lfm.plot_field(result, "heat")
    with pytest.raises(ValueError, match="trajectories"):
        lfm.evaluate_field(add_group(build({}), "posterior", ResultView.of(result).posterior), BASIS)
