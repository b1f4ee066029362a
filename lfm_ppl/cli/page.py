"""The report beside a result, ``report.html``; a failure does not affect the result."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd


def command_line(arguments: argparse.Namespace) -> str:
    """Return the command that repeats the run in a new folder."""
    return shlex.join(["lfm-ppl", *(word for word in arguments.line if word not in ("--overwrite", "--resume"))])


def refuse_foreign(folder: Path, overwrite: bool) -> None:
    """Raise FileExistsError for a ``report.html`` of another program; a report of lfm_ppl is replaced."""
    from lfm_ppl.results import html_report

    html_report.refuse_foreign(folder / html_report.NAME, overwrite)


def exists(folder: Path) -> bool:
    """Whether a folder has a page."""
    from lfm_ppl.results import html_report

    return (folder / html_report.NAME).is_file()


def save(result: Any, folder: Path, overwrite: bool, figures: Sequence[Path],
         more: Mapping[str, pd.DataFrame] | None = None) -> int:
    """Write the report and print its path; return 1 if that fails.

    Args:
        result: an ArviZ object.
        folder: folder of the result.
        overwrite: replace an existing report.
        figures: PNG files to show.
        more: further tables, see `lfm_ppl.save_report`.
    """
    from lfm_ppl.results import html_report

    return attempted(lambda: html_report.save_report(result, folder / html_report.NAME, overwrite, figures=figures,
                                                     more=more))


def update(result: Any, folder: Path, figures: Sequence[Path] = (),
           more: Mapping[str, pd.DataFrame] | None = None) -> int:
    """Write the report of an extended result; return 1 if that fails.

    Args:
        result: an ArviZ object.
        folder: folder of the result and its figures.
        figures: further figures.
        more: further tables, see `lfm_ppl.save_report`.
    """
    def write() -> Path:
        from lfm_ppl.results import html_report
        from lfm_ppl.results.plots.saving import pages_of

        # By name: the folder may hold figures of a replaced result.
        figure_paths = [path for name, _, _ in pages_of(result, "full") if (path := folder / f"{name}.png").is_file()]
        figure_paths = list(dict.fromkeys([*figure_paths, *figures]))
        return html_report.save_report(
            result, folder / html_report.NAME, overwrite=True, figures=figure_paths, more=more
        )

    return attempted(write)


def attempted(write: Callable[[], Path]) -> int:
    """Write a report and print its path; print the reason of a failure and return 1."""
    try:
        path = write()
    except Exception as error:
        print(f"lfm-ppl: the page could not be written: {error}", file=sys.stderr)
        return 1
    print(f"wrote    {path}")
    return 0
