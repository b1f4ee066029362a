"""What a model file holds, found by running its model once: parameters with their priors, forces, states, outputs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from lfm_ppl import loading
from lfm_ppl.data import Data, InputTable

_MOST_NUMBERS = 4
"""Numbers of a vector that are printed."""


class Parameter(NamedTuple):
    """A parameter of a model: name, shape, prior and support in words, and what the file says of it."""

    name: str
    shape: str
    prior: str
    support: str
    help: str


class Description(NamedTuple):
    """What a run of the model showed.

    Attributes:
        parameters: that are sampled.
        derived: names of what is computed from them, with their shapes.
        forces: name -> kind and unit.
        states: name -> unit.
        deterministics: name -> unit.
        approximation: the likelihood's settings.
    """

    parameters: list[Parameter]
    derived: list[tuple[str, str]]
    forces: dict[str, str]
    states: dict[str, str]
    deterministics: dict[str, str]
    approximation: str


def describe(model: loading.ModelFile) -> Description:
    """Run the model at the medians of its priors, and read off what it sampled.

    Raises:
        ValueError, TypeError: whatever a fit of it would say.
    """
    from lfm_ppl.inference.bound_model import bind

    data = model.simulate() if model.can_simulate else _made_up(model)
    bound = bind(model.model, data.times, data.y, **model.keywords(data, {}))
    site = bound.site
    system = site.example.ssm.model
    units: Mapping[str, str] = {**model.units, **system.units}
    parameters, derived = [], []
    for name, one in bound.trace().items():
        shape = np.shape(one["value"]) if one["type"] in ("sample", "deterministic") else ()
        text = " x ".join(map(str, shape)) or "number"
        if one["type"] == "sample" and name in bound.sites:
            parameters.append(Parameter(name, text, prior(one["fn"]), support(one["fn"].support),
                                        model.parameters.get(name, "")))
        elif one["type"] == "deterministic":
            derived.append((name, text))
    example = site.example
    approximation = ("exact: the model is linear" if _exact(example) else
                     f"{example.rule.name}, {example.steps} steps"
                     + (f", {example.iterations} iterations" if example.iterations else ""))
    return Description(
        parameters, derived, {name: " ".join([type(force).__name__, _bracketed(units.get(name))]).strip()
                              for name, force in system.forces.items()},
        {name: _bracketed(units.get(name)) for name in system.state_names},
        {name: _bracketed(units.get(name)) for name in system.deterministic_names}, approximation)


def _made_up(model: loading.ModelFile) -> Data:
    """Return data of the right shape, where the file has none."""
    outputs = model.outputs or ("y",)
    times = np.arange(3.0)
    inputs = {name: InputTable(times, np.ones(3), way) for name, way in model.inputs.items()}
    return Data(times, np.zeros((3, len(outputs))), outputs, units=model.units, inputs=inputs)


def prior(distribution: Any) -> str:
    """Return a distribution in words: its name and its arguments.

    Example:
        >>> import numpyro.distributions as dist
        >>> prior(dist.LogNormal(0.0, 0.5).expand([3]).to_event(1))
        'LogNormal(0, 0.5)'
    """
    while hasattr(distribution, "base_dist") and type(distribution).__name__ in (
            "Independent", "ExpandedDistribution", "MaskedDistribution"):
        distribution = distribution.base_dist
    values = [getattr(distribution, name, None) for name in distribution.arg_constraints]
    return f"{type(distribution).__name__}({', '.join(_number(value) for value in values if value is not None)})"


def support(constraint: Any) -> str:
    """Return a support in words.

    Example:
        >>> import numpyro.distributions as dist
        >>> support(dist.HalfNormal(1.0).support), support(dist.Uniform(2.0, 3.0).support)
        ('> 0', '2 to 3')
    """
    while hasattr(constraint, "base_constraint"):
        constraint = constraint.base_constraint
    low, high = (getattr(constraint, name, None) for name in ("lower_bound", "upper_bound"))
    if low is not None and high is not None:
        return f"{_number(low)} to {_number(high)}"
    if low is not None:
        return f"> {_number(low)}"
    if high is not None:
        return f"< {_number(high)}"
    return type(constraint).__name__.strip("_").lower()


def _number(value: Any) -> str:
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        return type(value).__name__
    flat = array.ravel()
    if flat.size and np.all(flat == flat[0]):
        return f"{flat[0]:.3g}"
    shown = ", ".join(f"{one:.3g}" for one in flat[:_MOST_NUMBERS])
    return f"[{shown}{', ...' if flat.size > _MOST_NUMBERS else ''}]"


def _bracketed(unit: str | None) -> str:
    return f"({unit})" if unit else ""


def _exact(example: Any) -> bool:
    from lfm_ppl.results.likelihoods import is_exact

    return is_exact(example.ssm)
