"""The result container, on whichever ArviZ is installed, and its way through a netCDF file."""

import os
import subprocess
import sys
import warnings

import arviz as az
import h5netcdf
import numpy as np
import pytest
import xarray as xr
from scipy import special

import lfm_ppl as lfm
from lfm_ppl.results import arviz_data, netcdf
from lfm_ppl.results.scalars import (
    choose,
    scalar_draws,
    scalar_truth,
    unit_of,
    units_attribute,
)

ONE_X = int(az.__version__.split(".")[0]) >= 1


def draws_only(draws, name="theta", **groups):
    posterior = xr.Dataset({name: (("chain", "draw"), draws)})
    return arviz_data.build({"posterior": posterior, **groups})


def test_build_gives_the_type_of_the_installed_arviz(result, datasets):
    assert type(result).__name__ == ("DataTree" if ONE_X else "InferenceData")
    assert set(arviz_data.groups(result)) == set(datasets)
    for name, dataset in datasets.items():
        xr.testing.assert_identical(arviz_data.group(result, name), dataset)
    assert arviz_data.attributes(result)["seed"] == 3
    assert arviz_data.attributes(result)["inference_library"] == "lfm_ppl"


def test_build_is_silent_about_our_own_groups(datasets):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        arviz_data.build(datasets)


def test_import_and_first_use_print_nothing():
    code = (
        "import numpy as np, xarray as xr; from lfm_ppl.results import arviz_data as a;"
        "d = xr.Dataset({'x': (('chain', 'draw'), np.random.default_rng(0).normal(size=(2, 50)))});"
        "a.summary(a.build({'posterior': d}))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "ArviZ" not in run.stderr


def test_build_renames_scopes_and_drops_empty_groups():
    posterior = xr.Dataset({"gene/decay": (("chain", "draw"), np.ones((2, 4)))})
    built = arviz_data.build({"posterior": posterior, "truth": xr.Dataset()})
    assert arviz_data.groups(built) == ("posterior",)
    assert list(arviz_data.group(built, "posterior").data_vars) == ["gene.decay"]


def test_build_refuses_what_is_no_dataset():
    with pytest.raises(TypeError, match="group 'posterior' must be an xarray.Dataset, got dict"):
        arviz_data.build({"posterior": {}})


def test_missing_group_says_how_to_get_it(result):
    bare = draws_only(np.ones((2, 4)))
    with pytest.raises(ValueError, match=r"no group 'trajectories'; it has posterior.*lfm\.fit"):
        arviz_data.group(bare, "trajectories")
    with pytest.raises(TypeError, match=r"lfm\.fit or lfm\.load returned, got dict"):
        arviz_data.groups({})


def test_add_group_adds_and_replaces(result):
    first = xr.Dataset({"y": ("time", [1.0, 2.0])})
    second = xr.Dataset({"y": ("time", [3.0])})
    before = arviz_data.groups(result)
    assert not arviz_data.has_group(result, "forecast")
    assert arviz_data.add_group(result, "forecast", first) is result
    arviz_data.add_group(result, "forecast", second)
    assert arviz_data.groups(result) == (*before, "forecast")
    xr.testing.assert_identical(arviz_data.group(result, "forecast"), second)


def test_round_trip_keeps_everything(tmp_path, result, datasets):
    path = arviz_data.save(result, tmp_path / "new" / "posterior.nc")
    loaded = arviz_data.load(path)
    assert type(loaded) is type(result)
    assert set(arviz_data.groups(loaded)) == set(datasets)
    for name, dataset in datasets.items():
        back = arviz_data.group(loaded, name)
        xr.testing.assert_identical(back, dataset)
        for variable in dataset.variables:
            assert back[variable].dtype == dataset[variable].dtype, variable
    times = arviz_data.group(loaded, "observed_data")["time"].values
    assert (np.diff(times) == 0.0).sum() == 4
    assert np.isnan(arviz_data.group(loaded, "observed_data")["y"].values).sum() == 7
    assert arviz_data.attributes(loaded) == arviz_data.attributes(result)
    assert os.listdir(path.parent) == ["posterior.nc"]


def test_the_public_names_save_and_load_a_results_folder(tmp_path, result, datasets):
    written = lfm.save(result, tmp_path / "run" / "posterior.nc")
    for where in (written, written.parent, str(written.parent)):
        loaded = lfm.load(where)
        assert type(loaded) is type(result) and set(arviz_data.groups(loaded)) == set(datasets)
    with pytest.raises(FileExistsError, match="overwrite=True"):
        lfm.save(result, written)
    assert lfm.save(loaded, written, overwrite=True) == written
    with pytest.raises(TypeError, match=r"result must be what lfm\.fit or lfm\.load returned, got dict"):
        lfm.save({}, tmp_path / "no.nc")
    assert not (tmp_path / "no.nc").exists()


def test_round_trip_of_awkward_attributes(tmp_path):
    attrs = {
        "versions": {"jax": "0.10", "arviz": None},
        "empty": "",
        "flag": True,
        "nothing": None,
        "names": ["a"],
        "numbers": [1.5, 2.0],
        "nested": {"a": [1, {"b": 2}]},
        "looks_encoded": "json:{",
        "huge": 10**30,
        "negative": -7,
        "text": "kg·m/s² — Ω",
    }
    dataset = xr.Dataset(
        {"x": (("chain", "draw"), np.ones((2, 4)), {"units": "hours since", "flag": False})},
        attrs={"note": None},
    )
    built = arviz_data.build({"posterior": dataset}, attrs)
    loaded = arviz_data.load(arviz_data.save(built, tmp_path / "a.nc"))
    result = arviz_data.attributes(loaded)
    assert {key: result[key] for key in attrs} == attrs
    assert all(type(result[key]) is type(value) for key, value in attrs.items())
    xr.testing.assert_identical(arviz_data.group(loaded, "posterior"), dataset)


def test_arrays_in_attributes_come_back_as_lists(tmp_path):
    built = arviz_data.build(
        {"posterior": xr.Dataset({"x": ("draw", [1.0])})},
        {"array": np.arange(3), "scalar": np.float32(0.5), "whole": np.int64(4), "set": {"b", "a"}},
    )
    result = arviz_data.attributes(arviz_data.load(arviz_data.save(built, tmp_path / "a.nc")))
    assert result["array"] == [0, 1, 2]
    assert result["scalar"] == 0.5
    assert result["whole"] == 4
    assert result["set"] == ["a", "b"]


@pytest.mark.parametrize("dtype", ["float32", "int16", "bool", "<U3"])
def test_round_trip_keeps_dtypes(tmp_path, dtype):
    values = np.array([["0", "1", "2"], ["1", "0", "2"]]).astype("float64").astype(dtype)
    dataset = xr.Dataset(
        {"x": (("chain", "draw"), values), "empty": ("none", np.array([], "float64"))},
        coords={"unit": ("draw", ["h", "ää", ""])},
    )
    path = netcdf.write({"posterior": dataset}, {}, tmp_path / "a.nc")
    groups, _ = netcdf.read(path)
    xr.testing.assert_identical(groups["posterior"], dataset)
    assert groups["posterior"]["x"].dtype == dataset["x"].dtype


def test_other_tools_read_the_file(tmp_path, result):
    path = arviz_data.save(result, tmp_path / "posterior.nc")
    theirs = az.from_netcdf(path)
    assert arviz_data.groups(theirs) == arviz_data.groups(result)
    assert arviz_data.summary(theirs).equals(arviz_data.summary(result))


def test_save_never_overwrites_unasked(tmp_path):
    first, second = draws_only(np.zeros((2, 4))), draws_only(np.ones((2, 4)))
    path = arviz_data.save(first, tmp_path / "posterior.nc")
    with pytest.raises(FileExistsError, match=r"already exists.*overwrite=True"):
        arviz_data.save(second, path)
    assert arviz_data.group(arviz_data.load(path), "posterior")["theta"].values.max() == 0.0
    arviz_data.save(second, path, overwrite=True)
    assert arviz_data.group(arviz_data.load(path), "posterior")["theta"].values.min() == 1.0
    with pytest.raises(IsADirectoryError, match="is a folder"):
        arviz_data.save(first, tmp_path, overwrite=True)


def test_failed_write_leaves_nothing(tmp_path):
    old = arviz_data.save(draws_only(np.zeros((2, 4))), tmp_path / "posterior.nc")
    broken = xr.Dataset({"x": ("draw", np.array([object(), object()], dtype=object))})
    with pytest.raises(Exception, match="."):
        arviz_data.save(arviz_data.build({"posterior": broken}), old, overwrite=True)
    assert os.listdir(tmp_path) == ["posterior.nc"]
    assert arviz_data.group(arviz_data.load(old), "posterior")["theta"].values.max() == 0.0


def test_load_explains_what_is_wrong(tmp_path, result):
    with pytest.raises(FileNotFoundError, match=r"there is no result .*none\.nc; expected a results folder, or a net"):
        arviz_data.load(tmp_path / "none.nc")
    with pytest.raises(FileNotFoundError, match=r"holds no posterior\.nc; expected a folder that `lfm-ppl fit` wrote"):
        arviz_data.load(tmp_path)
    text = tmp_path / "text.nc"
    text.write_text("time,y\n0,1\n")
    with pytest.raises(ValueError, match=r"text\.nc could not be read as a netCDF file"):
        arviz_data.load(text)
    whole = arviz_data.save(result, tmp_path / "whole.nc")
    cut = tmp_path / "cut.nc"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.raises(ValueError, match=r"cut\.nc could not be read"):
        arviz_data.load(cut)
    other = tmp_path / "other.nc"
    with h5netcdf.File(other, "w") as file:
        file.create_group("posterior")
    with pytest.raises(ValueError, match=r"not written by lfm_ppl.*arviz\.from_netcdf"):
        arviz_data.load(other)
    no_posterior = arviz_data.build({"observed_data": xr.Dataset({"y": ("time", [1.0])})})
    path = arviz_data.save(no_posterior, tmp_path / "data.nc")
    with pytest.raises(ValueError, match="holds no posterior; its groups are observed_data"):
        arviz_data.load(path)


def elpd(loo):
    return loo.elpd if ONE_X else loo.elpd_loo


@pytest.mark.parametrize("saved", [False, True])
def test_loo_and_compare(tmp_path, result, datasets, saved):
    if saved:
        result = arviz_data.load(arviz_data.save(result, tmp_path / "a.nc"))
    loo = az.loo(result)
    terms = datasets["log_likelihood"]["y"].values.reshape(400, -1)
    # Plain importance sampling: the log-likelihoods vary so little that smoothing changes nothing.
    plain = np.sum(np.log(len(terms)) - special.logsumexp(-terms, axis=0))
    assert elpd(loo) == pytest.approx(plain, abs=0.05)
    worse = dict(datasets)
    worse["log_likelihood"] = datasets["log_likelihood"] - 1.0
    table = az.compare({"good": result, "bad": arviz_data.build(worse)})
    assert list(table.index) == ["good", "bad"]
    assert table.loc["good", "rank"] == 0


def test_summary_against_numpy_and_arviz(result, datasets):
    frame = arviz_data.summary(result)
    assert list(frame.columns) == [
        "mean", "sd", "q2.5", "q97.5", "mcse_mean", "ess_bulk", "ess_tail", "r_hat",
    ]  # fmt: skip
    assert list(frame.index) == [
        "decay[CDKN1A]", "decay[SESN1]", "decay[TNFRSF10b]", "lengthscale", "noise_sd", "anchor",
    ]  # fmt: skip
    draws = datasets["posterior"]["decay"].values[:, :, 1]
    row = frame.loc["decay[SESN1]"]
    np.testing.assert_allclose(row["mean"], draws.mean())
    np.testing.assert_allclose(row["sd"], draws.std(ddof=1))
    np.testing.assert_allclose(row[["q2.5", "q97.5"]], np.quantile(draws, [0.025, 0.975]))
    np.testing.assert_allclose(row["mcse_mean"], row["sd"] / np.sqrt(az.ess(draws, method="mean")))
    np.testing.assert_allclose(row["r_hat"], az.rhat(draws))
    np.testing.assert_allclose(arviz_data.ess(result)["decay[SESN1]"], az.ess(draws))
    # 400 independent draws
    assert 250 < row["ess_bulk"] < 600
    assert frame.loc["anchor", ["mcse_mean", "ess_bulk", "ess_tail", "r_hat"]].isna().all()
    assert frame.loc["anchor", "sd"] == 0.0


def test_rhat_by_hand():
    rng = np.random.default_rng(3)
    draws = rng.normal(size=(4, 200)) + np.array([0.0, 0.0, 0.3, 0.3])[:, None]
    # Vehtari et al. (2021): the larger one of rank-normalised and folded split R-hat.
    halves = draws.reshape(8, 100)

    def one(values):
        ranks = values.ravel().argsort().argsort().reshape(values.shape) + 1
        z = special.ndtri((ranks - 0.375) / (values.size + 0.25))
        within = z.var(axis=1, ddof=1).mean()
        return np.sqrt(99 / 100 + z.mean(axis=1).var(ddof=1) / within)

    expected = max(one(halves), one(np.abs(halves - np.median(halves))))
    np.testing.assert_allclose(arviz_data.rhat(draws_only(draws))["theta"], expected, rtol=1e-6)


def test_diagnostics_are_quiet_and_undefined_where_they_must_be(caplog):
    good = np.random.default_rng(0).normal(size=(4, 100))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        broken = good.copy()
        broken[2, 5] = np.nan
        assert arviz_data.summary(draws_only(broken)).loc["theta"].isna().all()
        one = arviz_data.summary(draws_only(good[:1])).loc["theta"]
        assert np.isnan(one["r_hat"]) and one["ess_bulk"] > 20
        short = arviz_data.summary(draws_only(good[:, :3])).loc["theta"]
        assert short[["ess_bulk", "ess_tail", "r_hat"]].isna().all()
    assert not caplog.records


def test_no_warnings_when_all_is_well():
    rng = np.random.default_rng(0)
    assert arviz_data.convergence_warnings(draws_only(rng.normal(size=(4, 1000)))) == []


def test_convergence_warnings_name_parameter_value_and_remedy(datasets):
    rng = np.random.default_rng(0)
    apart = rng.normal(size=(4, 100)) + np.arange(4)[:, None]
    datasets["posterior"]["stuck"] = (("chain", "draw"), apart)
    broken = arviz_data.build(datasets, {"sampler": "nuts"})
    result = arviz_data.convergence_warnings(broken)
    row = arviz_data.summary(broken).loc["stuck"]
    r_hat = next(text for text in result if text.startswith("R-hat is above 1.01"))
    assert f"stuck ({row['r_hat']:.3f})" in r_hat and "Run longer" in r_hat
    assert "decay" not in r_hat or ", decay" in r_hat  # the worst comes first
    bulk = next(text for text in result if text.startswith("bulk effective sample size"))
    assert f"below 400 (100 per chain) for stuck ({row['ess_bulk']:.0f})" in bulk
    assert f"about {int(np.ceil(400 / row['ess_bulk']))}-fold" in bulk
    diverged = next(text for text in result if "diverged" in text)
    assert diverged.startswith("3 of 400 transitions diverged (0.75%)")
    assert "target_accept_prob" in diverged
    assert not any("anchor" in text for text in result)


def test_warnings_for_one_chain_bad_draws_and_many_parameters():
    rng = np.random.default_rng(0)
    (one,) = arviz_data.convergence_warnings(draws_only(rng.normal(size=(1, 2000))))
    assert "R-hat needs at least two chains" in one and "chains=4" in one
    draws = rng.normal(size=(4, 1000))
    draws[0, 0] = np.inf
    (bad,) = arviz_data.convergence_warnings(draws_only(draws))
    assert bad.startswith("draws are not finite for theta")
    few = arviz_data.convergence_warnings(draws_only(rng.normal(size=(4, 3))))
    assert few == ["3 draws per chain are too few for R-hat and ESS. Raise samples."]
    many = xr.Dataset({"x": (("chain", "draw", "k"), rng.normal(size=(4, 20, 9)))})
    result = arviz_data.convergence_warnings(arviz_data.build({"posterior": many}))
    assert any("and 4 more" in text for text in result)


def test_laplace_draws_are_independent():
    posterior = xr.Dataset(
        {"x": (("chain", "draw"), np.random.default_rng(0).normal(size=(1, 50)))}
    )
    assert not arviz_data.convergence_warnings(
        arviz_data.build({"posterior": posterior}, {"sampler": "map"})
    )


def test_scalar_labels():
    dataset = xr.Dataset(
        {
            "matrix": (("row", "draw", "chain", "column"), np.arange(48.0).reshape(2, 4, 2, 3)),
            "plain": (("chain", "draw", "plain_dim_0"), np.zeros((2, 4, 2))),
            "shared": ("row", [1.0, 2.0]),
        },
        coords={"row": ["a", "b"], "column": [10, 20, 30]},
    )
    draws = scalar_draws(dataset)
    assert list(draws) == [
        "matrix[a,10]", "matrix[a,20]", "matrix[a,30]",
        "matrix[b,10]", "matrix[b,20]", "matrix[b,30]",
        "plain[0]", "plain[1]",
    ]  # fmt: skip
    np.testing.assert_array_equal(
        draws["matrix[b,20]"], dataset["matrix"].sel(row="b", column=20).transpose("chain", "draw")
    )
    assert choose(draws, None) == [name for name in draws if name.startswith("matrix")]
    assert choose(draws, ["plain", "matrix[b,20]", "plain[1]"]) == [
        "plain[0]", "plain[1]", "matrix[b,20]",
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"unknown parameter 'matrx'\. Did you mean 'matrix'"):
        choose(draws, ["matrx"])


def test_truth_is_matched_by_coordinate_by_position_or_for_all():
    posterior = xr.Dataset(
        {name: (("chain", "draw", "gene"), np.zeros((2, 4, 2))) for name in ("a", "b", "c", "d")},
        coords={"gene": ["x", "y"]},
    )
    truth = xr.Dataset(
        {
            "a": ("gene", [1.0, 2.0]),
            "b": ("other", [3.0, 4.0]),
            "c": 5.0,
            "d": ("three", [0.0] * 3),
        },
        coords={"gene": ["y", "z"]},
    )
    assert scalar_truth(posterior, truth) == {
        "a[y]": 1.0, "b[x]": 3.0, "b[y]": 4.0, "c[x]": 5.0, "c[y]": 5.0,
    }  # fmt: skip


def test_units_of_several_names():
    names, units = ["x", "v", "w"], {"x": "m", "v": "m/s", "time": "s"}
    variable = xr.DataArray(np.zeros(3), dims="state", attrs=units_attribute(names, units))
    assert [unit_of(variable, name) for name in names] == ["m", "m/s", ""]
    assert unit_of(xr.DataArray(0.0)) == ""
    assert unit_of(xr.DataArray(0.0, attrs={"units": "{braces} are no JSON"})).startswith(
        "{braces}"
    )


def test_equal_draws_have_no_spread_and_give_no_warning():
    """The mean of 4,000 times 0.8 is not 0.8 in floating point."""
    draws = np.full((4, 1000), 0.8)
    varying = np.random.default_rng(0).normal(size=(4, 1000))
    posterior = xr.Dataset({"fixed": (("chain", "draw"), draws), "free": (("chain", "draw"), varying)})
    result = arviz_data.build({"posterior": posterior})
    assert draws.std(ddof=1) != 0.0
    assert arviz_data.summary(result)["sd"]["fixed"] == 0.0
    assert draws.mean() != 0.8 and arviz_data.summary(result)["mean"]["fixed"] == 0.8
    assert arviz_data.convergence_warnings(result) == []
