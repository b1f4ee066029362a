"""One series of a panel, selected from the groups and attributes of a result."""

import json

import numpy as np
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.results import arviz_data
from lfm_ppl.results.result_view import ResultView


@pytest.fixture
def panel():
    """Two subjects with labels that are numbers, rows that pad the first one, and a degenerate scale of the second."""
    sample = {"chain": [0], "draw": np.arange(4), "subject": [7, 9]}
    y = np.array([[1.0, 2.0, np.nan], [np.nan, 3.0, 4.0]])[..., None]
    times = (("subject", "time"), np.array([[0.0, 1.0, 1.0], [0.0, 2.0, 4.0]]), {"units": "h"})
    posterior = {"scale": (("chain", "draw", "subject"), np.arange(8.0).reshape(1, 4, 2)),
                 "shared": (("chain", "draw"), np.ones((1, 4)))}
    scores = {"y": (("chain", "draw", "observation"), np.arange(16.0).reshape(1, 4, 4))}
    entries = {"subject": ("observation", [7, 7, 9, 9]), "time": ("observation", [0.0, 1.0, 2.0, 4.0])}
    groups = {"posterior": xr.Dataset(posterior, sample),
              "data": xr.Dataset({"y": (("subject", "time", "output"), y)},
                                          {"subject": [7, 9], "output": ["x"], "times": times}),
              "log_likelihood": xr.Dataset(scores, {"chain": [0], "draw": np.arange(4), **entries}),
              "accuracy": xr.Dataset({"k": 1.0})}
    attrs = {"sampler": "map", arviz_data.MODE: json.dumps({"scale": [0.5, 1.5], "shared": 2.0}),
             arviz_data.DEGENERATE: json.dumps({"scale": [1]})}
    return arviz_data.build(groups, attrs)


def test_rows_scores_and_units(panel):
    view = lfm.select_series(panel, 7)
    data = ResultView.of(view).group("data")
    assert data["y"].dims == ("time", "output") and data["time"].attrs == {"units": "h"}
    np.testing.assert_array_equal(data["time"], [0.0, 1.0])
    np.testing.assert_array_equal(ResultView.of(view).group("log_likelihood")["y"][0, 0], [0.0, 1.0])
    other_view = ResultView.of(lfm.select_series(panel, "9"))
    np.testing.assert_array_equal(other_view.group("data")["time"], [0.0, 2.0, 4.0])  # missing, and no padding
    np.testing.assert_array_equal(other_view.group("log_likelihood")["y"][0, 0], [2.0, 3.0])
    assert "accuracy" not in ResultView.of(view).groups


def test_parameters_and_their_mode(panel):
    for series, mode, warning in ((7, 0.5, None), (-1, 1.5, "degenerate mode")):
        view = lfm.select_series(panel, series)
        table = arviz_data.summary(view)
        assert table.loc["scale", "mode"] == mode and table.loc["shared", "mode"] == 2.0
        assert ("warnings" in table) == (warning is not None)
        assert warning is None or table.loc["scale", "warnings"] == warning
    assert ResultView.of(lfm.select_series(panel, 0)).attrs["selected"] == "subject 7"
