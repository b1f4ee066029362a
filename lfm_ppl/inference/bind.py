"""Bind a NumPyro model to its arguments: its log posterior as a plain function."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.unbound_model import SharedModel
from lfm_ppl.utils import checks


def bind(numpyro_model: Callable, times: ArrayLike | Mapping[str, ArrayLike], y: ArrayLike | Mapping[str, ArrayLike],
         *, model_kwargs: Mapping[str, Any] | None = None) -> BoundModel:
    """Bind a NumPyro model to its times and data: its log posterior as a plain function, for any sampler.

    Args:
        numpyro_model: ``model(times, y=None, **model_kwargs)`` with one site
            ``numpyro.sample(name, lfm.MarginalLikelihood(...), obs=y)``, or a `lfm_ppl.panel` in a plate; or with
            several such sites, see below.
        times: (T,), or (B, T) for a panel; of several sites a dict of these by name of the site.
        y: (T, D), or (B, T, D) for a panel; NaN where missing. A tracer within compiled code. A dict like ``times``.
        model_kwargs: keyword arguments of the model. Arrays of real numbers, such as known inputs, doses and
            covariances of rows, are arguments of the compiled functions; other values decide what is compiled.

    Returns:
        The bound model, with ``log_density``, ``log_density_gradient``, ``constrain``, ``unconstrain``, ``names``,
        ``filter`` and ``smooth``. The same model function is not compiled again for other data, times and arrays of the
        same shapes, unless a global or closure variable that it reads has changed, or the time grid has another size
        (other numbers of breakpoints and doses between observations, of intervals in a long gap, of equal intervals).
        A model that needs the values of times or arrays, such as ``if times[-1] > 1``, is compiled for these values,
        and so is one with a panel or constraints. Of several sites, ``site_models["name"]`` is the bound model with one
        of them selected, for ``log_likelihood``, ``filter`` and ``smooth``.

    Raises:
        ValueError, TypeError: wrong shapes, traced times, a discrete parameter or none at all, no likelihood site,
            several sites without dicts, or dicts without one of the sites.

    Example:
        >>> import jax, jax.numpy as jnp, numpy as np, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
        >>> times = np.arange(5.0)
        >>> bound = lfm.bind(model, times, np.sin(times)[:, None])
        >>> z = bound.unconstrain({"rate": 1.0})
        >>> bound.names, z.tolist(), float(bound.constrain(z)["rate"])
        (('rate',), [0.0], 1.0)

        Two experiments that share a parameter are two sites, with times and data by name:

        >>> def experiments(times, y):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     for name in ("short", "long"):
        ...         system = lfm.LatentForceModel(
        ...             lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...             lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...             lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        ...         numpyro.sample(name, lfm.MarginalLikelihood(system, times[name]), obs=y[name])
        >>> both = lfm.bind(experiments, {"short": times[:3], "long": times},
        ...                 {"short": np.ones((3, 1)), "long": np.sin(times)[:, None]})
        >>> both.site_models["short"].smooth(z).mean.shape
        (3, 3)
        >>> bool(jnp.isclose(both.site_models["long"].log_likelihood(z), bound.log_likelihood(z)))
        True

        Many data sets side by side:

        >>> sets = jnp.stack([bound.y, 2 * bound.y])
        >>> jax.vmap(bound.log_density, in_axes=(None, 0))(z, sets).shape
        (2,)

        blackjax's NUTS:

        >>> import blackjax
        >>> nuts = blackjax.nuts(bound.log_density, step_size=0.5, inverse_mass_matrix=jnp.ones(bound.size))
        >>> state, info = jax.jit(nuts.step)(jax.random.key(0), nuts.init(z))
        >>> state.position.shape
        (1,)

        A posterior mode by optax:

        >>> import optax
        >>> optimiser = optax.adam(0.1)
        >>> state = optimiser.init(z)
        >>> for _ in range(100):
        ...     value, gradient = bound.log_density_gradient(z)
        ...     updates, state = optimiser.update(-gradient, state)
        ...     z = optax.apply_updates(z, updates)
        >>> bool(jnp.abs(bound.log_density_gradient(z)[1]).max() < 0.1)
        True
    """
    if not callable(numpyro_model):
        raise TypeError("numpyro_model must be a NumPyro model, a function of times and y, got "
                        f"{type(numpyro_model).__name__}.")
    if checks.traced(times):
        raise TypeError("times decide what is compiled, so they must be numbers, but they are traced; bind the model "
                        "outside of jit, and pass only y into it.")
    if y is None:
        raise ValueError("y must be the observations, (T, D) or (B, T, D) for a panel, got None.")
    is_by_site = isinstance(times, Mapping) or isinstance(y, Mapping)
    times, values = _arrays_by_site(times, y) if is_by_site else _arrays(times, y)
    columns = jax.tree.map(lambda y, times: y[:, None] if y.ndim == times.ndim == 1 else y, values, times)
    try:
        bound = bind_arguments(numpyro_model, (times, columns), model_kwargs or {})
    except (IndexError, KeyError) as error:
        # A dict without a site that the model reads, or an array in the place of a dict.
        is_missing = is_by_site and isinstance(error, KeyError) and error.args[0] not in values
        if not is_missing and (is_by_site or "are valid indices" not in str(error)):
            raise
        entry = repr(error.args[0]) if is_missing else '"y"'
        raise ValueError(f"the model reads times or y by the name of a site, and there is no entry {entry}; pass dicts "
                         f"by site, in lfm.fit {{{entry}: (times, y), ...}}.") from error
    if is_by_site and not bound.is_by_site:
        sites = ", ".join(site.name for site in bound.unbound.likelihoods) or "none"
        raise ValueError(f"the likelihood sites of the model are {sites}, and there are data of {', '.join(values)}: "
                         "pass {name: (times, y), ...} with all sites, and write numpyro.sample(name, "
                         "lfm.MarginalLikelihood(system, times[name]), obs=y[name]) in model(times, y).")
    sites_of_other_data = bound.unbound.sites_of_other_data(bound.constants) if is_by_site else []
    for name, site_model in bound.site_models.items():
        _check_data(site_model, values[name] if is_by_site else values, sites_of_other_data)
    return bound


def _arrays(times: Any, y: Any) -> tuple[Any, Any]:
    checks.refuse_dates("times", times)
    return np.array(checks.unmask(times), float), jnp.asarray(checks.unmask(y), float)


def _arrays_by_site(times: Any, y: Any) -> tuple[Any, Any]:
    """Return dicts of times and observations as dicts of arrays."""
    names = [", ".join(value) if isinstance(value, Mapping) else "no dict" for value in (times, y)]
    if "no dict" in names or not times or set(times) != set(y):
        raise ValueError("times and y of several likelihood sites must be dicts with the same names, the names of the "
                         f"sites; times has {names[0] or 'none'}, and y has {names[1] or 'none'}.")
    if empty := [name for name, value in y.items() if value is None]:
        raise ValueError(f"y[{empty[0]!r}] must be the observations of the site, got None.")
    pairs = {name: _arrays(times[name], y[name]) for name in times}
    return {name: pair[0] for name, pair in pairs.items()}, {name: pair[1] for name, pair in pairs.items()}


def _check_data(bound: BoundModel, values: jax.Array, sites_of_other_data: Sequence[str]) -> None:
    """Check that a likelihood site observes the data, and their shape."""
    name, argument = bound.site.name, f"y[{bound.site.name!r}]" if bound.is_by_site else "y"
    remedy = f"Write numpyro.sample({name!r}, ..., obs={argument}), with the argument y of the model."
    if name in bound.sites:
        raise ValueError(f"the model does not use the data: its likelihood site {name!r} is not observed. {remedy}")
    if name in bound.unbound.sites_of_times:
        raise ValueError(f"the likelihood site {name!r} observes the times, not the data. {remedy}")
    if name in sites_of_other_data:
        raise ValueError(f"the likelihood site {name!r} observes other data than those that were passed. {remedy}")
    try:
        bound.site.distribution.checked(values)
    except ValueError as error:
        raise ValueError(f"site {name!r}: {error}" if bound.is_by_site else str(error)) from None


def bind_arguments(model: Callable, arguments: tuple, keywords: Mapping[str, Any],
                   caller: str = "lfm.bind") -> BoundModel:
    """Bind any NumPyro model to its arguments, of which the last is its data if it is a pytree of real arrays.

    Args:
        model: a NumPyro model whose latent sites are continuous.
        arguments: its positional arguments. The data may be an array, or a pytree of arrays, such as measurements with
            known covariates of each series.
        keywords: its keyword arguments.
        caller: name of the calling function, for messages.
    """
    if isinstance(model, SharedModel):
        return BoundModel.of(model.fn, arguments, keywords, caller, model.programs)
    return BoundModel.of(model, arguments, keywords, caller)
