"""``lfm-ppl simulate``: a model's simulated data as files."""

from __future__ import annotations

import shlex

from lfm_ppl.cli import choices, folders, session
from lfm_ppl.cli.options import SimulateOptions
from lfm_ppl.io import data, loading
from lfm_ppl.io.truth import write_truth
from lfm_ppl.utils import atomic_files


def run(name: str, options: SimulateOptions) -> None:
    """Write FILE.csv and, where the truth is known, FILE.truth.json."""
    model = loading.load(name)
    model_options = choices.options(model, options.option)
    table = atomic_files.refuse_existing(options.out or f"{model.name}.csv", options.overwrite)
    truth_file = atomic_files.refuse_existing(table.with_suffix(".truth.json"), options.overwrite)
    folders.check_writable(table.parent)
    session.start(1, not options.no_cache)
    simulated = model.simulate(seed=options.seed, **model_options)
    with atomic_files.atomic_write(table, options.overwrite) as temporary:
        data.write_csv(simulated, temporary)
    print(f"wrote {table}: {len(simulated.times)} times of {', '.join(simulated.outputs)}")
    words = ["lfm-ppl", "fit", name, "--data", str(table)]
    if simulated.truth is not None:
        with atomic_files.atomic_write(truth_file, options.overwrite) as temporary:
            write_truth(simulated, temporary)
        print(f"wrote {truth_file}: the parameters, states and forces of the simulation")
        words += ["--truth", str(truth_file)]
    for text in options.option:
        words += ["--option", text]
    print(f"infer it back with: {shlex.join(words)}")
