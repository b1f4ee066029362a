"""Data files: what is read, and what a user is told about a file that cannot be."""

import numpy as np
import pytest

from lfm_ppl.io.data import read_csv, read_series, read_table, write_csv
from lfm_ppl.io.data_set import Data
from lfm_ppl.io.truth import read_truth, write_truth

P53 = """time_h,replicate,DDB2,CDKN1A
0,1,211.6,5.9
0,2,168.002,
2,1,482.582,117.017
"""


@pytest.fixture
def read(tmp_path):
    """Write a text to a file and read it."""

    def write_and_read(text, **options):
        path = tmp_path / "data.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_csv(path, **options)

    return write_and_read


def test_reads_times_values_missing_cells_and_the_unit(read):
    data = read(P53)
    np.testing.assert_array_equal(data.times, [0.0, 0.0, 2.0])
    np.testing.assert_array_equal(data.y, [[211.6, 5.9], [168.002, np.nan], [482.582, 117.017]])
    assert data.outputs == ("DDB2", "CDKN1A")
    assert data.units == {"time": "h"}


def test_reads_named_outputs_in_the_order_asked_for(read):
    data = read(P53, outputs=("CDKN1A", "replicate"))
    assert data.outputs == ("CDKN1A", "replicate")
    np.testing.assert_array_equal(data.y[:, 1], [1, 2, 1])


@pytest.mark.parametrize(
    "text",
    [
        "\ufefftime,x\n0,1\n1,2\n".encode(),  # byte-order mark of a spreadsheet
        b"time,x\r\n0,1\r\n1,2\r\n",
        b"# comment, with a comma\n time , x \n0, 1\n\n1,2\n",
        b'"Time","x"\n"0","1"\n"1","2"',
        b"t,x\n0,1\n1,2\n",
        b"when,x\n0,1\n1,2\n",
        b"time,x\n0,1\n1,2\n,\n",  # empty rows that a spreadsheet leaves at the end
    ],
)
def test_reads_files_as_programs_write_them(read, text):
    data = read(text, time_column="when" if text.startswith(b"when") else None)
    np.testing.assert_array_equal(data.times, [0, 1])
    np.testing.assert_array_equal(data.y, [[1], [2]])
    assert data.outputs == ("x",)


@pytest.mark.parametrize("cell", ["", "NA", "nan", "NaN", " "])
def test_missing_cells(read, cell):
    data = read(f"time,x,z\n0,{cell},1\n1,2,1\n")
    assert np.isnan(data.y[0, 0]) and data.y[1, 0] == 2


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (b"", {}, r"data\.csv is empty; expected a header row"),
        (b"\n\n", {}, r"data\.csv is empty"),
        (b"time,x\n", {}, r"data\.csv has a header and no rows"),
        (b"hour,x\n0,1\n", {}, r"no time column; expected .* got the columns hour, x\. Name it"),
        (b"time,t,x\n0,0,1\n", {}, r"several time columns: time, t"),
        (b"time,x\n0,1\n", {"time_column": "tine"}, r"unknown time column 'tine'.*'time'"),
        (b"time,x\n0,1\n1,high\n", {}, r"row 3, column 'x': expected a number .* got 'high'"),
        (b"# note\ntime,x\n0,1\n1,high\n", {}, r"row 4, column 'x'"),
        (b"time,x\n0,1\nlate,2\n", {}, r"row 3, column 'time': expected a number"),
        (b"time,x\n0,1\n,2\n", {}, r"row 3, column 'time': the time is missing"),
        (b"time,x\n0,1\ninf,2\n", {}, r"row 3, column 'time': expected a finite number, got 'inf'"),
        (b"time,x\n0,1\n1,inf\n", {}, r"row 3, column 'x': expected a finite number"),
        (b"time,x\n0,1\n4,1\n2,1\n", {}, r"row 4: the time goes back from 4 to 2\. Sort"),
        (b"time,x,x\n0,1,2\n", {}, r"row 1: the column name 'x' stands 2 times \(columns 2, 3\)"),
        (b"time,x\n0,\n1,NA\n", {}, r"every value of x is missing"),
        (b"time,x\n0,1,5\n", {}, r"row 2: 3 cells, but the header has 2 columns"),
        (b"time;x\n0;1,5\n", {}, r"separated by semicolons; expected commas"),
        (b"time\tx\n0\t1\n", {}, r"separated by tabs"),
        (b"time,replicate\n0,1\n", {}, r"no column beside the time 'time'"),
        (b"time,DDB2\n0,1\n", {"outputs": ["DDB3"]}, r"unknown output column 'DDB3'.*'DDB2'"),
        (b"PK\x03\x04\xff\xfe\x00", {}, r"is not a comma-separated text file"),
        (b"time,x\n0,1\n", {"outputs": []}, r"outputs must name at least one column, and each of them once; got \[\]"),
        (b"time,x\n0,1\n", {"outputs": ["x", "x"]}, r"each of them once; got \['x', 'x'\]"),
    ],
)
def test_complaints_name_the_place_and_the_remedy(read, text, options, message):
    with pytest.raises(ValueError, match=message):
        read(text, **options)


def test_a_folder_and_a_missing_file(tmp_path):
    with pytest.raises(ValueError, match="is a folder, not a CSV file"):
        read_csv(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_csv(tmp_path / "absent.csv")


def test_what_is_written_is_read_back(tmp_path):
    y = np.array([[0.1, np.nan], [1 / 3, 2e-300], [np.pi, -1.0]])
    truth = {
        "times": np.linspace(0, 1, 3),
        "forces": {"p53": np.array([1 / 3, 2.0, 3.0])},
        "state": np.ones((3, 2)),
        "parameters": {"decay": np.array([0.8, 0.5]), "scale": 1.0},
    }
    data = Data([0, 0, 1 / 7], y, ("a", "b"), units={"time": "h"}, truth=truth)
    write_csv(data, tmp_path / "d.csv")
    write_truth(data, tmp_path / "d.json")
    back = read_csv(tmp_path / "d.csv")
    np.testing.assert_array_equal(back.times, data.times)
    np.testing.assert_array_equal(back.y, y)
    assert (back.outputs, back.units) == (data.outputs, data.units)
    read = read_truth(tmp_path / "d.json")
    assert read.keys() == truth.keys()
    np.testing.assert_array_equal(read["forces"]["p53"], truth["forces"]["p53"])
    np.testing.assert_array_equal(read["parameters"]["decay"], [0.8, 0.5])


def test_truth_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match="no truth to write"):
        write_truth(Data([0.0], [[1.0]], ("x",)), tmp_path / "t.json")
    (tmp_path / "t.json").write_text("time,x\n")
    with pytest.raises(ValueError, match="is not a truth file"):
        read_truth(tmp_path / "t.json")


@pytest.mark.parametrize(
    ("times", "y", "message"),
    [
        ([0, 1], [[1.0]], r"shape \(times, outputs\) = \(2, 1\), got \(1, 1\)"),
        ([1, 0], [[1.0], [2.0]], r"must not go back, got 0 after 1 at index 1"),
        ([0, np.nan], [[1.0], [2.0]], "times must be finite"),
    ],
)
def test_data_checks_its_parts(times, y, message):
    with pytest.raises(ValueError, match=message):
        Data(times, y, ("x",))


def test_outputs_are_a_sequence_of_names(read):
    with pytest.raises(TypeError, match=r"sequence of column names, such as \['decay'\]"):
        read("time,decay\n0,1\n", outputs="decay")


def test_codes_of_missing_values_are_told(tmp_path):
    path = tmp_path / "d.csv"
    path.write_text("time,x,z\n0,1.5,-99\n1,-999,-101\n2,2.5,-98\n3,-999,-100\n")
    with pytest.warns(UserWarning, match=r"row 3, column 'x': -999.*\(2 of them\).*leave the cell empty") as said:
        read_csv(path)
    assert len(said) == 1  # z has -99 among its like
    path.write_text("time,x,z\n0,0,995\n1,0,999\n2,-9999,1003\n3,0,-999\n")
    with pytest.warns(UserWarning) as said:
        read_csv(path)
    assert sorted(str(one.message).split(": ")[1].split(",")[0] for one in said) == ["-999", "-9999"]


USUAL = np.round(np.sin(np.arange(30) / 3), 3)


@pytest.mark.parametrize("code", [
    -9, 99, -99, 999, -88.88, -99.9, 99.99, -999.25, 9999, -9999, 99999999, -888, 7777, 32767, -32768, -2147483648,
    1e20, 1e30, -1e34, 9.96921e36, 9.999e20, 3.4028235e38, 1.7e308, -1.7976931348623157e308,
])
@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_a_number_like_a_code_far_from_all_others_is_told(code, scale):
    y = np.where(np.isin(np.arange(30), [4, 20]), code, scale * USUAL)
    with pytest.warns(UserWarning, match=r"row 4, column 'x'.*taken as a measurement \(2 of them\)"):
        data = read_table({"time": np.arange(30), "x": y})
    np.testing.assert_array_equal(data.y[:, 0], y)


def test_several_codes_in_a_column_are_told():
    y = np.array([*USUAL, -99.0, -999.0, 9999.0])
    with pytest.warns(UserWarning) as said:
        read_table({"time": np.arange(33), "x": y}, inputs=[])
    assert len(said) == 3


def test_a_negative_code_among_numbers_that_are_not_is_told():
    flows = 5000 * np.linspace(0, 1, 40)**3
    with pytest.warns(UserWarning, match=r"row 40, column 'x': -999, far"):
        read_table({"time": np.arange(41), "x": np.append(flows, -999.0)})


@pytest.mark.parametrize("y", [
    [0, 3, 9, 12, 99, 80, 55, 60], [97, 98, 99, 99.9, 96], [-9, -3, 2, 5, -12, 8], [0.1, 0.99, 0.999, 9, 3],
    [1, 2, 4, 8, 16, 99, 128, 256, 512, 999], 2.0**np.arange(40), [1e30, 2e30, 3e30, 2.5e30], [990, 1001, 9.9e2, 999],
    [1, 0, 1, 9], [60, 65, 70, 99, 57.3, 1000.0], [10, 20, 4000.5, 12], np.linspace(0, 99, 50),
], ids=str)
def test_usual_numbers_are_no_codes(y, recwarn):
    read_table({"time": np.arange(len(y)), "x": np.asarray(y, float)})
    assert not recwarn


LONG = "ID,TIME,AMT,DV\n1,0,100,.\n1,24,.,9.2\n1,120,,2.5\n2,0,100,\n2,24,.,8.3\n2,120,,1.4\n"


def test_a_point_is_a_missing_value(read, tmp_path):
    assert read("time,x,dose\n0,.,1\n1, . ,2\n2,3,.\n", outputs=["x"]).y[:, 0].tolist()[2] == 3.0
    (tmp_path / "pk.csv").write_text(LONG)
    series = read_series(tmp_path / "pk.csv", "ID", outputs=["DV"])
    np.testing.assert_array_equal(series["2"].y[:, 0], [np.nan, 8.3, 1.4])
    with pytest.raises(ValueError, match="row 3, column 'time': the time is missing"):
        read("time,x\n0,1\n.,2\n")


def test_a_long_file_is_to_be_read_series_by_series(read):
    with pytest.raises(ValueError, match=r"row 5: the time goes back from 120 to 0, .*'ID' changes from 1 to 2.*"
                                         r"--series ID ") as raised:
        read(LONG, outputs=["DV"])
    assert "Sort" not in str(raised.value) and "\n" not in str(raised.value)
    other = LONG.replace("ID,", "who,").replace("\n1,", "\nanna,").replace("\n2,", "\nbert,")
    for text, options in ((LONG, {}), (other, {"outputs": ["DV"]}), (other, {"outputs": ["DV"], "inputs": ["AMT"]})):
        with pytest.raises(ValueError, match=r"--series (ID|who) "):
            read(text, **options)
    with pytest.raises(ValueError, match="--series ID "):  # rows of a series need not stand together
        read("id,time,x\nA,0,1\nB,5,1\nA,3,1\nB,7,1\n".replace("id", "ID"), outputs=["x"])


@pytest.mark.parametrize("text", [
    "time,replicate,x\n0,1,1\n1,1,2\n0,2,1\n1,2,2\n", "time,dose,x\n0,1,1\n1,0,2\n0,1,1\n1,0,2\n",
    "time,x\n0,1\n2,2\n1,3\n", "ID,time,x\n1,0,1\n1,2,2\n1,1,3\n", "ID,time,x\n1,0,1\n1,2,2\n,1,3\n2,3,3\n",
], ids=["replicates", "no identifiers", "no other column", "within a series", "a series without a name"])
def test_times_out_of_order_are_to_be_sorted(read, text):
    with pytest.raises(ValueError, match="Sort the rows by time"):
        read(text, outputs=["x"])
