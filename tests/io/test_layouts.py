"""Layouts of data files that people have: each is read right, or one line says what to change.

A layout is a name, the bytes of a file, keyword arguments of `read_csv`, and what is expected: the times and the first
value of the output, or words of the error or the warning.
"""

import datetime

import numpy as np
import pytest

from lfm_ppl.io.data import read_csv, read_table

HOURS = "2026-01-05 06:00,1\n2026-01-05 07:00,2\n2026-01-05 08:00,3\n"
PLAIN = "time,x\n0,1\n1,2\n2,3\n"
SEMICOLONS = PLAIN.replace(",", ";")


def nights(*rows):
    """Rows at local times without an offset from UTC."""
    return "date,x\n" + "".join(f"{row},{k}\n" for k, row in enumerate(rows, 1))


AUTUMN = nights(*(f"2026-10-25 {hour:02d}:00" for hour in (0, 1, 2, 2, 3, 4, 5)))
SPRING = nights(*(f"2026-03-29 {hour:02d}:00" for hour in (0, 1, 3, 4, 5, 6)))
NO_CHANGE = nights(*(f"2026-06-28 {hour:02d}:00" for hour in (0, 1, 3, 4, 5, 6)))

READ = [
    # separators, encodings, line ends
    ("commas", PLAIN, {}, [0, 1, 2]),
    ("byte-order mark", "\ufeff" + PLAIN, {}, [0, 1, 2]),
    ("lines of Windows", PLAIN.replace("\n", "\r\n"), {}, [0, 1, 2]),
    ("lines of old Macs", PLAIN.replace("\n", "\r"), {}, [0, 1, 2]),
    ("no line end", PLAIN.rstrip(), {}, [0, 1, 2]),
    ("sep= of a spreadsheet", "sep=,\n" + PLAIN, {}, [0, 1, 2]),
    ("quotes around all cells", '"time","x"\n"0","1"\n"1","2"\n"2","3"\n', {}, [0, 1, 2]),
    ("spaces after commas", PLAIN.replace(",", ", "), {}, [0, 1, 2]),
    ("name with a degree sign", PLAIN.replace("x", "T (°C)"), {}, [0, 1, 2]),
    # rows and columns beside the data
    ("comments", "# from the logger\n" + PLAIN.replace("1,2", "# note\n1,2"), {}, [0, 1, 2]),
    ("commented row of units", PLAIN.replace("x\n", "x\n#h,mg\n"), {}, [0, 1, 2]),
    ("blank lines", "\n" + PLAIN.replace("1,2", "\n1,2") + "\n\n", {}, [0, 1, 2]),
    ("empty rows at the end", PLAIN + ",\n,\n", {}, [0, 1, 2]),
    ("empty columns at the right", "time,x,,\n0,1,,\n1,2,,\n2,3,,\n", {}, [0, 1, 2]),
    ("commas at the end of some rows", PLAIN.replace("0,1", "0,1,,"), {}, [0, 1, 2]),
    ("numbers of rows of pandas", "Unnamed: 0,time,x\n0,0,1\n1,1,2\n2,2,3\n", {}, [0, 1, 2]),
    ("numbers of rows without a name", ",time,x\n0,0,1\n1,1,2\n2,2,3\n", {}, [0, 1, 2]),
    ("numbers of rows of R", '"rownames","time","x"\n"1",0,1\n"2",1,2\n"3",2,3\n', {}, [0, 1, 2]),
    ("one row", "time,x\n0,1\n", {}, [0]),
    ("column of notes", "time,x,note\n0,1,ok\n1,2,\n2,3,late\n", {"outputs": ["x"]}, [0, 1, 2]),
    # numbers and missing values
    ("NA, NaN and points", "time,x\n0,1\n1,NA\n2,.\n3,NaN\n", {}, [0, 1, 2, 3]),
    ("exponents", "time,x\n0,1e0\n1e1,2E-3\n2e1,3\n", {}, [0, 10, 20]),
    ("signs", "time,x\n-1,+1\n0,-2\n1,3\n", {}, [-1, 0, 1]),
    ("replicates", "time,replicate,x\n0,1,1\n0,2,1.1\n2,1,3\n", {}, [0, 0, 2]),
    ("unix time", "timestamp,x\n1700000000,1\n1700000060,2\n", {}, [1700000000, 1700000060]),
    # units and dates
    ("unit in the name", PLAIN.replace("time", "time_min"), {}, [0, 1, 2]),
    ("name in capitals", PLAIN.replace("time", "TIME"), {}, [0, 1, 2]),
    ("dates of hours", "date,x\n" + HOURS, {}, [6, 7, 8]),
    ("dates with T", "time,x\n" + HOURS.replace(" ", "T"), {}, [6, 7, 8]),
    ("dates with Z", "time,x\n" + HOURS.replace(":00,", ":00Z,"), {}, [6, 7, 8]),
    ("dates with an offset", "time,x\n" + HOURS.replace(":00,", ":00+01:00,"), {}, [6, 7, 8]),
    ("dates in an index without a name", "," "x\n" + HOURS, {}, [6, 7, 8]),
    ("days", "date,x\n2026-01-05,1\n2026-01-06,2\n2026-01-07,3\n", {}, [0, 1, 2]),
    ("days and hours mixed", "date,x\n2026-01-05,1\n2026-01-05 06:00,2\n2026-01-05 12:00,3\n", {"time_unit": "h"},
     [0, 6, 12]),
    ("fractions of seconds", "time,x\n2026-01-05T00:00:00.25,1\n2026-01-05T00:00:00.75,2\n", {}, [.25, .75]),
    ("YYYYMMDD under date", "date,x\n20260130,1\n20260131,2\n20260201,3\n", {}, [0, 1, 2]),
    ("YYYYMMDD and a unit", "time,x\n20260130,1\n20260131,2\n20260201,3\n", {"time_unit": "d"}, [0, 1, 2]),
    ("YYYYMMDD as the name", "YYYYMMDD,x\n20260130,1\n20260131,2\n20260201,3\n", {}, [0, 1, 2]),
    ("YYYYMMDDHH with hour 24", "date,x\n2026013022,1\n2026013023,2\n2026013024,3\n", {}, [22, 23, 24]),
    ("YYYYMMDDHHMM", "date,x\n202601302250,1\n202601302300,2\n202601302310,3\n", {}, [1370, 1380, 1390]),
    ("hours, and the date of the experiment", "time,date,x\n0,2026-01-05,1\n24,2026-01-06,2\n", {"outputs": ["x"]},
     [0, 24]),
    ("days, and hours of sunshine", "date,hours,x\n2026-01-05,3,1\n2026-01-06,7,2\n", {"outputs": ["x"]}, [0, 1]),
    ("years", "year,x\n1958,1\n1959,2\n1960,3\n", {"time_column": "year"}, [1958, 1959, 1960]),
    ("change of the clock with offsets", "time,x\n2026-10-25T02:00+02:00,1\n2026-10-25T02:00+01:00,2\n", {}, [2, 3]),
    ("a gap on a Sunday in June", NO_CHANGE, {}, [0, 1, 3, 4, 5, 6]),
]

REFUSED = [
    ("semicolons and commas", SEMICOLONS.replace("1\n", "1,5\n"), {}, "'time;x'"),
    ("semicolons", SEMICOLONS, {}, "commas between them"),
    ("tabs", PLAIN.replace(",", "\t"), {}, "commas between them"),
    ("spaces", PLAIN.replace(",", "  "), {}, "commas between them"),
    ("bars", PLAIN.replace(",", "|"), {}, "commas between them"),
    ("Latin-1", PLAIN.replace("x", "T °C").encode("latin-1"), {}, "UTF-8"),
    ("UTF-16", PLAIN.encode("utf-16"), {}, "UTF-8"),
    ("UTF-16 without a mark", PLAIN.encode("utf-16-le"), {}, "UTF-16"),
    ("spreadsheet", b"PK\x03\x04\x14\x00\x06\x00\x08\x00\xff\xfe", {}, "comma-separated"),
    ("web page", "<html>\n<body>not found</body>\n", {}, "CSV"),
    ("empty", "", {}, "empty"),
    ("comments only", "# a\n# b\n", {}, "empty"),
    ("header only", "time,x\n", {}, "no rows"),
    ("no header", "0,1\n1,2\n", {}, "first row of names"),
    ("row of units", PLAIN.replace("x\n", "x\nh,mg\n"), {}, "row of units"),
    ("short row", PLAIN.replace("1,2", "1"), {}, "row 3: 1 cells"),
    ("long row", PLAIN.replace("1,2", "1,2,7"), {}, "row 3: 3 cells"),
    ("decimal commas unquoted", "time,x\n0,1,5\n1,2,5\n", {}, "decimals with a point"),
    ("decimal comma", 'time,x\n0,"1,5"\n', {}, "1.5"),
    ("thousands", 'time,x\n0,"1,234"\n1,"2,345"\n', {}, "thousands, leave them out, 1234"),
    ("thousands and decimals", 'time,x\n0,"1.234,56"\n', {}, "1234.56"),
    ("unit in a cell", "time,x\n0,5 mg\n1,6 mg\n", {}, "unit in the name"),
    ("below a limit", "time,x\n0,<0.5\n1,2\n", {}, "CensoredObservation"),
    ("error of a spreadsheet", "time,x\n0,1\n1,#DIV/0!\n", {}, "'#DIV/0!'"),
    ("name twice", "time,x,x\n0,1,2\n", {}, "columns 2, 3"),
    ("no time", "hour,x\n0,1\n", {}, "--time-column"),
    ("two times", "time,t,x\n0,0,1\n", {}, "several time columns"),
    ("time missing", "time,x\n0,1\n,2\n", {}, "the time is missing"),
    ("rows out of order", "time,x\n0,1\n2,2\n1,3\n", {}, "Sort the rows"),
    ("day first", "date,x\n31/03/2026,1\n01/04/2026,2\n", {}, "2026-03-31"),
    ("month first", "date,x\n3/31/26,1\n4/1/26,2\n", {}, "2026-03-31"),
    ("names of months", "date,x\n5-Jan-2026,1\n6-Jan-2026,2\n", {}, "2026-03-31"),
    ("date and time of day", "date,time,x\n2026-01-05,06:00,1\n2026-01-05,07:00,2\n", {}, "'date'.*'time'.*one column"),
    ("date and hour", "YYYYMMDD,HH,x\n20260105,1,1\n20260105,2,2\n", {"outputs": ["x"]}, "'YYYYMMDD'.*'HH'"),
    ("date and hour that goes back", "date,time,x\n2026-01-05,12,1\n2026-01-06,6,2\n", {}, "'date'.*'time'"),
    ("time of day alone", "time,x\n06:00,1\n07:00,2\n", {}, "'06:00'"),
    ("offsets in some rows", "time,x\n2026-01-05T06:00Z,1\n2026-01-05T07:00,2\n", {}, "with an offset"),
    ("two subjects", "ID,TIME,DV\n1,0,9\n1,5,4\n2,6,9\n2,9,5\n", {}, "--series ID"),
    ("long table of outputs", "time,gene,x\n0,a,1\n0,b,2\n1,a,3\n1,b,4\n", {}, "give each of them a column"),
    ("clock set back, half hours", nights("2026-10-25 02:00", "2026-10-25 02:30", "2026-10-25 02:00"), {}, "offsets"),
]

WARNED = [
    ("YYYYMMDD under time", "time,x\n20260130,1\n20260131,2\n", {}, "dates YYYYMMDD"),
    ("serial dates", "date,x\n46052,1\n46053.5,2\n", {}, "2026-01-30"),
    ("an hour twice", AUTUMN, {}, "2026-10-25T02:00 occurs twice.*replicates.*an hour apart"),
    ("an hour skipped", SPRING, {}, "2026-03-29T02:00 is skipped.*120 min apart.*60 min apart"),
    ("code of a missing value", "time,x\n0,1.5\n1,-9999\n2,2.5\n3,2\n", {}, "-9999"),
    ("input with blanks", "time,x,heat\n0,1,1\n1,2,\n2,3,0\n", {"inputs": ["heat"]}, "blank"),
]


def names(layouts):
    return [layout[0] for layout in layouts]


@pytest.mark.parametrize("layout", READ, ids=names(READ))
def test_layouts_that_are_read(write, layout, recwarn):
    _, text, options, times = layout
    data = read_csv(write(text), **options)
    np.testing.assert_allclose(data.times, times, atol=1e-12)
    assert len(data.outputs) == 1 and data.y[0, 0] == 1 and not recwarn.list


@pytest.mark.parametrize("layout", REFUSED, ids=names(REFUSED))
def test_layouts_that_are_refused_in_one_line(write, layout):
    _, text, options, words = layout
    with pytest.raises(ValueError, match=words) as raised:
        read_csv(write(text), **options)
    assert "\n" not in str(raised.value) and "data.csv" in str(raised.value)


@pytest.mark.parametrize("layout", WARNED, ids=names(WARNED))
def test_layouts_that_are_read_with_a_warning(write, layout):
    _, text, options, words = layout
    with pytest.warns(UserWarning, match=words) as caught:
        read_csv(write(text), **options)
    assert len(caught) == 1 and "\n" not in str(caught[0].message)


def test_a_table_in_memory_is_read_alike():
    compact = {"date": [20260130, 20260131, 20260201], "x": [1.0, 2.0, 3.0]}
    assert read_table(compact).times.tolist() == [0, 1, 2]
    stamps = [datetime.datetime(2026, 3, 29, hour) for hour in (0, 1, 3, 4, 5)]
    with pytest.warns(UserWarning, match="skipped"):
        read_table({"date": stamps, "x": range(5)})
