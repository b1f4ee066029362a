"""``lfm-ppl compare``: a published experiment, run again, with tables and figures."""

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
    """List the experiments, or run one: what its folder holds already is not computed again."""
    chosen = arguments.study
    if chosen is None:
        print(f"{listed('')}\n\n`lfm-ppl compare NAME` runs one; `--quick` shows in a few minutes that it runs.")
        return 0
    from lfm_ppl.results import tables, web_page
    from lfm_ppl.utils.progress import Console, duration

    report = None if arguments.quiet else Console()
    workers, study = choices.workers(arguments.jobs, arguments.scheduler), chosen.study
    settings = study.settings.from_command_line(report, arguments.quick, **study_options.given(arguments))
    default = Path("lfm-results") / "compare" / (f"{chosen.name}-quick" if arguments.quick else chosen.name)
    with results.lasting(default, arguments.out) as folder:
        web_page.refuse_foreign(folder / PAGE, arguments.overwrite)
        began = time.perf_counter()
        found = study.run(settings, folder, overwrite=arguments.overwrite, report=report, workers=workers)
        written = study.save(found, folder)
    width = shutil.get_terminal_size().columns
    for title, table in found.printed.items():
        print(f"\n{title}\n{tables.text_table(table, width=width)}")
    for note in found.notes:
        print(f"\n{textwrap.fill(note, width)}")
    print(f"\ntime     {duration(time.perf_counter() - began)}")
    for path in written:
        print(f"wrote    {path}")
    return page.attempted(lambda: _index(folder, chosen, found, written, page.command_line(arguments)))


def _index(folder: Path, chosen: CatalogueEntry, found: StudyResult, written: list[Path], command: str) -> Path:
    """Write the tables and figures of an experiment as one page."""
    from lfm_ppl.results import tables, web_page
    from lfm_ppl.results.web_page import Section

    there = [path for path in written if path.is_file()]
    inside = [path.relative_to(folder).as_posix() for path in there if path.is_relative_to(folder)]
    sections = [
        Section("tables", "Tables", "\n".join(web_page.heading(title) + tables.html_table(table)
                                              for title, table in found.printed.items())),
        Section("notes", "Notes", "\n".join(web_page.paragraph(note) for note in found.notes)),
        Section("figures", "Figures", "\n".join(web_page.picture(path.read_bytes(), path.stem)
                                                for path in there if path.suffix == ".png")),
        Section("repeat", "How to repeat it", web_page.preformatted(command) + web_page.paragraph(
            "What the folder holds already is not computed again; in another one, --out, everything is.", "note")),
        Section("files", "Files", web_page.file_list(inside)),
    ]
    return web_page.write(web_page.render(chosen.name, chosen.summary, sections), folder / PAGE, overwrite=True)


def listed(indent: str = "  ") -> str:
    """Return a line on each study."""
    shown = [catalogue.experiment(name) for name in catalogue.names()]
    width = max(len(one.name) for one in shown)
    return "\n".join(f"{indent}{one.name:<{width}}  {one.summary}" for one in shown)
