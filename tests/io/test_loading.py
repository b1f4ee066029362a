"""Model files: finding them, and what a user is told about one that cannot be used."""

import numpy as np
import pytest

from lfm_ppl.io import loading
from lfm_ppl.io.data_set import Data

COMPLETE = '''"""A line: y = slope * t.

More words.
"""
from lfm_ppl.io.data_set import Data

OUTPUTS = ("y",)
UNITS = {"time": "s", "y": "m"}
OPTIONS = {
    "link": ("linear", ("linear", "softplus"), "the link"),
    "gamma": (0.5, float, "saturation constant"),
    "count": (3, int, "number"),
    "known": (False, bool, "whether the start is known"),
}
PARAMETERS = {"slope": "slope (m/s)"}


def model(times, y=None, **options):
    return options


def simulate(seed=0, **options):
    return Data([0.0, 1.0], [[0.0], [seed]], OUTPUTS, units={"time": "min"})


def prepare(data):
    return Data(data.times, data.y / 2, data.outputs, note="halved")


def anchors(data):
    return {"slope": 1.0}
'''


@pytest.fixture
def model_file(tmp_path):
    """Write a model file and return its path."""

    def write(text, name="my_line.py"):
        path = tmp_path / name
        path.write_text(text)
        return str(path)

    return write


def test_every_shipped_model_is_listed_and_loads():
    shipped = loading.available()
    assert {"ginzburg-landau", "spring", "transcription"} <= set(shipped)
    for name in shipped:
        loaded = loading.load(name)
        assert loaded.name == name
        assert loaded.path == shipped[name]
        assert loading.load(name.replace("-", "_")).path == loaded.path


def test_a_complete_file(model_file):
    loaded = loading.load(model_file(COMPLETE))
    assert (loaded.name, loaded.summary) == ("my-line", "A line: y = slope * t.")
    assert loaded.outputs == ("y",)
    data = loaded.simulate(seed=4)
    assert data.y[1, 0] == 4
    assert data.units == {"time": "min", "y": "m"}, "the data's own unit wins over the model's"
    prepared = loaded.prepare(data)
    assert (prepared.y[1, 0], prepared.note) == (2, "halved")
    assert loaded.anchors(data) == {"slope": 1.0}
    assert loaded.definitions["OUTPUTS"] == ("y",) and loaded.definitions["model"] is loaded.model
    with pytest.raises(TypeError):
        loaded.definitions["OUTPUTS"] = ("z",)


def test_a_file_with_the_model_alone(model_file):
    loaded = loading.load(model_file("def model(times, y=None): ..."))
    data = Data([0.0], [[1.0, 2.0]], ("a", "b"))
    assert loaded.prepare(data).y is data.y
    assert loaded.anchors(data) == {}
    assert loaded.keywords(data, {}) == {}
    with pytest.raises(ValueError, match=r"defines no simulate.*--data FILE"):
        loaded.simulate()


def test_a_model_is_told_names_and_units_where_it_takes_them(model_file):
    data = Data([0.0], [[1.0, 2.0]], ("a", "b"), units={"time": "h"})
    names = loading.load(model_file("def model(times, y=None, outputs=()): ..."))
    assert names.keywords(data, {}) == {"outputs": ("a", "b")}
    both = loading.load(model_file("def model(times, y=None, *, units=None, outputs=()): ..."))
    assert both.keywords(data, {}) == {"outputs": ("a", "b"), "units": {"time": "h"}}


def test_options_are_converted_and_have_defaults(model_file):
    loaded = loading.load(model_file(COMPLETE))
    data = loaded.simulate()
    expected = {"link": "linear", "gamma": 0.25, "count": 3, "known": False}
    assert loaded.keywords(data, {"gamma": loaded.option("gamma", "0.25")}) == expected
    assert loaded.option("link", "softplus") == "softplus"
    assert loaded.option("count", "7") == 7
    assert loaded.option("known", "yes") is True


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("lnk", "linear", r"unknown option of my-line 'lnk'\. Did you mean 'link'"),
        ("link", "softpuls", r"unknown value of option link 'softpuls'\. Did you mean 'softplus'"),
        ("gamma", "half", r"option gamma of my-line takes a value of type float, got 'half'"),
        ("known", "maybe", r"type bool, got 'maybe'"),
    ],
)
def test_options_that_do_not_exist(model_file, name, text, message):
    with pytest.raises(ValueError, match=message):
        loading.load(model_file(COMPLETE)).option(name, text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "def transcription(times): ...",
            r"no function model\(times.*functions are: transcription",
        ),
        ("from math import sin as model", r"defines no function model.*functions are: none"),
        ("import absent_module", r"does not run: line 1: ModuleNotFoundError: No module"),
        ("x = 1\nx = 1 / 0", r"does not run: line 2: ZeroDivisionError"),
        ("x = 1\ndef model(:", r"does not run: line 2: SyntaxError"),
        (
            "def model(times): ...\nOUTPUTS = 'x'",
            r'OUTPUTS must be a tuple of names, as in \("x",\)',
        ),
        ("def model(times): ...\nsimulate = 3", r"simulate must be a function, got 3"),
        ("def model(times): ...\nOPTIONS = {'a': 1}", r"OPTIONS\['a'\] must be \(default"),
        ("def model(times): ...\nTARGET_ACCEPT = '0.9'", r"TARGET_ACCEPT must lie between 0 and 1, got '0.9'"),
        ("def model(times): ...\nTARGET_ACCEPT = 90", r"TARGET_ACCEPT must lie between 0 and 1, got 90"),
    ],
)
def test_files_that_cannot_be_used(model_file, text, message):
    with pytest.raises(ValueError, match=message):
        loading.load(model_file(text))


def test_simulate_must_return_data(model_file):
    text = "def model(times, y=None): ...\ndef simulate(seed=0):\n    return [1]\n"
    with pytest.raises(TypeError, match=r"simulate in .* must return lfm.Data, got list"):
        loading.load(model_file(text)).simulate()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("ginsburg-landau", r"unknown model 'ginsburg-landau'\. Did you mean 'ginzburg-landau'"),
        ("absent.py", r"there is no model file absent\.py"),
        ("folder/absent", r"there is no model file folder/absent"),
    ],
)
def test_unknown_models(name, message):
    with pytest.raises(ValueError, match=message):
        loading.load(name)


def test_a_model_file_cannot_hide_another_module(model_file):
    loading.load(model_file(COMPLETE, name="numpy.py"))
    import numpy

    assert numpy is np
