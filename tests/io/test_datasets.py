"""Data sets of the examples."""

import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.io import loading

ROWS = {"theophylline": (12, 11), "p53": (21,), "coal": (111,), "house": (792,), "calls": (27716,)}


@pytest.mark.thorough
def test_the_simulated_room_is_that_of_the_model():
    data, expected = lfm.datasets.load("room"), loading.load("room").simulate()
    np.testing.assert_array_equal(data.y, expected.y)
    assert data.truth["forces"]["heat"].shape == data.truth["times"].shape


@pytest.mark.parametrize("name", ROWS)
def test_measured_data_have_times_outputs_and_units(name):
    try:
        data = lfm.datasets.load(name)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    assert data.times.shape == ROWS[name] and data.y.shape == (*ROWS[name], len(data.outputs))
    assert np.isfinite(data.y).all() and data.units["time"] in ("h", "years")
    if name == "theophylline":
        assert len(data.series) == 12 and data.units["conc"] == "mg/L" and len(data.doses()) == 1
        assert data.doses()[0].values.shape == (12, 1)
    if name == "coal":
        assert data.y.sum() == 191 - 1  # the last disaster is of 1962


def test_other_names_and_absent_files_are_named(tmp_path):
    with pytest.raises(ValueError, match="'theophyline'.*'theophylline'"):
        lfm.datasets.load("theophyline")
    with pytest.raises(ValueError, match="coal"):
        lfm.datasets.load("x")
    with pytest.raises(FileNotFoundError, match="theoph.csv.*Theoph of R.*LFM_DATA"):
        lfm.datasets.load("theophylline", folder=tmp_path)
