"""Elliptical slice sampling: Gaussian priors, any likelihood, no gradients and nothing to tune."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro import handlers
from numpyro.infer import init_to_sample, init_to_uniform
from numpyro.infer.util import initialize_model
from numpyro.util import identity, is_prng_key

from lfm_ppl import checks
from lfm_ppl.inference.kernels.kernel import Kernel, check_start, floating, of_chains

MAX_EVALUATIONS = 200
"""Angles tried in one step. By then the bracket is below 1e-20, and the proposal is the present point to rounding."""

_GAUSSIAN = (dist.Normal, dist.MultivariateNormal, dist.LowRankMultivariateNormal)


class SliceState(NamedTuple):
    """A point of the chain, as `elliptical_slice_step` takes and returns it.

    Attributes:
        position: x, a pytree of real arrays.
        log_likelihood: log L(x). Minus infinity, where a chain may start but never goes, is left at the first chance.
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

    are tried at ``a ~ Uniform(0, 2 pi)`` and then uniformly on a bracket, ``[a - 2 pi, a]`` at first, which each point
    below the level shrinks towards ``a = 0``. The first point on or above the level is the new state. Leaves the
    density proportional to N(x; m, C) L(x) invariant. A point at which the log likelihood is NaN or infinite is not
    accepted. Each angle costs one evaluation; under ``jax.vmap`` all chains wait for the last.

    Args:
        key: a JAX random key.
        state: the present point and its log likelihood.
        prior_draw: v, an independent draw of N(m, C), shaped like ``state.position``.
        log_likelihood: ``log L``, a function of the position.
        mean: m, shaped like ``state.position``; None for zero.

    Returns:
        The next state; the present one, should `MAX_EVALUATIONS` angles not be enough.

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

    def on_ellipse(angle: jax.Array) -> Any:
        along, across = jnp.cos(angle), jnp.sin(angle)
        return jax.tree_util.tree_map(
            lambda x, v, m: (m + (x - m) * along + (v - m) * across).astype(x.dtype), position, prior_draw, centre
        )

    def searching(search: _Search) -> jax.Array:
        return ~search.accepted & (search.evaluations < MAX_EVALUATIONS)

    def try_angle(search: _Search) -> _Search:
        angle = search.angle
        value = jnp.asarray(log_likelihood(on_ellipse(angle)), float)
        accepted = jnp.isfinite(value) & (value >= level)
        lower, upper = jnp.where(angle < 0, angle, search.lower), jnp.where(angle < 0, search.upper, angle)
        share = jax.random.uniform(jax.random.fold_in(key_angles, search.evaluations))
        following = jnp.where(accepted, angle, lower + share * (upper - lower))
        return _Search(following, lower, upper, value, accepted, search.evaluations + 1)

    first = 2 * jnp.pi * jax.random.uniform(key_first)
    # The loop carries angles alone: copying positions would cost more than one more point of the ellipse.
    start = _Search(first, first - 2 * jnp.pi, first, present, jnp.array(False), jnp.zeros((), int))
    found = jax.lax.while_loop(searching, try_angle, start)
    moved = jax.tree_util.tree_map(partial(jnp.where, found.accepted), on_ellipse(found.angle), position)
    return SliceState(moved, jnp.where(found.accepted, found.value, present), found.evaluations)


class _Search(NamedTuple):
    angle: jax.Array
    lower: jax.Array
    upper: jax.Array
    value: jax.Array
    accepted: jax.Array
    evaluations: jax.Array


class GaussianSite(NamedTuple):
    """The prior of a latent site.

    Attributes:
        fn: Normal, MultivariateNormal or LowRankMultivariateNormal; its shape broadcasts to the site's.
        power: the power to which ``numpyro.handlers.scale`` raises the density, which divides the covariance.
    """

    fn: Any
    power: jax.Array

    def deviation(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Return a draw of the site's shape, less its mean."""
        noise = jax.random.normal(key, shape)
        if isinstance(self.fn, dist.Normal):
            draw = self.fn.scale * noise
        elif isinstance(self.fn, dist.MultivariateNormal):
            draw = jnp.einsum("...ij,...j->...i", self.fn.scale_tril, noise)
        else:
            factor = self.fn.cov_factor
            common = jax.random.normal(jax.random.fold_in(key, 1), (*shape[:-1], factor.shape[-1]))
            draw = jnp.einsum("...ij,...j->...i", factor, common) + jnp.sqrt(self.fn.cov_diag) * noise
        return draw / jnp.sqrt(self.power)

    def log_density(self, value: jax.Array) -> jax.Array:
        """Return the log density at a value, up to a constant where ``power`` is not one."""
        return self.power * jnp.sum(self.fn.log_prob(value))


class EllipticalSliceState(NamedTuple):
    """What the chain carries. Every field but ``prior`` can be collected with ``extra_fields`` of ``MCMC.run``.

    Attributes:
        i: number of steps taken, warm-up included.
        z: site -> value.
        log_likelihood: log likelihood at ``z``.
        potential_energy: minus the log density at ``z``, prior included, as of other NumPyro kernels.
        evaluations: evaluations of the likelihood that the last step took.
        prior: site -> `GaussianSite`, factorised once; shared by vectorised chains.
        rng_key: random key of the next step.
    """

    i: jax.Array
    z: dict[str, jax.Array]
    log_likelihood: jax.Array
    potential_energy: jax.Array
    evaluations: jax.Array
    prior: dict[str, GaussianSite] | None
    rng_key: jax.Array


class EllipticalSlice(Kernel):
    r"""Elliptical slice sampling of a model whose latent sites are all Gaussian a priori.

    A step draws v from the prior N(m, C) of all latent sites together and moves to a point of the ellipse
    ``m + (x - m) cos a + (v - m) sin a`` on a random level of the likelihood (see `elliptical_slice_step`). There is
    nothing to adapt: the warm-up only forgets the starting point. It is at its best where the likelihood is weak
    against the prior, as for a force on a grid of times, and needs no gradient. For ``numpyro.infer.MCMC`` with any
    ``chain_method``. NumPyro's ``ESS`` is ensemble slice sampling, another method.

    The likelihood is the sum of all observed sites and factors, masks and scales included. Without any, the draws come
    from the prior. What the model draws with ``numpyro.prng_key`` is the same in every evaluation.

    Args:
        model: a NumPyro model. Its latent sites are Normal, MultivariateNormal or LowRankMultivariateNormal, also in
            plates, expanded and with ``to_event``, and independent of each other a priori.
        init_strategy: a NumPyro strategy for the first point of each chain; by default a draw of the prior.

    Raises:
        ValueError: when sampling starts: no latent site, or one that is not Gaussian, or masked, or depends on another
            (found by comparing its prior at two draws of the others), or has an array as scale; a
            subsampled plate; ``init_params`` of other sites or shapes; a starting point without likelihood.

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

    def __init__(self, model: Callable, init_strategy: Callable = init_to_sample) -> None:
        super().__init__(model)
        self._init_strategy = init_strategy
        self._replay = False

    def get_diagnostics_str(self, state: EllipticalSliceState) -> str:
        """Return the log likelihood and the last step's evaluations of it, for the progress bar."""
        return f"log likelihood {state.log_likelihood:.2f}. evaluations={state.evaluations}"

    def postprocess_fn(self, args: tuple, kwargs: dict) -> Callable:
        """Return the map from the latent to the latent and the deterministic sites."""
        if self._model is None or not self._replay:
            return identity
        return partial(_with_deterministic, self._model, args, kwargs)

    def begin(self, rng_key: jax.Array, model_key: jax.Array, num_warmup: int, init_params: Any, args: tuple,
              kwargs: dict) -> EllipticalSliceState:
        """Return the state before the first step; steps of the warm-up are like all others."""
        assert self._model is not None
        with jax.ensure_compile_time_eval():  # chains that run in parallel are initialised within a trace
            prior, trace = _gaussian_prior(self._model, args, kwargs)
        self._replay = any(site["type"] == "deterministic" for site in trace.values())
        if init_params is None:
            z = self._starting_point(model_key, args, kwargs)
        else:
            shapes = {name: np.shape(trace[name]["value"]) for name in prior}
            z = _checked_start(init_params, shapes, () if is_prng_key(rng_key) else rng_key.shape[:1])
        value = of_chains(partial(_log_likelihood, self._model, args, kwargs), rng_key)(z)
        check_start(value, "the starting point has log likelihood {}, which must be finite. Start from another point: "
                           "MCMC.run(..., init_params=...), or EllipticalSlice(model, init_strategy=init_to_value("
                           "values=...)).")
        value = jnp.where(jnp.isfinite(value), value, -jnp.inf)
        count = jnp.zeros(jnp.shape(value), int)
        energy = -value - of_chains(partial(_log_prior, prior), rng_key)(z)
        return EllipticalSliceState(count, z, value, energy, count, prior, rng_key)

    def sample(
        self, state: EllipticalSliceState, model_args: tuple, model_kwargs: dict | None
    ) -> EllipticalSliceState:
        """Return the state after one step of every chain in ``state``."""
        prior = state.prior
        assert prior is not None and self._model is not None
        log_likelihood = partial(_log_likelihood, self._model, model_args, model_kwargs or {})

        def one_chain(z: dict, value: jax.Array, key: jax.Array) -> tuple[SliceState, jax.Array, jax.Array]:
            key, key_prior, key_step = jax.random.split(key, 3)
            mean, draw = _prior_draw(prior, key_prior, {name: jnp.shape(x) for name, x in z.items()})
            moved = elliptical_slice_step(key_step, SliceState(z, value), draw, log_likelihood, mean)
            return moved, -moved.log_likelihood - _log_prior(prior, moved.position), key

        moved, energy, rng_key = of_chains(one_chain, state.rng_key)(state.z, state.log_likelihood, state.rng_key)
        count = jnp.asarray(moved.evaluations)
        return EllipticalSliceState(state.i + 1, moved.position, moved.log_likelihood, energy, count, prior, rng_key)

    def _starting_point(self, rng_key: jax.Array, args: tuple, kwargs: dict) -> dict:
        try:
            info = initialize_model(
                rng_key,
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
        return floating(info.param_info.z)


def _trace(model: Callable, args: tuple, kwargs: Mapping[str, Any], z: Mapping[str, Any]) -> dict[str, dict]:
    """Return the model's trace at ``z``; the key serves what the model draws besides its sites, and never changes."""
    seeded = handlers.seed(handlers.substitute(model, data=z), jax.random.key(0))
    return handlers.trace(seeded).get_trace(*args, **kwargs)


def _log_likelihood(model: Callable, args: tuple, kwargs: Mapping[str, Any], z: Mapping[str, Any]) -> jax.Array:
    total = jnp.zeros(())
    for site in _trace(model, args, kwargs, z).values():
        if site["type"] == "sample" and site["is_observed"]:
            log_prob = site["fn"].log_prob(site["value"])
            total += jnp.sum(log_prob if site["scale"] is None else site["scale"] * log_prob)
    return total


def _with_deterministic(model: Callable, args: tuple, kwargs: Mapping[str, Any], z: Mapping[str, Any]) -> dict:
    trace = _trace(model, args, kwargs, z)
    return {name: s["value"] for name, s in trace.items() if name in z or s["type"] == "deterministic"}


def _prior_draw(
    prior: Mapping[str, GaussianSite], key: jax.Array, shapes: Mapping[str, tuple[int, ...]]
) -> tuple[dict, dict]:
    """Return the mean of every site, and a draw."""
    keys = jax.random.split(key, len(prior))
    mean = {name: jnp.broadcast_to(site.fn.loc, shapes[name]) for name, site in prior.items()}
    draw = {
        name: mean[name] + prior[name].deviation(site_key, shapes[name])
        for name, site_key in zip(prior, keys, strict=True)
    }
    return mean, draw


def _log_prior(prior: Mapping[str, GaussianSite], z: Mapping[str, Any]) -> jax.Array:
    return sum((site.log_density(z[name]) for name, site in prior.items()), start=jnp.zeros(()))


def _gaussian_prior(
    model: Callable, args: tuple, kwargs: Mapping[str, Any]
) -> tuple[dict[str, GaussianSite], dict[str, dict]]:
    """Return the prior of every latent site and a trace of the model, or raise ValueError."""
    # init_to_uniform also serves improper priors, from which nothing can be drawn
    drawn = handlers.substitute(handlers.seed(model, jax.random.key(0)), substitute_fn=init_to_uniform)
    trace = handlers.trace(drawn).get_trace(*args, **kwargs)
    for site in trace.values():
        if site["type"] == "plate" and site["args"][1] not in (None, site["args"][0]):
            raise ValueError(
                f"plate {site['name']!r} takes {site['args'][1]} of {site['args'][0]} at random, but slice sampling "
                "needs the whole likelihood. Leave out subsample_size."
            )
    names = [name for name, s in trace.items() if s["type"] == "sample" and not s["is_observed"]]
    _check_gaussian({name: trace[name]["fn"] for name in names})
    guess = {name: _gaussian_site(trace[name]) for name in names}
    shapes = {name: np.shape(trace[name]["value"]) for name in names}
    draws = [_prior_draw(guess, jax.random.key(seed), shapes)[1] for seed in (1, 2)]
    first, second = (_trace(model, args, kwargs, z) for z in draws)
    for name in names:
        if not _same(_gaussian_site(first[name]), _gaussian_site(second[name])):
            raise ValueError(
                f"the prior of site {name!r} depends on other latent sites, so that the joint prior is not Gaussian "
                f"as it stands. Write it with a standard normal, as {name} = loc + scale * noise (NumPyro's "
                "LocScaleReparam(0) does it for you), or pass obs if it holds data, or fix the site that it depends "
                "on with numpyro.handlers.condition, or use NUTS or lfm.RAM."
            )
    return {name: _gaussian_site(first[name]) for name in names}, first


def _check_gaussian(latent: Mapping[str, Any]) -> None:
    if not latent:
        raise ValueError(
            "EllipticalSlice found no latent site in the model: every sample site is observed. Give at least one "
            "parameter a Gaussian prior with numpyro.sample(name, distribution), without obs."
        )
    masked = [name for name, fn in latent.items() if isinstance(_unwrapped(fn), dist.MaskedDistribution)]
    if masked:
        raise ValueError(
            f"the prior of site {masked[0]!r} is masked, and flat where the mask is False. Put the mask around "
            "observed sites alone."
        )
    other = {name: _unwrapped(fn) for name, fn in latent.items() if not isinstance(_unwrapped(fn), _GAUSSIAN)}
    if other:
        listed = ", ".join(f"{name!r} ({type(fn).__name__})" for name, fn in other.items())
        raise ValueError(
            f"EllipticalSlice needs Gaussian priors, but these latent sites have others: {listed}. Fix them with "
            "numpyro.handlers.condition, pass obs if they hold data, write them as functions of Normal sites (for "
            "example exp of one for LogNormal; NumPyro's TransformReparam does it for you), or use NUTS or lfm.RAM."
        )


def _unwrapped(fn: Any) -> Any:
    while isinstance(fn, (dist.ExpandedDistribution, dist.Independent)):
        fn = fn.base_dist
    return fn


def _gaussian_site(site: Mapping[str, Any]) -> GaussianSite:
    power = 1.0 if site["scale"] is None else site["scale"]
    if jnp.ndim(power):
        raise ValueError(
            f"the scale of latent site {site['name']!r} must be one number, got shape {jnp.shape(power)}. Put "
            "numpyro.handlers.scale around observed sites alone."
        )
    return GaussianSite(jax.tree_util.tree_map(jnp.asarray, _unwrapped(site["fn"])), jnp.asarray(power, float))


def _same(one: GaussianSite, other: GaussianSite) -> bool:
    """Whether two priors are equal; one that contains a tracer cannot be compared and passes."""
    if type(one.fn) is not type(other.fn) or (one.fn.batch_shape, one.fn.event_shape) != (
        other.fn.batch_shape, other.fn.event_shape,
    ):
        return False
    if checks.traced((one, other)):
        return True
    pairs = zip(jax.tree_util.tree_leaves(one), jax.tree_util.tree_leaves(other), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def _checked_start(init_params: Any, shapes: Mapping[str, tuple[int, ...]], chains: tuple[int, ...]) -> dict:
    wanted = {name: (*chains, *shape) for name, shape in shapes.items()}
    given = (
        {name: np.shape(value) for name, value in init_params.items()}
        if isinstance(init_params, Mapping)
        else type(init_params).__name__
    )
    if given != wanted:
        raise ValueError(f"init_params must be a dict of the latent sites with shapes {wanted}, got {given}.")
    return floating({name: init_params[name] for name in shapes})
