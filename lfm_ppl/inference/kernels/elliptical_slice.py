"""Elliptical slice sampling: Gaussian priors, any likelihood, no gradients and nothing to tune.

One step from x, with the prior N(m, C):
1. Draw v from the prior and a level ``log h = log L(x) - e`` with ``e ~ Exponential(1)``.
2. Draw an angle a uniformly; the bracket of angles is ``[a - 2 pi, a]``.
3. If the likelihood at ``m + (x - m) cos a + (v - m) sin a`` reaches the level, move there.
4. Otherwise shrink the bracket to a, on the side away from zero, draw a new angle in it, and repeat step 3.

Source: Murray, Adams and MacKay (2010), Elliptical slice sampling, JMLR W&CP 9, 541-548.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro.infer import init_to_sample
from numpyro.infer.util import ParamInfo, initialize_model
from numpyro.util import identity, is_prng_key

from lfm_ppl.inference.kernels import gaussian_prior
from lfm_ppl.inference.kernels.algorithm import SamplingAlgorithm
from lfm_ppl.inference.kernels.gaussian_prior import GaussianSite
from lfm_ppl.inference.kernels.kernel import Kernel, as_floating_point, check_start, map_chains

MAX_EVALUATIONS = 200
"""Largest number of angles of one step. The bracket is then below 1e-20: the proposal equals the present point."""


class SliceState(NamedTuple):
    """Position of a chain, argument and result of `elliptical_slice_step`.

    Attributes:
        position: x, a pytree of real arrays.
        log_likelihood: log L(x). A chain may start at minus infinity; it never moves there.
        evaluations: evaluations of the likelihood that the last step took.
    """

    position: Any
    log_likelihood: jax.Array
    evaluations: jax.Array | int = 0


def elliptical_slice_step(
    key: jax.Array,
    state: SliceState,
    prior_draw: Any,
    log_likelihood: Callable[[Any], jax.Array],
    mean: Any = None,
) -> SliceState:
    r"""Move along an ellipse through the present point and a draw of the prior.

    With a prior N(m, C), a draw v of it, and a level ``log h = log L(x) - e``, e ~ Exponential(1), the points

        x(a) = m + (x - m) cos a + (v - m) sin a

    are tried at ``a ~ Uniform(0, 2 pi)`` and then uniformly on a bracket, first ``[a - 2 pi, a]``, that shrinks towards
    ``a = 0`` at each point below the level. The first point on or above the level is the new state. The step leaves the
    density proportional to N(x; m, C) L(x) invariant. A point whose log likelihood is NaN or infinite is not accepted.
    Each angle costs one evaluation; under ``jax.vmap`` all chains wait for the last.

    Args:
        key: a JAX random key.
        state: the present point and its log likelihood.
        prior_draw: v, an independent draw of N(m, C), shaped like ``state.position``.
        log_likelihood: ``log L``, a function of the position.
        mean: m, shaped like ``state.position``; None for zero.

    Returns:
        The next state; the present one if none of `MAX_EVALUATIONS` angles is accepted.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> log_likelihood = lambda x: -0.5 * jnp.sum((x - 1.0) ** 2)
        >>> def step(state, key):
        ...     key_draw, key_step = jax.random.split(key)
        ...     state = elliptical_slice_step(key_step, state, jax.random.normal(key_draw, (2,)), log_likelihood)
        ...     return state, state.position
        >>> start = SliceState(jnp.zeros(2), log_likelihood(jnp.zeros(2)))
        >>> _, draws = jax.lax.scan(step, start, jax.random.split(jax.random.key(0), 20_000))
        >>> draws.mean(0).round(1).tolist()
        [0.5, 0.5]

    Source: Murray, Adams and MacKay (2010), Elliptical slice sampling, JMLR W&CP 9, 541-548, figure 2.
    """
    key_level, key_first, key_angles = jax.random.split(key, 3)
    position = jax.tree_util.tree_map(jnp.asarray, state.position)
    centre = jax.tree_util.tree_map(jnp.zeros_like, position) if mean is None else mean
    present = jnp.asarray(state.log_likelihood, float)
    level = jnp.where(jnp.isnan(present), -jnp.inf, present) - jax.random.exponential(key_level)

    def point_on_ellipse(angle: jax.Array) -> Any:
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        return jax.tree_util.tree_map(
            lambda x, v, m: (m + (x - m) * cosine + (v - m) * sine).astype(x.dtype), position, prior_draw, centre
        )

    def is_unfinished(search: tuple) -> jax.Array:
        *_, accepted, evaluations = search
        return ~accepted & (evaluations < MAX_EVALUATIONS)

    def try_angle(search: tuple) -> tuple:
        angle, lower, upper, _, _, evaluations = search
        value = jnp.asarray(log_likelihood(point_on_ellipse(angle)), float)
        accepted = jnp.isfinite(value) & (value >= level)
        lower, upper = jnp.where(angle < 0, angle, lower), jnp.where(angle < 0, upper, angle)
        fraction = jax.random.uniform(jax.random.fold_in(key_angles, evaluations))
        next_angle = jnp.where(accepted, angle, lower + fraction * (upper - lower))
        return next_angle, lower, upper, value, accepted, evaluations + 1

    first_angle = 2 * jnp.pi * jax.random.uniform(key_first)
    # The loop carries angles alone: copying positions would cost more than one more point of the ellipse.
    start = first_angle, first_angle - 2 * jnp.pi, first_angle, present, jnp.array(False), jnp.zeros((), int)
    angle, _, _, value, accepted, evaluations = jax.lax.while_loop(is_unfinished, try_angle, start)
    new_position = jax.tree_util.tree_map(partial(jnp.where, accepted), point_on_ellipse(angle), position)
    return SliceState(new_position, jnp.where(accepted, value, present), evaluations)


class EllipticalSliceState(NamedTuple):
    """State of a chain. Every field but ``prior`` can be collected with ``extra_fields`` of ``MCMC.run``.

    Attributes:
        i: number of steps taken, warm-up included.
        z: site -> value.
        log_likelihood: log likelihood at ``z``.
        potential_energy: minus the log density at ``z``, prior included, as in other NumPyro kernels.
        evaluations: evaluations of the likelihood that the last step took.
        prior: site -> `GaussianSite`, with its factorised covariance; shared by vectorised chains.
        rng_key: random key of the next step.
    """

    i: jax.Array
    z: dict[str, jax.Array]
    log_likelihood: jax.Array
    potential_energy: jax.Array
    evaluations: jax.Array
    prior: dict[str, GaussianSite]
    rng_key: jax.Array


def elliptical_slice(log_likelihood_at: Callable[[Any], Callable[[Any], jax.Array]]) -> SamplingAlgorithm:
    """Return elliptical slice sampling; its tuning is the prior, site name -> `GaussianSite`.

    The potential energy of the starting point is that of the likelihood alone, minus log L.

    Args:
        log_likelihood_at: from the data to the log likelihood, a function of the position.
    """

    def init(key: jax.Array, point: ParamInfo, data: Any, prior: dict[str, GaussianSite]) -> EllipticalSliceState:
        value = -point.potential_energy
        value = jnp.where(jnp.isfinite(value), value, -jnp.inf)
        zero = jnp.zeros(jnp.shape(value), int)
        energy = -value - gaussian_prior.log_prior(prior, point.z)
        return EllipticalSliceState(zero, point.z, value, energy, zero, prior, key)

    def step(state: EllipticalSliceState, data: Any) -> EllipticalSliceState:
        key, key_prior, key_step = jax.random.split(state.rng_key, 3)
        shapes = {name: jnp.shape(value) for name, value in state.z.items()}
        mean, draw = gaussian_prior.prior_draw(state.prior, key_prior, shapes)
        present = SliceState(state.z, state.log_likelihood)
        position, value, evaluations = elliptical_slice_step(key_step, present, draw, log_likelihood_at(data), mean)
        energy = -value - gaussian_prior.log_prior(state.prior, position)
        return EllipticalSliceState(state.i + 1, position, value, energy, jnp.asarray(evaluations), state.prior, key)

    def summary(state: EllipticalSliceState) -> dict[str, jax.Array]:
        return {"z": ravel_pytree(state.z)[0], "lp": state.potential_energy, "evaluations": state.evaluations}

    return SamplingAlgorithm(init, step, summary)


class EllipticalSlice(Kernel):
    r"""Elliptical slice sampling of a model whose latent sites are all Gaussian a priori.

    A step draws v from the prior N(m, C) of all latent sites together and moves to a point of the ellipse
    ``m + (x - m) cos a + (v - m) sin a`` on a random level of the likelihood (see `elliptical_slice_step`). There is
    nothing to adapt: the warm-up only forgets the starting point. The sampler is best where the likelihood is weak
    against the prior, as for a force on a grid of times, and needs no gradient. For ``numpyro.infer.MCMC`` with any
    ``chain_method``. NumPyro's ``ESS`` is ensemble slice sampling, another method.

    The log likelihood is the sum over all observed sites and factors, masks and scales included. Without any, the draws
    come from the prior. Random numbers of the model (``numpyro.prng_key``) are the same in every evaluation.

    Args:
        model: a NumPyro model. Its latent sites are Normal, MultivariateNormal or LowRankMultivariateNormal, also in
            plates, expanded and with ``to_event``, and independent of each other a priori.
        init_strategy: a NumPyro strategy for the first point of each chain; by default a draw of the prior.

    Raises:
        ValueError: when sampling starts: no latent site, or one that is not Gaussian, or masked, or depends on another
            (its prior is compared at two draws of the others), or has an array as scale; a subsampled plate;
            ``init_params`` of other sites or shapes; a starting point whose likelihood is not finite.

    Example:
        >>> import jax, jax.numpy as jnp, numpyro, numpyro.distributions as dist
        >>> from numpyro.infer import MCMC
        >>> def model(y):
        ...     level = numpyro.sample("level", dist.Normal(0.0, 2.0))
        ...     numpyro.sample("y", dist.Poisson(jnp.exp(level)), obs=y)
        >>> mcmc = MCMC(EllipticalSlice(model), num_warmup=200, num_samples=500, progress_bar=False)
        >>> mcmc.run(jax.random.key(0), jnp.array([3, 5]), extra_fields=("evaluations", "log_likelihood"))
        >>> mcmc.get_samples()["level"].shape
        (500,)

    Source: Murray, Adams and MacKay (2010), Elliptical slice sampling, JMLR W&CP 9, 541-548.
    """

    _chain_axes = EllipticalSliceState(0, 0, 0, 0, 0, None, 0)  # type: ignore[arg-type]

    def __init__(self, model: Callable, init_strategy: Callable = init_to_sample) -> None:
        super().__init__(model)
        self._init_strategy = init_strategy
        self._has_deterministic_sites = False

    def get_diagnostics_str(self, state: EllipticalSliceState) -> str:
        """Return the log likelihood and the last step's evaluations of it, for the progress bar."""
        return f"log likelihood {state.log_likelihood:.2f}. evaluations={state.evaluations}"

    def postprocess_fn(self, args: tuple, kwargs: dict) -> Callable:
        """Return the map from the latent to the latent and the deterministic sites."""
        if self._model is None or not self._has_deterministic_sites:
            return identity
        return partial(gaussian_prior.with_deterministic_sites, self._model, args, kwargs)

    def algorithm(self, num_warmup: int = 0) -> SamplingAlgorithm:
        """Return elliptical slice sampling on the model; its steps are the same in the warm-up."""
        return elliptical_slice(self._log_likelihood_at)

    def _log_likelihood_at(self, data: tuple[tuple, dict]) -> Callable[[Any], jax.Array]:
        model = self._model
        assert model is not None
        return partial(gaussian_prior.log_likelihood, model, *data)

    def starting_point(self, key: jax.Array, init_params: Any, args: tuple,
                       kwargs: dict) -> tuple[ParamInfo, dict[str, GaussianSite]]:
        """Return the position with minus its log likelihood, and the prior."""
        assert self._model is not None
        with jax.ensure_compile_time_eval():  # parallel chains are initialised within a trace
            prior, trace = gaussian_prior.gaussian_prior(self._model, args, kwargs)
        self._has_deterministic_sites = any(site["type"] == "deterministic" for site in trace.values())
        if init_params is None:
            z = self._starting_position(key, args, kwargs)
        else:
            shapes = {name: np.shape(trace[name]["value"]) for name in prior}
            z = _as_position(init_params, shapes, () if is_prng_key(key) else key.shape[:1])
        value = map_chains(self._log_likelihood_at((args, kwargs)), key)(z)
        check_start(value, "the starting point has log likelihood {}, which must be finite. Start from another point: "
                           "MCMC.run(..., init_params=...), or EllipticalSlice(model, init_strategy=init_to_value("
                           "values=...)).")
        return ParamInfo(z, -value, None), prior

    def _starting_position(self, key: jax.Array, args: tuple, kwargs: dict) -> dict:
        try:
            info = initialize_model(
                key,
                self._model,
                init_strategy=self._init_strategy,
                model_args=args,
                model_kwargs=kwargs,
                validate_grad=False,
            )
        except RuntimeError as error:
            if "Cannot find valid initial parameters" not in str(error):
                raise
            raise ValueError(
                "EllipticalSlice found no starting point: the log density is NaN or infinite at 100 points of "
                "init_strategy. Pass a point that the data allow: MCMC.run(..., init_params=...), or "
                "EllipticalSlice(model, init_strategy=init_to_value(values=...))."
            ) from error
        return as_floating_point(info.param_info.z)


def _as_position(init_params: Any, shapes: Mapping[str, tuple[int, ...]], chains: tuple[int, ...]) -> dict:
    """Return ``init_params`` as arrays, after a check of their names and shapes."""
    expected = {name: (*chains, *shape) for name, shape in shapes.items()}
    actual = (
        {name: np.shape(value) for name, value in init_params.items()}
        if isinstance(init_params, Mapping)
        else type(init_params).__name__
    )
    if actual != expected:
        raise ValueError(f"init_params must be a dict of the latent sites with shapes {expected}, got {actual}.")
    return as_floating_point({name: init_params[name] for name in shapes})
