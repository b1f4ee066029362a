"""NumPyro's NUTS as a `SamplingAlgorithm` on a bound model.

1. The potential energy and its gradient come from the compiled program of the bound model, in the derivative mode that
   is faster there.
2. With a Laplace approximation, the chain moves in coordinates x in which the posterior is nearly symmetric
   (`lfm_ppl.inference.symmetrising`), and the warm-up starts with the correlation matrix C of the approximation, the
   covariance of x to first order, as the dense inverse mass matrix.
3. NumPyro estimates the covariance of x anew in each window of the warm-up. Each estimate starts with `_PSEUDO_DRAWS`
   draws of the approximation, so that the inverse mass matrix is (n S + n_0 C) / (n + n_0) for the covariance S of n
   draws.

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
from lfm_ppl.inference.symmetrising import SymmetrisingTransform

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
        hmc: NumPyro's state; its position is x of the transform, or z without one.
        transform: from the position of the chain to z, constant in time; its correlation matrix regularises the mass
            matrix. None: there is none.
    """

    hmc: HMCState
    transform: SymmetrisingTransform | None

    @property
    def z(self) -> jax.Array:
        """Unconstrained parameters (d,)."""
        position = ravel_pytree(self.hmc.z)[0]
        return position if self.transform is None else self.transform.to_z(position)

    @property
    def potential(self) -> jax.Array:
        """Minus the log density of the unconstrained parameters."""
        if self.transform is None:
            return self.hmc.potential_energy
        return self.hmc.potential_energy + self.transform.log_jacobian(ravel_pytree(self.hmc.z)[0])


def nuts_options(bound: BoundModel, options: Mapping[str, Any], has_transform: bool) -> dict[str, Any]:
    """Return the options of NUTS with defaults.

    A dense mass matrix is the default for up to ten parameters, with a Laplace approximation for any number.
    """
    completed = {"forward_mode_differentiation": bound.forward_mode,
                 "dense_mass": has_transform or bound.size <= _DENSE_MASS_LIMIT,
                 "target_accept_prob": _ACCEPTANCE_AT_MODE if has_transform else _ACCEPTANCE, **options}
    if isinstance(completed["dense_mass"], bool):
        # Blocks of named sites, the form that NUTS itself uses for a model.
        completed["dense_mass"] = [tuple(sorted(bound.sites))] if completed["dense_mass"] else []
    return completed


def nuts(bound: BoundModel, num_warmup: int, options: Mapping[str, Any]) -> SamplingAlgorithm:
    """Return NumPyro's NUTS; its tuning is a `SymmetrisingTransform` or None.

    Args:
        bound: the model.
        num_warmup: warm-up steps of each chain.
        options: completed options, see `nuts_options`.
    """
    options = dict(options)
    log_density_gradient = bound.gradient(bool(options.pop("forward_mode_differentiation")))

    def kernel_at(y: Any, transform: SymmetrisingTransform | None, **mass_matrix: Any) -> NUTS:
        # NumPyro differentiates the potential in reverse mode. A custom derivative gives it the gradient of the traced
        # program, which is in forward mode for few parameters and is compiled once for all chains and blocks.
        @jax.custom_jvp
        def log_density(z: jax.Array) -> jax.Array:
            return bound.log_density(z, y)

        @log_density.defjvp
        def _(primals: tuple, tangents: tuple) -> tuple:
            value, gradient = log_density_gradient(primals[0], y)
            return value, gradient @ tangents[0]

        def potential(position: Any) -> jax.Array:
            x = ravel_pytree(position)[0]
            if transform is None:
                return -log_density(x)
            return -log_density(transform.to_z(x)) - transform.log_jacobian(x)

        return NUTS(potential_fn=potential, **options, **mass_matrix)

    def init(key: jax.Array, point: ParamInfo, y: Any, transform: SymmetrisingTransform | None) -> NUTSState:
        mass_matrix = {}
        if transform is not None:
            point, mass_matrix = _transformed(point, transform), {"inverse_mass_matrix": transform.correlation}
        hmc = kernel_at(y, transform, **mass_matrix).init(key, num_warmup, point, (), {})
        return NUTSState(_with_pseudo_draws(hmc, transform), transform)

    def step(state: NUTSState, y: Any) -> NUTSState:
        hmc, transform = state
        kernel = kernel_at(y, transform)
        # `init` builds the functions of the kernel. Its state is not used, and the compiler removes it.
        kernel.init(jax.random.key(0), num_warmup, ParamInfo(hmc.z, hmc.potential_energy, hmc.z_grad), (), {})
        return NUTSState(_with_pseudo_draws(kernel.sample(hmc, (), {}), transform), transform)

    return SamplingAlgorithm(init, step, _summary)


def _transformed(point: ParamInfo, transform: SymmetrisingTransform) -> ParamInfo:
    """Return x of a point, and the potential energy there with its gradient."""
    z, unravel = ravel_pytree(point.z)
    x = transform.to_x(z)
    log_jacobian, its_gradient = jax.value_and_grad(transform.log_jacobian)(x)
    gradient = ravel_pytree(point.z_grad)[0] * transform.derivative(x) - its_gradient
    return ParamInfo(unravel(x), point.potential_energy - log_jacobian, unravel(gradient))


def _summary(state: NUTSState) -> dict[str, jax.Array]:
    hmc = state.hmc
    return {"z": state.z, "diverging": hmc.diverging, "acceptance_rate": hmc.accept_prob,
            "n_steps": hmc.num_steps, "energy": hmc.energy, "step_size": hmc.adapt_state.step_size,
            "lp": state.potential}


def _with_pseudo_draws(hmc: HMCState, transform: SymmetrisingTransform | None) -> HMCState:
    """Return the state with `_PSEUDO_DRAWS` draws of the approximation in every empty covariance estimate.

    A window of the warm-up may have few draws for d parameters. Welford's algorithm continues from the mean, the sum of
    squares and the count of the pseudo-draws.
    """
    if transform is None:
        return hmc
    adaptation = hmc.adapt_state
    (sites, (mean, sum_of_squares, count)), = adaptation.mm_state.items()  # one dense block of all sites
    is_empty = count == 0
    estimate = (jnp.where(is_empty, 0.0, mean),
                jnp.where(is_empty, _PSEUDO_DRAWS * transform.correlation, sum_of_squares),
                jnp.where(is_empty, _PSEUDO_DRAWS, count))
    return hmc._replace(adapt_state=adaptation._replace(mm_state={sites: estimate}))
