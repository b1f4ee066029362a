"""Dosing files against an independent simulation with matrix exponentials, and rows that are refused."""

from __future__ import annotations

import dataclasses
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import lfm_ppl as lfm
from lfm_ppl.cli import choices
from lfm_ppl.cli.options import Columns
from lfm_ppl.io.data import read_csv, read_series
from lfm_ppl.io.data_set import Data, stack_series
from lfm_ppl.io.input_table import InputTable, continued_inputs
from lfm_ppl.io.loading import load
from lfm_ppl.results.inputs import from_dataset, to_dataset

ABSORPTION, ELIMINATION = 0.3, 0.1
RATES = np.array([[-ABSORPTION, 0.0], [ABSORPTION, -ELIMINATION]])
HEADER = "TIME,DV,AMT,EVID,MDV,CMT,RATE,dur,ADDL,II"


@pytest.fixture
def read(tmp_path):
    def read(text, way="dose:gut,blood", **more):
        path = tmp_path / "pk.csv"
        path.write_text(text)
        return read_csv(path, outputs=["DV"], inputs={"AMT": way, **more})

    return read


def random_file(seed):
    """Return a file with all columns, and its doses (time, amount, state, duration) and resets."""
    generator = np.random.default_rng(seed)
    rows, doses, resets = [], [], []
    for time in np.sort(generator.choice(np.arange(0.0, 48.0, 0.5), 16, replace=False)):
        kind = generator.choice(["observation", "observation", "dose", "dose", "reset", "other"])
        cells = dict.fromkeys(HEADER.split(","), ".") | {"TIME": time, "EVID": 0, "MDV": 0, "DV": 1.0}
        if kind in ("dose", "reset"):
            state, amount = generator.integers(2), float(generator.integers(20, 100))
            duration, additional, gap = 0.0, int(generator.integers(3)), 7.25
            compartment = generator.choice([str(state + 1), ["gut", "blood"][state]])
            cells |= {"EVID": 1, "MDV": 1, "AMT": amount, "CMT": compartment}
            if kind == "reset":
                resets.append(time)
                cells["EVID"] = 4
            if generator.random() < 0.5:
                duration = float(generator.choice([0.75, 4.0, 10.0]))
                cells |= {"RATE": repr(amount / duration)} if generator.random() < 0.5 else {"dur": duration}
            if additional:
                cells |= {"ADDL": additional, "II": gap}
            doses += [(time + k * gap, amount, state, duration) for k in range(additional + 1)]
            if kind == "reset" and generator.random() < 0.5:
                cells |= dict.fromkeys(("AMT", "CMT", "RATE", "dur", "ADDL", "II"), ".") | {"EVID": 3}
                del doses[-additional - 1:]
        elif kind == "other":
            cells |= {"EVID": generator.choice([0, 2]), "MDV": 1, "DV": 99.0}
        rows.append(",".join(str(cells[name]) for name in HEADER.split(",")))
    rows.append("49.0,1.0,.,0,0,.,.,.,.,.")
    return "\n".join([HEADER, *rows, ""]), doses, resets


def simulate(times, doses, resets):
    """Return the state (T, 2) before the doses at each of the times."""
    stop_times = {(t, a, s, d): min([t + d, *(r for r in resets if r > t)]) for t, a, s, d in doses}
    marks = sorted({*times, *resets, *(dose[0] for dose in doses), *stop_times.values()})
    state, current_time, states = np.zeros(2), 0.0, {}
    for mark in marks:
        generator = np.zeros((3, 3))
        generator[:2, :2] = RATES
        for (start, amount, index, duration), end in stop_times.items():
            if duration and start <= current_time < end:
                generator[index, 2] += amount / duration
        state = (expm(generator * (mark - current_time)) @ np.append(state, 1.0))[:2]
        current_time = mark
        states[mark] = state
        if mark in resets:
            state = np.zeros(2)
        for start, amount, index, duration in doses:
            if start == mark and not duration:
                state = state + amount * np.eye(2)[index]
    return np.array([states[time] for time in times])


def predicted(data):
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.asarray(RATES) @ x, {}, lfm.GaussianObservation(lambda x, u, t: x[1:], jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(2), jnp.zeros((2, 2))), state_names=("gut", "blood"), initial_time=0.0,
        events=data.doses())
    return np.asarray(lfm.filter(model, data.times, data.y, max_step=0.05).predicted_mean)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [0, 1])
def test_a_dosing_file_is_the_history_that_it_describes(seed, read):
    text, doses, resets = random_file(seed)
    data = read(text)
    unobserved = np.array([row.split(",")[4] == "1" for row in text.splitlines()[1:]])
    np.testing.assert_array_equal(np.isnan(data.y[:, 0]), unobserved)
    np.testing.assert_allclose(predicted(data), simulate(data.times, doses, resets), atol=1e-8)
    # Stored with a result, and read back.
    stored = from_dataset(to_dataset(data.inputs))["AMT"]
    for loaded, original in zip(stored, data.inputs["AMT"], strict=True):
        np.testing.assert_array_equal(loaded, original)


def test_rows_without_evid_are_doses_where_they_have_an_amount(read):
    data = read("TIME,DV,AMT,MDV\n0,0,320,1\n1,6.1,0,0\n24,0,320,1\n25,7.0,0,0\n", "dose:gut")
    (dose,) = data.doses()
    assert dose.times.tolist() == [0.0, 24.0] and dose.state == "gut"
    np.testing.assert_array_equal(data.y[:, 0], [np.nan, 6.1, np.nan, 7.0])


def test_a_column_of_another_name_has_the_role_that_it_is_given(read):
    data = read("TIME,DV,AMT,where,rate\n0,,3,2,1\n1,2,,,5\n2,2,1,1,\n", where="CMT")
    dose, infusion = data.doses()
    assert (dose.state, infusion.state, infusion.durations.tolist()) == ("gut", "blood", [3.0])


def test_resets_come_before_doses_and_end_infusions(read):
    data = read(f"{HEADER}\n0,.,40,1,1,2,8,.,.,.\n2,.,5,4,1,1,.,.,.,.\n4,1,.,0,0,.,.,.,.,.\n")
    reset, dose, infusion = data.doses()
    assert reset.is_reset and reset.times.tolist() == [2.0] and reset.state is None
    assert infusion.durations.tolist() == [2.0] and infusion.values.tolist() == [16.0]
    assert dose.times.tolist() == [2.0]


@pytest.mark.parametrize(("cells", "message"), [
    ("AMT,SS,II\n3,1,12", "steady state"), ("AMT,RATE\n3,-2", "to be estimated"), ("AMT,RATE\n3,-1", "to be estimated"),
    ("AMT,EVID\n3,2", "EVID 2 with a dose"), ("AMT,EVID\n3,0", "no dose"), ("AMT,EVID\n.,1", "no amount"),
    ("AMT,EVID\n3,7", "EVID must be"), ("AMT\n-3", "negative"), ("AMT,CMT\n3,3", "compartment 3"),
    ("AMT,CMT\n3,liver", "compartment liver"), ("AMT,ADDL\n3,2", "in II"),
    ("AMT,ADDL,II\n3,1.5,2", "number of additional"),
    ("AMT,RATE,DUR\n3,1,1", "leave one"), ("AMT,DUR\n3,-1", "duration"), ("AMT,rate\n3,-7", "above zero"),
])
def test_rows_that_are_not_read_are_named(cells, message, read):
    names, values = cells.split("\n")
    with pytest.raises(ValueError, match=f"row 2, column.*{message}"):
        read(f"TIME,DV,{names}\n0,.,{values}\n1,2,{','.join('.' * len(values.split(',')))}\n")


REPEATED = "time,conc,dose\n0,0.7,320\n0.5,2.8,320\n1,6.6,320\n"


def test_a_column_that_repeats_one_dose(tmp_path):
    path = tmp_path / "theoph.csv"
    path.write_text(REPEATED)
    with pytest.warns(UserWarning, match="all 3 rows hold the same dose, so that 3 doses of 320 are given, 960 in all"):
        data = read_csv(path, ["conc"], inputs={"dose": "dose:gut"})
    stored = to_dataset(data.inputs)["dose"]
    assert (stored.attrs["doses"], stored.attrs["total"]) == (3, 960.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = read_csv(path, ["conc"], inputs={"dose": "dose:gut:once"})
        table = data.inputs["dose"]
        assert (table.times.tolist(), table.values.tolist(), table.interpolation) == ([0.0], [320.0], "dose:gut")
        path.write_text("time,conc,dose,EVID\n0,.,320,1\n12,.,320,1\n24,.,320,1\n")
        read_csv(path, ["conc"], inputs={"dose": "dose:gut"}, observed=False)
    path.write_text(REPEATED.replace("1,6.6,320", "1,6.6,300"))
    with pytest.raises(ValueError, match="several amounts"):
        read_csv(path, ["conc"], inputs={"dose": "dose:gut:once"})


def test_series_of_a_panel_have_infusions_and_resets_of_their_own(tmp_path):
    path = tmp_path / "panel.csv"
    path.write_text("ID,TIME,DV,AMT,RATE,EVID\n1,0,.,8,2,1\n1,5,1,.,.,0\n1,6,.,.,.,3\n2,1,.,4,.,1\n2,7,1,.,.,0\n")
    panel = stack_series(read_series(path, "ID", ["DV"], inputs={"AMT": "dose:gut"}))
    reset, dose, infusion = panel.doses()
    assert reset.times[0].tolist() == [6.0] and infusion.values.tolist() == [[8.0], [0.0]]
    assert dose.values.tolist() == [[0.0], [4.0]] and dose.times[1].tolist() == [1.0]


@pytest.mark.parametrize(("text", "outputs"), [
    ("TIME,DV,AMT,EVID,CMT\n0,.,4,1,1\n1,2,.,0,1\n1,7,.,0,2\n2,3,.,0,1\n", ["DV"]),
    ("TIME,DV,AMT,cmt\n0,.,4,1\n1,2,.,1\n2,7,.,2.0\n", ["DV"]),
    ("TIME,DV,AMT,EVID,DVID\n0,.,4,1,0\n1,2,.,0,1\n1,7,.,0,2\n", ["DV"]),
    ("TIME,DV,OTHER,AMT,dvid\n0,.,.,4,0\n1,2,.,.,conc\n1,7,1,.,effect\n", ["DV", "OTHER"]),
])
def test_outputs_that_share_a_column_are_refused(tmp_path, text, outputs):
    path = tmp_path / "pk.csv"
    path.write_text(text)
    for inputs in ({"AMT": "dose:gut,blood"}, {}):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that no dose is read
            with pytest.raises(ValueError, match="give each output a column|series"):
                read_csv(path, outputs, inputs=inputs)
    path.write_text("TIME,DV,AMT,EVID,DVID,CMT\n0,.,4,1,0,1\n1,2,.,0,1,2\n1,7,.,0,1,2.0\n2,3,.,2,3,1\n")
    assert np.isfinite(read_csv(path, ["DV"], inputs={"AMT": "dose:gut,blood"}).y).sum() == 2


def test_columns_that_tell_rows_of_doses_apart_identify_no_series(tmp_path):
    path = tmp_path / "pk.csv"
    rows = "".join(f"{time},.,4,1,dose\n{time},2,.,0,sample\n" for time in range(4))
    path.write_text("TIME,DV,AMT,EVID,kind\n" + rows)
    assert len(read_csv(path, ["DV"], inputs={"AMT": "dose:gut"}).times) == 8
    path.write_text("TIME,DV,AMT,EVID,ID\n0,.,4,1,\n" + "".join(f"{t},2,.,0,{1 + t % 2}\n" for t in range(1, 5)))
    with pytest.raises(ValueError, match="--series ID"):
        read_csv(path, ["DV"], inputs={"AMT": "dose:gut"})


@pytest.mark.parametrize(("names", "cells", "column"), [
    ("EVID,AMT", "1,4", "EVID"), ("evid,amt", "4,4", "evid"), ("EVID,AMT", "3,.", "EVID"), ("ADDL,dose", "2,4", "ADDL"),
    ("SS,AMT", "1,4", "SS"),
])
def test_doses_that_are_not_read_are_a_warning(tmp_path, names, cells, column):
    path = tmp_path / "pk.csv"
    path.write_text(f"TIME,DV,{names}\n0,.,{cells}\n1,2,.,.\n")
    with pytest.warns(UserWarning, match=f"{column!r}: the file marks doses.*--events {names.split(',')[1]}:STATE"):
        read_csv(path, ["DV"])


def test_intervals_and_rates_beside_dates_need_a_unit(tmp_path):
    path = tmp_path / "pk.csv"
    for name, cells in (("II", "12,1"), ("DUR", "2,."), ("RATE", "2,.")):
        path.write_text(f"date,DV,AMT,{name},ADDL\n2026-01-05,.,4,{cells}\n2026-01-06,1,.,.,.\n")
        with pytest.raises(ValueError, match=f"row 2, column '{name}'.*unit of time of {name} is.*--time-unit"):
            read_csv(path, ["DV"], inputs={"AMT": "dose:gut"})
        for unit, scale in ((None, 1.0), ("d", 24.0)):
            table = read_csv(path, ["DV"], inputs={"AMT": "dose:gut"}, time_unit=unit, usual_unit="h").inputs["AMT"]
            table = table.on_clock(scale, 0.0)
            time = table.times[1] if name == "II" else table.durations[0]
            assert time == (12.0 if name == "II" else 2.0) * scale


def test_outputs_of_rows_with_an_amount(read, recwarn):
    for column in ("CMT,1", "ADDL,.", "RATE,."):
        name, cell = column.split(",")
        data = read(f"TIME,DV,AMT,{name}\n0,0,4,{cell}\n1,2,.,.\n")
        np.testing.assert_array_equal(data.y[:, 0], [np.nan, 2.0])
    assert not recwarn.list
    with pytest.warns(UserWarning, match="'DV': the output is 0 in all rows with a dose"):
        data = read("TIME,DV,AMT\n0,0,4\n1,2,.\n2,0,4\n3,0,.\n")
    assert data.y[:, 0].tolist() == [0.0, 2.0, 0.0, 0.0]
    read("TIME,DV,AMT\n0,0,4\n1,2,.\n2,1.5,4\n")
    assert len(recwarn.list) == 0


def test_identifiers_and_columns_of_events_are_no_outputs(tmp_path):
    path = tmp_path / "pk.csv"
    path.write_text("SubjectID,time,conc,dose,CMT,where\n1,0,.,4,9,2\n1,1,2,.,.,.\n")
    data = read_csv(path, inputs={"dose": "dose:gut,blood", "where": "cmt"})
    assert data.outputs == ("conc",) and data.doses()[0].state == "blood"
    assert read_csv(path).outputs == ("SubjectID", "conc", "dose", "CMT", "where")
    with pytest.raises(ValueError, match=r"unknown column of CMT 'were'\. Did you mean 'where'"):
        read_csv(path, ["conc"], inputs={"dose": "dose:gut,blood", "were": "CMT"})
    with pytest.raises(ValueError, match="'where' and 'SubjectID' are both given the role CMT"):
        read_csv(path, ["conc"], inputs={"dose": "dose:gut", "where": "CMT", "SubjectID": "cmt"})
    with pytest.raises(ValueError, match=r"'amount'.*--events COLUMN:gut,blood \(inputs="):
        read_csv(path, ["conc"], inputs={"amount": "dose:gut,blood"})


def test_the_remedy_of_repeated_doses_to_several_states_is_an_option(tmp_path):
    path = tmp_path / "theoph.csv"
    path.write_text(REPEATED)
    with pytest.warns(UserWarning, match="--events dose:gut,blood:once"):
        read_csv(path, ["conc"], inputs={"dose": "dose:gut,blood"})
    (name, way), = choices.inputs(Columns(events="dose:gut,blood:once"), load("pharmacokinetics")).values()
    assert read_csv(path, ["conc"], inputs={name: way}).inputs["dose"].values.tolist() == [320.0]


def test_a_bolus_and_an_infusion_at_one_time(read):
    data = read("TIME,DV,AMT,RATE\n0,.,4,.\n0,.,6,3\n0,.,8,1\n1,2,.,.\n", "dose:gut")
    dose, infusion = data.doses()
    assert dose.values.tolist() == [4.0] and infusion.durations.tolist() == [2.0, 8.0]
    with pytest.raises(ValueError, match="row 4.*their sum"):
        read("TIME,DV,AMT,RATE\n0,.,4,.\n0,.,6,3\n0,.,5,.\n1,2,.,.\n", "dose:gut")


def test_names_of_measurements_are_no_infusions(tmp_path):
    path = tmp_path / "pk.csv"
    for name in ("rate", "dur", "Rate", "ii", "ss"):
        path.write_text(f"time,conc,dose,{name}\n0,.,4,72\n1,2,.,70\n")
        data = read_csv(path, inputs={"dose": "dose:gut"})
        assert data.outputs == ("conc", name) and data.inputs["dose"].durations is None
    path.write_text("time,conc,dose,rate,cmt\n0,.,4,2,1\n1,2,.,.,.\n")
    assert read_csv(path, inputs={"dose": "dose:gut"}).inputs["dose"].durations.tolist() == [2.0]


def continued(earlier, later):
    return continued_inputs({"AMT": earlier}, {"AMT": later})["AMT"]


def test_later_doses_continue_the_earlier_ones(read):
    earlier = read("TIME,DV,AMT,RATE\n0,.,4,2\n6,1,.,.\n").inputs["AMT"]
    later = read("TIME,DV,AMT,CMT\n8,.,3,2\n9,1,.,.\n").inputs["AMT"]
    joined = continued(earlier, later)
    assert joined.times.tolist() == [0.0, 8.0] and joined.durations.tolist() == [2.0, 0.0]
    assert joined.compartments.tolist() == [0, 1]
    events = Data([0.0], [[1.0]], ("DV",), inputs={"AMT": joined}).doses()
    assert [(type(event).__name__, event.state) for event in events] == [("Dose", "blood"), ("Infusion", "gut")]


def test_later_doses_keep_their_states(read):
    earlier = read("TIME,DV,AMT\n0,.,4\n6,1,.\n", "dose:gut").inputs["AMT"]
    later = read("TIME,DV,AMT,CMT\n8,.,3,2\n9,.,5,1\n10,1,.,.\n", "dose:blood,gut").inputs["AMT"]
    joined = continued(earlier, later)
    assert joined.dosed_states == ("gut", "blood") and joined.compartments.tolist() == [0, 0, 1]
    (dose,) = Data([0.0], [[1.0]], ("DV",), inputs={"AMT": continued(earlier, earlier.on_clock(1.0, 9.0))}).doses()
    assert dose.times.tolist() == [0.0, 9.0]
    blood, _ = Data([0.0], [[1.0]], ("DV",), inputs={
        "AMT": continued(earlier, InputTable(np.array([9.0]), np.array([2.0]), "dose:blood"))}).doses()
    assert (blood.state, blood.values.tolist()) == ("blood", [2.0])
    with pytest.raises(ValueError, match="doses to gut in the fit and a function of time"):
        continued(earlier, InputTable(np.array([9.0]), np.array([2.0])))


def test_a_later_reset_ends_an_infusion_that_runs(read):
    text = f"{HEADER}\n0,.,40,1,1,1,4,.,.,.\n1,.,5,1,1,1,.,.,.,.\n7,.,.,3,1,.,.,.,.,.\n9,1,.,0,0,.,.,.,.,.\n"
    earlier = read(text, "dose:gut").inputs["AMT"]
    assert earlier.durations.tolist() == [7.0, 0.0]
    later = read(f"{HEADER}\n5,.,.,3,1,.,.,.,.,.\n6,1,.,0,0,.,.,.,.,.\n", "dose:gut").inputs["AMT"]
    joined = continued(earlier, later)
    assert joined.durations.tolist() == [5.0, 0.0] and joined.values.tolist() == [20.0, 5.0]
    assert joined.resets.tolist() == [5.0]
    dose = read("TIME,DV,AMT\n6,.,3\n9,1,.\n", "dose:gut").inputs["AMT"]
    assert continued(earlier, dose).resets is None  # the reset at 7 belongs to the rows that are replaced
    other_table = InputTable(np.array([6.0]), np.array([1.0]), "dose:blood")
    tables = continued_inputs({"AMT": dose, "iv": earlier}, {"AMT": later, "iv": other_table})
    assert tables["iv"].durations.tolist() == [5.0, 0.0, 0.0] and tables["AMT"].resets.tolist() == [5.0]


def test_a_later_reset_ends_infusions_of_doses_that_are_not_named_later(read):
    infusion = InputTable(np.array([0.0, 2.0]), np.array([10.0, 3.0]), "dose:blood", np.array([20.0, 0.0]))
    reset = InputTable(np.zeros(0), np.zeros(0), "dose:gut", None, None, np.array([5.0]))
    dose = InputTable(np.array([0.0]), np.array([1.0]), "dose:gut")
    tables = continued_inputs({"AMT": dose, "iv": infusion}, {"AMT": reset})
    assert tables["iv"].durations.tolist() == [5.0, 0.0] and tables["iv"].values.tolist() == [2.5, 3.0]
    assert list(continued_inputs({"AMT": dose, "iv": infusion}, {"AMT": dose})) == ["AMT"]
    # A reset of one series of a panel is none of the others.
    names = [f"{name} of series {label}" for name in ("AMT", "iv") for label in ("Ann", "Bo")]
    panel = dict(zip(names, (dose, dose, infusion, infusion), strict=True))
    assert set(continued_inputs(panel, {names[1]: reset})) == {names[1], names[3]}


def test_the_command_line_names_states_and_roles():
    model = load("pharmacokinetics")
    assert choices.inputs(Columns(events="AMT:gut"), model) == {"dose": ("AMT", "dose:gut")}
    assert choices.inputs(Columns(events="AMT:gut,blood,where:CMT"), model) == {
        "dose": ("AMT", "dose:gut,blood"), "where": ("where", "CMT")}
    assert choices.inputs(Columns(events="dose:gut:once"), model) == {"dose": ("dose", "dose:gut:once")}
    stored = dataclasses.replace(model, inputs={"dose": "dose:gut,blood", "AMT": "dose:liver"})
    assert choices.inputs(Columns(events="AMT:gut,blood"), stored) == {"dose": ("AMT", "dose:gut,blood")}
    assert choices.inputs(Columns(events="D:gut , where:cmt"), stored) == {
        "dose": ("D", "dose:gut"), "where": ("where", "CMT")}
    assert choices.inputs(Columns(events="D:gut,blood:once"), stored) == {"dose": ("D", "dose:gut,blood:once")}
    assert choices.inputs(Columns(events="D:liver,gut"), stored) == {"AMT": ("D", "dose:liver,gut")}


@pytest.mark.parametrize(("events", "words"), [
    ("AMT:gut:once,blood", "'blood' after the other states"), ("AMT:gut,where:CMT,blood", "'blood' after the other"),
    ("AMT:gut,a:CMT,b:cmt", "two columns for CMT: a and b"), ("AMT:gut,AMT:blood", "column AMT twice"),
    ("AMT:gut:twice", "COLUMN:STATE"), ("AMT:", "COLUMN:STATE"), ("AMT", "COLUMN:STATE"),
])
def test_mistakes_in_events_are_one_line(events, words):
    with pytest.raises(ValueError, match=words):
        choices.inputs(Columns(events=events), load("pharmacokinetics"))


@pytest.mark.parametrize(("value", "words"), [
    (([0.0], [4.0], "dose:gut:once"), "'AMT': 'dose:gut:once' is for a column of a file.*'dose:gut'"),
    (([0.0, 1.0], [4.0, -1.0], "dose:gut"), "'AMT': the dose -1 at index 1 is negative"),
    (([0.0, 1.0, 2.0], [4.0, np.nan, -2.0], "dose:gut,blood"), "the dose -2 at index"),
])
def test_doses_in_memory_that_are_not_read(value, words):
    with pytest.raises(ValueError, match=words):
        Data([0.0], [[1.0]], ("DV",), inputs={"AMT": value})
