"""SP3 files: what is read, how days connect, and what a user is told about files that cannot be read."""

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
LINES_OF_HEADER = {"c": 22, "d": 19}
SATELLITES = ("G05", "G32", "E01")
COMMENTS = {"c": ["/* A COMMENT", "/*", "/* ", "/*"], "d": ["/* " + "A LONG COMMENT " * 5]}


def circle(epochs, satellites=SATELLITES):
    """Positions on circles, kilometres, to the six decimals of a file: (T, S, 3)."""
    radius = np.array([26560.0 + 100 * sum(map(ord, name)) for name in satellites])
    angle = np.asarray(epochs)[:, None] / 6856.0 + radius
    positions = radius[:, None] * np.stack([np.cos(angle), np.sin(angle), 0.5 * np.sin(angle)], axis=-1)
    return np.round(positions, 6)


def sp3(
    day=0, epochs=4, satellites=SATELLITES, positions=None, version="c", system="GPS", step=STEP, frame="IGb08",
    velocities=False,
):  # fmt: skip
    """The lines of a file that begins `day` days after START, in the columns of the format."""
    start = START + 86400.0 * day
    times = start + step * np.arange(epochs)
    positions = circle(times, satellites) if positions is None else positions
    week, second = divmod(start, 604800)
    mjd, fraction = divmod(44244 + start / 86400, 1)
    rows = -(-len(satellites) // 17) if version == "d" else max(5, -(-len(satellites) // 17))
    names = [*satellites, *["  0"] * (17 * rows - len(satellites))]
    lines = [f"#{version}{'V' if velocities else 'P'}{date(start)} {epochs:7d} ORBIT {frame} FIT  WHU",
             f"## {week:4.0f} {second:15.8f} {step:14.8f} {mjd:5.0f} {fraction:15.13f}"]  # fmt: skip
    for row in range(rows):
        count = f"+  {len(satellites):3d}   " if row == 0 else "+        "
        lines.append(count + "".join(names[17 * row : 17 * (row + 1)]))
    lines += ["++       " + "  0" * 17] * rows
    lines += [f"%c M  cc {system} ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc",
              "%c cc cc ccc ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc",
              "%f  1.2500000  1.025000000  0.00000000000  0.000000000000000",
              "%f  0.0000000  0.000000000  0.00000000000  0.000000000000000"]  # fmt: skip
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


@pytest.mark.parametrize("name", ["a.sp3", "A.SP3", "a.sp3.gz", "A.SP3.gz", "other.txt"])
@pytest.mark.parametrize("version", ["c", "d"])
@pytest.mark.parametrize("velocities", [False, True])
def test_reads_what_was_written(write, name, version, velocities):
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


def test_windows_line_ends_and_blank_lines_at_the_end(write):
    orbits = read_sp3(write([line + "  \r" for line in sp3()] + ["\r", ""]))
    np.testing.assert_array_equal(orbits.positions, circle(orbits.epochs, orbits.satellites))


def test_gps_time_is_not_utc():
    assert gps_seconds(1980, 1, 6) == 0
    assert divmod(gps_seconds(2019, 4, 7), 604800) == (2048, 0)
    # 2017-01-01 00:00:00 UTC, after the last leap second, is 18 s later in GPS time; the well-known 1167264018.
    assert gps_seconds(2017, 1, 1, second=18) == 1167264018
    assert gps_seconds(2019, 4, 7, 24) == gps_seconds(2019, 4, 8)
    assert calendar(gps_seconds(2020, 2, 29, 23, 59, 59.5)) == "2020-02-29 23:59:59.500000"


@pytest.mark.parametrize(("system", "seconds"), [("GAL", 0), ("QZS", 0), ("IRN", 0), ("TAI", -19), ("BDT", 14)])
def test_time_systems_at_a_fixed_distance_become_gps_time(write, system, seconds):
    assert read_sp3(write(sp3(system=system))).epochs[0] == START + seconds


@pytest.mark.parametrize("absent", [[0, 0, 0], [999999.999999] * 3, [1.0, 2.0, 999999.999999]])
def test_missing_positions(write, absent):
    positions = circle(START + STEP * np.arange(4))
    positions[1, 2] = absent
    orbits = read_sp3(write(sp3(positions=positions)), SATELLITES)
    expected = np.zeros((4, 3), dtype=bool)
    expected[1, 2] = True
    np.testing.assert_array_equal(np.isnan(orbits.positions), np.repeat(expected[..., None], 3, axis=-1))
    assert str(orbits.gaps("E01")[0]) == "2019-04-07 06:00:00 GPS"


def test_a_coordinate_may_be_zero(write):
    positions = circle(START + STEP * np.arange(4))
    positions[0, 0] = [0.0, 26560.0, 0.0]
    np.testing.assert_array_equal(read_sp3(write(sp3(positions=positions)), ["G05"]).positions[0, 0], positions[0, 0])


def test_a_satellite_without_a_line_at_some_epochs(write):
    lines = sp3()
    del lines[line_of(lines, "PG05", 2) - 1]
    orbits = read_sp3(write(lines))
    assert [len(orbits.gaps(name)) for name in orbits.satellites] == [0, 1, 0]
    assert np.isnan(orbits.positions[2, 1]).all() and np.isnan(orbits.positions).sum() == 3


@pytest.mark.parametrize(
    "rest", ["", "     -4.812044 19 18 17 219 EP  MP", f"{'':14} 19 18 17{'':9}MP", f"{'':32}MP", " 999999.9999"]
)
def test_what_follows_the_position_is_not_read(write, rest):
    lines = [line[:46] + rest if line.startswith("P") else line for line in sp3()]
    orbits = read_sp3(write(lines))
    np.testing.assert_array_equal(orbits.positions, circle(orbits.epochs, orbits.satellites))


def test_names_with_a_blank(write):
    lines = [line.replace("G05", "G 5") for line in sp3()]
    assert read_sp3(write(lines)).satellites == ("E01", "G05", "G32")


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
    expected[4:8, [0, 3]] = np.nan
    expected[:4, 2] = expected[8:, 2] = np.nan
    np.testing.assert_array_equal(orbits.positions, expected)
    assert [str(gap) for gap in orbits.gaps("G06")] == [
        "2019-04-07 00:00:00 to 2019-04-07 18:00:00 GPS", "2019-04-09 00:00:00 to 2019-04-09 18:00:00 GPS"
    ]  # fmt: skip
    assert orbits.gaps("G05") == []
    chosen = read_sp3(tmp_path, satellites=["G32", "G06"])
    np.testing.assert_array_equal(chosen.positions, orbits.select(["G32", "G06"]).positions)
    assert chosen.satellites == orbits.select(["G32", "G06"]).satellites == ("G32", "G06")


def test_a_midnight_in_both_files_is_kept_once(write):
    second = circle(START + 86400 + STEP * np.arange(4))
    second[0, 0, 0] += 9e-6  # 9 mm
    paths = [write(sp3(1, positions=second), "b.sp3"), write(sp3(epochs=5), "a.sp3")]
    orbits = read_sp3(paths)
    assert len(orbits.epochs) == 8
    np.testing.assert_array_equal(orbits.positions, circle(orbits.epochs, orbits.satellites))


def test_a_midnight_on_which_files_disagree(write):
    second = circle(START + 86400 + STEP * np.arange(4))
    second[0, 1, 2] += 1.1e-5
    lines = sp3(1, positions=second)
    paths = [write(sp3(epochs=5), "a.sp3"), write(lines, "b.sp3")]
    message = rf"b\.sp3, line {line_of(lines, '*')}: G32 at 2019-04-08 00:00:00 is 1\.1 cm from .*a\.sp3.*at most 1 cm"
    with pytest.raises(ValueError, match=message):
        read_sp3(paths)
    assert read_sp3(paths, ["G05"]).days == 2  # nothing wrong with the others
    orbits = read_sp3(paths, tolerance=1e-4)
    np.testing.assert_array_equal(orbits.positions, circle(orbits.epochs, orbits.satellites))


def test_a_position_missing_in_one_of_two_files_comes_from_the_other(write):
    first = circle(START + STEP * np.arange(5))
    first[4, 0] = 0.0
    orbits = read_sp3([write(sp3(epochs=5, positions=first), "a.sp3"), write(sp3(1), "b.sp3"), write(sp3(1), "c.sp3")])
    np.testing.assert_array_equal(orbits.positions, circle(orbits.epochs, orbits.satellites))


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (sp3(2), r"b\.sp3, line 1: begins at 2019-04-09 00:00:00, but .*a\.sp3 ends at 2019-04-07 18:00:00\. Add"),
        (sp3(1, step=STEP / 2), r"b\.sp3, line 2: the interval is 10800 s, but 21600 s in .*a\.sp3"),
        (sp3(1, frame="IGS14"), r"b\.sp3, line 1: the frame is IGS14, but IGb08 in .*a\.sp3"),
        (sp3(1, system="TAI"), r"b\.sp3, line 13: the time system is TAI, but GPS in .*a\.sp3"),
        (sp3(1.125), r"b\.sp3, line 1: the first epoch 2019-04-08 03:00:00 is not a whole number of intervals of 2"),
    ],
)
def test_days_that_do_not_connect(write, second, message):
    paths = [write(sp3(), "a.sp3"), write(second, "b.sp3")]
    with pytest.raises(ValueError, match=message):
        read_sp3(paths)


def replace(old, new, occurrence=0):
    """A change of one line, which begins with `old`."""

    def change(lines):
        lines[line_of(lines, old, occurrence) - 1] = new
        return lines

    return change


def cut(line, at, *columns):
    return lambda lines: [*lines[: line_of(lines, line, at) - 1], lines[line_of(lines, line, at) - 1][slice(*columns)]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        # Lines of the body: the header has 22, an epoch 4.
        (lambda lines: lines[:-1], r"line 38: the file is cut: it ends with 'PE01.*', not EOF"),
        (cut("PG32", 1, 30), r"line 29: the file is cut: it ends with 'PG32"),
        (lambda lines: [*lines[:-5], "EOF"], r"line 35: EOF after 3 of the 4 epochs of line 1"),
        (lambda lines: lines[:10], r"line 10: the file is cut"),
        (replace("PG32", "PG32 -19998.241033  -8466.2348", 1), r"line 29: the line is cut after column 30; a position"),
        (lambda lines: [*lines, "#cP2019"], r"line 40: expected nothing after EOF, got '#cP2019'"),
        (lambda lines: [*lines[:-1], lines[22], "EOF"], r"line 39: an epoch more than the 4 of line 1"),
        (replace("PG05", f"PG05 -19998.241033  -84x6.234828{1:14.6f}{1:14.6f}"),
         r"line 24: expected the coordinate y in kilometres in columns 19 to 32, got '-84x6\.234828'"),
        (replace("PG05", f"PG05{1:14.6f}{1:14.6f}{'nan':>14}{1:14.6f}", 3), r"line 36: .* coordinate z .* got 'nan'"),
        (replace("PG05", f"PG05{'':14}{1:14.6f}{1:14.6f}"), r"line 24: .* coordinate x .* got ''"),
        (lambda lines: [*lines[:23], lines[23] + lines[24], *lines[25:]], r"line 24: .* at most 80 columns, got 'PG05"),
        (lambda lines: [*lines[:22], lines[22] + lines[23], *lines[24:]], r"line 23: expected nothing after the date"),
        (replace("PG05", f"PG05{1:15.6f}{1:14.6f}{1:14.6f}{1:14.6f}"), r"line 24: expected the coordinate y .* got '0"),
        (replace("PG05", f"PG05{1:14.6f}{1:14.6f}{1:15.6f}{1:14.6f}"), r"line 24: expected three numbers with six dec"),
        (replace("PG05", f"PG05{1:14.6f}{1:14.6f}{1:13.6f}{1:14.6f}"), r"line 24: expected three numbers with six dec"),
        (replace("PG05", f"PG07{1:14.6f}{1:14.6f}{1:14.6f}"), r"line 24: the satellite 'G07' is not among the 3 that"),
        (replace("PG32", f"PG05{1:14.6f}{1:14.6f}{1:14.6f}"), r"line 25: a second position of G05 at the same epoch"),
        (replace("PG32", "QG32"), r"line 25: expected a line that begins with \*, P, .* got 'QG32'"),
        (replace("*", "*  2019  4  7 12  0  0.00000000", 1),
         r"line 27: expected the epoch 2019-04-07 06:00:00, .* got 2019-04-07 12:00:00"),
        (replace("*", "*  2019  4 31  6  0  0.00000000", 1), r"line 27: the date in columns 4 to 31 does not exist"),
        (replace("*", "*  2019  4  7  b  0  0.00000000", 1), r"line 27: expected an hour in columns 15 to 16, got 'b'"),
        # Lines of the header.
        (lambda lines: ["time,x", "0,1"], r"line 1: expected an SP3 file, .* got 'time,x'"),
        (lambda lines: [], r"line 1: expected an SP3 file"),
        (lambda lines: ["#aP" + lines[0][3:], *lines[1:]], r"line 1: this is SP3-a; expected SP3-c or SP3-d"),
        (lambda lines: [lines[0].replace("      4 ", "   four "), *lines[1:]], r"line 1: .*number of epochs.* 'four'"),
        (lambda lines: [lines[0].replace("  4  7", " 14  7"), *lines[1:]], r"line 1: the date .* does not exist"),
        (lambda lines: [lines[0].replace("  4  7", "  4  8"), *lines[1:]],
         r"line 2: the modified Julian date 58580\.0+ is not the date of line 1, 2019-04-08"),
        (lambda lines: [lines[0], *lines[2:]], r"line 2: expected the line ##"),
        (lambda lines: [lines[0], lines[1].replace("21600.0", "    0.0"), *lines[2:]], r"a positive interval, got 4"),
        (replace("+    3", "+    4   G05G32E01"), r"line 3: 4 satellites are announced, but 3 are listed"),
        (replace("+    3", "+    3   G05G32G05"), r"line 3: the satellite G05 is listed twice"),
        (lambda lines: [line for line in lines if line[:2] != "+ "], r"the header ends without a line \+"),
        (lambda lines: [line for line in lines if line[:2] != "%c"], r"the header ends without the line %c"),
        (lambda lines: sp3(system="UTC"), r"line 13: the epochs are in UTC, which has leap seconds; expected .* GPS, "),
        (lambda lines: sp3(system="GLO"), r"line 13: the epochs are in GLO, which has leap seconds"),
        (lambda lines: sp3(system="ccc"), r"line 13: unknown time system 'ccc'; expected one of GPS"),
    ],
)  # fmt: skip
def test_complaints_name_file_and_line(write, change, message):
    with pytest.raises(ValueError, match=r"a\.sp3, .*" + message):
        read_sp3(write(change(sp3())))


def test_a_compressed_file_that_is_cut_or_damaged(write):
    path = write(sp3(), "a.sp3.gz")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=r"a\.sp3\.gz, line \d+: the compressed file is cut or damaged here"):
        read_sp3(path)
    path.write_bytes(data[:100] + bytes(20) + data[120:])
    with pytest.raises(ValueError, match=r"a\.sp3\.gz, line \d+: the compressed file is cut or damaged here"):
        read_sp3(path)
    path.write_bytes(b"\x1f\x9d\x90")
    with pytest.raises(ValueError, match=r"a\.sp3\.gz is compressed by `compress`.*gzip -d"):
        read_sp3(path)


def test_files_and_folders_that_are_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"the folder .* has no SP3 files; expected names ending in \.sp3"):
        read_sp3(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"absent does not exist; expected an SP3 file or a folder"):
        read_sp3(tmp_path / "absent")
    with pytest.raises(FileNotFoundError, match=r"absent\.sp3 does not exist"):
        read_sp3([str(tmp_path / "absent.sp3")])
    with pytest.raises(ValueError, match="is a folder; pass it alone"):
        read_sp3([tmp_path])
    with pytest.raises(ValueError, match="got an empty sequence"):
        read_sp3([])


def test_satellites_that_are_not_there(write):
    path = write(sp3())
    with pytest.raises(ValueError, match=r"unknown satellite 'G06'\. .*Known: G05, G32\. Read from .*a\.sp3\."):
        read_sp3(path, ["G06"])
    with pytest.raises(ValueError, match=r"'g05'\. Did you mean 'G05'.* Read from .*a\.sp3 to .*b\.sp3, 2 files\."):
        read_sp3([path, write(sp3(1), "b.sp3")], ["g05"])
    with pytest.raises(ValueError, match=r"unknown satellite 'R01'.* Known: E01, G05, G32\."):
        read_sp3(path, ["R01"])
    orbits = read_sp3(path)
    for ask in (lambda: orbits.select(["G06"]), lambda: orbits.gaps("G06")):
        with pytest.raises(ValueError, match=r"unknown satellite 'G06'\. Did you mean .*a\.sp3"):
            ask()
    with pytest.raises(TypeError, match=r"such as \['G05'\], got the text 'G05'"):
        read_sp3(path, "G05")
    with pytest.raises(TypeError, match=r"got the text 'G05'"):
        orbits.select("G05")
    with pytest.raises(ValueError, match=r"each of them once; got \['G05', 'G05'\]"):
        read_sp3(path, ["G05", "G05"])
    with pytest.raises(ValueError, match="at least one satellite"):
        orbits.select([])
    with pytest.raises(ValueError, match="tolerance must be finite and greater than zero"):
        read_sp3(path, tolerance=-1.0)


def test_ephemerides_check_their_shapes():
    with pytest.raises(ValueError, match=r"positions must have shape .* = \(2, 1, 3\), got \(2, 3\)"):
        Ephemerides([0.0, 900.0], ("G05",), np.ones((2, 3)), 900.0)
    with pytest.raises(ValueError, match=r"epochs must be 900 s apart, got 1800 s before index 2"):
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


@needs_gps
def test_a_real_day_that_is_left_out(april):
    with pytest.raises(ValueError, match=r"20190990000.*, line 1: begins at 2019-04-09 .* ends at 2019-04-07 23:45:00"):
        read_sp3([april.files[0], *april.files[2:]], ["G05"])
