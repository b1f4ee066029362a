"""Make the notebooks from their Python files and run them.

Every notebook is written as a Python file with cells (jupytext's percent format), which is what is
read and reviewed. This script turns each into an .ipynb, runs it from top to bottom, and keeps the
result with its pictures beside the source.

    python notebooks/execute.py                    all of them
    python notebooks/execute.py 01_quickstart      one
    LFM_QUICK=1 python notebooks/execute.py --check    run all in quick mode, write nothing
    python notebooks/execute.py --jobs 2           two at a time

With LFM_QUICK=1 the notebooks draw few samples, from programs that are compiled with less effort: it
shows that they run, and no more. An error in a cell ends the script.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

from lfm_ppl.utils.compilation import fast_loops, quick_compilation

FOLDER = Path(__file__).resolve().parent
CELL_TIMEOUT_S = 3600
# Tracing makes millions of objects that live, through which Python would look for garbage again and again.
RARE_GARBAGE_COLLECTION = "--IPKernelApp.exec_lines=import gc; gc.set_threshold(50_000, 20, 50)"


def quick() -> bool:
    """Return whether the notebooks are run in quick mode."""
    return bool(os.environ.get("LFM_QUICK"))


def sources() -> list[Path]:
    """Return the Python files that are notebooks."""
    return sorted(FOLDER.glob("[0-9][0-9]_*.py"))


def execute(source: Path, folder: Path) -> nbformat.NotebookNode:
    """Return the notebook of a Python file, run in `folder`."""
    notebook = jupytext.read(source)
    client = NotebookClient(
        notebook,
        timeout=CELL_TIMEOUT_S,
        kernel_name="python3",
        extra_arguments=[RARE_GARBAGE_COLLECTION] if quick() else [],
        resources={"metadata": {"path": str(folder)}},
    )
    client.execute()
    return tidy(notebook)


def tidy(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Drop what differs between two runs of the same notebook or names this machine."""
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook.metadata = nbformat.from_dict({"kernelspec": kernel})
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number}"
        cell.metadata = nbformat.from_dict({})
        for output in cell.get("outputs", []):
            if output.output_type == "stream":  # a warning starts with the path of a file
                output.text = re.sub(r"(?m)^/\S*/site-packages/", "", output.text)
    return notebook


def main() -> int:
    """Run the notebooks that the command line names."""
    os.environ["PYTHONWARNINGS"] = "ignore:IProgress not found"  # in the kernel: there is no widget to draw a bar
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", help="such as 01_quickstart; default: all")
    parser.add_argument("--check", action="store_true", help="write nothing")
    parser.add_argument("--jobs", type=int, default=1, help="how many at a time; default: 1")
    arguments = parser.parse_args()
    selection = [path for path in sources() if not arguments.names or path.stem in arguments.names]
    if not selection:
        stems = ", ".join(path.stem for path in sources())
        print(f"no notebook {' '.join(arguments.names)}; there are: {stems}", file=sys.stderr)
        return 2
    if not arguments.check and quick():
        print("LFM_QUICK is for --check: quick results are not to be kept", file=sys.stderr)
        return 2
    if arguments.jobs < 1:
        print(f"--jobs must be at least 1, got {arguments.jobs}", file=sys.stderr)
        return 2

    if quick():  # kernels inherit the environment; those that are kept run as a reader's would
        fast_loops()
        quick_compilation(1)

    def run(source: Path) -> None:
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as scratch:
            notebook = execute(source, Path(scratch))
        if not arguments.check:
            nbformat.write(notebook, source.with_suffix(".ipynb"))
        print(f"{source.stem}: {time.perf_counter() - started:.0f} s", flush=True)

    # Each notebook computes in a kernel, which is a process of its own; here a thread waits for it.
    with ThreadPoolExecutor(arguments.jobs) as pool:
        waiting = [pool.submit(run, source) for source in selection]
        try:
            for future in waiting:
                future.result()
        finally:
            pool.shutdown(cancel_futures=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
