"""Positions of satellites at equally spaced epochs, and the GPS time of the epochs.

1. GPS time runs with atomic time, TAI - 19 s, and has no leap seconds. It is ahead of UTC by the leap seconds since
   1980: 18 s since 2017.
2. `Ephemerides` holds positions (epochs, satellites, 3) with NaN for gaps, and converts epochs to dates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import date, datetime, timedelta

import numpy as np

from lfm_ppl.utils import checks

DAY = 86400.0
_ORIGIN = datetime(1980, 1, 6)


def gps_seconds(year: int, month: int, day: int, hour: int = 0, minute: int = 0, second: float = 0.0) -> float:
    """Return the seconds of GPS time since its origin, 1980-01-06 00:00:00 GPS, at a date of GPS time.

    Args:
        year: four digits.
        month: 1 to 12.
        day: 1 to 31.
        hour: 0 to 23, or more: hour 24 is hour 0 of the next day.
        minute: 0 to 59.
        second: 0 up to 60.

    Returns:
        Seconds; 604800 of them are a GPS week.

    Raises:
        ValueError: if there is no such day.

    Example:
        >>> divmod(gps_seconds(2019, 4, 7), 604800)  # GPS week and second of the week
        (2048.0, 0.0)
    """
    days = date(year, month, day).toordinal() - _ORIGIN.toordinal()
    return days * DAY + hour * 3600.0 + minute * 60.0 + second


def calendar(epoch: float) -> str:
    """Write an epoch as a date of GPS time.

    Args:
        epoch: seconds of GPS time, as from :func:`gps_seconds`.

    Returns:
        Date and time to the microsecond, without it where it is zero.

    Example:
        >>> calendar(gps_seconds(2019, 4, 7, 23, 45))
        '2019-04-07 23:45:00'
    """
    return str(_ORIGIN + timedelta(seconds=float(epoch)))


@dataclass(frozen=True)
class Gap:
    """Epochs without a position, from the first to the last of them, in seconds of GPS time.

    Attributes:
        start: the first epoch without a position.
        end: the last one; equal to ``start`` where a single epoch is missing.

    Example:
        >>> print(Gap(gps_seconds(2019, 4, 7), gps_seconds(2019, 4, 10, 23, 45)))
        2019-04-07 00:00:00 to 2019-04-10 23:45:00 GPS
    """

    start: float
    end: float

    def __str__(self) -> str:
        if self.start == self.end:
            return f"{calendar(self.start)} GPS"
        return f"{calendar(self.start)} to {calendar(self.end)} GPS"


@dataclass(frozen=True, eq=False)
class Ephemerides:
    """Positions of S satellites at T equally spaced epochs.

    Attributes:
        epochs: seconds of GPS time since 1980-01-06 00:00:00 GPS, shape (T,), increasing by ``interval``.
        satellites: the names of the S satellites, such as ``G05``: the letter of the system (G for GPS, R for GLONASS,
            E for Galileo, C for BeiDou, J for QZSS) and the number.
        positions: kilometres in the Earth-fixed ``frame``, shape (T, S, 3); NaN where there is none.
        interval: seconds from one epoch to the next.
        frame: the Earth-fixed frame as the files name it, such as ``IGb08``.
        agency: who computed the orbits; several are separated by commas.
        files: the files that the positions came from, in the order of time.

    Raises:
        ValueError: if the shapes do not fit together, or the epochs are not equally spaced.

    Example:
        >>> orbits = Ephemerides(gps_seconds(2019, 4, 7) + 900.0 * np.arange(96), ("G05",), np.ones((96, 1, 3)), 900.0)
        >>> orbits.days
        1.0
    """

    epochs: np.ndarray = field(repr=False)
    satellites: tuple[str, ...]
    positions: np.ndarray = field(repr=False)
    interval: float
    frame: str = ""
    agency: str = ""
    files: tuple[str, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        """Convert to arrays and check that the shapes fit together."""
        object.__setattr__(self, "epochs", np.asarray(self.epochs, dtype=float))
        object.__setattr__(self, "positions", np.asarray(checks.unmask(self.positions), dtype=float))
        object.__setattr__(self, "satellites", tuple(self.satellites))
        expected = (len(self.epochs), len(self.satellites), 3)
        if self.epochs.ndim != 1 or self.positions.shape != expected:
            raise ValueError(
                f"positions must have shape (epochs, satellites, 3) = {expected}, got {self.positions.shape} for "
                f"epochs of shape {self.epochs.shape}."
            )
        checks.positive("interval", self.interval)
        steps = np.diff(self.epochs)
        if not np.all(np.abs(steps - self.interval) < 1e-3):
            index = int(np.argmax(~(np.abs(steps - self.interval) < 1e-3))) + 1
            raise ValueError(
                f"epochs must be {self.interval:g} s apart, got {steps[index - 1]:g} s before index {index}. "
                "Leave a missing position NaN and keep its epoch."
            )

    @property
    def days(self) -> float:
        """The time that the epochs cover, in days: T intervals."""
        return len(self.epochs) * self.interval / DAY

    def select(self, satellites: Sequence[str]) -> Ephemerides:
        """Return some of the satellites, in the order asked for.

        Args:
            satellites: names such as ``["G05", "G06"]``.

        Returns:
            The same epochs with the positions of these satellites.

        Raises:
            ValueError: if a satellite is unknown (with the nearest names and the files), or named twice.
            TypeError: if ``satellites`` is a single text.

        Example:
            >>> orbits = Ephemerides([0.0, 900.0], ("G05", "G06"), np.ones((2, 2, 3)), 900.0)
            >>> orbits.select(["G06"]).positions.shape
            (2, 1, 3)
        """
        names = check_satellites(satellites, self.satellites, self.files)
        columns = [self.satellites.index(name) for name in names]
        return Ephemerides(
            self.epochs, names, self.positions[:, columns], self.interval, self.frame, self.agency, self.files
        )

    def gaps(self, satellite: str) -> list[Gap]:
        """Return where a satellite has no position.

        Args:
            satellite: its name, such as ``G08``.

        Returns:
            First and last missing epoch of each gap, in the order of time; empty where nothing is missing.

        Raises:
            ValueError: if the satellite is unknown.

        Example:
            >>> positions = np.ones((4, 1, 3))
            >>> positions[1:3] = np.nan
            >>> start = gps_seconds(2019, 4, 7)
            >>> orbits = Ephemerides(start + 900.0 * np.arange(4), ("G08",), positions, 900.0)
            >>> print(*orbits.gaps("G08"))
            2019-04-07 00:15:00 to 2019-04-07 00:30:00 GPS
        """
        (name,) = check_satellites([satellite], self.satellites, self.files)
        missing = np.isnan(self.positions[:, self.satellites.index(name)]).any(axis=-1)
        edges = np.flatnonzero(np.diff(missing.astype(int), prepend=0, append=0))
        return [
            Gap(float(self.epochs[first]), float(self.epochs[following - 1]))
            for first, following in zip(edges[::2], edges[1::2], strict=True)
        ]


def check_satellites(names: Sequence[str], available: Sequence[str], files: Sequence[str] = ()) -> tuple[str, ...]:
    """Raise unless ``names`` are some of the ``available`` satellites, each once; return them as a tuple."""
    if isinstance(names, str):
        raise TypeError(f"satellites must be a sequence of names, such as [{names!r}], got the text {names!r}.")
    if not len(names) or len(set(names)) < len(names):
        raise ValueError(f"satellites must name at least one satellite, and each of them once; got {list(names)}.")
    for name in names:
        if name not in available:
            system = [candidate for candidate in available if candidate[:1] == str(name)[:1].upper()]
            where = f" Read from {files[0]}" if files else ""
            where += f" to {files[-1]}, {len(files)} files" if len(files) > 1 else ""
            raise ValueError(checks.unknown("satellite", name, system or available) + where + ("." if files else ""))
    return tuple(names)
