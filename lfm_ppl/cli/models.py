"""``lfm-ppl models``: list the shipped models, or describe one."""

from __future__ import annotations

import argparse
from typing import Any

from lfm_ppl.cli import description
from lfm_ppl.io import loading


def run(arguments: argparse.Namespace) -> int:
    """Print the list, or the description of ``arguments.model``."""
    if arguments.model is None:
        _list()
    else:
        _describe(loading.load(arguments.model))
    return 0


def _list() -> None:
    shipped = [loading.load(name) for name in loading.available()]
    width = max(len(model.name) for model in shipped)
    for model in shipped:
        print(f"{model.name:<{width}}  {model.summary}")
    print("\n`lfm-ppl models NAME` describes one, `lfm-ppl fit NAME` runs it on simulated data.")


def _describe(model: loading.ModelFile) -> None:
    print(f"{model.name}  ({model.path})\n\n{model.description}\n")
    from lfm_ppl.cli import session

    session.start(1)
    print(f"outputs: {_outputs(model)}")
    if model.inputs:
        print("known inputs: " + ", ".join(f"{_with_unit(model, name)} ({way})" for name, way in model.inputs.items()))
    if unit := model.units.get("time"):
        print(f"time: in {unit}")
    print()
    try:
        model_description = description.describe(model)
    except Exception:  # the constants of the file describe a model that does not run
        _table("parameters (fix one with --set NAME=VALUE)", list(model.parameters.items()))
        _print_options(model)
        print("The model itself could not be run.")
        raise
    else:
        _print_parameters(model_description)
        more = (
            (("of states and forces (deterministics)", model_description.deterministics),)
            if model_description.deterministics
            else ()
        )
        for title, entries in (("forces", model_description.forces), ("states", model_description.states), *more):
            _table(title, [(name, text) for name, text in entries.items()])
        print(f"likelihood: {model_description.approximation}\n")
        for table, names in model_description.unknown_names.items():
            if names and not model.options:  # options may change the sites
                print(f"{table} has {', '.join(names)}, which the model does not have; correct the name.\n")
    _print_options(model)


def _print_options(model: loading.ModelFile) -> None:
    rows = [(name, _option(*entry)) for name, entry in model.options.items()]
    _table("options (choose with --option NAME=VALUE)", rows)


def _print_parameters(model_description: description.Description) -> None:
    print("parameters (fix one with --set NAME=VALUE):")
    rows = [("name", "shape", "prior", "support", ""), *model_description.parameters]
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    for row in rows:
        cells = [f"{cell:<{width}}" for cell, width in zip(row[:4], widths, strict=True)]
        print("  " + "  ".join([*cells, row[4]]).rstrip())
    print()
    if model_description.derived:
        _table("derived from them", model_description.derived)


def _outputs(model: loading.ModelFile) -> str:
    if model.outputs is None:
        return "any number, the columns of the data file"
    return ", ".join(_with_unit(model, name) for name in model.outputs)


def _with_unit(model: loading.ModelFile, name: str) -> str:
    return f"{name} ({unit})" if (unit := model.units.get(name)) else name


def _option(default: Any, accepted: tuple[Any, ...] | type, help_: str) -> str:
    if isinstance(accepted, tuple):
        values = ", ".join(str(value) for value in accepted)
    else:
        values = {float: "a number", int: "a whole number", bool: "true or false"}.get(accepted, "text")
    return f"{help_}: {values} (default: {default})"


def _table(title: str, rows: list[tuple[str, str]]) -> None:
    print(f"{title}:")
    width = max((len(name) for name, _ in rows), default=0)
    for name, help_ in rows:
        print(f"  {name:<{width}}  {help_}")
    print("" if rows else "  none\n")
