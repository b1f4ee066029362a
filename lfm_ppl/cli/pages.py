"""The report beside a result, ``report.html``, and figures; a failure does not affect the result."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lfm_ppl.report import html_report
from lfm_ppl.utils.atomic_files import atomic_write


def command_line(line: Sequence[str], *more: str) -> str:
    """Return the command that repeats a run in a new folder, with ``more`` words."""
    return shlex.join(["lfm-ppl", *(word for word in line if word not in ("--overwrite", "--resume")), *more])


def update(result: Any, folder: Path, figures: Sequence[Path] = (),
           more: Mapping[str, pd.DataFrame] | None = None) -> int:
    """Write the report of an extended result beside it, with further figures and tables; return 1 if that fails."""
    def write() -> Path:
        from lfm_ppl.plots.saving import pages_of

        # By name: the folder may hold figures of a replaced result.
        stored = [path for name, _, _ in pages_of(result, "full") if (path := folder / f"{name}.png").is_file()]
        return html_report.save_report(result, folder / html_report.NAME, overwrite=True, figures=[*stored, *figures],
                                       more=more)

    return report_failure(write)


def draw(plot: Callable, result: Any, path: Path, overwrite: bool) -> int:
    """Write a figure; return 1 if that fails."""
    def write() -> Path:
        figure = plot(result, width="full")
        with atomic_write(path, overwrite) as temporary:
            figure.savefig(temporary, format="png")
        return path

    return report_failure(write, "figure")


def report_failure(write: Callable[[], Path], kind: str = "page") -> int:
    """Write a file and print its path; print the reason of a failure and return 1."""
    try:
        print(f"wrote    {write()}")
    except Exception as error:  # the numbers are saved
        print(f"lfm-ppl: the {kind} could not be written: {error}", file=sys.stderr)
        return 1
    return 0
