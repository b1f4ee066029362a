"""``lfm-ppl new``: a commented model file to start from."""

from __future__ import annotations

import argparse
import shlex
from importlib import resources
from pathlib import Path

from lfm_ppl.cli import results


def run(arguments: argparse.Namespace) -> int:
    """Write the file and print the next commands; an existing file is an error."""
    path = Path(arguments.file)
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise ValueError(f"a model file is a Python file that can be imported, such as my_model.py, got {path.name!r}.")
    if path.exists():
        raise FileExistsError(f"{path} already exists; choose another name.")
    results.writable(path.parent)
    text = resources.files("lfm_ppl.cli").joinpath("template.py").read_text(encoding="utf-8")
    with open(path, "x", encoding="utf-8") as file:  # fails if another process has made it meanwhile
        file.write(text)
    name = shlex.quote(str(path))
    print(f"wrote {path}\n\n"
          f"  lfm-ppl models {name}                 what is in it\n"
          f"  lfm-ppl fit {name}                    fit it to the data that it simulates\n"
          f"  lfm-ppl fit {name} --data mine.csv    fit it to your own")
    return 0
