"""What an experiment leaves in its folder: tables as CSV and Markdown, figures as PNG."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from lfm_ppl.experiments import scores
from lfm_ppl.results.files import writing
from lfm_ppl.results.plots import style
from lfm_ppl.results.tables import write_csv, write_markdown


def save(folder: str | Path, tables: Mapping[str, pd.DataFrame], figures: Mapping[str, Figure],
         label: str) -> list[Path]:
    """Write tables and figures by name, replacing older ones, and return their paths.

    Args:
        folder: of the experiment.
        tables: name -> table; as CSV in full, as Markdown with standard errors in parentheses.
        figures: name -> figure.
        label: header of the first column, which holds the row names.
    """
    folder, written = Path(folder), []
    for name, table in tables.items():
        written.append(write_csv(table, folder / f"{name}.csv", True, index_label=label))
        written.append(write_markdown(scores.readable(table), folder / f"{name}.md", True))
    for name, figure in figures.items():
        with writing(folder / f"{name}.png", True) as temporary, style.in_style():
            figure.savefig(temporary, format="png")
        written.append(folder / f"{name}.png")
    return written
