"""Bind a NumPyro model to its arguments: its log posterior as a plain function."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.filtering.arguments import check_observations
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.panel import Panel
from lfm_ppl.inference.traced_model import traced_model
from lfm_ppl.utils import checks


def bind(model: Callable, times: ArrayLike, y: ArrayLike, **keywords: Any) -> BoundModel:
    """Bind a NumPyro model to its times and data: its log posterior as a plain function, for any sampler.

    Args:
        model: ``model(times, y=None, **keywords)`` with one site ``numpyro.sample(name, lfm.MarginalLikelihood(...),
            obs=y)``, or a `lfm_ppl.panel` in a plate.
        times: (T,), or (B, T) for a panel.
        y: (T, D), or (B, T, D) for a panel; NaN where missing. A tracer within compiled code.
        **keywords: further arguments of the model. Arrays of real numbers, such as known inputs, doses and covariances
            of rows, are arguments of the compiled functions; other values decide what is compiled.

    Returns:
        The bound model, with ``log_density``, ``log_density_gradient``, ``constrain``, ``unconstrain``, ``names``,
        ``filter`` and ``smooth``. The same model function is not compiled again for other data, times and arrays of the
        same shapes, unless a global or closure variable that it reads has changed, or the time grid has another size
        (other numbers of breakpoints and doses between observations, of intervals in a long gap, of equal intervals).
        A model that needs the values of times or arrays, such as ``if times[-1] > 1``, is compiled for these values,
        and so is one with a panel or constraints.

    Raises:
        ValueError, TypeError: wrong shapes, traced times, a discrete parameter or none at all, no or
            several likelihood sites.

    Example:
        >>> import jax, jax.numpy as jnp, numpy as np, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
        >>> times = np.arange(5.0)
        >>> bound = lfm.bind(model, times, np.sin(times)[:, None])
        >>> z = bound.unconstrain({"rate": 1.0})
        >>> bound.names, z.tolist(), float(bound.constrain(z)["rate"])
        (('rate',), [0.0], 1.0)

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
    if not callable(model):
        raise TypeError(f"model must be a NumPyro model, a function of times and y, got {type(model).__name__}.")
    if checks.traced(times):
        raise TypeError("times decide what is compiled, so they must be numbers, but they are traced; bind the model "
                        "outside of jit, and pass only y into it.")
    if y is None:
        raise ValueError("y must be the observations, (T, D) or (B, T, D) for a panel, got None.")
    checks.refuse_dates("times", times)
    times = np.array(checks.unmask(times), float)
    values = jnp.asarray(checks.unmask(y), float)
    y = values[:, None] if values.ndim == times.ndim == 1 else values
    traced, data = traced_model(model, (times, y), keywords, "lfm.bind")
    bound = BoundModel(traced, data)
    if bound.site.name in bound.sites:
        raise ValueError(f"the model does not use the data: its likelihood site {bound.site.name!r} is not observed. "
                         f"Write numpyro.sample({bound.site.name!r}, ..., obs=y), with the argument y of the model.")
    for name in traced.sites_of_times:
        raise ValueError(f"the likelihood site {name!r} observes the times, not the data. Write "
                         f"numpyro.sample({name!r}, ..., obs=y), with the argument y of the model.")
    distribution = bound.site.distribution
    if isinstance(distribution, Panel):
        distribution.checked(values)
    else:
        rows, outputs = distribution.event_shape
        check_observations(values, rows, outputs, model=distribution.model)
    return bound


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
    return BoundModel(*traced_model(model, arguments, keywords, caller))
