"""The page beside a result, ``report.html``, as the commands write it: nothing is lost where it cannot be."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd


def command_line(arguments: argparse.Namespace) -> str:
    """Return the command that does the same again, in a folder of its own."""
    return shlex.join(["lfm-ppl", *(word for word in arguments.line if word not in ("--overwrite", "--resume"))])


def refuse_foreign(folder: Path, overwrite: bool) -> None:
    """Raise FileExistsError where another program's ``report.html`` stands in the way; ours is brought up to date."""
    from lfm_ppl.results import html_report, web_page

    web_page.refuse_foreign(folder / html_report.NAME, overwrite)


def exists(folder: Path) -> bool:
    """Whether a folder has a page."""
    from lfm_ppl.results import html_report

    return (folder / html_report.NAME).is_file()


def save(result: Any, folder: Path, overwrite: bool, figures: Sequence[Path],
         more: Mapping[str, pd.DataFrame] | None = None) -> int:
    """Write the page and say so; return 1 where it could not be written.

    Args:
        result: an ArviZ object.
        folder: of the result.
        overwrite: replace a page that exists.
        figures: PNG files to show.
        more: further tables, see `lfm_ppl.save_report`.
    """
    from lfm_ppl.results import html_report

    return attempted(lambda: html_report.save_report(result, folder / html_report.NAME, overwrite, figures=figures,
                                                     more=more))


def update(result: Any, folder: Path, figures: Sequence[Path] = (),
           more: Mapping[str, pd.DataFrame] | None = None) -> int:
    """Write the page of a result that another command has added to; return 1 where it could not be written.

    Args:
        result: an ArviZ object.
        folder: of the result, with the figures that were drawn of it.
        figures: further ones.
        more: further tables, see `lfm_ppl.save_report`.
    """
    def write() -> Path:
        from lfm_ppl.results import html_report
        from lfm_ppl.results.plots.saving import pages_of

        # By name, since the folder may hold figures of a result that was replaced.
        drawn = [path for name, _, _ in pages_of(result, "full") if (path := folder / f"{name}.png").is_file()]
        return html_report.save_report(result, folder / html_report.NAME, overwrite=True, figures=[*drawn, *figures],
                                       more=more)

    return attempted(write)


def attempted(write: Callable[[], Path]) -> int:
    """Write a page and say where; where it fails, which costs no result, say why and return 1."""
    try:
        path = write()
    except Exception as error:
        print(f"lfm-ppl: the page could not be written: {error}", file=sys.stderr)
        return 1
    print(f"wrote    {path}")
    return 0
