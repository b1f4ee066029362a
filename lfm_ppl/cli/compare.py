"""``lfm-ppl compare``: a published study with its tables and figures."""

from __future__ import annotations

import argparse
import shutil
import textwrap
import time
from pathlib import Path
from typing import TYPE_CHECKING

from lfm_ppl.cli import choices, page, results, study_options
from lfm_ppl.experiments import catalogue

if TYPE_CHECKING:  # experiments, which take seconds to import
    from lfm_ppl.experiments.catalogue import CatalogueEntry
    from lfm_ppl.experiments.study import StudyResult

PAGE = "index.html"


def run(arguments: argparse.Namespace) -> int:
    """List the studies, or run one; stored results are not computed again."""
    entry = arguments.study
    if entry is None:
        print(f"{listed('')}\n\n`lfm-ppl compare NAME` runs a study; `--quick` is a short run of a few minutes.")
        return 0
    from lfm_ppl.results import html_report, tables
    from lfm_ppl.utils.progress import Console, duration

    report = None if arguments.quiet else Console()
    workers, study = choices.workers(arguments.jobs, arguments.scheduler), entry.study
    settings = study.settings.from_command_line(report, arguments.quick, **study_options.given_settings(arguments))
    default = Path("lfm-results") / "compare" / (f"{entry.name}-quick" if arguments.quick else entry.name)
    with results.lasting(default, arguments.out) as folder:
        html_report.refuse_foreign(folder / PAGE, arguments.overwrite)
        start_time = time.perf_counter()
        study_result = study.run(settings, folder, overwrite=arguments.overwrite, report=report, workers=workers)
        written = study.save(study_result, folder)
    width = shutil.get_terminal_size().columns
    for title, table in study_result.printed.items():
        print(f"\n{title}\n{tables.text_table(table, width=width)}")
    for note in study_result.notes:
        print(f"\n{textwrap.fill(note, width)}")
    print(f"\ntime     {duration(time.perf_counter() - start_time)}")
    for path in written:
        print(f"wrote    {path}")
    return page.attempted(lambda: _index(folder, entry, study_result, written, page.command_line(arguments)))


def _index(folder: Path, entry: CatalogueEntry, study_result: StudyResult, written: list[Path], command: str) -> Path:
    """Write the tables and figures of a study as one page."""
    from lfm_ppl.results import html_report

    existing_files = [path for path in written if path.is_file()]
    return html_report.write_page(
        folder / PAGE, True, entry.name, entry.summary,
        {path.stem: path.read_bytes() for path in existing_files if path.suffix == ".png"},
        tables=study_result.printed, notes=study_result.notes,
        repeat={"commands": [command], "note": "Stored results of the folder are not computed again; in another folder "
                                               "(--out) everything is."},
        files=[path.relative_to(folder).as_posix() for path in existing_files if path.is_relative_to(folder)])


def listed(indent: str = "  ") -> str:
    """Return one line per study."""
    entries = [catalogue.experiment(name) for name in catalogue.names()]
    width = max(len(entry.name) for entry in entries)
    return "\n".join(f"{indent}{entry.name:<{width}}  {entry.summary}" for entry in entries)
