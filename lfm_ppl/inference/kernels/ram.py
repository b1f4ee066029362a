"""Robust adaptive Metropolis as a NumPyro kernel: no gradients, one density value each step.

1. `RAM` holds the options, and adapts the algorithm of `robust_metropolis` to NumPyro's kernel interface.
2. The first proposal covariance is a multiple of the identity, or given, for example from `lfm_ppl.map_estimate`.

Source: Vihola (2012), Statistics and Computing 22.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from numpyro import handlers
from numpyro.infer import init_to_median, init_to_uniform
from numpyro.infer.util import ParamInfo, initialize_model
from numpyro.util import identity, is_prng_key

from lfm_ppl.inference.kernels.algorithm import SamplingAlgorithm
from lfm_ppl.inference.kernels.kernel import Kernel, as_floating_point, check_start, map_chains
from lfm_ppl.inference.kernels.robust_metropolis import Adaptation, RAMState, finite_or_infinity, robust_metropolis
from lfm_ppl.inference.unconstrained import check_latent, latent_sites
from lfm_ppl.utils import checks

_ADAPTATIONS = ("warmup", "throughout")
_OPTIMAL_SCALE = 2.38
"""Optimal scale of a Gaussian random walk on a Gaussian target of covariance I, times sqrt(d)."""


class RAM(Kernel):
    r"""Robust adaptive Metropolis: a random walk whose covariance is coerced to an acceptance rate.

    In the unconstrained space of the model, with ``U ~ N(0, I)``, propose ``x + S_n U``, accept
    with probability ``alpha_n = min(1, pi(x + S_n U) / pi(x))``, and set

        S_{n+1} S_{n+1}' = S_n (I + eta_n (alpha_n - alpha*) U U' / |U|^2) S_n'

    by a rank-one update of the Cholesky factor, with ``eta_n = min(1, d n^-gamma)``. On an
    elliptical target ``S S'`` becomes proportional to its covariance. A proposal at which the
    density is NaN or infinite is rejected. A step costs one evaluation of the density and O(d^2).
    For ``numpyro.infer.MCMC`` with any ``chain_method``.

    Args:
        model: a NumPyro model whose latent sites are continuous. Either this or ``potential_fn``.
        potential_fn: minus the log density, a function of any pytree of real arrays; ``MCMC.run``
            then needs ``init_params``.
        target_accept_prob: ``alpha*`` in (0, 1); by default 0.234, and 0.44 in one dimension.
        initial_scale: factor of the initial ``S``; by default 1, or ``2.38 / sqrt(d)`` when a
            covariance is given.
        initial_covariance: the initial ``S`` is ``initial_scale`` times the Cholesky factor of this
            matrix (d, d), or of this vector of variances (d,); the identity by default. In the flat
            order of ``jax.flatten_util.ravel_pytree``: sites sorted by name, each in C order, in
            unconstrained coordinates. ``lfm.map_estimate(...).covariance`` is laid out like that.
        adapt: ``"warmup"`` freezes ``S`` after the warm-up, so that the draws come from a plain
            Metropolis chain; ``"throughout"`` goes on with the vanishing steps ``eta_n``.
        exponent: ``gamma`` in (1/2, 1]; a small one adapts faster and longer.
        init_strategy: a NumPyro strategy for the first point of each chain, for example
            ``init_to_uniform``.

    Raises:
        ValueError: bad arguments; when sampling starts: no or discrete latent sites, a missing or
            impossible starting point, a covariance of another size.

    Example:
        >>> import jax, numpyro, numpyro.distributions as dist
        >>> from numpyro.infer import MCMC
        >>> def model(y):
        ...     scale = numpyro.sample("scale", dist.HalfNormal(1.0))
        ...     numpyro.sample("y", dist.Normal(0.0, scale), obs=y)
        >>> mcmc = MCMC(RAM(model), num_warmup=500, num_samples=500, progress_bar=False)
        >>> mcmc.run(jax.random.key(0), 0.3, extra_fields=("accept_prob", "accepted"))
        >>> mcmc.get_samples()["scale"].shape
        (500,)

    Source:
        Vihola (2012), Robust adaptive Metropolis algorithm with coerced acceptance rate, Statistics
        and Computing 22, 997-1008, https://doi.org/10.1007/s11222-011-9269-5.
    """

    def __init__(
        self,
        model: Callable | None = None,
        potential_fn: Callable[[Any], jax.Array] | None = None,
        target_accept_prob: float | None = None,
        initial_scale: float | None = None,
        initial_covariance: ArrayLike | None = None,
        adapt: str = "warmup",
        exponent: float = 2 / 3,
        init_strategy: Callable = init_to_median,
    ) -> None:
        if (model is None) == (potential_fn is None):
            count = "neither" if model is None else "both"
            raise ValueError(
                f"RAM needs exactly one of model and potential_fn, got {count}. Pass a NumPyro "
                "model, or minus the log density as potential_fn."
            )
        if target_accept_prob is not None and not 0.0 < target_accept_prob < 1.0:
            raise ValueError(
                f"target_accept_prob must lie between 0 and 1, got {target_accept_prob}. "
                "Leave it out for 0.234 (0.44 in one dimension)."
            )
        if not 0.5 < exponent <= 1.0:
            raise ValueError(
                f"exponent must lie in (1/2, 1], got {exponent}: otherwise the adaptation "
                "does not vanish, or stops too early. The default is 2/3."
            )
        checks.one_of("adapt", adapt, _ADAPTATIONS)
        if initial_scale is not None:
            checks.positive("initial_scale", initial_scale)
        super().__init__(model)
        self._potential_fn = potential_fn
        self.adaptation = Adaptation(target_accept_prob, exponent, adapt == "throughout")
        self._initial_scale = initial_scale
        self._initial_chol = None if initial_covariance is None else _cholesky(initial_covariance)
        self._init_strategy = init_strategy
        self._potential_fn_gen: Callable | None = None
        self._postprocess_fn: Callable | None = None

    def get_diagnostics_str(self, state: RAMState) -> str:
        """Return the step size and the mean acceptance probability, for the progress bar."""
        return f"step size {state.step_size:.2e}. acc. prob={state.mean_accept_prob:.2f}"

    def postprocess_fn(self, args: tuple, kwargs: dict) -> Callable:
        """Return the map from unconstrained parameters to constrained and deterministic sites."""
        if self._postprocess_fn is None:
            return identity
        return self._postprocess_fn(*args, **kwargs)

    def algorithm(self, num_warmup: int = 0) -> SamplingAlgorithm:
        """Return robust adaptive Metropolis on the model, or on the potential function."""
        return robust_metropolis(self._potential_at, self.adaptation, num_warmup)

    def _potential_at(self, data: tuple[tuple, dict]) -> Callable[[Any], jax.Array]:
        if self._model is None:
            assert self._potential_fn is not None
            return self._potential_fn
        assert self._potential_fn_gen is not None, "init must be called before sample."
        args, kwargs = data
        return self._potential_fn_gen(*args, **kwargs)

    def starting_point(self, key: jax.Array, init_params: Any, args: tuple,
                       kwargs: dict) -> tuple[ParamInfo, jax.Array]:
        """Return the unconstrained position with its potential energy, and the first proposal factor."""
        z, energy = self._starting_position(key, init_params, args, kwargs)
        chain_axes = 0 if is_prng_key(key) else 1
        dimension = sum(math.prod(leaf.shape[chain_axes:]) for leaf in jax.tree_util.tree_leaves(z))
        return ParamInfo(z, energy, None), jnp.asarray(self.initial_factor(dimension))

    def _starting_position(self, key: jax.Array, init_params: Any, args: tuple,
                           kwargs: dict) -> tuple[Any, jax.Array]:
        if self._model is not None:
            # init_to_uniform also serves improper priors, from which nothing can be drawn.
            seeded = handlers.substitute(handlers.seed(self._model, jax.random.key(0)), substitute_fn=init_to_uniform)
            check_latent(latent_sites(handlers.trace(seeded).get_trace(*args, **kwargs)), "RAM")
            info, self._potential_fn_gen, self._postprocess_fn, _ = initialize_model(
                key,
                self._model,
                init_strategy=self._init_strategy,
                dynamic_args=True,
                model_args=args,
                model_kwargs=kwargs,
                validate_grad=False,
            )
            if init_params is None:
                return info.z, info.potential_energy
        elif init_params is None:
            raise ValueError(
                "RAM with potential_fn does not know where to start. Pass MCMC.run(..., "
                "init_params=point), with a leading axis of num_chains if there are several chains."
            )
        z = as_floating_point(init_params)
        energy = map_chains(self._potential_at((args, kwargs)), key)(z)
        check_start(energy, "init_params has potential energy {}, which must be finite. Start from another point, for "
                            "example from lfm.map_estimate(...).unconstrained.")
        return z, finite_or_infinity(energy)

    def initial_factor(self, dimension: int) -> np.ndarray:
        """Return the first Cholesky factor (d, d) of the proposal covariance for d unconstrained parameters."""
        if dimension == 0:
            raise ValueError("RAM needs at least one parameter, but init_params holds none.")
        if self._initial_chol is None:
            return (self._initial_scale or 1.0) * np.eye(dimension)
        if self._initial_chol.shape[0] != dimension:
            raise ValueError(
                f"initial_covariance must be of size {dimension}, the number of unconstrained "
                f"parameters, got shape {self._initial_chol.shape}."
            )
        scale = self._initial_scale or _OPTIMAL_SCALE / np.sqrt(dimension)
        return scale * self._initial_chol


def _cholesky(covariance: Any) -> np.ndarray:
    checks.covariance_matrix("initial_covariance", covariance)
    matrix = np.asarray(covariance, float)
    matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ValueError(
            "initial_covariance is singular, so that RAM would never move in some direction. Add a "
            "small positive number to its diagonal."
        ) from None
