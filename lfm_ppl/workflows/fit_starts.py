"""The starting points of the chains of `lfm_ppl.fit`, and the sampler that moves them.

1. NUTS starts at draws from the widened Laplace approximation, whose covariance is its first inverse mass matrix, in
   coordinates in which the posterior is nearly symmetric (`lfm_ppl.inference.symmetrising`). Where the approximation is
   not usable, it starts at the prior median with a unit mass matrix.
2. A random walk needs no gradient, but to learn the shape of the posterior by rejection takes thousands of steps. Its
   first proposal covariance is that of the Laplace approximation, and its chains start at draws from it.
3. Particle-marginal RAM also chooses the number of particles, by default at the mode.
4. With a usable mode, the likelihood's iterations start from the smoothed moments there, and iterations and integration
   steps are as few as suffice (`lfm_ppl.inference.tuning`).
5. Where an explicit step is too long for a fast decay at the mode, and the model leaves steps and method open, the
   mode is searched again with exponential steps.
6. A resumed run finds nothing anew: its setup holds the numbers that were chosen before the first step.

Source: `lfm_ppl.inference.laplace_start`; Vihola (2012), Statistics and Computing 22, 997-1008.
"""

from __future__ import annotations

import dataclasses
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from numpyro.infer import init_to_median, init_to_value

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.bound_samplers import BoundSampler, nuts_sampler, particle_marginal_sampler, ram_sampler
from lfm_ppl.inference.kernels.options import KERNELS
from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalRAM, Tuned
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.laplace_start import (
    NEGLIGIBLE_RISE,
    Laplace,
    UnusableModeError,
    has_second_mode,
    laplace_approximation,
    starting_points,
)
from lfm_ppl.inference.long_steps import EXPONENTIAL, stiff_sites, with_exponential_steps
from lfm_ppl.inference.map import MAPResult, mode_of
from lfm_ppl.inference.symmetrising import SymmetrisingTransform, symmetrising_transform
from lfm_ppl.inference.tuning import ANCHOR, Tuning, anchor_at_mode, anchor_attribute, anchored
from lfm_ppl.utils import checks
from lfm_ppl.utils.interruption import was_interrupt
from lfm_ppl.utils.random_keys import split_keys
from lfm_ppl.workflows.fit_options import FitOptions

FALLBACK = "init_fallback"
"""Attribute of a result: the reason why NUTS did not start from the Laplace approximation."""

_WARMUP, _SHORT_WARMUP = 1000, 300
"""Default warm-up draws of each chain; the short one is that of NUTS from the Laplace approximation."""

_SETUP = ("particles", "log_likelihood_sd", "warmup", "init", FALLBACK, EXPONENTIAL, ANCHOR)
"""Attributes that a resumed run needs."""


@dataclass(frozen=True)
class ChainStart:
    """The sampler and the starting points of all chains.

    Attributes:
        sampler: the sampler on the bound model.
        points: (C, d) starting points; None in a resumed run.
        attributes: of the result, with ``warmup``, the number of warm-up draws.
        particle_options: keyword arguments of the particle smoother; empty for other samplers.
        mode: (d,), the posterior mode where it is known.
        tunings: settings of the likelihoods that were found at the mode, by site.
    """

    sampler: BoundSampler
    points: np.ndarray | None
    attributes: dict[str, Any]
    particle_options: dict[str, Any] = field(default_factory=dict)
    mode: np.ndarray | None = None
    tunings: Mapping[str, Tuning] = field(default_factory=dict)

    @property
    def setup(self) -> dict[str, Any]:
        """Numbers that a resumed run needs."""
        return {name: self.attributes[name] for name in _SETUP if name in self.attributes}


def find_start(bound: BoundModel, options: FitOptions, setup: Mapping[str, Any] | None) -> ChainStart:
    """Return the sampler and the starting points; ``setup`` is that of a run which is resumed, None for a new run."""
    check_init(options.init)
    find = _find_nuts_start if options.sampler == "nuts" else _find_random_walk_start
    return find(bound, options, setup)


def check_init(init: Any) -> None:
    """Check the argument ``init``."""
    if isinstance(init, str):
        checks.one_of("init", init, ("map", "median"))
    elif init is not None and not callable(init):
        raise TypeError('init must be None, "map", "median" or a NumPyro strategy such as '
                        f"numpyro.infer.init_to_uniform, got {init!r}.")


def _find_nuts_start(bound: BoundModel, options: FitOptions, setup: Mapping[str, Any] | None) -> ChainStart:
    sampler_options = options.sampler_options
    # The Laplace approximation does not regularise a mass matrix of the user.
    is_regularized = "inverse_mass_matrix" not in sampler_options and sampler_options.get("dense_mass", True) is True

    def sampler(bound: BoundModel, transform: SymmetrisingTransform | None, warmup: int) -> BoundSampler:
        num_warmup = warmup * (options.thin or 1)
        return nuts_sampler(bound, num_warmup, sampler_options, transform)

    transform = None
    if setup is not None:
        bound = with_exponential_steps(bound, json.loads(setup.get(EXPONENTIAL, "[]")))
        if setup["init"] == "laplace" and is_regularized:
            # The stored state holds the transform; the program needs its shapes only.
            zeros = np.zeros(bound.size)
            transform = SymmetrisingTransform(Laplace(zeros, np.eye(bound.size)), zeros)
        return ChainStart(sampler(anchored(bound, setup), transform, setup["warmup"]), None, dict(setup))
    laplace, fallback, stiff = None, {}, []
    is_at_mode = options.init in (None, "map")
    if is_at_mode:
        try:
            laplace = laplace_approximation(options.keys["mode"], bound)
            if stiff := _stiff_sites(bound, laplace.mode):
                bound = with_exponential_steps(bound, stiff)
                laplace = laplace_approximation(options.keys["mode"], bound)
        except UnusableModeError as error:
            laplace = None
            fallback = {FALLBACK: f"the chains start at the prior median, with a unit mass matrix: {error}"}
    default_warmup = _SHORT_WARMUP if laplace is not None and is_regularized else _WARMUP
    warmup = default_warmup if options.warmup is None else options.warmup
    tunings: dict[str, Tuning] = {}
    if laplace is not None:
        bound, tunings = anchor_at_mode(options.keys["tuning"], bound, laplace)
    if laplace is not None and is_regularized:
        transform = symmetrising_transform(options.keys["transform"], bound, laplace)
    nuts = sampler(bound, transform, warmup)
    if is_at_mode:  # the advice for a slow warm-up is to start there
        nuts = dataclasses.replace(nuts, slow_warmup_hint="")
    if laplace is not None:
        points = starting_points(options.keys["starts"], bound, laplace, options.chains)
        attributes = {"warmup": warmup, "init": "laplace", **_stiff_attribute(stiff),
                      **anchor_attribute(bound, tunings)}
        return ChainStart(nuts, points, attributes, mode=laplace.mode, tunings=tunings)
    strategy = init_to_median if is_at_mode else _strategy(options)
    points = _starting_points(bound, options, strategy, nuts.evaluate)
    init = "strategy" if callable(options.init) else "median"
    return ChainStart(nuts, points, {"warmup": warmup, "init": init, **_stiff_attribute(stiff), **fallback})


def _find_random_walk_start(bound: BoundModel, options: FitOptions, setup: Mapping[str, Any] | None) -> ChainStart:
    kernel_type, sampler_options = KERNELS[options.sampler], dict(options.sampler_options)
    if setup is not None:
        bound = with_exponential_steps(bound, json.loads(setup.get(EXPONENTIAL, "[]")))
        bound, kernel = anchored(bound, setup), kernel_type(bound.model, **sampler_options)
        if isinstance(kernel, ParticleMarginalRAM):
            kernel.prepare(bound, None, Tuned(int(setup["particles"]), float(setup["log_likelihood_sd"])))
        start = _random_walk_start(bound, options, kernel, None)
        return dataclasses.replace(start, attributes={**start.attributes, **setup})
    has_covariance = "initial_covariance" in sampler_options
    tunings: dict[str, Tuning] = {}
    mode = None if has_covariance and options.init != "map" else _find_mode(bound, options)
    stiff: list[str] = []
    if mode is not None and options.sampler != "pmmh" and (stiff := _stiff_sites(bound, mode.mode)):
        bound = with_exponential_steps(bound, stiff)
        mode = _find_mode(bound, options)
    strategy = _strategy(options, mode)
    # Without a usable covariance the mode is a starting point only.
    if mode is not None and (has_covariance or mode.unidentified or not np.all(np.isfinite(mode.covariance))):
        mode = None
    if mode is not None:
        sampler_options["initial_covariance"] = mode.covariance
        if options.sampler == "pmmh":
            # The start of a chain may be far from the posterior, where the variance of the estimate is another one.
            sampler_options.setdefault("tune_at", bound.unravel(mode.mode))
        elif options.init in (None, "map") and mode.converged and not has_second_mode(mode):
            bound, tunings = anchor_at_mode(options.keys["tuning"], bound, Laplace(mode.mode, mode.start_covariance))
    kernel = kernel_type(bound.model, **sampler_options)
    if mode is None or options.init is not None:
        points = _starting_points(bound, options, strategy, bound.log_density)
    else:
        points = _draws_about_mode(bound, options, mode)
    if isinstance(kernel, ParticleMarginalRAM):
        kernel.prepare(bound, points[0])
    start = _random_walk_start(bound, options, kernel, points)
    attributes = {**start.attributes, **_stiff_attribute(stiff), **anchor_attribute(bound, tunings)}
    return dataclasses.replace(start, attributes=attributes, mode=None if mode is None else mode.mode, tunings=tunings)


def _random_walk_start(bound: BoundModel, options: FitOptions, kernel: RAM, points: np.ndarray | None) -> ChainStart:
    warmup = _WARMUP if options.warmup is None else options.warmup
    num_warmup = warmup * (options.thin or 1)
    if not isinstance(kernel, ParticleMarginalRAM):
        return ChainStart(ram_sampler(bound, num_warmup, kernel), points, {"warmup": warmup})
    assert kernel.tuned is not None
    attributes = {"particles": kernel.tuned.particles, "log_likelihood_sd": kernel.tuned.sd,
                  "delayed": int(kernel.delayed), "warmup": warmup}
    particle_options = {"particle_settings": kernel.settings, "particle_steps": kernel.particle_steps}
    return ChainStart(particle_marginal_sampler(bound, num_warmup, kernel), points, attributes, particle_options)


def _stiff_sites(bound: BoundModel, z: np.ndarray) -> list[str]:
    """Return `stiff_sites`; none where a function of the model has no derivative in forward mode."""
    try:
        return stiff_sites(bound, z)
    except Exception as error:  # of any kind; the check before the sampling says which
        if was_interrupt(error):
            raise KeyboardInterrupt from error
        return []


def _stiff_attribute(sites: list[str]) -> dict[str, str]:
    return {EXPONENTIAL: json.dumps(sites)} if sites else {}


def _find_mode(bound: BoundModel, options: FitOptions) -> MAPResult:
    """Return the posterior mode; its warnings concern chains that start there, and no mere proposal covariance."""
    if options.init == "map":
        return mode_of(options.keys["mode"], bound, negligible_rise=NEGLIGIBLE_RISE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return mode_of(options.keys["mode"], bound, restarts=2, negligible_rise=NEGLIGIBLE_RISE)


def _strategy(options: FitOptions, mode: MAPResult | None = None) -> Callable:
    """Return the NumPyro strategy of ``init``, which is at ``mode`` for "map"."""
    if callable(options.init):
        return options.init
    return init_to_value(values=mode.parameters) if options.init == "map" and mode is not None else init_to_median


def _starting_points(bound: BoundModel, options: FitOptions, strategy: Callable, evaluate: Callable) -> np.ndarray:
    """Return one point (C, d) for each chain, by a NumPyro strategy, where ``evaluate`` returns finite values."""
    keys = split_keys(options.keys["starts"], options.chains)
    return np.stack([bound.start(keys(chain), strategy, evaluate=evaluate) for chain in range(options.chains)])


def _draws_about_mode(bound: BoundModel, options: FitOptions, mode: MAPResult) -> np.ndarray:
    """Return draws (C, d) from the Laplace approximation; the mode itself where the density of a draw is zero."""
    root = np.linalg.cholesky(mode.covariance)
    normals = np.asarray(jax.random.normal(options.keys["starts"], (options.chains, bound.size)))
    points = mode.mode + normals @ root.T
    is_possible = [bool(np.isfinite(bound.log_density(point))) for point in points]
    return np.where(np.array(is_possible)[:, None], points, mode.mode)
