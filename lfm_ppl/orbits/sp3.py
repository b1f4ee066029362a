"""Orbits from SP3 files: the files of consecutive days, joined.

1. Read the files (`sp3_file`), in the order of their first epochs, without positions that are flagged as predictions
   or manoeuvres.
2. Check that interval, frame and time system agree, and that no span is missing.
3. Join the positions; files that share an epoch must agree within a tolerance.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from lfm_ppl.orbits.ephemerides import Ephemerides, calendar, check_satellites
from lfm_ppl.orbits.sp3_file import FLAGS, Sp3File, read_file
from lfm_ppl.utils import checks

_NAME = re.compile(r".+\.sp3(\.gz|\.z)?", re.IGNORECASE)


def read_sp3(
    source: str | PathLike[str] | Iterable[str | PathLike[str]],
    satellites: Sequence[str] | None = None,
    tolerance: float = 1e-5,
    include: Sequence[str] = (),
) -> Ephemerides:
    r"""Read the positions of satellites from SP3 files of consecutive days.

    The files are put in the order of their first epochs and must follow one another without a gap, in one frame, one
    time system and one interval. Epochs are converted to GPS time from the time systems at a fixed distance from it
    (Galileo, QZSS, NavIC, TAI, BeiDou), and refused in UTC and GLONASS time, which have leap seconds. Velocities,
    clocks and accuracies are not read.

    Args:
        source: a folder with files ``*.sp3`` or ``*.SP3``, a file, or several files; SP3-c or SP3-d, as text or
            compressed by gzip (``*.sp3.gz``).
        satellites: the satellites to read, such as ``["G05"]``, in this order. None: all satellites, sorted.
        tolerance: how far apart, in kilometres, two files may put a satellite at an epoch that both have. Some agencies
            write the midnight between two days into both files; the position of the earlier file is kept.
        include: flagged positions to read: "predicted" (flag P in column 80, as in the second half of an ultra-rapid
            file), "manoeuvres" (flag M in column 79, at an epoch of a manoeuvre), or both.

    Returns:
        The positions; NaN where a file has none: the satellite is not in it, has no line at an epoch, has a flagged
        position that ``include`` does not name, or a position of 0.000000 or 999999.999999, which stand for a missing
        one.

    Raises:
        ValueError: with file and line, for a file that is cut, not SP3, or has text in a number column, for a file that
            does not begin where the one before ends, for files that disagree, or differ in interval, frame or time
            system; and for an unknown satellite, with the nearest names and the files.
        FileNotFoundError: if there is no such file or folder, or no SP3 file in the folder.
        TypeError: if ``satellites`` or ``include`` is a single text.

    Warns:
        UserWarning: flagged positions are left out; the message has their numbers.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "day.sp3"
        >>> _ = path.write_text('''#dP2019  4  7  0  0  0.00000000       2 ORBIT IGb08 FIT  WHU
        ... ## 2048      0.00000000   900.00000000 58580 0.0000000000000
        ... +    1   G05
        ... %c G  cc GPS ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc
        ... *  2019  4  7  0  0  0.00000000
        ... PG05 -19998.241033  -8466.234828 -15340.135642      1.117283
        ... *  2019  4  7  0 15  0.00000000
        ... PG05      0.000000      0.000000      0.000000 999999.999999
        ... EOF
        ... ''')
        >>> orbits = read_sp3(path)
        >>> orbits.satellites, orbits.epochs - orbits.epochs[0], orbits.positions[0, 0]
        (('G05',), array([  0., 900.]), array([-19998.241033,  -8466.234828, -15340.135642]))
        >>> print(*orbits.gaps("G05"))
        2019-04-07 00:15:00 GPS

    Source: S. Hilla, The Extended Standard Product 3 Orbit Format (SP3-d), 2016.
    """
    checks.positive("tolerance", tolerance, "It is a distance in kilometres.")
    if isinstance(satellites, str):
        check_satellites(satellites, ())
    if isinstance(include, str):
        raise TypeError(f"include must be a sequence of words, such as [{include!r}], got {include!r}.")
    for name in include:
        checks.one_of("include", name, FLAGS)
    files = [read_file(path, satellites) for path in _find(source)]
    files.sort(key=lambda file: (file.start, file.end))
    names = tuple(str(file.path) for file in files)
    available = sorted({name for file in files for name in file.header.satellites})
    selected = check_satellites(available if satellites is None else satellites, available, names)
    _check_alike(files)
    files = _without_flagged(files, selected, include)
    positions = _connect(files, selected, tolerance)
    interval = files[0].header.interval
    return Ephemerides(
        epochs=files[0].start + interval * np.arange(len(positions)),
        satellites=selected,
        positions=positions,
        interval=interval,
        frame=files[0].header.frame,
        agency=", ".join(dict.fromkeys(file.header.agency for file in files)),
        files=names,
    )


def _without_flagged(files: list[Sp3File], satellites: tuple[str, ...], include: Sequence[str]) -> list[Sp3File]:
    """Return files without flagged positions, unless ``include`` names the flag; warn of them."""
    counts = dict.fromkeys([name for name in FLAGS if name not in include], 0)
    cleaned, first = [], None
    for file in files:
        positions = file.positions.copy()
        is_selected = np.isin(file.satellites, satellites)
        for name in counts:
            is_left_out = file.flags[name] & np.isfinite(file.positions).all(axis=-1)
            positions[is_left_out] = np.nan
            counts[name] += int(is_left_out[:, is_selected].sum())
        first = first or (file.path if any(counts.values()) else None)
        cleaned.append(replace(file, positions=positions))
    if flagged := {name: count for name, count in counts.items() if count}:
        words = {"predicted": "predicted (flag P)", "manoeuvres": "at epochs of a manoeuvre (flag M)"}
        numbers = " and ".join(f"{count} {words[name]}" for name, count in flagged.items())
        checks.warn(f"{first}: positions are left out, {numbers}. To read them: include={list(flagged)}, or --include "
                    f"{' '.join(flagged)}.")
    return cleaned


def _find(source: str | PathLike[str] | Iterable[str | PathLike[str]]) -> list[Path]:
    if not isinstance(source, (str, PathLike)):
        paths = [Path(path) for path in source]
        if not paths:
            raise ValueError("source must be a folder, a file or several files, got an empty sequence.")
    elif Path(source).is_dir():
        paths = sorted(path for path in Path(source).iterdir() if _NAME.fullmatch(path.name))
        if not paths:
            raise FileNotFoundError(f"the folder {source} has no SP3 files; expected names ending in .sp3 or .sp3.gz.")
    else:
        paths = [Path(source)]
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist; expected an SP3 file or a folder with SP3 files.")
        if path.is_dir():
            raise ValueError(f"{path} is a folder; pass it alone, or its files.")
    return paths


def _check_alike(files: list[Sp3File]) -> None:
    """Raise unless all files have the interval, the frame and the time system of the first."""
    first = files[0]
    for file in files[1:]:
        for line, label, expected, value in (
            (2, "interval", f"{first.header.interval:g} s", f"{file.header.interval:g} s"),
            (1, "frame", first.header.frame, file.header.frame),
            (file.header.time_system_line, "time system", first.header.time_system, file.header.time_system),
        ):
            if expected != value:
                raise ValueError(
                    f"{file.path}, line {line}: the {label} is {value}, but {expected} in {first.path}. "
                    "Read the files that agree."
                )


def _connect(files: list[Sp3File], satellites: tuple[str, ...], tolerance: float) -> np.ndarray:
    """Return the positions (epochs, satellites, 3) of files in the order of their first epochs."""
    interval, start = files[0].header.interval, files[0].start
    last = max(file.end for file in files)
    _check_order(files)
    positions = np.full((round((last - start) / interval) + 1, len(satellites), 3), np.nan)
    source = np.zeros(positions.shape[:2], dtype=int)  # the file that a position is from
    for index, file in enumerate(files):
        first = round((file.start - start) / interval)
        rows = slice(first, first + file.header.epochs)
        columns = [satellites.index(name) for name in file.satellites]
        stored, new = positions[rows, columns], file.positions
        distance = np.linalg.norm(new - stored, axis=-1)
        if np.any(distance > tolerance):
            row, column = np.argwhere(distance > tolerance)[0]
            other_path = files[source[first + row, columns[column]]].path
            epoch = calendar(file.start + row * interval)
            raise ValueError(
                f"{file.path}, line {file.lines[row]}: {file.satellites[column]} at {epoch} is "
                f"{distance[row, column] * 1e5:.1f} cm from where {other_path} has it; "
                f"expected at most {tolerance * 1e5:g} cm. Leave out one of the files, or set tolerance= (km) to "
                "keep the position of the earlier one."
            )
        positions[rows, columns] = np.where(np.isnan(stored), new, stored)
        source[rows, columns] = np.where(np.isnan(stored).any(axis=-1), index, source[rows, columns])
    return positions


def _check_order(files: list[Sp3File]) -> None:
    """Raise unless each file begins on the epochs of the first, and no later than the ones before it end."""
    interval, latest = files[0].header.interval, files[0]
    for file in files[1:]:
        steps = (file.start - files[0].start) / interval
        if abs(steps - round(steps)) * interval > 1e-3:
            raise ValueError(
                f"{file.path}, line 1: the first epoch {calendar(file.start)} is not a whole number of intervals of "
                f"{interval:g} s after the first of {files[0].path}, {calendar(files[0].start)}."
            )
        if file.start > latest.end + 1.5 * interval:
            raise ValueError(
                f"{file.path}, line 1: begins at {calendar(file.start)}, but {latest.path} ends at "
                f"{calendar(latest.end)}. Add the files in between, or read each span separately."
            )
        latest = max(latest, file, key=lambda candidate: candidate.end)
