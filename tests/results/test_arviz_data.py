"""The result container on the installed ArviZ, its way through a netCDF file, and its diagnostics."""

import os
import warnings

import arviz as az
import h5netcdf
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from scipy import special, stats

import lfm_ppl as lfm
from lfm_ppl.results import arviz_data, netcdf
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.scalars import choose, scalar_draws, scalar_truth, unit_of, units_attribute
from tests.arviz_checks import IS_DATATREE, check_arviz
from tests.inference import linear_motif as motif


def draws_only(draws, name="theta", **groups):
    return arviz_data.build({"posterior": xr.Dataset({name: (("chain", "draw"), draws)}), **groups})


# The container


def test_build_and_groups(result, datasets):
    assert type(result).__name__ == ("DataTree" if IS_DATATREE else "InferenceData")
    for name, dataset in datasets.items():
        xr.testing.assert_identical(ResultView.of(result).group(name), dataset)
    assert ResultView.of(result).attrs["seed"] == 3
    scoped = xr.Dataset({"gene/decay": (("chain", "draw"), np.ones((2, 4)))})
    built = arviz_data.build({"posterior": scoped, "truth": xr.Dataset()})
    assert tuple(ResultView.of(built).groups) == ("posterior",)
    assert list(ResultView.of(built).posterior.data_vars) == ["gene.decay"]
    for faulty in (lambda: arviz_data.build({"posterior": {}}), lambda: tuple(ResultView.of({}).groups)):
        with pytest.raises(TypeError):
            faulty()
    with pytest.raises(ValueError, match="trajectories"):
        ResultView.of(built).group("trajectories")


def test_add_group_adds_and_replaces(result):
    first, second = xr.Dataset({"y": ("time", [1.0, 2.0])}), xr.Dataset({"y": ("time", [3.0])})
    initial_groups = tuple(ResultView.of(result).groups)
    assert arviz_data.add_group(result, "forecast", first) is result
    arviz_data.add_group(result, "forecast", second)
    assert tuple(ResultView.of(result).groups) == (*initial_groups, "forecast")
    xr.testing.assert_identical(ResultView.of(result).group("forecast"), second)
    assert tuple(ResultView.of(arviz_data.remove_group(result, "forecast")).groups) == initial_groups


# Files


def test_round_trip_keeps_everything(tmp_path, result, datasets):
    path = lfm.save(result, tmp_path / "new" / "posterior.nc")
    for location in (path, str(path.parent)):
        loaded = lfm.load(location)
        assert type(loaded) is type(result)
        assert set(ResultView.of(loaded).groups) == set(datasets)
        for name, dataset in datasets.items():
            stored = ResultView.of(loaded).group(name)
            xr.testing.assert_identical(stored, dataset)
            assert all(stored[variable].dtype == dataset[variable].dtype for variable in dataset.variables)
        assert ResultView.of(loaded).attrs == ResultView.of(result).attrs
    assert os.listdir(path.parent) == ["posterior.nc"]
    by_arviz = az.from_netcdf(path)
    assert tuple(ResultView.of(by_arviz).groups) == tuple(ResultView.of(result).groups)
    assert arviz_data.summary(by_arviz).equals(arviz_data.summary(result))


def test_round_trip_of_unusual_values(tmp_path):
    attrs = {
        "versions": {"jax": "0.10", "arviz": None}, "empty": "", "flag": True, "nothing": None, "names": ["a"],
        "numbers": [1.5, 2.0], "nested": {"a": [1, {"b": 2}]}, "looks_encoded": "json:{", "huge": 10**30,
        "negative": -7, "text": "kg·m/s² — Ω",
    }
    arrays = {"array": (np.arange(3), [0, 1, 2]), "scalar": (np.float32(0.5), 0.5), "set": ({"b", "a"}, ["a", "b"])}
    variables = {kind: (("chain", "draw"), np.array([["0", "1", "2"], ["1", "0", "2"]]).astype(float).astype(kind))
                 for kind in ("float32", "int16", "bool", "<U3")}
    dataset = xr.Dataset({**variables, "x": ("draw", np.ones(3), {"units": "hours since", "flag": False}),
                          "none": ("none", np.zeros(0))}, {"unit": ("draw", ["h", "ää", ""])}, {"note": None})
    stored = {**attrs, **{name: value for name, (value, _) in arrays.items()}}
    path = netcdf.write({"posterior": dataset}, stored, tmp_path / "a.nc")
    groups, read = netcdf.read(path)
    xr.testing.assert_identical(groups["posterior"], dataset)
    assert all(groups["posterior"][name].dtype == dataset[name].dtype for name in dataset.variables)
    assert {name: read[name] for name in attrs} == attrs
    assert all(type(read[name]) is type(value) for name, value in attrs.items())
    assert {name: read[name] for name in arrays} == {name: value for name, (_, value) in arrays.items()}


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    first, second = draws_only(np.zeros((2, 4))), draws_only(np.ones((2, 4)))
    path = arviz_data.save(first, tmp_path / "posterior.nc")
    with pytest.raises(FileExistsError, match=r"posterior\.nc"):
        arviz_data.save(second, path)
    broken = xr.Dataset({"x": ("draw", np.array([object(), object()], dtype=object))})
    with pytest.raises((TypeError, ValueError)):
        arviz_data.save(arviz_data.build({"posterior": broken}), path, overwrite=True)
    assert os.listdir(tmp_path) == ["posterior.nc"]
    assert ResultView.of(arviz_data.load(path)).posterior["theta"].values.max() == 0.0
    arviz_data.save(second, path, overwrite=True)
    assert ResultView.of(arviz_data.load(path)).posterior["theta"].values.min() == 1.0
    with pytest.raises(IsADirectoryError):
        arviz_data.save(first, tmp_path, overwrite=True)


def test_files_that_are_no_results(tmp_path, result):
    with pytest.raises(FileNotFoundError, match=r"none\.nc"):
        arviz_data.load(tmp_path / "none.nc")
    with pytest.raises(FileNotFoundError, match=r"posterior\.nc"):
        arviz_data.load(tmp_path)
    complete_file = arviz_data.save(result, tmp_path / "whole.nc")
    (tmp_path / "text.nc").write_text("time,y\n0,1\n")
    (tmp_path / "cut.nc").write_bytes(complete_file.read_bytes()[: complete_file.stat().st_size // 2])
    with h5netcdf.File(tmp_path / "other.nc", "w") as file:
        file.create_group("posterior")
    arviz_data.save(arviz_data.build({"observed_data": xr.Dataset({"y": ("time", [1.0])})}), tmp_path / "data.nc")
    for name in ("text.nc", "cut.nc", "other.nc", "data.nc"):
        with pytest.raises(ValueError, match=name):
            arviz_data.load(tmp_path / name)


# ArviZ's functions


def test_loo_and_compare(tmp_path, result, datasets):
    result = arviz_data.load(arviz_data.save(result, tmp_path / "a.nc"))
    loo = az.loo(result)
    terms = datasets["log_likelihood"]["y"].values.reshape(400, -1)
    # Plain importance sampling: the terms vary so little that smoothing changes nothing.
    plain = np.sum(np.log(len(terms)) - special.logsumexp(-terms, axis=0))
    assert (loo.elpd if IS_DATATREE else loo.elpd_loo) == pytest.approx(plain, abs=0.05)
    worse = {**datasets, "log_likelihood": datasets["log_likelihood"] - 1.0}
    table = az.compare({"good": result, "bad": arviz_data.build(worse)})
    assert list(table.index) == ["good", "bad"] and table.loc["good", "rank"] == 0


@pytest.mark.thorough
def test_predictive_checks_and_prior_sensitivity_of_a_fit():
    y, rng = motif.data(missing=False), np.random.default_rng(0)
    draws = {name: value * np.exp(0.1 * rng.normal(size=(2, 60, *np.shape(value))))
             for name, value in motif.THETA.items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lfm.ConvergenceWarning)
        result = lfm.to_arviz(draws, motif.model, motif.TIMES, y, trajectory_draws=30)
    prior, posterior = ResultView.of(result).group("log_prior"), ResultView.of(result).posterior
    for name, value in motif.THETA.items():
        expected = stats.lognorm.logpdf(posterior[name].values, 0.4, scale=value)
        np.testing.assert_allclose(prior[name].values, expected.sum(-1) if name == "decay" else expected, rtol=1e-6)
    check_arviz(result, {"y": y.size})
    if IS_DATATREE:
        az.plot_ppc_interval(result)
        az.plot_ppc_pit(result, coords={"output": "a"})
        plt.close("all")


# Diagnostics


def test_summary_against_numpy_and_arviz(result, datasets):
    frame = arviz_data.summary(result)
    assert list(frame) == ["mean", "sd", "q2.5", "q97.5", "truth", "mcse_mean", "ess_bulk", "ess_tail", "r_hat"]
    assert list(frame.index) == ["decay[CDKN1A]", "decay[SESN1]", "decay[TNFRSF10b]", "lengthscale", "noise_sd",
                                 "anchor"]
    draws = datasets["posterior"]["decay"].values[:, :, 1]
    row = frame.loc["decay[SESN1]"]
    np.testing.assert_allclose(row["mean"], draws.mean())
    np.testing.assert_allclose(row["sd"], draws.std(ddof=1))
    np.testing.assert_allclose(row[["q2.5", "q97.5"]], np.quantile(draws, [0.025, 0.975]))
    np.testing.assert_allclose(row["mcse_mean"], row["sd"] / np.sqrt(az.ess(draws, method="mean")))
    np.testing.assert_allclose(row["r_hat"], az.rhat(draws))
    np.testing.assert_allclose(row["ess_bulk"], az.ess(draws))
    assert 250 < row["ess_bulk"] < 600, "400 independent draws"
    assert frame.loc["anchor", ["mcse_mean", "ess_bulk", "ess_tail", "r_hat"]].isna().all()
    assert frame.loc["anchor", "sd"] == 0.0


def test_rhat_by_hand():
    rng = np.random.default_rng(3)
    draws = rng.normal(size=(4, 200)) + np.array([0.0, 0.0, 0.3, 0.3])[:, None]
    halves = draws.reshape(8, 100)

    def rank_normalised(values):
        ranks = values.ravel().argsort().argsort().reshape(values.shape) + 1
        z = special.ndtri((ranks - 0.375) / (values.size + 0.25))
        return np.sqrt(99 / 100 + z.mean(axis=1).var(ddof=1) / z.var(axis=1, ddof=1).mean())

    # Vehtari et al. (2021): the larger one of rank-normalised and folded split R-hat.
    expected = max(rank_normalised(halves), rank_normalised(np.abs(halves - np.median(halves))))
    np.testing.assert_allclose(arviz_data.summary(draws_only(draws)).loc["theta", "r_hat"], expected, rtol=1e-6)


def test_diagnostics_that_do_not_exist_are_nan_without_messages(caplog):
    good = np.random.default_rng(0).normal(size=(4, 100))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        broken = good.copy()
        broken[2, 5] = np.nan
        assert arviz_data.summary(draws_only(broken)).loc["theta"].isna().all()
        single = arviz_data.summary(draws_only(good[:1])).loc["theta"]
        assert np.isnan(single["r_hat"]) and single["ess_bulk"] > 20
        short = arviz_data.summary(draws_only(good[:, :3])).loc["theta"]
        assert short[["ess_bulk", "ess_tail", "r_hat"]].isna().all()
    assert not caplog.records


def test_convergence_warnings_name_parameters_and_values(datasets):
    rng = np.random.default_rng(0)
    assert arviz_data.convergence_warnings(draws_only(rng.normal(size=(4, 1000)))) == []
    datasets["posterior"]["stuck"] = (("chain", "draw"), rng.normal(size=(4, 100)) + np.arange(4)[:, None])
    broken = arviz_data.build(datasets, {"sampler": "nuts"})
    messages = arviz_data.convergence_warnings(broken)
    row = arviz_data.summary(broken).loc["stuck"]
    for value in (f"stuck ({row['r_hat']:.4f})", f"stuck ({row['ess_bulk']:.0f})", "3 of 400"):
        assert any(value in message for message in messages), value
    assert not any("anchor" in message for message in messages)
    draws = rng.normal(size=(4, 1000))
    draws[0, 0] = np.inf
    for faulty in (rng.normal(size=(1, 2000)), draws, rng.normal(size=(4, 3))):
        assert len(arviz_data.convergence_warnings(draws_only(faulty))) == 1


def test_equal_draws_have_no_spread_and_give_no_warning():
    """The mean of 4,000 times 0.8 is not 0.8 in floating point."""
    draws = np.full((4, 1000), 0.8)
    posterior = xr.Dataset({"fixed": (("chain", "draw"), draws),
                            "free": (("chain", "draw"), np.random.default_rng(0).normal(size=(4, 1000)))})
    result = arviz_data.build({"posterior": posterior})
    assert draws.std(ddof=1) != 0.0 and arviz_data.summary(result)["sd"]["fixed"] == 0.0
    assert draws.mean() != 0.8 and arviz_data.summary(result)["mean"]["fixed"] == 0.8
    assert arviz_data.convergence_warnings(result) == []


# Scalars


def test_scalars_by_label():
    values = np.arange(2 * 4 * 2 * 2, dtype=float).reshape(2, 4, 2, 2)
    dataset = xr.Dataset({"matrix": (("chain", "draw", "row", "column"), values), "mass": ("chain", np.ones(2)),
                          "plain": (("draw", "chain", "k"), np.ones((4, 2, 2)))},
                         {"row": ["a", "b"], "column": [10, 20]})
    draws = scalar_draws(dataset)
    assert list(draws) == ["matrix[a,10]", "matrix[a,20]", "matrix[b,10]", "matrix[b,20]", "plain[0]", "plain[1]"]
    np.testing.assert_array_equal(draws["matrix[b,10]"], values[:, :, 1, 0])
    assert draws["plain[0]"].shape == (2, 4)
    assert choose(draws, None) == [name for name in draws if name.startswith("matrix")]
    assert choose(draws, ["plain", "matrix[b,20]", "plain[1]"]) == ["plain[0]", "plain[1]", "matrix[b,20]"]
    with pytest.raises(ValueError, match="matrx"):
        choose(draws, ["matrx"])


def test_truth_is_matched_by_coordinate_by_position_or_for_all():
    posterior = xr.Dataset({name: (("chain", "draw", "gene"), np.zeros((2, 4, 2))) for name in ("a", "b", "c", "d")},
                           {"gene": ["x", "y"]})
    truth = xr.Dataset({"a": ("gene", [1.0, 2.0]), "b": ("other", [3.0, 4.0]), "c": 5.0, "d": ("three", [0.0] * 3)},
                       {"gene": ["y", "z"]})
    assert scalar_truth(posterior, truth) == {"a[y]": 1.0, "b[x]": 3.0, "b[y]": 4.0, "c[x]": 5.0, "c[y]": 5.0}


def test_units_of_several_names():
    names, units = ["x", "v", "w"], {"x": "m", "v": "m/s", "time": "s"}
    variable = xr.DataArray(np.zeros(3), dims="state", attrs=units_attribute(names, units))
    assert [unit_of(variable, name) for name in names] == ["m", "m/s", ""]
    assert unit_of(xr.DataArray(0.0)) == ""
    assert unit_of(xr.DataArray(0.0, attrs={"units": "{braces} are no JSON"})) == "{braces} are no JSON"
