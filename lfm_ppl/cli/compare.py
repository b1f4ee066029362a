"""``lfm-ppl compare``: a published study with its tables and figures."""

from __future__ import annotations

import shutil
import textwrap
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lfm_ppl.cli import folders, pages
from lfm_ppl.cli.options import StudyOptions
from lfm_ppl.report import html_report
from lfm_ppl.results import tables
from lfm_ppl.studies.catalogue import CatalogueEntry
from lfm_ppl.studies.declaration import StudyResult
from lfm_ppl.utils.progress import Console, duration

PAGE = "index.html"


def run(entry: CatalogueEntry, values: Mapping[str, Any], options: StudyOptions, line: Sequence[str]) -> int:
    """Run a study with the settings of the user; stored results are not computed again.

    Return 1 if its page cannot be written.
    """
    report = None if options.quiet else Console()
    workers, study = options.processes.workers, entry.study
    settings = study.settings.from_command_line(report, options.quick, **values)
    path = Path(options.out or folders.FOLDER / "compare" / (f"{entry.name}-quick" if options.quick else entry.name))
    with folders.open_folder(path) as folder:
        html_report.refuse_foreign(folder / PAGE, options.overwrite)
        start_time = time.perf_counter()
        result = study.run(settings, folder, overwrite=options.overwrite, report=report, workers=workers)
        written = study.save(result, folder)
    width = shutil.get_terminal_size().columns
    for title, table in result.printed.items():
        print(f"\n{title}\n{tables.text_table(table, width=width)}")
    for note in result.notes:
        print(f"\n{textwrap.fill(note, width)}")
    print(f"\ntime     {duration(time.perf_counter() - start_time)}")
    for path in written:
        print(f"wrote    {path}")
    return pages.report_failure(lambda: _write_page(folder, entry, result, written, pages.command_line(line)))


def _write_page(folder: Path, entry: CatalogueEntry, result: StudyResult, written: list[Path], command: str) -> Path:
    """Write the tables and figures of a study as one page."""
    existing = [path for path in written if path.is_file()]
    return html_report.write_page(
        folder / PAGE, True, entry.name, entry.summary,
        {path.stem: path.read_bytes() for path in existing if path.suffix == ".png"},
        tables=result.printed, notes=result.notes,
        repeat={"commands": [command], "note": "Stored results of the folder are not computed again; in another folder "
                                               "(--out) everything is."},
        files=[path.relative_to(folder).as_posix() for path in existing if path.is_relative_to(folder)])
