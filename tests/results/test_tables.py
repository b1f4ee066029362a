"""Tables: the numbers in them, their width, and their files."""

import math
import os

import numpy as np
import pandas as pd
import pytest

from lfm_ppl.results import arviz_data
from lfm_ppl.results.tables import format_number, markdown_table, text_table, write_csv, write_markdown
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


def test_format_number():
    values = {0.80123: "0.801", 0.0: "0", -0.05: "-0.0500", 9.9999: "10.0", 99.96: "100", 0.00099996: "0.00100",
              1234.5: "1234", 999999.0: "999999", 1e6: "1.00e+06", 9.99e-5: "9.99e-05", 3: "3",
              np.int64(12345678): "12345678", math.nan: "-", None: "-", -math.inf: "-inf", "text": "text"}
    assert {value: format_number(value) for value in values} == values
    assert format_number(True) == "True"
    numbers = np.concatenate([10.0 ** np.linspace(-8, 8, 97), -(10.0 ** np.linspace(-8, 8, 13))])
    for digits in (1, 2, 4, 6):
        errors = [abs(float(format_number(number, digits)) / number - 1.0) for number in numbers]
        assert max(errors) <= 0.5000001 * 10.0 ** (1 - digits)


def test_text_table(frame):
    lines = text_table(frame).splitlines()
    assert max(map(len, lines)) <= 80 and len(lines) == 5
    assert lines[2].split() == ["decay[CDKN1A]", "0.800", "0.100", "0.610", "1.00", "0.0012", "3012", "2950", "1.000"]
    assert lines[4].split()[-3:] == ["-", "-", "-"]
    assert len({len(line) for line in lines[1:]}) == 1, "the last column is aligned right"
    blocks = text_table(frame, width=40).split("\n\n")
    assert len(blocks) > 1 and all(block.count("decay[CDKN1A]") == 1 for block in blocks)
    assert max(len(line) for block in blocks for line in block.splitlines()) <= 40
    words = " ".join(" ".join(block.splitlines()[-4].split()) for block in blocks)
    assert words == "mean sd q2.5 q97.5 mean bulk tail r_hat"
    texts = pd.DataFrame({"name": ["x", "longer"], "count": [1, 22]}, index=["a", "b"])
    assert text_table(texts).splitlines() == ["   name    count", "a  x           1", "b  longer     22"]
    assert text_table(texts.iloc[:0]).split() == ["name", "count"]
    narrow = text_table(pd.DataFrame({"a": [1.0], "b": [2.0]}, index=["a_name_of_thirty_characters_ok"]), width=20)
    assert "1.00" in narrow and "2.00" in narrow


def test_markdown_table(frame, tmp_path):
    table = markdown_table(frame.rename(index={"mass": "a|b"}))
    lines = table.splitlines()
    assert lines[0].replace(" ", "") == "||" + "|".join(COLUMNS) + "|"
    assert lines[1].count("-:") == 8 and lines[1].count(":-") == 1 and r"| a\|b " in lines[4]
    path = write_markdown(frame, tmp_path / "summary.md")
    assert path.read_text(encoding="utf-8") == markdown_table(frame) + "\n"


def test_csv_keeps_full_precision_and_the_truth(tmp_path, result):
    frame = arviz_data.summary(result)
    path = write_csv(frame, tmp_path / "new" / "summary.csv")
    assert path.read_text().startswith("parameter,mean,sd,q2.5,q97.5,truth,mcse_mean,ess_bulk,ess_tail,r_hat\n")
    assert frame["truth"]["decay[SESN1]"] == 0.4 and np.isnan(frame["truth"]["noise_sd"])
    pd.testing.assert_frame_equal(pd.read_csv(path, index_col="parameter"), frame, check_names=False, rtol=1e-15)
    with pytest.raises(FileExistsError):
        write_csv(frame, path)
    write_csv(frame.iloc[:1], path, overwrite=True)
    assert len(path.read_text().splitlines()) == 2 and os.listdir(path.parent) == ["summary.csv"]


def test_a_killed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_write(path, overwrite=True) as temporary:
        temporary.write_text("half")
        assert temporary.parent == path.parent and temporary.suffix == ".csv"
        raise KeyboardInterrupt
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.csv"]
    new = tmp_path / "b.csv"
    with pytest.raises(FileExistsError), atomic_write(new) as temporary:
        temporary.write_text("ours")
        new.write_text("theirs")
    assert new.read_text() == "theirs" and sorted(os.listdir(tmp_path)) == ["a.csv", "b.csv"]
