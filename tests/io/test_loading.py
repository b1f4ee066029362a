"""Model files: how they are found, what they define, and one line on a file that cannot be used."""

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
def load(tmp_path):
    """Write a model file and load it."""

    def write_and_load(text, name="my_line.py"):
        (tmp_path / name).write_text(text)
        return loading.load(str(tmp_path / name))

    return write_and_load


def test_every_shipped_model_is_listed_and_loads():
    shipped = loading.available()
    assert {"ginzburg-landau", "spring", "transcription"} <= set(shipped)
    for name in shipped:
        loaded = loading.load(name)
        assert (loaded.name, loaded.path) == (name, shipped[name])
        assert loading.load(name.replace("-", "_")).path == loaded.path


def test_a_complete_file(load):
    loaded = load(COMPLETE)
    assert (loaded.name, loaded.summary, loaded.outputs) == ("my-line", "A line: y = slope * t.", ("y",))
    data = loaded.simulate(seed=4)
    assert data.y[1, 0] == 4
    assert data.units == {"time": "min", "y": "m"}, "the data's own unit wins over the model's"
    prepared = loaded.prepare(data)
    assert (prepared.y[1, 0], prepared.note) == (2, "halved")
    assert loaded.anchors(data) == {"slope": 1.0}
    assert loaded.definitions["OUTPUTS"] == ("y",) and loaded.definitions["model"] is loaded.model
    with pytest.raises(TypeError):
        loaded.definitions["OUTPUTS"] = ("z",)


def test_a_file_with_the_model_alone(load):
    loaded = load("def model(times, y=None): ...")
    data = Data([0.0], [[1.0, 2.0]], ("a", "b"))
    assert loaded.prepare(data).y is data.y
    assert loaded.anchors(data) == loaded.keywords(data, {}) == {}
    with pytest.raises(ValueError, match="simulate.*--data FILE"):
        loaded.simulate()


def test_a_model_gets_names_and_units_where_it_takes_them(load):
    data = Data([0.0], [[1.0, 2.0]], ("a", "b"), units={"time": "hours"})
    assert load("def model(times, y=None, outputs=()): ...").keywords(data, {}) == {"outputs": ("a", "b")}
    model_file = load("def model(times, y=None, *, units=None, outputs=()): ...")
    assert model_file.keywords(data, {}) == {"outputs": ("a", "b"), "units": {"time": "h"}}


def test_options_are_converted_and_have_defaults(load):
    loaded = load(COMPLETE)
    expected = {"link": "linear", "gamma": 0.25, "count": 3, "known": False}
    assert loaded.keywords(loaded.simulate(), {"gamma": loaded.option("gamma", "0.25")}) == expected
    values = [loaded.option(name, text) for name, text in (("link", "softplus"), ("count", "7"), ("known", "yes"))]
    assert values == ["softplus", 7, True]
    for name, text, words in (("lnk", "linear", "'lnk'.*'link'"), ("link", "softpuls", "'softpuls'.*'softplus'"),
                              ("gamma", "half", "float.*'half'"), ("known", "maybe", "bool.*'maybe'")):
        with pytest.raises(ValueError, match=words):
            loaded.option(name, text)


@pytest.mark.parametrize(("text", "words"), [
    ("def transcription(times): ...", ["model(times", "transcription"]),
    ("from math import sin as model", ["model", "none"]),
    ("import absent_module", ["line 1: ModuleNotFoundError"]), ("x = 1\nx = 1 / 0", ["line 2: ZeroDivisionError"]),
    ("x = 1\ndef model(:", ["line 2: SyntaxError"]), ("def model(times): ...", ["model must take"]),
    ("def model(times): ...\nOUTPUTS = 'x'", ["OUTPUTS", "'x'"]), ("def model(times): ...\nsimulate = 3", ["simulate"]),
    ("def model(times): ...\nOPTIONS = {'a': 1}", ["OPTIONS['a']", "got 1"]),
    ("def model(times): ...\nTARGET_ACCEPT = '0.9'", ["TARGET_ACCEPT", "'0.9'"]),
    ("def model(times): ...\nTARGET_ACCEPT = 90", ["TARGET_ACCEPT", "90"]),
])
def test_files_that_cannot_be_used(load, text, words):
    with pytest.raises(ValueError) as raised:
        load(text)
    message = str(raised.value)
    assert "\n" not in message and all(word in message for word in ["my_line.py", *words]), message


def test_simulate_must_return_data(load):
    with pytest.raises(TypeError, match="simulate in .* lfm.Data, got list"):
        load("def model(times, y=None): ...\ndef simulate(seed=0):\n    return [1]\n").simulate()


@pytest.mark.parametrize(("name", "words"), [("ginsburg-landau", "'ginsburg-landau'.*'ginzburg-landau'"),
                                             ("absent.py", "absent.py"), ("folder/absent", "folder/absent")])
def test_unknown_models(name, words):
    with pytest.raises(ValueError, match=words):
        loading.load(name)


def test_a_model_file_cannot_hide_another_module(load):
    load(COMPLETE, name="numpy.py")
    import numpy

    assert numpy is np
