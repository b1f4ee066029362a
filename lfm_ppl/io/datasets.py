"""Data sets of the examples, ready for `lfm_ppl.fit`.

Measured data are read from files, which this package does not contain: `load` names the file that it needs and its
source.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lfm_ppl.io import loading
from lfm_ppl.io.data import read_csv, read_series, read_table
from lfm_ppl.io.data_set import Data, stack_series
from lfm_ppl.utils import checks


class _Measured(NamedTuple):
    """A data set in a file: its place in the folder of data, how it is read, and where it was published."""

    file: str
    read: Callable[[Path], Data]
    source: str


def load(name: str, folder: str | Path | None = None) -> Data:
    """Return the observations of an example, with units; pass them to `lfm_ppl.fit` as they are.

    - ``"room"``: simulated, with its truth. The temperature of a room (degC) in 49 hours, with the known inputs heater
      (kW) and outside (degC).
    - ``"theophylline"``: concentrations (mg/L) in the blood of twelve subjects after a dose (mg/kg, to the state gut),
      eleven in a day; a panel. Source: Boeckmann, Sheiner and Beal (1994), NONMEM Users Guide, part V; `Theoph` of R.
    - ``"p53"``: expression of five genes at seven times (h) after irradiation, in three replicates. Source: Barenco et
      al. (2006), Genome Biology 7:R25.
    - ``"coal"``: disasters in British coal mines with ten deaths or more in each year, 1851 to 1961. Source: Jarrett
      (1979), Biometrika 66; `coal` of R's package boot.
    - ``"house"``: temperature inside (Ti, degC) in 792 hours, with the known inputs heating power (Ph), temperature
      outside (Ta, degC) and of the heating water (Th, degC). Source: the tutorial of darkgreybox.
    - ``"calls"``: calls to a bank in bins of five minutes, weekdays 7:00 to 21:00. Source: Weinberg, Brown and Stroud
      (2007), Journal of the American Statistical Association 102.

    Args:
        name: one of these.
        folder: the folder with the files of measured data. None: that of the environment variable ``LFM_DATA``, by
            default ``../shared/data``.

    Raises:
        ValueError: there is no such data set; the message lists the names.
        FileNotFoundError: the file is not in the folder.

    Example:
        >>> data = load("room")
        >>> data.outputs, data.y.shape, sorted(data.inputs), data.units["time"]
        (('temperature',), (49, 1), ['heater', 'outside'], 'h')
    """
    checks.one_of("data set", name, ["room", *_MEASURED])
    if name == "room":
        return loading.load(name).simulate()
    measured = _MEASURED[name]
    path = Path(os.environ.get("LFM_DATA", "../shared/data") if folder is None else folder) / measured.file
    if not path.is_file():
        raise FileNotFoundError(f"the data set {name!r} needs the file {path}, which is not there. Source: "
                                f"{measured.source}. Give its folder as folder=, or in the variable LFM_DATA; "
                                "lfm.datasets.load('room') needs no file.")
    return measured.read(path)


def _theophylline(path: Path) -> Data:
    series = read_series(path, "subject", ["conc"], "time", {"dose": "dose:gut:once"}, "h")
    return _with_units(stack_series(series), conc="mg/L", dose="mg/kg")


def _coal(path: Path) -> Data:
    """Count the dates in calendar years; the period of the record begins in March 1851 and ends in March 1962."""
    import pandas as pd

    dates = pd.read_csv(path)["date"].to_numpy(float)
    counts, edges = np.histogram(dates, np.arange(1851.0, 1963.0))
    return Data(0.5 * (edges[:-1] + edges[1:]), counts[:, None].astype(float), ("disasters",),
                units={"time": "year"})


def _house(path: Path) -> Data:
    import pandas as pd

    table = pd.read_csv(path, index_col=0, parse_dates=True)
    data = read_table(table, outputs=["Ti"], inputs={"Ph": "previous", "Ta": "linear", "Th": "linear"}, time_unit="h")
    return _with_units(data, Ti="degC", Ta="degC", Th="degC")


def _calls(path: Path) -> Data:
    import pandas as pd

    table = pd.read_csv(path, parse_dates=["DateTime"], index_col="DateTime")
    return read_table(table[["Calls"]].rename(columns={"Calls": "calls"}), time_unit="h")


def _with_units(data: Data, **units: str) -> Data:
    return replace(data, units={**data.units, **units})


_MEASURED = {
    "theophylline": _Measured("theoph/theoph.csv", _theophylline, "Theoph of R, columns subject, time, conc, dose"),
    "p53": _Measured("p53/p53_targets.csv", read_csv, "Barenco et al., Genome Biology 7:R25, arrays of rHVDM"),
    "coal": _Measured("coal/coal.csv", _coal, "coal of R's package boot, a column date"),
    "house": _Measured("house/house_hourly.csv", _house, "the tutorial of darkgreybox"),
    "calls": _Measured("calls/bank_calls.csv.gz", _calls, "Weinberg, Brown and Stroud (2007)"),
}
