"""Tables: what stands in them, and how they stand."""

import math
import os

import numpy as np
import pandas as pd
import pytest

from lfm_ppl.results import arviz_data
from lfm_ppl.results.tables import (
    format_number,
    markdown_table,
    text_table,
    write_csv,
    write_markdown,
)
from lfm_ppl.utils.atomic_files import atomic_write

COLUMNS = ["mean", "sd", "q2.5", "q97.5", "mcse_mean", "ess_bulk", "ess_tail", "r_hat"]


@pytest.fixture
def frame():
    rows = {
        "decay[CDKN1A]": [0.8, 0.1, 0.61, 1.0, 0.0012, 3012.4, 2950.0, 1.0004],
        "noise_variance": [2.3e-7, 1e-8, 1e-7, 3e-7, 1.04e-9, 400.0, 399.6, 1.0125],
        "mass": [-1234567.0, 20.0, -1300.0, -3.0, 0.2, np.nan, np.nan, np.nan],
    }
    return pd.DataFrame.from_dict(rows, orient="index", columns=COLUMNS)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.80123, "0.801"),
        (0.0, "0"),
        (-0.05, "-0.0500"),
        (9.9999, "10.0"),
        (99.96, "100"),
        (0.00099996, "0.00100"),
        (1234.5, "1234"),
        (999999.0, "999999"),
        (1e6, "1.00e+06"),
        (9.99e-5, "9.99e-05"),
        (3, "3"),
        (np.int64(12345678), "12345678"),
        (math.nan, "-"),
        (None, "-"),
        (-math.inf, "-inf"),
        (True, "True"),
        ("text", "text"),
    ],
)
def test_format_number(value, text):
    assert format_number(value) == text


@pytest.mark.parametrize("digits", [1, 2, 4, 6])
def test_format_number_keeps_the_digits(digits):
    values = np.concatenate([10.0 ** np.linspace(-8, 8, 97), -(10.0 ** np.linspace(-8, 8, 13))])
    for value in values:
        error = abs(float(format_number(value, digits)) / value - 1.0)
        assert error <= 0.5000001 * 10.0 ** (1 - digits), value


def test_text_table_is_aligned_and_80_wide(frame):
    lines = text_table(frame).splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) == 5  # one block: two lines of header, three rows
    assert lines[1].split() == ["mean", "sd", "q2.5", "q97.5", "mean", "bulk", "tail", "r_hat"]
    assert lines[0].split() == ["mcse", "ess", "ess"]
    assert len({len(line) for line in lines[1:]}) == 1  # the last column is aligned right
    assert lines[2].split() == [
        "decay[CDKN1A]", "0.800", "0.100", "0.610", "1.00", "0.0012", "3012", "2950", "1.000",
    ]  # fmt: skip
    assert lines[3].split()[-3:] == ["400", "400", "1.012"]
    assert lines[4].split()[-3:] == ["-", "-", "-"]


def test_text_table_continues_below_when_too_wide(frame):
    table = text_table(frame, width=40)
    assert max(map(len, table.splitlines())) <= 40
    blocks = table.split("\n\n")
    assert len(blocks) > 1
    assert all(block.count("decay[CDKN1A]") == 1 for block in blocks)
    words = " ".join(" ".join(block.splitlines()[-4].split()) for block in blocks)
    assert words == "mean sd q2.5 q97.5 mean bulk tail r_hat"


def test_text_table_keeps_names_that_are_wider_than_the_line():
    frame = pd.DataFrame({"a": [1.0], "b": [2.0]}, index=["a_name_of_thirty_characters_ok"])
    lines = text_table(frame, width=20).splitlines()
    assert [line for line in lines if line.endswith("1.00")]
    assert [line for line in lines if line.endswith("2.00")]


def test_text_table_of_text_and_of_nothing():
    frame = pd.DataFrame({"name": ["x", "longer"], "count": [1, 22]}, index=["a", "b"])
    assert text_table(frame).splitlines() == [
        "   name    count",
        "a  x           1",
        "b  longer     22",
    ]
    assert text_table(frame.iloc[:0]).split() == ["name", "count"]


def test_summary_of_a_result_fits_the_terminal(result):
    table = text_table(arviz_data.summary(result))
    assert max(map(len, table.splitlines())) <= 80
    assert table.count("\n\n") == 0


def test_markdown_table(frame):
    lines = markdown_table(frame.rename(index={"mass": "a|b"})).splitlines()
    assert lines[0].replace(" ", "") == "||" + "|".join(COLUMNS) + "|"
    assert set(lines[1]) <= set("|-: ")
    assert lines[1].count("-:") == 8 and lines[1].count(":-") == 1
    assert r"| a\|b " in lines[4]
    assert len({len(line) for line in lines}) == 1


def test_csv_keeps_full_precision(tmp_path, result):
    frame = arviz_data.summary(result)
    path = write_csv(frame, tmp_path / "new" / "summary.csv")
    assert path.read_text().startswith("parameter,mean,sd,q2.5,q97.5,")
    pd.testing.assert_frame_equal(
        pd.read_csv(path, index_col="parameter"), frame, check_names=False, rtol=1e-15
    )
    with pytest.raises(FileExistsError, match="already exists"):
        write_csv(frame, path)
    write_csv(frame.iloc[:1], path, overwrite=True)
    assert len(path.read_text().splitlines()) == 2
    assert os.listdir(path.parent) == ["summary.csv"]


def test_markdown_file(tmp_path, frame):
    path = write_markdown(frame, tmp_path / "summary.md")
    assert path.read_text(encoding="utf-8") == markdown_table(frame) + "\n"


def test_a_killed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_write(path, overwrite=True) as temporary:
        temporary.write_text("half")
        assert temporary.parent == path.parent and temporary.suffix == ".csv"
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.csv"]


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    path = tmp_path / "a.csv"
    with pytest.raises(FileExistsError), atomic_write(path) as temporary:
        temporary.write_text("ours")
        path.write_text("theirs")
    assert path.read_text() == "theirs"
    assert os.listdir(tmp_path) == ["a.csv"]
