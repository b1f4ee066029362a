"""SP3 files: what is read, how days connect, and the messages about files that cannot be read."""

import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from lfm_ppl.orbits import Ephemerides, calendar, gps_seconds, read_sp3

ROOT = Path(__file__).resolve().parent.parent.parent
GPS = Path(os.environ.get("LFM_DATA", ROOT.parent / "shared" / "data")) / "gps"
needs_gps = pytest.mark.skipif(not GPS.is_dir(), reason=f"{GPS} is not there; LFM_DATA says where")

START = gps_seconds(2019, 4, 7)
STEP = 21600.0  # four epochs a day
SATELLITES = ("G05", "G32", "E01")
COMMENTS = {"c": ["/* A COMMENT", "/*", "/* ", "/*"], "d": ["/* " + "A LONG COMMENT " * 5]}


def circle(epochs, satellites=SATELLITES):
    """Positions on circles, kilometres, to the six decimals of a file: (T, S, 3)."""
    radius = np.array([26560.0 + 100 * sum(map(ord, name)) for name in satellites])
    angle = np.asarray(epochs)[:, None] / 6856.0 + radius
    positions = radius[:, None] * np.stack([np.cos(angle), np.sin(angle), 0.5 * np.sin(angle)], axis=-1)
    return np.round(positions, 6)


def sp3(day=0, epochs=4, satellites=SATELLITES, positions=None, version="c", system="GPS", step=STEP, frame="IGb08",
        velocities=False):
    """The lines of a file that begins `day` days after START, in the columns of the format."""
    start = START + 86400.0 * day
    times = start + step * np.arange(epochs)
    positions = circle(times, satellites) if positions is None else positions
    week, second = divmod(start, 604800)
    mjd, fraction = divmod(44244 + start / 86400, 1)
    rows = -(-len(satellites) // 17) if version == "d" else max(5, -(-len(satellites) // 17))
    names = [*satellites, *["  0"] * (17 * rows - len(satellites))]
    lines = [f"#{version}{'V' if velocities else 'P'}{date(start)} {epochs:7d} ORBIT {frame} FIT  WHU",
             f"## {week:4.0f} {second:15.8f} {step:14.8f} {mjd:5.0f} {fraction:15.13f}"]
    for row in range(rows):
        count = f"+  {len(satellites):3d}   " if row == 0 else "+        "
        lines.append(count + "".join(names[17 * row : 17 * (row + 1)]))
    lines += ["++       " + "  0" * 17] * rows
    lines += [f"%c M  cc {system} ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc",
              "%c cc cc ccc ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc",
              "%f  1.2500000  1.025000000  0.00000000000  0.000000000000000",
              "%f  0.0000000  0.000000000  0.00000000000  0.000000000000000"]
    lines += ["%i    0    0    0    0      0      0      0      0         0"] * 2
    lines += COMMENTS[version]
    for time, row in zip(times, positions, strict=True):
        lines.append(f"*  {date(time)}")
        for name, (x, y, z) in zip(satellites, row, strict=True):
            lines.append(f"P{name}{x:14.6f}{y:14.6f}{z:14.6f}{1.117283:14.6f}")
            if velocities:
                lines.append("EP    55   55   55     222  1234567 -1234567  5999999      -30       21 -1230000")
                lines.append(f"V{name}{x:14.6f}{y:14.6f}{z:14.6f}{0:14.6f}")
    return [*lines, "EOF"]


def date(epoch):
    """2019  4  7  0  0  0.00000000"""
    day, time = calendar(epoch).split()
    (year, month, day), (hour, minute, second) = map(int, day.split("-")), map(int, time.split(":"))
    return f"{year:4d} {month:2d} {day:2d} {hour:2d} {minute:2d} {second:11.8f}"


@pytest.fixture
def write(tmp_path):
    """Write the lines of a file."""

    def write_lines(lines, name="a.sp3"):
        path = tmp_path / name
        data = ("\n".join(lines) + "\n").encode()
        path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
        return path

    return write_lines


def line_of(lines, text, occurrence=0):
    """The number of a line as an editor counts it."""
    return [number for number, line in enumerate(lines, 1) if line.startswith(text)][occurrence]


def test_reads_what_was_written(write):
    for name in ("a.sp3", "A.SP3.gz", "other.txt"):
        for version, velocities in (("c", False), ("d", True)):
            orbits = read_sp3(write(sp3(version=version, velocities=velocities), name))
            assert orbits.satellites == ("E01", "G05", "G32")
            assert (orbits.interval, orbits.frame, orbits.agency, orbits.days) == (STEP, "IGb08", "WHU", 1.0)
            np.testing.assert_array_equal(orbits.epochs, START + STEP * np.arange(4))
            np.testing.assert_array_equal(orbits.positions, circle(orbits.epochs, orbits.satellites))
            assert orbits.positions.dtype == orbits.epochs.dtype == np.float64


@pytest.mark.parametrize("version", ["c", "d"])
def test_more_satellites_than_fit_a_line_of_the_header(write, version):
    names = tuple(f"{system}{number:02d}" for system in "GREC" for number in range(1, 31))
    orbits = read_sp3(write(sp3(satellites=names, version=version)), ["C30", "G01"])
    np.testing.assert_array_equal(orbits.positions, circle(orbits.epochs, ("C30", "G01")))


@pytest.mark.parametrize("change", [
    lambda line: line + "  \r", lambda line: line.replace("G05", "G 5"), *(
        lambda line, ending=ending: line[:46] + ending if line.startswith("P") else line for ending in (
            "", "     -4.812044 19 18 17 219 EP  MP", f"{'':14} 19 18 17{'':9}MP", f"{'':32}MP", " 999999.9999"))])
def test_other_spellings_of_the_same(write, change):
    """Windows' line ends, names with a blank, and whatever follows a position."""
    orbits = read_sp3(write([*map(change, sp3()), ""]), include=["predicted", "manoeuvres"])
    assert orbits.satellites == ("E01", "G05", "G32")
    np.testing.assert_array_equal(orbits.positions, circle(orbits.epochs, orbits.satellites))


def test_gps_time_is_not_utc(write):
    assert gps_seconds(1980, 1, 6) == 0
    assert divmod(gps_seconds(2019, 4, 7), 604800) == (2048, 0)
    # 2017-01-01 00:00:00 UTC, after the last leap second, is 18 s later in GPS time; the well-known 1167264018.
    assert gps_seconds(2017, 1, 1, second=18) == 1167264018
    assert gps_seconds(2019, 4, 7, 24) == gps_seconds(2019, 4, 8)
    assert calendar(gps_seconds(2020, 2, 29, 23, 59, 59.5)) == "2020-02-29 23:59:59.500000"
    for system, seconds in (("GAL", 0), ("QZS", 0), ("IRN", 0), ("TAI", -19), ("BDT", 14)):
        assert read_sp3(write(sp3(system=system))).epochs[0] == START + seconds


def test_missing_positions(write):
    """Marked by zeros or nines, or without a line; one coordinate of zero is a position."""
    for absent in ([0, 0, 0], [999999.999999] * 3, [1.0, 2.0, 999999.999999]):
        positions = circle(START + STEP * np.arange(4))
        positions[0, 0, 0], positions[1, 2] = 0.0, absent
        lines = sp3(positions=positions)
        del lines[line_of(lines, "PG05", 2) - 1]
        orbits = read_sp3(write(lines), SATELLITES)
        positions[1, 2] = positions[2, 0] = np.nan
        np.testing.assert_array_equal(orbits.positions, positions)
        assert str(orbits.gaps("E01")[0]) == "2019-04-07 06:00:00 GPS"


def test_days_connect_in_any_order_and_satellites_come_and_go(write, tmp_path):
    write(sp3(1, satellites=("G05", "G06")), "a.SP3.gz")
    write(sp3(2), "b.sp3.gz")
    write(sp3(0), "c.sp3")
    (tmp_path / "notes.txt").write_text("not an orbit")
    orbits = read_sp3(tmp_path)
    assert [Path(file).name for file in orbits.files] == ["c.sp3", "a.SP3.gz", "b.sp3.gz"]
    assert orbits.satellites == ("E01", "G05", "G06", "G32") and orbits.days == 3
    np.testing.assert_array_equal(orbits.epochs, START + STEP * np.arange(12))
    expected = circle(orbits.epochs, orbits.satellites)
    expected[4:8, [0, 3]] = expected[:4, 2] = expected[8:, 2] = np.nan
    np.testing.assert_array_equal(orbits.positions, expected)
    assert [str(gap) for gap in orbits.gaps("G06")] == [
        "2019-04-07 00:00:00 to 2019-04-07 18:00:00 GPS", "2019-04-09 00:00:00 to 2019-04-09 18:00:00 GPS"]
    assert orbits.gaps("G05") == []
    selection = read_sp3(tmp_path, satellites=["G32", "G06"])
    np.testing.assert_array_equal(selection.positions, orbits.select(["G32", "G06"]).positions)
    assert selection.satellites == orbits.select(["G32", "G06"]).satellites == ("G32", "G06")


def flagged(lines, flags):
    """Lines with flags at their ends: (beginning, occurrence) -> columns 61 to 80."""
    for (text, occurrence), columns in flags.items():
        number = line_of(lines, text, occurrence) - 1
        lines[number] = lines[number].ljust(60) + columns
    return lines


PREDICTED, MANOEUVRE, CLOCK = " " * 15 + "P   P", " " * 18 + "M", " " * 14 + "EP"
"""An orbit and its clock are predicted; a manoeuvre; only the clock is predicted, after an event."""


def test_predicted_positions_and_manoeuvres_are_left_out_unless_they_are_named(write, recwarn):
    path = write(flagged(sp3(), {("PG05", 1): MANOEUVRE, ("PG05", 2): PREDICTED, ("PG05", 3): PREDICTED,
                                 ("PG32", 1): PREDICTED[:-1] + "  ", ("PE01", 3): CLOCK}))
    all_positions = circle(START + STEP * np.arange(4), ["E01", "G05", "G32"])
    for include, rows in (([], [1, 2, 3]), (["predicted"], [1]), (["manoeuvres"], [2, 3]),
                          (["manoeuvres", "predicted"], [])):
        expected = all_positions.copy()
        expected[rows, 1] = np.nan
        np.testing.assert_array_equal(read_sp3(path, include=include).positions, expected)
    messages = [str(warning.message) for warning in recwarn]
    assert len(messages) == 3 and "2 predicted (flag P) and 1 at epochs of a manoeuvre (flag M)" in messages[0]
    assert "a.sp3" in messages[0] and "include=['predicted', 'manoeuvres']" in messages[0]
    assert read_sp3(path, ["E01"]).gaps("E01") == [] and len(recwarn) == 3  # of another satellite
    with pytest.raises(ValueError, match="'prediction'.*'predicted'"):
        read_sp3(path, include=["prediction"])
    with pytest.raises(TypeError, match="'predicted'"):
        read_sp3(path, include="predicted")


def test_a_prediction_is_replaced_by_the_position_of_a_later_file(write):
    first = flagged(sp3(epochs=5), {("PG05", 4): PREDICTED})
    wrong = line_of(first, "PG05", 4) - 1
    first[wrong] = first[wrong].replace(first[wrong][4:18], f"{20000:14.6f}")
    files = [write(first, "a.sp3"), write(sp3(1), "b.sp3")]
    with pytest.warns(UserWarning, match="1 predicted"):
        orbits = read_sp3(files)
    np.testing.assert_array_equal(orbits.positions, circle(orbits.epochs, orbits.satellites))
    with pytest.raises(ValueError, match="G05"):
        read_sp3(files, include=["predicted"])


def test_a_midnight_in_both_files_is_kept_once(write):
    second = circle(START + 86400 + STEP * np.arange(4))
    second[0, 0, 0] += 9e-6  # 9 mm
    orbits = read_sp3([write(sp3(1, positions=second), "b.sp3"), write(sp3(epochs=5), "a.sp3")])
    np.testing.assert_array_equal(orbits.positions, circle(START + STEP * np.arange(8), orbits.satellites))
    second[0, 1, 2] += 1.1e-5
    paths = [write(sp3(epochs=5), "a.sp3"), write(sp3(1, positions=second), "b.sp3")]
    with pytest.raises(ValueError, match=r"b\.sp3.*G32"):
        read_sp3(paths)
    assert read_sp3(paths, ["G05"]).days == 2  # nothing wrong with the others
    np.testing.assert_array_equal(read_sp3(paths, tolerance=1e-4).positions, orbits.positions)
    first = circle(START + STEP * np.arange(5))
    first[4, 0] = 0.0  # missing in one of the files
    orbits = read_sp3([write(sp3(epochs=5, positions=first), "a.sp3"), write(sp3(1), "b.sp3")])
    np.testing.assert_array_equal(orbits.positions, circle(orbits.epochs, orbits.satellites))


@pytest.mark.parametrize(("second", "line"), [
    (sp3(2), 1), (sp3(1, step=STEP / 2), 2), (sp3(1, frame="IGS14"), 1), (sp3(1, system="TAI"), 13), (sp3(1.125), 1)])
def test_days_that_do_not_connect(write, second, line):
    with pytest.raises(ValueError, match=rf"b\.sp3, line {line}:"):
        read_sp3([write(sp3(), "a.sp3"), write(second, "b.sp3")])


def replace(old, new, occurrence=0):
    """A change of one line, which begins with `old`."""

    def change(lines):
        lines[line_of(lines, old, occurrence) - 1] = new
        return lines

    return change


@pytest.mark.parametrize(("change", "line"), [
    # The header has 22 lines, an epoch 4.
    (lambda lines: lines[:-1], 38),
    (lambda lines: lines[:10], 10),
    (lambda lines: [*lines, "#cP2019"], 40),
    (replace("PG32", "PG32 -19998.241033  -8466.2348", 1), 29),
    (replace("PG05", f"PG05 -19998.241033  -84x6.234828{1:14.6f}{1:14.6f}"), 24),
    (replace("PG05", f"PG05{1:14.6f}{1:14.6f}{'nan':>14}{1:14.6f}", 3), 36),
    (replace("PG05", f"PG05{1:14.6f}{1:14.6f}{1:13.6f}{1:14.6f}"), 24),
    (replace("PG05", f"PG07{1:14.6f}{1:14.6f}{1:14.6f}"), 24),
    (replace("PG32", f"PG05{1:14.6f}{1:14.6f}{1:14.6f}"), 25),
    (replace("*", "*  2019  4  7 12  0  0.00000000", 1), 27),
    (replace("*", "*  2019  4 31  6  0  0.00000000", 1), 27),
    (lambda lines: ["time,x", "0,1"], 1),
    (lambda lines: ["#aP" + lines[0][3:], *lines[1:]], 1),
    (lambda lines: [lines[0].replace("  4  7", "  4  8"), *lines[1:]], 2),
    (replace("+    3", "+    4   G05G32E01"), 3),
    (lambda lines: sp3(system="UTC"), 13),
])
def test_complaints_name_file_and_line(write, change, line):
    with pytest.raises(ValueError, match=rf"a\.sp3, line {line}:"):
        read_sp3(write(change(sp3())))


def test_files_that_are_damaged_or_not_there(write, tmp_path):
    path = write(sp3(), "a.sp3.gz")
    data = path.read_bytes()
    for damaged in (data[: len(data) // 2], data[:100] + bytes(20) + data[120:], b"\x1f\x9d\x90"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.sp3\.gz"):
            read_sp3(path)
    (tmp_path / "empty").mkdir()
    for name in ("empty", "absent", "absent.sp3"):
        with pytest.raises(FileNotFoundError, match=name):
            read_sp3(tmp_path / name)
    for files in ([tmp_path], []):
        with pytest.raises(ValueError):
            read_sp3(files)


def test_satellites_that_are_not_there(write):
    path = write(sp3())
    orbits = read_sp3(path)
    for ask, name in ((lambda: read_sp3(path, ["G06"]), "'G06'"), (lambda: read_sp3(path, ["g05"]), "'G05'"),
                      (lambda: orbits.select(["G06"]), "'G06'"), (lambda: orbits.gaps("G06"), "'G06'"),
                      (lambda: read_sp3(path, ["G05", "G05"]), "'G05'"), (lambda: orbits.select([]), "satellite"),
                      (lambda: read_sp3(path, tolerance=-1.0), "tolerance")):
        with pytest.raises(ValueError, match=name):
            ask()
    for ask in (lambda: read_sp3(path, "G05"), lambda: orbits.select("G05")):
        with pytest.raises(TypeError, match="'G05'"):
            ask()
    with pytest.raises(ValueError, match=r"\(2, 3\)"):
        Ephemerides([0.0, 900.0], ("G05",), np.ones((2, 3)), 900.0)
    with pytest.raises(ValueError, match="index 2"):
        Ephemerides([0.0, 900.0, 2700.0], ("G05",), np.ones((3, 1, 3)), 900.0)


@pytest.fixture(scope="module")
def april():
    """Ten days of April 2019."""
    return read_sp3(GPS)


@needs_gps
def test_real_epochs_are_gps_time(april):
    assert divmod(april.epochs[0], 604800) == (2048, 0)
    assert calendar(april.epochs[-1]) == "2019-04-16 23:45:00"
    assert (april.days, april.interval, april.frame, april.agency, len(april.files)) == (10, 900, "IGb08", "WHU", 10)
    np.testing.assert_array_equal(np.diff(april.epochs), 900.0)


@needs_gps
def test_real_positions_are_orbits(april):
    np.testing.assert_array_equal(
        april.select(["G05"]).positions[0, 0], read_sp3(april.files[0], ["G05"]).positions[0, 0]
    )
    gps = april.select([name for name in april.satellites if name[0] == "G"])
    radius = np.linalg.norm(gps.positions, axis=-1) / 26560.0  # the semi-major axis of half a sidereal day
    assert np.nanmin(radius) > 0.97 and np.nanmax(radius) < 1.03  # eccentricities are below 0.03
    # Eighth differences of an orbit are small, also across midnights.
    weights = np.array([1, -8, 28, -56, 70, -56, 28, -8, 1.0])
    terms = [weight * gps.positions[k : len(gps.epochs) - 8 + k] for k, weight in enumerate(weights)]
    eighth = np.linalg.norm(np.sum(terms, axis=0), axis=-1)
    assert np.nanmax(eighth) < 0.1  # km; a position at a wrong epoch is off by 2,000 km


@needs_gps
def test_real_gaps(april):
    gaps = {name: [str(gap) for gap in april.gaps(name)] for name in april.satellites if name[0] == "G"}
    assert {name: spans for name, spans in gaps.items() if spans} == {
        "G04": ["2019-04-07 00:00:00 to 2019-04-10 23:45:00 GPS", "2019-04-16 00:00:00 to 2019-04-16 23:45:00 GPS"],
        "G08": ["2019-04-12 00:00:00 to 2019-04-13 23:45:00 GPS"],
        "G22": ["2019-04-12 00:00:00 to 2019-04-13 23:45:00 GPS"],
        "G32": ["2019-04-09 00:00:00 to 2019-04-10 23:45:00 GPS"],
    }
