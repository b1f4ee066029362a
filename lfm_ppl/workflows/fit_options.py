"""The options of `lfm_ppl.fit`, and the record of a run for its result and for its resumption."""

from __future__ import annotations

import functools
import inspect
import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

import jax
import numpy as np

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.samplers import SAMPLERS
from lfm_ppl.likelihoods.priors import assumptions, prior_interval, without_parameters
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.storage import run_record
from lfm_ppl.utils import checks
from lfm_ppl.utils.random_keys import split_by_name


def keys_of(seed: int) -> dict[str, jax.Array]:
    """Return the random keys of a seed: one for each part of a fit, and one for the forecasts of its result."""
    return split_by_name(jax.random.key(seed), ("mode", "chains", "starts", "trajectories", "scores", "forecasts",
                                               "tuning", "transform"))


@dataclass(frozen=True)
class FitOptions:
    """Options of `lfm_ppl.fit`, where they are described.

    Attributes:
        sampler: name of the sampler.
        chains: number of chains.
        warmup: warm-up draws of each chain; None: the default of the starting point.
        samples: draws of each chain.
        thin: steps of one draw; None for "map".
        seed: of all random numbers.
        fixed: name -> value of the fixed parameters.
        requested_times: times of the trajectories, the argument ``at``; None: a grid over the data; a dict by site.
        trajectory_draws: number of draws with a trajectory.
        init: starting points.
        sampler_options: arguments of the sampler's kernel.
        chain_method: "parallel", "vectorized" or "sequential"; None for "map".
        settings: of the likelihoods, where the model leaves them open.
    """

    sampler: str
    chains: int
    warmup: int | None
    samples: int
    thin: int | None
    seed: int
    fixed: dict[str, Any]
    requested_times: Any
    trajectory_draws: int
    init: Any
    sampler_options: dict[str, Any]
    chain_method: str | None
    settings: dict[str, Any] = field(default_factory=dict)

    @functools.cached_property
    def keys(self) -> dict[str, jax.Array]:
        """Random keys by purpose, see `keys_of`."""
        return keys_of(self.seed)

    def description(self, bound: BoundModel) -> dict[str, Any]:
        """Return the attributes of the result on the likelihood and the sampler."""
        likelihood = (likelihood_settings(bound.site.example) if not bound.is_by_site else
                      {"likelihood": "; ".join(f"{name}: {site_model.site.example.description}"
                                               for name, site_model in bound.site_models.items())})
        if self.sampler == "pmmh":
            likelihood["likelihood"] = "estimated without bias (particle filter)"
        return {
            **likelihood, "sampler": self.sampler, "seed": self.seed, "chains": self.chains, "warmup": self.warmup,
            "samples": self.samples, "fixed": json.dumps({k: np.asarray(v).tolist() for k, v in self.fixed.items()}),
        }  # fmt: skip

    def record(self, bound: BoundModel, model_digest: Any) -> dict[str, Any]:
        """Return the settings that a run must share with the run that it resumes."""
        times = self.requested_times
        parts = list(times.values()) if isinstance(times, Mapping) else [times]
        return {
            **self.description(bound), "thin": self.thin, "chain_method": self.chain_method, "init": self.init,
            "sampler_options": self.sampler_options, "trajectory_draws": self.trajectory_draws,
            "parameters": bound.names, "model": run_record.digest(model_digest),
            "times": run_record.digest(*jax.tree.leaves(bound.times)),
            "data": run_record.digest(*jax.tree.leaves(bound.y)),
            "times of the trajectories": None if times is None else run_record.digest(
                *(part if part is None else np.asarray(part, float) for part in parts)),
            "versions": run_record.versions(),
        }  # fmt: skip

    def call(self, model: str, data: str, model_kwargs: Mapping[str, Any] | None) -> str:
        """Return the call of `lfm_ppl.fit` as text; an argument that is not plain data appears as its own name."""
        arguments = {
            "sampler": self.sampler, "chains": self.chains, "warmup": self.warmup, "samples": self.samples,
            "thin": self.thin, "seed": self.seed, "trajectory_draws": self.trajectory_draws,
            "chain_method": self.chain_method, "init": self.init, "sampler_options": self.sampler_options,
            "fixed": {name: np.asarray(value).tolist() for name, value in self.fixed.items()}, **self.settings,
        }  # fmt: skip
        values = [f"{name}={value!r}" if isinstance(value, (str, int, float, dict)) else f"{name}={name}"
                  for name, value in arguments.items() if value is not None and value != {}]
        objects = [f"{name}={name}" for name, value in (("at", self.requested_times), ("model_kwargs", model_kwargs))
                   if value is not None]
        return f"lfm.fit({', '.join([model, data, *values, *objects])})"


def likelihood_settings(example: SeriesLikelihood) -> dict[str, Any]:
    """Return the attributes of a result on the likelihood of one site."""
    return {
        **example.recorded_settings, "likelihood": example.description,
        **({"factors": example.factors_in_words} if example.factors_in_words else {}),
        **({"constraints": example.constraints_in_words} if example.constraints_in_words else {}),
    }  # fmt: skip


def check_sizes(sampler: str, chains: int, warmup: int | None, samples: int, thin: int | None,
                trajectory_draws: int) -> None:
    """Check the name of the sampler and the numbers of chains, draws and steps."""
    checks.one_of("sampler", sampler, SAMPLERS, likeness=checks.ABBREVIATIONS)
    for name, value, special_values in (
            ("chains", chains, ()), ("samples", samples, ()), ("warmup", warmup, (None, 0)), ("thin", thin, (None,)),
            ("trajectory_draws", trajectory_draws, (0,))):
        if value not in special_values:
            checks.positive_integer(name, value)


def describe_priors(bound: BoundModel) -> str:
    """Return name -> prior in words, as JSON."""
    trace = bound.trace()
    return json.dumps({name: prior_interval(trace[name]["fn"]) for name in bound.sites})


def describe_assumptions(bound: BoundModel) -> str:
    """Return the model's observations, forces and initial state in words, without estimated numbers, as JSON."""
    trace = bound.trace()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a draw of the prior may be extreme
        another = bound.likelihood({name: _draw(trace[name]["fn"], trace[name]["value"]) for name in bound.sites})
    descriptions = assumptions(another.first.ssm.model)
    return json.dumps({topic: without_parameters(description, descriptions[topic])
                       for topic, description in assumptions(bound.site.example.ssm.model).items()})


def _draw(prior: Any, value: Any) -> Any:
    """Return a draw of a prior; of an improper one, which has no draws, ``value`` and a percent of it."""
    try:
        return prior.sample(jax.random.key(0))
    except NotImplementedError:
        return 1.01 * value


def model_docstring(numpyro_model: Any) -> str | None:
    """Return the docstring of a model, without its handlers and partial applications; None where there is none."""
    while (inner := getattr(numpyro_model, "fn", getattr(numpyro_model, "func", None))) is not None:
        numpyro_model = inner
    return inspect.getdoc(numpyro_model) if inspect.isroutine(numpyro_model) else None


def versions() -> dict[str, str]:
    """Return the versions of the packages that produced a result."""
    return run_record.versions() | {"arviz": metadata.version("arviz")}
