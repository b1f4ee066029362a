"""NumPyro's NUTS as a `SamplingAlgorithm` on a bound model.

1. The potential energy and its gradient come from the compiled program of the bound model, in the derivative mode that
   is faster there.
2. With a Laplace approximation N(mode, C), the warm-up starts with C as the dense inverse mass matrix.
3. NumPyro estimates the covariance anew in each window of the warm-up. Each estimate starts with `_PSEUDO_DRAWS` draws
   of the approximation, so that the inverse mass matrix is (n S + n_0 C) / (n + n_0) for the covariance S of n draws.

Source: Hoffman and Gelman (2014), JMLR 15, 1593-1623; Stan Development Team, Stan reference manual, "HMC algorithm
parameters" (windows and regularisation of the warm-up).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from numpyro.infer import NUTS
from numpyro.infer.hmc import HMCState
from numpyro.infer.util import ParamInfo

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.kernels.algorithm import SamplingAlgorithm
from lfm_ppl.inference.laplace_start import Laplace

_DENSE_MASS_LIMIT = 10
"""Largest number of unconstrained parameters with a dense mass matrix by default."""

_PSEUDO_DRAWS = 20
"""Weight of the Laplace approximation in the covariance estimates of a warm-up, in draws."""

_ACCEPTANCE, _ACCEPTANCE_AT_MODE = 0.8, 0.9
"""Target acceptance probability. With the posterior's covariance as mass matrix the higher one costs a quarter more
gradients, and no draw of the p53 data diverged, where one to three of 1,000 did."""


class NUTSState(NamedTuple):
    """State of a NUTS chain.

    Attributes:
        hmc: NumPyro's state.
        laplace: the Laplace approximation that regularises the mass matrix, constant in time; or None.
    """

    hmc: HMCState
    laplace: Laplace | None

    @property
    def z(self) -> Any:
        """Unconstrained parameters by site."""
        return self.hmc.z


def nuts_options(bound: BoundModel, options: Mapping[str, Any], laplace: Laplace | None) -> dict[str, Any]:
    """Return the options of NUTS with defaults.

    A dense mass matrix is the default for up to ten parameters, with a Laplace approximation for any number.
    """
    completed = {"forward_mode_differentiation": bound.forward_mode,
                 "dense_mass": laplace is not None or bound.size <= _DENSE_MASS_LIMIT,
                 "target_accept_prob": _ACCEPTANCE if laplace is None else _ACCEPTANCE_AT_MODE, **options}
    if isinstance(completed["dense_mass"], bool):
        # Blocks of named sites, the form that NUTS itself uses for a model.
        completed["dense_mass"] = [tuple(sorted(bound.sites))] if completed["dense_mass"] else []
    return completed


def nuts(bound: BoundModel, num_warmup: int, options: Mapping[str, Any]) -> SamplingAlgorithm:
    """Return NumPyro's NUTS; its tuning is a Laplace approximation or None.

    Args:
        bound: the model.
        num_warmup: warm-up steps of each chain.
        options: completed options, see `nuts_options`.
    """
    options = dict(options)
    log_density_gradient = bound.gradient(bool(options.pop("forward_mode_differentiation")))

    def kernel_at(y: Any, **mass_matrix: Any) -> NUTS:
        # NumPyro differentiates the potential in reverse mode. A custom derivative gives it the gradient of the traced
        # program, which is in forward mode for few parameters and is compiled once for all chains and blocks.
        @jax.custom_jvp
        def log_density(z: jax.Array) -> jax.Array:
            return bound.log_density(z, y)

        @log_density.defjvp
        def _(primals: tuple, tangents: tuple) -> tuple:
            value, gradient = log_density_gradient(primals[0], y)
            return value, gradient @ tangents[0]

        return NUTS(potential_fn=lambda z: -log_density(ravel_pytree(z)[0]), **options, **mass_matrix)

    def init(key: jax.Array, point: ParamInfo, y: Any, laplace: Laplace | None) -> NUTSState:
        mass_matrix = {} if laplace is None else {"inverse_mass_matrix": laplace.covariance}
        hmc = kernel_at(y, **mass_matrix).init(key, num_warmup, point, (), {})
        return NUTSState(_with_pseudo_draws(hmc, laplace), laplace)

    def step(state: NUTSState, y: Any) -> NUTSState:
        kernel, hmc = kernel_at(y), state.hmc
        # `init` builds the functions of the kernel. Its state is not used, and the compiler removes it.
        kernel.init(jax.random.key(0), num_warmup, ParamInfo(hmc.z, hmc.potential_energy, hmc.z_grad), (), {})
        return NUTSState(_with_pseudo_draws(kernel.sample(hmc, (), {}), state.laplace), state.laplace)

    return SamplingAlgorithm(init, step, _summary)


def _summary(state: NUTSState) -> dict[str, jax.Array]:
    hmc = state.hmc
    return {"z": ravel_pytree(hmc.z)[0], "diverging": hmc.diverging, "acceptance_rate": hmc.accept_prob,
            "n_steps": hmc.num_steps, "energy": hmc.energy, "step_size": hmc.adapt_state.step_size,
            "lp": hmc.potential_energy}


def _with_pseudo_draws(hmc: HMCState, laplace: Laplace | None) -> HMCState:
    """Return the state with `_PSEUDO_DRAWS` draws of the approximation in every empty covariance estimate.

    A window of the warm-up may have few draws for d parameters. Welford's algorithm continues from the mean, the sum of
    squares and the count of the pseudo-draws.
    """
    if laplace is None:
        return hmc
    adaptation = hmc.adapt_state
    (sites, (mean, sum_of_squares, count)), = adaptation.mm_state.items()  # one dense block of all sites
    is_empty = count == 0
    estimate = (jnp.where(is_empty, laplace.mode, mean),
                jnp.where(is_empty, _PSEUDO_DRAWS * laplace.covariance, sum_of_squares),
                jnp.where(is_empty, _PSEUDO_DRAWS, count))
    return hmc._replace(adapt_state=adaptation._replace(mm_state={sites: estimate}))
