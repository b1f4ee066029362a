"""``lfm-ppl simulate``: a model's simulated data as files."""

from __future__ import annotations

import argparse
import shlex

from lfm_ppl.cli import choices, results, session
from lfm_ppl.io import data, loading
from lfm_ppl.io.truth import write_truth
from lfm_ppl.utils import atomic_files


def run(arguments: argparse.Namespace) -> int:
    """Write FILE.csv and, where the truth is known, FILE.truth.json."""
    model = loading.load(arguments.model)
    options = choices.options(model, arguments.option)
    table = atomic_files.refuse_existing(arguments.out or f"{model.name}.csv", arguments.overwrite)
    truth_file = atomic_files.refuse_existing(table.with_suffix(".truth.json"), arguments.overwrite)
    results.writable(table.parent)
    session.start(1, not arguments.no_cache)
    simulated = model.simulate(seed=arguments.seed, **options)
    with atomic_files.atomic_write(table, arguments.overwrite) as temporary:
        data.write_csv(simulated, temporary)
    print(f"wrote {table}: {len(simulated.times)} times of {', '.join(simulated.outputs)}")
    words = ["lfm-ppl", "fit", arguments.model, "--data", str(table)]
    if simulated.truth is not None:
        with atomic_files.atomic_write(truth_file, arguments.overwrite) as temporary:
            write_truth(simulated, temporary)
        print(f"wrote {truth_file}: what it was simulated from")
        words += ["--truth", str(truth_file)]
    for option in arguments.option:
        words += ["--option", option]
    print(f"infer it back with: {shlex.join(words)}")
    return 0
