"""Results of tasks as datasets with named dimensions, and the rows of tables that follow from them."""

import numpy as np
import pytest
import xarray as xr

from lfm_ppl.parallel.task import Task
from lfm_ppl.studies.datasets import TaskKind, row
from lfm_ppl.studies.scores import Estimate, estimate_mean, estimate_rate

ENTRIES = {"dataset": "rmse, held", "dataset path": "coverage", "path time": "mean", "": "count, name"}


def block_result(rule, first, last):
    """A block of results that say which data set and which path they are of."""
    index = np.arange(first, last + 1)
    bonus = 100.0 if rule == "CKF" else 0.0
    return {"rmse": bonus + index, "held": index % 2 == 0, "coverage": bonus + index[:, None] + [0.25, 0.5],
            "mean": np.full((2, 3), bonus + first), "count": last - first + 1, "name": rule}


def blocks(rule, *bounds):
    return [Task(f"{rule}/{first}", 0, {"rule": rule, "first": first, "last": last}) for first, last in bounds]


def collect(tasks, entries=ENTRIES, by=("rule",)):
    kind = TaskKind(lambda task: block_result(task.settings["rule"], task.settings["first"], task.settings["last"]),
                    entries, by)
    return kind.collect(tasks, {task.name: kind.compute(task) for task in tasks})


def test_blocks_of_data_sets_follow_one_another():
    dataset = collect([*blocks("EKF", (0, 1), (2, 4)), *blocks("CKF", (0, 1), (2, 4))])
    assert dataset["rmse"].dims == ("rule", "dataset") and dataset["coverage"].dims == ("rule", "dataset", "path")
    assert dataset["rmse"].sel(rule="CKF").values.tolist() == [100.0, 101.0, 102.0, 103.0, 104.0]
    assert dataset["held"].dtype == bool
    assert dataset["held"].sel(rule="EKF").values.tolist() == [True, False] * 2 + [True]
    # What has no data sets is that of the first block.
    assert dataset["mean"].dims == ("rule", "path", "time") and (dataset["mean"].sel(rule="CKF") == 100.0).all()
    assert dataset["count"].values.tolist() == [2, 2] and dataset["name"].values.tolist() == ["EKF", "CKF"]


def test_what_a_cell_lacks_is_missing():
    dataset = collect([*blocks("EKF", (0, 1), (2, 4)), *blocks("CKF", (0, 1))])
    assert dataset["rmse"].sizes == {"rule": 2, "dataset": 5}
    assert np.isnan(dataset["rmse"].sel(rule="CKF").values).tolist() == [False, False, True, True, True]
    assert row(dataset.sel(rule="CKF"), {"RMSE": "rmse"})["RMSE"] == 100.5
    kind = TaskKind(block_result, {"dataset": "rmse, k"}, ("rule",))
    tasks = [Task(rule, 0, {"rule": rule, "index": 0}) for rule in ("EKF", "CKF")]
    dataset = kind.collect(tasks, {"EKF": {"rmse": 1.0}, "CKF": {"rmse": 2.0, "k": 0.5}})
    assert np.isnan(dataset.k.sel(rule="EKF")).all() and dataset.k.sel(rule="CKF").item() == 0.5
    assert "k" not in kind.collect(tasks[:1], {"EKF": {"rmse": 1.0}})


def test_an_entry_that_some_tasks_of_a_cell_lack_is_an_error():
    tasks = [Task(f"EKF/{index}", 0, {"rule": "EKF", "index": index}) for index in range(2)]
    for lacking in ("EKF/0", "EKF/1"):
        results = {task.name: {} if task.name == lacking else {"k": 1.0} for task in tasks}
        with pytest.raises(ValueError, match=f"'k' is missing in the result of {lacking}"):
            TaskKind(block_result, {"dataset": "k"}, ("rule",)).collect(tasks, results)


def test_several_settings_become_dimensions():
    tasks = [Task(f"{store}/{rule}/{index}", 0, {"store": store, "rule": rule, "index": index})
             for index in range(3) for store, rule in (("one", "EKF"), ("one", "CKF"), ("two", "CKF"))]
    results = {task.name: {"rmse": float(task.settings["index"])} for task in tasks}
    dataset = TaskKind(block_result, {"dataset": "rmse"}, ("store", "rule")).collect(tasks, results)
    assert dataset["rmse"].sizes == {"store": 2, "rule": 2, "dataset": 3}
    assert dataset["rmse"].sel(store="two", rule="CKF").values.tolist() == [0.0, 1.0, 2.0]
    assert np.isnan(dataset["rmse"].sel(store="two", rule="EKF")).all()
    single = TaskKind(block_result, {"dataset": "rmse"}).collect(tasks[:1], results)
    assert single["rmse"].sizes == {"dataset": 1}


def test_a_row_has_means_shares_and_numbers():
    rmse, held = np.array([1.0, 2.0, 6.0]), np.array([True, True, False])
    dataset = xr.Dataset({"rmse": ("dataset", rmse), "held": ("dataset", held), "k": ("dataset", [0.1, 0.2, 0.9])})
    cells = row(dataset, {"RMSE": "rmse", "held": "held", "k > 0.7": lambda results: (results.k > 0.7).mean(),
                          "largest": lambda results: Estimate(6.0, 0.5), "kind": lambda results: "plain",
                          "count": lambda results: 3})
    assert cells == {"RMSE": 3.0, "RMSE se": estimate_mean(rmse).error, "held": pytest.approx(2 / 3),
                     "held se": estimate_rate(held).error, "k > 0.7": pytest.approx(1 / 3),
                     "largest": 6.0, "largest se": 0.5, "kind": "plain", "count": 3}
    assert type(cells["count"]) is int and type(cells["k > 0.7"]) is float


def test_a_name_stands_for_a_column_of_each_entry():
    dataset = xr.Dataset({"rmse": (("dataset", "path"), np.array([[1.0, 10.0], [3.0, 30.0]]))},
                         {"path": ["x", "v"], "unit": ("path", ["m", "m/s"])})
    assert list(row(dataset, {"RMSE {path} ({unit})": "rmse"})) == [
        "RMSE x (m)", "RMSE x (m) se", "RMSE v (m/s)", "RMSE v (m/s) se"]
    assert row(dataset, {"{path}": lambda results: results.rmse.max()}) == {"x": 3.0, "v": 30.0}
    # Of one entry alone, that is not a dimension any more, the name has the label.
    assert row(dataset.sel(path="v"), {"RMSE {path}": "rmse"})["RMSE v"] == 20.0
    levels = xr.Dataset({"share": ("level", [0.4, 0.9])}, {"level": [0.5, 0.95]})
    assert row(levels, {"coverage {level:.0%}": "share"}) == {"coverage 50%": 0.4, "coverage 95%": 0.9}
