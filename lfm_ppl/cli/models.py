"""``lfm-ppl models``: list the shipped models, or describe one from a run at the medians of its priors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lfm_ppl.cli import session
from lfm_ppl.io import loading
from lfm_ppl.io.data_set import Data
from lfm_ppl.io.input_table import ONCE, InputTable

_TYPES = {float: "a number", int: "a whole number", bool: "true or false"}


def list_models() -> None:
    """Print a line for each shipped model."""
    shipped = [loading.load(name) for name in loading.available()]
    width = max(len(model.name) for model in shipped)
    for model in shipped:
        print(f"{model.name:<{width}}  {model.summary}")
    print("\n`lfm-ppl models NAME` describes one, `lfm-ppl fit NAME` runs it on simulated data.")


def describe_model(name: str) -> None:
    """Print the constants of a model file, and the parameters, forces and states of its model."""
    model = loading.load(name)
    print(f"{model.name}  ({model.path})\n\n{model.description}\n")

    def with_unit(name: str) -> str:
        return f"{name} ({unit})" if (unit := model.units.get(name)) else name

    if model.outputs is None:
        print("outputs: any number, the columns of the data file")
    else:
        print("outputs: " + ", ".join(with_unit(name) for name in model.outputs))
    if model.inputs:
        print("known inputs: " + ", ".join(f"{with_unit(name)} ({way})" for name, way in model.inputs.items()))
    if unit := model.units.get("time"):
        print(f"time: in {unit}")
    print()
    session.start(1)
    try:
        bound = _bind(model)
    except Exception:  # the constants of the file describe a model that does not run
        _print_table("parameters (fix one with --set NAME=VALUE)", list(model.parameters.items()))
        _print_options(model)
        print("The model itself could not be run.")
        raise
    _print_sites(model, bound)
    _print_options(model)


def _bind(model: loading.ModelFile) -> Any:
    """Return the bound model, with simulated data or with data of the right shape."""
    from lfm_ppl.inference.bind import bind

    if model.can_simulate:
        data = model.simulate()
    else:
        times, outputs = np.arange(3.0), model.outputs or ("y",)
        inputs = {name: InputTable(times, np.ones(3), way.removesuffix(ONCE)) for name, way in model.inputs.items()}
        labels = ("1", "2") if loading.is_panel(str(model.path)) else ()
        shape = (2, 3) if labels else (3,)
        data = Data(np.broadcast_to(times, shape), np.zeros((*shape, len(outputs))), outputs, units=model.units,
                    inputs=inputs, series=labels)
    return bind(model.model, data.times, data.y, model_kwargs=model.keywords(data, {}))


def _print_sites(model: loading.ModelFile, bound: Any) -> None:
    from lfm_ppl.likelihoods.priors import prior, support

    trace, example = bound.trace(), bound.site.example
    system = example.ssm.model
    units = {**model.units, **system.units}
    shapes = {name: " x ".join(map(str, np.shape(site["value"]))) or "number" for name, site in trace.items()
              if site["type"] in ("sample", "deterministic")}
    _print_table("parameters (fix one with --set NAME=VALUE)", [("name", "shape", "prior", "support", ""), *(
        (name, shapes[name], prior(trace[name]["fn"]), support(trace[name]["fn"].support),
         model.parameters.get(name, "")) for name in shapes if name in bound.sites)])
    derived = [(name, shape) for name, shape in shapes.items() if trace[name]["type"] == "deterministic"]
    for title, rows in (
        ("derived from them", derived),
        ("forces", [(name, f"{type(force).__name__} {_bracketed(units, name)}") for name, force in
                    system.forces.items()]),
        ("states", [(name, _bracketed(units, name)) for name in system.state_names]),
        ("of states and forces (deterministics)", [(name, _bracketed(units, name)) for name in
                                                   system.deterministic_names]),
    ):
        if rows or title in ("forces", "states"):
            _print_table(title, rows)
    settings = example.settings
    parts = [f"{settings.rule.name}, {settings.steps} steps",
             settings.iterations and f"{settings.iterations} iterations"]
    factors = f"; factors by {example.factors_in_words}" if example.factors_in_words else ""
    text = ", ".join(filter(None, parts)) + factors
    if example.ssm.has_exact_likelihood or not example.has_gaussian_state:
        is_exact_likelihood = example.has_gaussian_state and example.ssm.plan.has_exact_moments
        text = "exact: the model is linear" if is_exact_likelihood else example.description
    print(f"likelihood: {text}\n")
    model_names = {"time", *model.inputs, *system.output_names, *system.state_names, *system.force_names,
                   *system.deterministic_names, *trace}
    for table, names in (("UNITS", set(model.units) - model_names), ("PARAMETERS", set(model.parameters) - set(trace))):
        if names and not model.options:  # options may change the sites
            print(f"{table} has {', '.join(sorted(names))}, which the model does not have; correct the name.\n")


def _bracketed(units: dict[str, str], name: str) -> str:
    return f"({unit})" if (unit := units.get(name)) else ""


def _print_options(model: loading.ModelFile) -> None:
    rows = []
    for name, (default, accepted, help_) in model.options.items():
        values = ", ".join(map(str, accepted)) if isinstance(accepted, tuple) else _TYPES.get(accepted, "text")
        rows.append((name, f"{help_}: {values} (default: {default})"))
    _print_table("options (choose with --option NAME=VALUE)", rows)


def _print_table(title: str, rows: Sequence[tuple[str, ...]]) -> None:
    print(f"{title}:")
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  " + "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    print("" if rows else "  none\n")
