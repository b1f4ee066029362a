"""Options of `lfm-ppl fit` as arguments of `lfm_ppl.fit`: likelihood, sampler, attributes of the result."""

from __future__ import annotations

import argparse
import json
from typing import Any

from lfm_ppl.cli import choices, page
from lfm_ppl.io import loading
from lfm_ppl.io.data_set import Data

SETTINGS = ("rule", "steps", "max_step", "iterations", "tolerance")
"""Options of the approximation; None: the model's setting."""


def check_sampler(arguments: argparse.Namespace) -> None:
    """Raise ValueError for a setting of another sampler."""
    if arguments.target_accept is not None and arguments.sampler == "map":
        raise ValueError("--target-accept is for the samplers nuts, ram and pmmh, not for map.")
    if arguments.trajectory_draws == 0 and (arguments.until is not None or arguments.at is not None):
        raise ValueError("--until and --at need trajectories; --trajectory-draws 0 draws none.")
    if arguments.init is not None and arguments.sampler == "map":
        raise ValueError("--init sets the starting points of chains; the sampler map has no chains.")
    if arguments.particles is not None and arguments.sampler != "pmmh":
        raise ValueError(f"--particles is for the sampler pmmh; {arguments.sampler} uses none.")


def approximated_model(arguments: argparse.Namespace, model: loading.ModelFile) -> Any:
    """Return the NumPyro model with the user's settings of the approximation."""
    from lfm_ppl.inference.handlers.settings import approximate

    return approximate(
        model.model,
        rule=choices.rule(arguments.rule),
        steps=arguments.steps,
        max_step=arguments.max_step,
        iterations=arguments.iterations,
        tolerance=arguments.tolerance,
        **constraint_settings(arguments),
    )


def constraint_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the bounds and the times at which they hold; empty without bounds."""
    bounds = {"lower": choices.bounds("--lower", arguments.lower), "upper": choices.bounds("--upper", arguments.upper)}
    if bounds == {"lower": None, "upper": None}:
        if arguments.grid is not None:
            raise ValueError(
                "--grid is the number of times at which --lower and --upper hold; give one of them with it."
            )
        return {}
    if arguments.sampler == "pmmh":
        raise ValueError("--lower and --upper are for the samplers nuts, ram and map: the particle filter of pmmh "
                         "does not support constraints.")
    return {name: value for name, value in (bounds | {"grid": arguments.grid}).items() if value is not None}


def sampling_arguments(arguments: argparse.Namespace, model: loading.ModelFile) -> dict[str, Any]:
    """Return the arguments of `lfm_ppl.fit` on the sampler."""
    target_accept = arguments.target_accept
    if target_accept is None and arguments.sampler == "nuts":
        target_accept = model.target_accept
    sampler_options = (("target_accept_prob", target_accept), ("particles", arguments.particles))
    return {
        "sampler": arguments.sampler,
        "chains": arguments.chains,
        "warmup": arguments.warmup,
        "samples": arguments.samples,
        "thin": arguments.thin,
        "trajectory_draws": arguments.trajectory_draws,
        "init": arguments.init,
        "sampler_options": {name: value for name, value in sampler_options if value is not None},
    }


def result_attributes(arguments: argparse.Namespace, model: loading.ModelFile, observed: Data,
               options: dict[str, Any]) -> dict[str, Any]:
    """Return the attributes of a result that `lfm-ppl check` and `forecast` read."""
    return {
        "model_file": model.name if loading.available().get(model.name) == model.path else str(model.path),
        "settings": json.dumps({name: getattr(arguments, name) for name in SETTINGS} | constraint_settings(arguments)),
        "options": json.dumps(options), "data": arguments.data or "simulated",
        "description": model.description, "meanings": json.dumps(dict(model.parameters)),
        "command_line": page.command_line(arguments),
        **({"note": observed.note} if observed.note else {}),
    }  # fmt: skip
