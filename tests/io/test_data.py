"""Data files and tables: the numbers in them, and one line on what cannot be read."""

import numpy as np
import pytest

from lfm_ppl.io.data import read_csv, read_series, read_table, write_csv
from lfm_ppl.io.data_set import Data, stack_series
from lfm_ppl.io.truth import read_truth, write_truth

P53 = "time_h,replicate,DDB2,CDKN1A\n0,1,211.6,5.9\n0,2,168.002,\n2,1,482.582,117.017\n"
LONG = "ID,TIME,AMT,DV\n1,0,100,.\n1,24,.,9.2\n1,120,,2.5\n2,0,100,\n2,24,.,8.3\n2,120,,1.4\n"


def test_times_values_missing_cells_and_the_unit_are_read(write):
    data = read_csv(write(P53))
    np.testing.assert_array_equal(data.times, [0.0, 0.0, 2.0])
    np.testing.assert_array_equal(data.y, [[211.6, 5.9], [168.002, np.nan], [482.582, 117.017]])
    assert (data.outputs, data.units) == (("DDB2", "CDKN1A"), {"time": "h"})
    named = read_csv(write(P53.replace("time_h", "time_hours")), outputs=("CDKN1A", "replicate"), time_unit="h")
    assert (named.outputs, named.units) == (("CDKN1A", "replicate"), {"time": "h"})
    np.testing.assert_array_equal(named.y[:, 1], [1, 2, 1])


@pytest.mark.parametrize("text", [
    "\ufefftime,x\n0,1\n1,2\n".encode(),  # byte-order mark of a spreadsheet
    b"time,x\r\n0,1\r\n1,2\r\n",
    b"# comment, with a comma\n time , x \n0, 1\n\n1,2\n",
    b'"Time","x"\n"0","1"\n"1","2"',
    b"t,x\n0,1\n1,2\n",
    b"when,x\n0,1\n1,2\n",
    b"time,x\n0,1\n1,2\n,\n",  # empty rows that a spreadsheet leaves at the end
])
def test_files_are_read_as_programs_write_them(write, text):
    data = read_csv(write(text), time_column="when" if text.startswith(b"when") else None)
    np.testing.assert_array_equal(data.times, [0, 1])
    np.testing.assert_array_equal(data.y, [[1], [2]])
    assert data.outputs == ("x",)


def test_rows_are_counted_as_in_an_editor_and_cells_may_hold_a_hash_and_lines(write):
    text = '# note\ntime,x,note\n0,1,"first\nsecond"\n\n1,2,plant #3\n2,high,\n'
    assert read_csv(write(text.replace("high", "3")), ["x"]).y.ravel().tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match="row 7, column 'x'.*'high'"):
        read_csv(write(text), ["x"])
    with pytest.raises(ValueError, match="'plant #3'"):
        read_csv(write(text.replace('"first\nsecond"', "1")), ["note"])


@pytest.mark.parametrize("cell", ["", "NA", "nan", "NaN", " ", "."])
def test_missing_cells(write, cell):
    data = read_csv(write(f"time,x,z\n0,{cell},1\n1,2,1\n"))
    assert np.isnan(data.y[0, 0]) and data.y[1, 0] == 2


@pytest.mark.parametrize(("text", "options", "words"), [
    (b"", {}, ["empty"]), (b"time,x\n", {}, ["no rows"]), (b"PK\x03\x04\xff\xfe\x00", {}, ["comma-separated"]),
    (b"time;x\n0;1,5\n", {}, ["'time;x'", "commas"]), (b"time,x\n0,1,5\n", {}, ["row 2", "3 cells"]),
    (b"time,x\n0\n", {}, ["row 2", "1 cells"]), (b"time,x,x\n0,1,2\n", {}, ["'x'", "columns 2, 3"]),
    (b"hour,x\n0,1\n", {}, ["hour, x", "--time-column"]), (b"time,t,x\n0,0,1\n", {}, ["time, t"]),
    (b"time,x\n0,1\n", {"time_column": "tine"}, ["'tine'", "'time'"]),
    (b"time,x\n0,1\n1,high\n", {}, ["row 3, column 'x'", "'high'"]),
    (b'time,x\n0,"1,5"\n', {}, ["row 2, column 'x'", "'1,5'", "1.5"]),
    (b"time,x\n0,1\nlate,2\n", {}, ["row 3, column 'time'", "'late'"]),
    (b"time,x\n0,1\n,2\n", {}, ["row 3, column 'time'"]), (b"time,x\n0,1\n.,2\n", {}, ["row 3, column 'time'"]),
    (b"time,x\n0,1\ninf,2\n", {}, ["row 3, column 'time'", "'inf'"]),
    (b"time,x\n0,1\n1,inf\n", {}, ["row 3, column 'x'", "finite"]),
    (b"time,x\n0,1\n4,1\n2,1\n", {}, ["row 4", "from 4 to 2", "Sort"]), (b"time,x\n0,\n1,NA\n", {}, ["x", "missing"]),
    (b"time,replicate\n0,1\n", {}, ["output column", "'time'"]),
    (b"time,DDB2\n0,1\n", {"outputs": ["DDB3"]}, ["'DDB3'", "'DDB2'"]), (b"time,x\n0,1\n", {"outputs": []}, ["output"]),
    (b"time,x\n0,1\n", {"outputs": ["x", "x"]}, ["['x', 'x']"]),
])
def test_errors_are_one_line_with_file_place_value_and_remedy(write, text, options, words):
    with pytest.raises(ValueError) as raised:
        read_csv(write(text), **options)
    message = str(raised.value)
    assert "\n" not in message and all(word in message for word in ["data.csv", *words]), message


def test_a_folder_a_missing_file_and_a_single_name(tmp_path, write):
    with pytest.raises(IsADirectoryError):
        read_csv(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_csv(tmp_path / "absent.csv")
    with pytest.raises(TypeError, match=r"\['decay'\]"):
        read_csv(write("time,decay\n0,1\n"), outputs="decay")


def test_data_and_truth_are_written_and_read_back(tmp_path):
    y = np.array([[0.1, np.nan], [1 / 3, 2e-300], [np.pi, -1.0]])
    truth = {"times": np.linspace(0, 1, 3), "forces": {"p53": np.array([1 / 3, 2.0, 3.0])}, "state": np.ones((3, 2)),
             "parameters": {"decay": np.array([0.8, 0.5]), "scale": 1.0}}
    data = Data([0, 0, 1 / 7], y, ("a", "b"), units={"time": "h"}, truth=truth)
    write_csv(data, tmp_path / "d.csv")
    write_truth(data, tmp_path / "d.json")
    loaded = read_csv(tmp_path / "d.csv")
    np.testing.assert_array_equal(loaded.times, data.times)
    np.testing.assert_array_equal(loaded.y, y)
    assert (loaded.outputs, loaded.units) == (data.outputs, data.units)
    read = read_truth(tmp_path / "d.json")
    assert read.keys() == truth.keys()
    np.testing.assert_array_equal(read["forces"]["p53"], truth["forces"]["p53"])
    np.testing.assert_array_equal(read["parameters"]["decay"], [0.8, 0.5])
    with pytest.raises(ValueError, match="no truth"):
        write_truth(loaded, tmp_path / "t.json")
    with pytest.raises(ValueError, match="d.csv"):
        read_truth(tmp_path / "d.csv")


@pytest.mark.parametrize(("times", "y", "words"), [
    ([0, 1], [[1.0]], r"\(2, 1\).*\(1, 1\)"), ([1, 0], [[1.0], [2.0]], "index 1"), ([0, np.nan], [[1], [2]], "times")])
def test_data_checks_its_parts(times, y, words):
    with pytest.raises(ValueError, match=words):
        Data(times, y, ("x",))


USUAL = np.round(np.sin(np.arange(30) / 3), 3)


@pytest.mark.parametrize("code", [
    -9, 99, -99, 999, -88.88, -99.9, 99.99, -999.25, 9999, -9999, 99999999, -888, 7777, 32767, -32768, -2147483648,
    1e20, 1e30, -1e34, 9.96921e36, 9.999e20, 3.4028235e38, 1.7e308, -1.7976931348623157e308,
])
@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_a_code_of_missing_values_is_reported(code, scale):
    y = np.where(np.isin(np.arange(30), [4, 20]), code, scale * USUAL)
    with pytest.warns(UserWarning, match=r"row 4, column 'x'.*\(2 of them\)"):
        data = read_table({"time": np.arange(30), "x": y})
    np.testing.assert_array_equal(data.y[:, 0], y)


@pytest.mark.parametrize(("y", "codes"), [
    ([*USUAL, -99.0, -999.0, 9999.0], ["-99", "-999", "9999"]), ([*5000 * np.linspace(0, 1, 40)**3, -999.0], ["-999"]),
    ([0, 0, -9999, 0], ["-9999"]), ([1.5, -999, 2.5, -999], ["-999"]), ([995, 999, 1003, -999], ["-999"]),
    ([-99, -101, -98, -100], []), ([0, 3, 9, 12, 99, 80, 55, 60], []), ([97, 98, 99, 99.9, 96], []),
    ([-9, -3, 2, 5, -12, 8], []), ([0.1, 0.99, 0.999, 9, 3], []), ([1, 2, 4, 8, 16, 99, 128, 256, 512, 999], []),
    (2.0**np.arange(40), []), ([1e30, 2e30, 3e30, 2.5e30], []), ([990, 1001, 9.9e2, 999], []), ([1, 0, 1, 9], []),
    ([60, 65, 70, 99, 57.3, 1000.0], []), ([10, 20, 4000.5, 12], []), (np.linspace(0, 99, 50), []),
], ids=str)
def test_codes_are_far_from_the_other_numbers(y, codes, recwarn):
    read_table({"time": np.arange(len(y)), "x": np.asarray(y, float)})
    assert sorted(str(warning.message).split(": ")[1].split(",")[0] for warning in recwarn) == codes


def test_a_long_file_is_read_series_by_series(write):
    path = write(LONG)
    np.testing.assert_array_equal(read_series(path, "ID", outputs=["DV"])["2"].y[:, 0], [np.nan, 8.3, 1.4])
    with pytest.raises(ValueError, match="row 5.* from 120 to 0.*'ID' changes from 1 to 2.*--series ID ") as raised:
        read_csv(path, outputs=["DV"])
    assert "Sort" not in str(raised.value)
    renamed = LONG.replace("ID,", "who,").replace("\n1,", "\nanna,").replace("\n2,", "\nbert,")
    for text, options in ((LONG, {}), (renamed, {"outputs": ["DV"]}), (renamed, {"outputs": ["DV"], "inputs": ["AMT"]}),
                          ("ID,time,x\nA,0,1\nB,5,1\nA,3,1\nB,7,1\n", {"outputs": ["x"]})):  # rows may be mixed
        with pytest.raises(ValueError, match="--series (ID|who) "):
            read_csv(write(text), **options)


@pytest.mark.parametrize("text", [
    "time,replicate,x\n0,1,1\n1,1,2\n0,2,1\n1,2,2\n", "time,dose,x\n0,1,1\n1,0,2\n0,1,1\n1,0,2\n",
    "time,x\n0,1\n2,2\n1,3\n", "ID,time,x\n1,0,1\n1,2,2\n1,1,3\n", "ID,time,x\n1,0,1\n1,2,2\n,1,3\n2,3,3\n",
], ids=["replicates", "no identifiers", "no other column", "within a series", "a series without a name"])
def test_times_out_of_order_are_to_be_sorted(write, text):
    with pytest.raises(ValueError, match="Sort the rows by time"):
        read_csv(write(text), outputs=["x"])


@pytest.mark.parametrize("text", [
    "ID,TIME,x\n1,0,9\n1,5,4\n2,6,9\n2,9,5\n", "ID,TIME,x\n1,0,9\n2,0,8\n1,5,4\n2,5,3\n",
    "patient,time,x\nAnn,0,9\nBob,0,8\nAnn,5,4\nBob,5,3\n", "PatientID,time,x\n7,0,9\n7,1,8\n9,1,4\n",
    "cage,time,x\nA,0,9\nB,0,8\nA,5,4\nB,5,3\nA,7,3\n", "rat,time,x\n1,0,9\n1,5,4\n2,6,9\n2,9,5\n",
    "variant,time,x\n1,0,9\n2,0,8\n1,5,4\n2,5,3\n", "strain,time,x\nwt,0,9\nko,0,8\nwt,5,4\nko,5,3\n",
], ids=lambda text: text[:20].replace("\n", " "))
def test_series_whose_times_do_not_go_back_are_not_merged(write, text):
    column = text.partition(",")[0]
    with pytest.raises(ValueError, match=f"column '{column}' changes from .*--series {column} "):
        read_csv(write(text), outputs=["x"])
    assert len(read_series(write(text), column, outputs=["x"])) == 2


@pytest.mark.parametrize("text", [
    "time,weather,x\n0,dry,9\n1,dry,8\n2,wet,7\n3,wet,5\n4,dry,3\n",  # a factor
    "time,weather,x\n0,dry,9\n0,dry,8\n2,wet,7\n2,wet,5\n",  # with replicates
    "time,heater,x\n0,1,9\n1,1,8\n2,0,7\n3,0,5\n", "time,count,x\n0,3,9\n0,5,8\n2,5,7\n2,4,5\n",
    "time,replicate,x\n0,1,9\n0,2,8\n1,1,3\n1,2,4\n", "time,tech_rep,x\n0,a,9\n0,b,8\n1,a,3\n1,b,4\n",
    "time,id,x\n0,1,9\n1,2,8\n2,3,3\n", "time,animal,x\n0,1,9\n0,2,8\n2,3,3\n2,4,3\n",  # each measured once
    "time,ID,x\n0,7,9\n1,7,8\n2,7,3\n", "time,dose,x\n0,1.5,9\n0,2.5,8\n1,1.5,3\n1,2.5,3\n",
    "time,day,x\n0,1,9\n12,1,8\n24,2,7\n36,2,5\n", "time,rat1,rat2,x\n0,3,4,9\n1,3,5,9\n2,4,5,8\n",
    "time,ID,x\n0,,9\n1,,8\n2,,3\n", "time,group,x\n0,a,9\n1,a,8\n2,b,3\n3,b,2\n",
    "time,who,x\n0,Ann,9\n1,Bo,8\n2,Ann,3\n3,Bo,2\n", "time,name,x\n0,calm,9\n1,calm,8\n2,storm,3\n3,storm,2\n",
], ids=lambda text: text[5:30].replace("\n", " "))
def test_columns_that_do_not_identify_series_raise_no_alarm(write, text):
    assert read_csv(write(text), outputs=["x"]).y[0, 0] == 9


def test_outputs_with_names_of_subjects_are_measurements(write):
    assert read_csv(write("time,sheep,wolves\n0,3,1\n1,3,1\n2,4,2\n3,4,2\n")).outputs == ("sheep", "wolves")
    assert read_csv(write("time,series\n0,3\n1,3\n2,4\n3,4\n")).outputs == ("series",)
    assert read_csv(write("time,ID,x\n0,1,9\n1,2,8\n2,1,3\n"), inputs=["ID"]).outputs == ("x",)


def test_series_are_stacked_with_rows_all_missing_and_one_origin(write):
    path = write("date,x,who\n2026-01-05 06:00,1,b\n2026-01-04 12:00,2,a\n2026-01-05 18:00,3,b\n")
    panel = stack_series(read_series(path, "who", time_unit="h"))
    assert panel.series == ("b", "a") and panel.origin == "2026-01-04T00:00:00"
    np.testing.assert_array_equal(panel.times, [[30.0, 42.0], [12.0, 12.0]])
    np.testing.assert_array_equal(panel.y[..., 0], [[1.0, 3.0], [2.0, np.nan]])
    with pytest.raises(ValueError, match="known inputs"):
        stack_series({"a": Data([0.0], [[1.0]], ("x",), inputs={"dose": ([0.0], [1.0])}),
                      "b": Data([0.0], [[1.0]], ("x",))})
    with pytest.raises(ValueError, match="'b'"):
        stack_series({"a": Data([0.0], [[1.0]], ("x",)), "b": Data([0.0], [[1.0]], ("z",))})


def test_known_inputs_of_series_are_stacked_for_the_model():
    def data(times, values):
        return Data([0.0, 1.0], [[1.0], [2.0]], ("x",), inputs={
            "dose": (times, values, "dose:gut"), "heat[K]": ([0.0, *times[1:]], values)})

    panel = stack_series({"a": data([0.0], [3.0]), "b": data([0.5, 2.0], [1.0, 4.0])})
    (dose,), heat = panel.doses(), panel.known_inputs()["heat[K]"]
    assert dose.state == "gut" and list(panel.inputs)[0] == "dose of series a"
    np.testing.assert_array_equal(dose.times, [[0.0, np.finfo(float).max], [0.5, 2.0]])  # a dose that never happens
    np.testing.assert_array_equal(dose.values, [[3.0, 0.0], [1.0, 4.0]])
    np.testing.assert_array_equal(heat.values, [[3.0, 3.0], [1.0, 4.0]])
