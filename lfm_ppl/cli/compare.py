"""``lfm-ppl compare``: a published experiment, run again, with tables and figures."""

from __future__ import annotations

import argparse
import shutil
import textwrap
import time
from pathlib import Path
from typing import TYPE_CHECKING

from lfm_ppl.cli import choices, page, results, session

if TYPE_CHECKING:  # experiments, which take seconds to import
    from lfm_ppl.experiments.catalogue import Experiment, Report

PAGE = "index.html"


def run(arguments: argparse.Namespace) -> int:
    """List the experiments, or run one: what its folder holds already is not computed again."""
    session.start(1, not arguments.no_cache, one_thread=True)  # so that one process finds the numbers of several
    from lfm_ppl.engine.progress import Console
    from lfm_ppl.experiments import catalogue
    from lfm_ppl.progress import duration
    from lfm_ppl.results import tables, web_page

    if arguments.experiment is None:
        _list()
        return 0
    chosen = catalogue.experiment(arguments.experiment)
    workers = choices.workers(arguments.jobs, arguments.scheduler)
    default = Path("lfm-results") / "compare" / (f"{chosen.name}-quick" if arguments.quick else chosen.name)
    with results.lasting(default, arguments.out) as folder:
        web_page.refuse_foreign(folder / PAGE, arguments.overwrite)
        started = time.perf_counter()
        found = chosen.run(catalogue.Wanted(
            folder, arguments.realisations, arguments.conditional, arguments.seed, arguments.quick, arguments.overwrite,
            None if arguments.quiet else Console(), workers, arguments.data,
            tuple(arguments.satellites) if arguments.satellites else None, arguments.train_days, arguments.axes))
    width = shutil.get_terminal_size().columns
    for title, table in found.tables.items():
        print(f"\n{title}\n{tables.text_table(table, width=width)}")
    for note in found.notes:
        print(f"\n{textwrap.fill(note, width)}")
    print(f"\ntime     {duration(time.perf_counter() - started)}")
    for path in found.written:
        print(f"wrote    {path}")
    return page.attempted(lambda: _index(folder, chosen, found, page.command_line(arguments)))


def _index(folder: Path, chosen: Experiment, found: Report, command: str) -> Path:
    """Write the tables and figures of an experiment as one page."""
    from lfm_ppl.results import tables, web_page
    from lfm_ppl.results.web_page import Section

    there = [path for path in found.written if path.is_file()]
    inside = [path.relative_to(folder).as_posix() for path in there if path.is_relative_to(folder)]
    sections = [
        Section("tables", "Tables", "\n".join(web_page.heading(title) + tables.html_table(table)
                                              for title, table in found.tables.items())),
        Section("notes", "Notes", "\n".join(web_page.paragraph(note) for note in found.notes)),
        Section("figures", "Figures", "\n".join(web_page.picture(path.read_bytes(), path.stem)
                                                for path in there if path.suffix == ".png")),
        Section("repeat", "How to repeat it", web_page.preformatted(command) + web_page.paragraph(
            "What the folder holds already is not computed again; in another one, --out, everything is.", "note")),
        Section("files", "Files", web_page.file_list(inside)),
    ]
    return web_page.write(web_page.render(chosen.name, chosen.summary, sections), folder / PAGE, overwrite=True)


def _list() -> None:
    from lfm_ppl.experiments import catalogue

    shown = [catalogue.experiment(name) for name in catalogue.names()]
    width = max(len(one.name) for one in shown)
    for one in shown:
        print(f"{one.name:<{width}}  {one.summary}")
    print("\n`lfm-ppl compare NAME` runs one; `--quick` shows in a few minutes that it runs.")
