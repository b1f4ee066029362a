"""The Gaussian prior of a NumPyro model, for elliptical slice sampling.

1. Trace the model at its initial values, and check that every latent site is Gaussian, unmasked and in a full plate.
2. Trace it at two prior draws. A site whose prior differs between them depends on another latent site, so that the
   joint prior is not Gaussian.
3. Keep the distribution of every site with its factorised covariance: a step draws from it and evaluates its density.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro import handlers
from numpyro.infer import init_to_uniform

from lfm_ppl.utils import checks
from lfm_ppl.utils.random_keys import split_by_name

_GAUSSIAN = (dist.Normal, dist.MultivariateNormal, dist.LowRankMultivariateNormal)


class GaussianSite(eqx.Module):
    """Gaussian prior of a latent site.

    Attributes:
        fn: Normal, MultivariateNormal or LowRankMultivariateNormal; its shape broadcasts to the site's.
        power: the power to which ``numpyro.handlers.scale`` raises the density, which divides the covariance.
    """

    fn: Any
    power: jax.Array

    def deviation(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Return a draw of the site's shape minus its mean."""
        keys = split_by_name(key, ("noise", "common factors"))
        noise = jax.random.normal(keys["noise"], shape)
        if isinstance(self.fn, dist.Normal):
            draw = self.fn.scale * noise
        elif isinstance(self.fn, dist.MultivariateNormal):
            draw = jnp.einsum("...ij,...j->...i", self.fn.scale_tril, noise)
        else:
            factor = self.fn.cov_factor
            common = jax.random.normal(keys["common factors"], (*shape[:-1], factor.shape[-1]))
            draw = jnp.einsum("...ij,...j->...i", factor, common) + jnp.sqrt(self.fn.cov_diag) * noise
        return draw / jnp.sqrt(self.power)

    def log_density(self, value: jax.Array) -> jax.Array:
        """Return the log density at a value, up to a constant where ``power`` is not one."""
        return self.power * jnp.sum(self.fn.log_prob(value))


def _trace(model: Callable, args: tuple, kwargs: Mapping[str, Any], z: Mapping[str, Any]) -> dict[str, dict]:
    """Return the model's trace at ``z``; the model's own random draws have a fixed key."""
    seeded = handlers.seed(handlers.substitute(model, data=z), jax.random.key(0))
    return handlers.trace(seeded).get_trace(*args, **kwargs)


def log_likelihood(model: Callable, args: tuple, kwargs: Mapping[str, Any], z: Mapping[str, Any]) -> jax.Array:
    """Return the log density of all observed sites at ``z``."""
    total = jnp.zeros(())
    for site in _trace(model, args, kwargs, z).values():
        if site["type"] == "sample" and site["is_observed"]:
            log_prob = site["fn"].log_prob(site["value"])
            total += jnp.sum(log_prob if site["scale"] is None else site["scale"] * log_prob)
    return total


def with_deterministic_sites(model: Callable, args: tuple, kwargs: Mapping[str, Any],
                             z: Mapping[str, Any]) -> dict:
    """Return the values of the latent and the deterministic sites at ``z``."""
    trace = _trace(model, args, kwargs, z)
    return {name: s["value"] for name, s in trace.items() if name in z or s["type"] == "deterministic"}


def prior_draw(
    prior: Mapping[str, GaussianSite], key: jax.Array, shapes: Mapping[str, tuple[int, ...]]
) -> tuple[dict, dict]:
    """Return the mean and a draw of every site."""
    keys = jax.random.split(key, len(prior))
    mean = {name: jnp.broadcast_to(site.fn.loc, shapes[name]) for name, site in prior.items()}
    draw = {
        name: mean[name] + prior[name].deviation(site_key, shapes[name])
        for name, site_key in zip(prior, keys, strict=True)
    }
    return mean, draw


def log_prior(prior: Mapping[str, GaussianSite], z: Mapping[str, Any]) -> jax.Array:
    """Return the log prior density at ``z``, up to a constant."""
    return sum((site.log_density(z[name]) for name, site in prior.items()), start=jnp.zeros(()))


def gaussian_prior(
    model: Callable, args: tuple, kwargs: Mapping[str, Any]
) -> tuple[dict[str, GaussianSite], dict[str, dict]]:
    """Return the prior of every latent site and a trace of the model, or raise ValueError."""
    # init_to_uniform, because improper priors cannot be sampled.
    seeded = handlers.substitute(handlers.seed(model, jax.random.key(0)), substitute_fn=init_to_uniform)
    trace = handlers.trace(seeded).get_trace(*args, **kwargs)
    for site in trace.values():
        if site["type"] == "plate" and site["args"][1] not in (None, site["args"][0]):
            raise ValueError(
                f"plate {site['name']!r} takes {site['args'][1]} of {site['args'][0]} at random, but slice sampling "
                "needs the whole likelihood. Leave out subsample_size."
            )
    names = [name for name, s in trace.items() if s["type"] == "sample" and not s["is_observed"]]
    _check_gaussian({name: trace[name]["fn"] for name in names})
    first_prior = {name: _gaussian_site(trace[name]) for name in names}
    shapes = {name: np.shape(trace[name]["value"]) for name in names}
    draws = [prior_draw(first_prior, jax.random.key(seed), shapes)[1] for seed in (1, 2)]
    first, second = (_trace(model, args, kwargs, z) for z in draws)
    for name in names:
        if not _are_equal(_gaussian_site(first[name]), _gaussian_site(second[name])):
            raise ValueError(
                f"the prior of site {name!r} depends on other latent sites, so that the joint prior is not Gaussian "
                f"in this parametrisation. Write it with a standard normal, as {name} = loc + scale * noise (NumPyro's "
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
    non_gaussian = {name: _unwrapped(fn) for name, fn in latent.items() if not isinstance(_unwrapped(fn), _GAUSSIAN)}
    if non_gaussian:
        sites = ", ".join(f"{name!r} ({type(fn).__name__})" for name, fn in non_gaussian.items())
        raise ValueError(
            f"EllipticalSlice needs Gaussian priors, but these latent sites have others: {sites}. Fix them with "
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


def _are_equal(first: GaussianSite, second: GaussianSite) -> bool:
    """Return whether two priors are equal; True where they hold a tracer and cannot be compared."""
    first_shape, second_shape = ((site.fn.batch_shape, site.fn.event_shape) for site in (first, second))
    if type(first.fn) is not type(second.fn) or first_shape != second_shape:
        return False
    if checks.traced((first, second)):
        return True
    pairs = zip(jax.tree_util.tree_leaves(first), jax.tree_util.tree_leaves(second), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
