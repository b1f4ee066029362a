"""The description of a model file, from one run of its model: parameters with priors, forces, states, outputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lfm_ppl.io import loading
from lfm_ppl.io.data_set import Data, InputTable


class Parameter(NamedTuple):
    """A parameter of a model: name, shape, prior and support as text, and the help text of the file."""

    name: str
    shape: str
    prior: str
    support: str
    help: str


@dataclass(frozen=True)
class Description:
    """The description of a model.

    Attributes:
        parameters: sampled parameters.
        derived: deterministic sites and their shapes.
        forces: name -> kind and unit.
        states: name -> unit.
        deterministics: name -> unit.
        approximation: the likelihood's settings.
        unknown_names: table of the file (UNITS, PARAMETERS) -> names that the model does not have, at default options.
    """

    parameters: list[Parameter]
    derived: list[tuple[str, str]]
    forces: dict[str, str]
    states: dict[str, str]
    deterministics: dict[str, str]
    approximation: str
    unknown_names: dict[str, list[str]]


def describe(model: loading.ModelFile) -> Description:
    """Run the model at the medians of its priors, and describe its sites.

    Raises:
        ValueError, TypeError: as a fit of the model.
    """
    from lfm_ppl.inference.bind import bind
    from lfm_ppl.inference.priors import prior, support

    data = model.simulate() if model.can_simulate else _placeholder_data(model)
    bound = bind(model.model, data.times, data.y, **model.keywords(data, {}))
    site = bound.site
    system = site.example.ssm.model
    units: Mapping[str, str] = {**model.units, **system.units}
    parameters, derived = [], []
    for name, entry in bound.trace().items():
        shape = np.shape(entry["value"]) if entry["type"] in ("sample", "deterministic") else ()
        text = " x ".join(map(str, shape)) or "number"
        if entry["type"] == "sample" and name in bound.sites:
            parameters.append(Parameter(name, text, prior(entry["fn"]), support(entry["fn"].support),
                                        model.parameters.get(name, "")))
        elif entry["type"] == "deterministic":
            derived.append((name, text))
    example = site.example
    approximation = ("exact: the model is linear" if _exact(example) else
                     f"{example.rule.name}, {example.steps} steps"
                     + (f", {example.iterations} iterations" if example.iterations else "")
                     + (f"; sites by {example.sites_in_words}" if example.sites_in_words else ""))
    named = {"time", *data.inputs, *system.output_names, *system.state_names, *system.force_names,
             *system.deterministic_names, *bound.trace()}
    return Description(
        parameters, derived, {name: " ".join([type(force).__name__, _bracketed(units.get(name))]).strip()
                              for name, force in system.forces.items()},
        {name: _bracketed(units.get(name)) for name in system.state_names},
        {name: _bracketed(units.get(name)) for name in system.deterministic_names}, approximation,
        {"UNITS": [name for name in model.units if name not in named],
         "PARAMETERS": [name for name in model.parameters if name not in bound.trace()]})


def _placeholder_data(model: loading.ModelFile) -> Data:
    """Return data of the right shape for a model without simulated data."""
    outputs = model.outputs or ("y",)
    times = np.arange(3.0)
    inputs = {name: InputTable(times, np.ones(3), way) for name, way in model.inputs.items()}
    return Data(times, np.zeros((3, len(outputs))), outputs, units=model.units, inputs=inputs)


def _bracketed(unit: str | None) -> str:
    return f"({unit})" if unit else ""


def _exact(example: Any) -> bool:
    from lfm_ppl.results.likelihoods import is_exact

    return is_exact(example.ssm)
