"""One SP3 file: a header, and at each epoch one line per satellite, in fixed columns.

The columns follow S. Hilla, *The Extended Standard Product 3 Orbit Format (SP3-d)*, 2016, counted from
1. SP3-c has the same columns with at most 85 satellites and four lines of comments, a limit that some agencies exceed.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Container
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lfm_ppl.orbits.ephemerides import DAY, calendar, gps_seconds

# GPS time minus the time of the file, in seconds, where it never changes.
TIME_SYSTEMS = {"GPS": 0.0, "GAL": 0.0, "QZS": 0.0, "IRN": 0.0, "TAI": -19.0, "BDT": 14.0}
ABSENT = 999999.0  # km; and three zeros
FLAGS = {"predicted": (80, "P"), "manoeuvres": (79, "M")}  # the column and the letter of a flagged position
_SKIPPED = ("V", "EP", "EV")  # velocities, and correlations of positions and of velocities
_MJD_OF_GPS_ORIGIN = 44244
# Columns 5 to 46 are three numbers, F14.6; then to column 60 the clock, and to column 80 accuracies and flags. Strict,
# because a line that lost a character, or its end, still has numbers in these columns.
_POSITION = re.compile(r"P...(?:[ \d-]{7}\.\d{6}){3}(?:(?: {14}|[ \d-]{7}\.[ \d]{0,6})[ \dEPM]{0,20})?")


@dataclass(frozen=True)
class Header:
    """The header: the lines before the first epoch.

    Attributes:
        start: the first epoch in the time system of the file, seconds since 1980-01-06 00:00:00 of that system.
        epochs: their number.
        interval: seconds from one epoch to the next.
        frame: the Earth-fixed frame.
        agency: who computed the orbits.
        time_system: one of :data:`TIME_SYSTEMS`.
        time_system_line: its line.
        satellites: the names listed.
        length: the number of lines of the header.
    """

    start: float
    epochs: int
    interval: float
    frame: str
    agency: str
    time_system: str
    time_system_line: int
    satellites: tuple[str, ...]
    length: int


@dataclass(frozen=True)
class Sp3File:
    """A complete file.

    Attributes:
        path: its path.
        header: its header.
        start: the first epoch, seconds of GPS time.
        satellites: the satellites read, in the order of the header.
        positions: kilometres, shape (epochs, satellites, 3); NaN where there is none.
        lines: the line of each epoch.
        flags: name in :data:`FLAGS` -> whether a position has the flag, shape (epochs, satellites).
    """

    path: Path
    header: Header
    start: float
    satellites: tuple[str, ...]
    positions: np.ndarray
    lines: list[int]
    flags: dict[str, np.ndarray]

    @property
    def end(self) -> float:
        """The last epoch, seconds of GPS time."""
        return self.start + (self.header.epochs - 1) * self.header.interval


@dataclass(frozen=True)
class _Text:
    """The lines of a file, and errors with line numbers from 1."""

    path: Path
    lines: list[str]

    def error(self, line: int, message: str) -> ValueError:
        return ValueError(f"{self.path}, line {line}: {message}")

    def number(self, line: int, first: int, last: int, label: str) -> float:
        """Return the number in the columns ``first`` to ``last``."""
        cell = self.lines[line - 1][first - 1 : last]
        try:
            value = float(cell)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise self.error(line, f"expected {label} in columns {first} to {last}, got {cell.strip()!r}.")
        return value

    def integer(self, line: int, first: int, last: int, label: str) -> int:
        """Return the whole number in the columns ``first`` to ``last``."""
        value = self.number(line, first, last, label)
        if value != int(value):
            raise self.error(line, f"expected {label}, a whole number, in columns {first} to {last}, got {value:g}.")
        return int(value)

    def epoch(self, line: int) -> float:
        """Return the date in columns 4 to 31, which line 1 and the lines of the epochs share."""
        columns = ((4, 7, "a year"), (9, 10, "a month"), (12, 13, "a day"), (15, 16, "an hour"), (18, 19, "a minute"))
        year, month, day, hour, minute = (self.integer(line, *column) for column in columns)
        second = self.number(line, 21, 31, "seconds")
        try:
            return gps_seconds(year, month, day, hour, minute, second)
        except ValueError as error:
            raise self.error(line, f"the date in columns 4 to 31 does not exist: {error}.") from None


def read_file(path: Path, names: Container[str] | None = None) -> Sp3File:
    """Read one SP3-c or SP3-d file, as text or compressed by gzip.

    Args:
        path: the file.
        names: satellites to read; None: all.

    Returns:
        The positions and the header.

    Raises:
        ValueError: the file is invalid; the message names file and line.
        FileNotFoundError: if there is no such file.
    """
    text = _Text(path, _read_lines(path))
    header = _read_header(text)
    satellites = tuple(name for name in header.satellites if names is None or name in names)
    positions, lines, flags = _read_positions(text, header, satellites)
    return Sp3File(path, header, header.start + TIME_SYSTEMS[header.time_system], satellites, positions, lines, flags)


def _read_lines(path: Path) -> list[str]:
    with open(path, "rb") as file:
        magic = file.read(2)
    if magic == b"\x1f\x9d":
        raise ValueError(f"{path} is compressed by `compress`, which Python does not read. Run `gzip -d` on it first.")
    lines: list[bytes] = []
    with gzip.open(path) if magic == b"\x1f\x8b" else open(path, "rb") as stream:
        try:
            lines.extend(stream)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise ValueError(
                f"{path}, line {len(lines) + 1}: the compressed file is cut or damaged here: {error}. Fetch it again."
            ) from None
    return [line.decode("latin-1").rstrip() for line in lines]


def _read_header(text: _Text) -> Header:
    lines = text.lines
    first = lines[0] if lines else ""
    if first[:1] != "#" or first[2:3] not in ("P", "V"):
        raise text.error(1, f"expected an SP3 file, which begins with #cP, #cV, #dP or #dV, got {first[:20]!r}.")
    if first[1] not in "cd":
        raise text.error(1, f"this is SP3-{first[1]}; expected SP3-c or SP3-d, which name their time system.")
    if "EOF" not in lines:
        last = max(k for k, line in enumerate(lines, 1) if line)
        raise text.error(last, f"the file is cut: it ends with {lines[last - 1][:60]!r}, not EOF. Fetch it again.")
    length = next((k for k, line in enumerate(lines) if line[:1] == "*"), len(lines))
    start, count = text.epoch(1), text.integer(1, 33, 39, "the number of epochs")
    if lines[1][:2] != "##":
        raise text.error(2, f"expected the line ##, with the interval, got {lines[1][:20]!r}.")
    interval = text.number(2, 25, 38, "the interval in seconds")
    if interval <= 0 or count < 1:
        raise text.error(1, f"expected at least one epoch and a positive interval, got {count} and {interval:g} s.")
    day = text.number(2, 40, 44, "the modified Julian day") + text.number(2, 46, 60, "the fraction of the day")
    if abs((day - _MJD_OF_GPS_ORIGIN) * DAY - start) > 1e-2:
        raise text.error(2, f"the modified Julian date {day:.6f} is not the date of line 1, {calendar(start)}.")
    system, line = _read_time_system(text, length)
    return Header(
        start=start,
        epochs=count,
        interval=interval,
        frame=first[46:51].strip(),
        agency=first[56:60].strip(),
        time_system=system,
        time_system_line=line,
        satellites=_read_satellites(text, length),
        length=length,
    )


def _read_time_system(text: _Text, length: int) -> tuple[str, int]:
    line = next((k for k, line in enumerate(text.lines[:length], 1) if line[:2] == "%c"), None)
    if line is None:
        raise text.error(length, "the header ends without the line %c, which names the time system.")
    system = text.lines[line - 1][9:12]
    if system in ("UTC", "GLO"):
        raise text.error(
            line,
            f"the epochs are in {system}, which has leap seconds; expected a time system at a fixed distance from GPS "
            f"time: {', '.join(TIME_SYSTEMS)}.",
        )
    if system not in TIME_SYSTEMS:
        raise text.error(line, f"unknown time system {system!r}; expected one of {', '.join(TIME_SYSTEMS)}.")
    return system, line


def _read_satellites(text: _Text, length: int) -> tuple[str, ...]:
    rows = [k for k, line in enumerate(text.lines[:length], 1) if line[:2] in ("+ ", "+")]
    if not rows:
        raise text.error(length, "the header ends without a line +, which lists the satellites.")
    count = text.integer(rows[0], 4, 6, "the number of satellites")
    listed = [(row, text.lines[row - 1][k : k + 3]) for row in rows for k in range(9, 60, 3)]
    names = [(row, _name(cell)) for row, cell in listed if cell[:1].isalpha()]
    if len(names) != count:
        raise text.error(rows[0], f"{count} satellites are announced, but {len(names)} are listed.")
    for k, (row, name) in enumerate(names):
        if name in (earlier for _, earlier in names[:k]):
            raise text.error(row, f"the satellite {name} is listed twice.")
    return tuple(name for _, name in names)


def _name(cell: str) -> str:
    """Return ``G05`` for ``G 5``."""
    return cell[:1] + cell[1:].strip().zfill(2)


def _read_positions(
    text: _Text, header: Header, satellites: tuple[str, ...]
) -> tuple[np.ndarray, list[int], dict[str, np.ndarray]]:
    """Return the positions (epochs, satellites, 3), the lines of the epochs, and the flags (epochs, satellites)."""
    columns = {name: satellites.index(name) if name in satellites else None for name in header.satellites}
    cells: list[int] = []
    values: list[tuple[float, float, float]] = []
    line_numbers: list[int] = []
    epochs: list[int] = []
    for number, line in enumerate(text.lines[header.length :], header.length + 1):
        if line[:1] == "P":
            name = line[1:4]
            column = columns[name] if name in columns else _listed(text, number, columns)
            if column is None:
                continue
            if not _POSITION.fullmatch(line):
                raise _bad_position(text, number)
            try:
                values.append((float(line[4:18]), float(line[18:32]), float(line[32:46])))
            except ValueError:
                raise _bad_position(text, number) from None
            cells.append((len(epochs) - 1) * len(satellites) + column)
            line_numbers.append(number)
        elif line[:1] == "*":
            epochs.append(number)
            _check_epoch(text, header, epochs)
        elif line == "EOF":
            _check_end(text, header, number, len(epochs))
            break
        elif line and not line.startswith(_SKIPPED):
            raise text.error(number, f"expected a line that begins with *, P, V, EP, EV or EOF, got {line[:20]!r}.")
    shape = (header.epochs, len(satellites))
    flags = {name: np.zeros(shape, dtype=bool) for name in FLAGS}
    for cell, number in zip(cells, line_numbers, strict=True):
        line = text.lines[number - 1]
        for name, (column, letter) in FLAGS.items():
            flags[name].flat[cell] = line[column - 1 : column] == letter
    return _positions(text, shape, cells, values, line_numbers), epochs, flags


def _positions(
    text: _Text,
    shape: tuple[int, int],
    cells: list[int],
    values: list[tuple[float, float, float]],
    line_numbers: list[int],
) -> np.ndarray:
    """Return the values (epochs, satellites, 3) that were read at the lines ``places``, NaN where there is none."""
    coordinates = np.array(values).reshape(-1, 3)
    _, first = np.unique(cells, return_index=True)
    if len(first) < len(cells):
        line = line_numbers[min(set(range(len(cells))) - set(first.tolist()))]
        raise text.error(line, f"a second position of {_name(text.lines[line - 1][1:4])} at the same epoch.")
    coordinates[(coordinates == 0).all(axis=1) | (np.abs(coordinates) >= ABSENT).any(axis=1)] = np.nan
    positions = np.full((shape[0] * shape[1], 3), np.nan)
    positions[np.array(cells, dtype=int)] = coordinates
    return positions.reshape(*shape, 3)


def _listed(text: _Text, line: int, columns: dict[str, int | None]) -> int | None:
    """Return the column of a satellite that is not written as in the header."""
    name = _name(text.lines[line - 1][1:4])
    if name not in columns:
        raise text.error(line, f"the satellite {name!r} is not among the {len(columns)} that the header lists.")
    return columns[name]


def _bad_position(text: _Text, line: int) -> ValueError:
    """Return the error of a line that is not a position."""
    length = len(text.lines[line - 1])
    if length < 46:
        return text.error(line, f"the line is cut after column {length}; a position ends in column 46.")
    try:
        for first, axis in ((5, "x"), (19, "y"), (33, "z")):
            text.number(line, first, first + 13, f"the coordinate {axis} in kilometres")
    except ValueError as error:
        return error
    return text.error(
        line,
        "expected three numbers with six decimals in columns 5 to 46, the clock and its flags after them, and at most "
        f"80 columns, got {text.lines[line - 1][:100]!r}.",
    )


def _check_epoch(text: _Text, header: Header, epochs: list[int]) -> None:
    """Raise ValueError unless the last of ``epochs`` follows from line 1 and the interval."""
    if len(epochs) > header.epochs:
        raise text.error(epochs[-1], f"an epoch more than the {header.epochs} of line 1.")
    if extra := text.lines[epochs[-1] - 1][31:]:
        raise text.error(epochs[-1], f"expected nothing after the date, which ends in column 31, got {extra[:20]!r}.")
    epoch = text.epoch(epochs[-1])
    expected = header.start + (len(epochs) - 1) * header.interval
    if abs(epoch - expected) > 1e-3:
        raise text.error(
            epochs[-1],
            f"expected the epoch {calendar(expected)}, by line 1 and the interval {header.interval:g} s, got "
            f"{calendar(epoch)}.",
        )


def _check_end(text: _Text, header: Header, line: int, epochs: int) -> None:
    """Raise ValueError unless all epochs precede the EOF in ``line``, and nothing follows it."""
    if epochs < header.epochs:
        raise text.error(line, f"EOF after {epochs} of the {header.epochs} epochs of line 1; the file is not complete.")
    for number, extra in enumerate(text.lines[line:], line + 1):
        if extra:
            raise text.error(number, f"expected nothing after EOF, got {extra[:20]!r}.")
