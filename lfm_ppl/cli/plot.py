"""``lfm-ppl plot``: the figures of a saved result again."""

from __future__ import annotations

import argparse
from pathlib import Path

from lfm_ppl.cli import results


def run(arguments: argparse.Namespace) -> int:
    """Draw every figure that the result has the numbers for."""
    from lfm_ppl.results import arviz_data, files
    from lfm_ppl.results.plots import save_figures

    path = files.locate(arguments.result)
    target = Path(arguments.out) if arguments.out else path.parent
    results.writable(target)
    posterior = arviz_data.load(path)
    for written in save_figures(posterior, target, (arguments.format,), overwrite=arguments.overwrite):
        print(f"wrote {written}")
    return 0
