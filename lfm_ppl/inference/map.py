"""The posterior mode of a NumPyro model, and the Gaussian (Laplace) approximation around it.

1. Search from the prior median, or from a given point, and from prior draws with L-BFGS.
2. Polish the best end point by Newton's method.
3. Decompose the Hessian there: the covariance is its inverse, and flat directions are reported.
4. Report why the point is not a minimum: derivatives that are not finite, a saddle point, a coordinate that runs away,
   or a remaining slope.

Source: Tierney and Kadane (1986), Journal of the American Statistical Association 81, 82-86.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import init_to_median, init_to_sample

from lfm_ppl.inference.bind import bind_arguments
from lfm_ppl.inference.bound_model import BoundModel, StartError
from lfm_ppl.inference.optimise import End, Minimum, Objective, newton, quasi_newton
from lfm_ppl.utils import checks
from lfm_ppl.utils.random_keys import split_keys

_HESSIANS = ("autodiff", "finite-differences")
_ATTEMPTS = 20
_SEARCH = {"maxcor": 40, "ftol": 1e-9, "gtol": 1e-7}
"""Options of L-BFGS: it ends where a step gains less than 1e-9 of the log density, and Newton's method continues."""
_REMEDY = (
    "Try more restarts, a starting point of your own (init={'site': value}), more max_iterations, "
    "or a prior that says more about these parameters."
)


@dataclass(frozen=True, eq=False)
class MAPResult:
    """A posterior mode with its Laplace approximation ``z ~ N(mode, covariance)``.

    Attributes:
        parameters: site name -> value at the mode, in the constrained space of the model.
        deterministic: name of a deterministic site -> value at the mode.
        unconstrained: site name -> unconstrained value; ``init_params`` for ``MCMC.run``.
        mode: the unconstrained parameters as one vector, (d,), in flat order.
        coordinates: names of the entries of ``mode``, in flat order: sites sorted by name, each in C order.
        covariance: inverse Hessian of minus the log density at the mode, (d, d), unconstrained, in
            flat order; positive definite; NaN where no finite Hessian exists.
        start_covariance: the same with variance one along flat directions, for a sampler's first mass matrix, (d, d).
        log_density: log joint density at the mode: of the unconstrained parameters (with the
            Jacobian), or of the constrained ones with ``jacobian=False``.
        log_evidence: Laplace approximation of the log marginal likelihood; exact if the posterior
            is Gaussian in the space whose mode this is.
        converged: whether the search ended at a minimum.
        message: how the search ended.
        unidentified: coordinates along which the density is flat; their variances are arbitrary large numbers.
        runaway: coordinates along which the search diverged, to the edge of the support or to infinity.
        restart_log_densities: log density at the end of each search, (restarts,); -inf where no starting point has a
            finite density. Differences above 1e-6 of the value mean several modes.
        restart_ends: end point of each search, (restarts, d); NaN where there is no starting point.
        evaluations: number of computed gradients.
    """

    parameters: dict[str, np.ndarray]
    deterministic: dict[str, np.ndarray]
    unconstrained: dict[str, np.ndarray]
    mode: np.ndarray
    coordinates: tuple[str, ...]
    covariance: np.ndarray
    start_covariance: np.ndarray
    log_density: float
    log_evidence: float
    converged: bool
    message: str
    unidentified: tuple[str, ...]
    runaway: tuple[str, ...]
    restart_log_densities: np.ndarray
    restart_ends: np.ndarray
    evaluations: int
    _factor: np.ndarray = field(repr=False)
    _constrain: Callable = field(repr=False)

    def sample(self, key: jax.Array, n: int) -> dict[str, np.ndarray]:
        """Return ``n`` draws from the Laplace approximation, in constrained space.

        Args:
            key: random key.
            n: number of draws.

        Returns:
            Site name -> draws of shape (n, ...), deterministic sites included.

        Raises:
            ValueError: the covariance is not finite, or ``n`` is not positive.
        """
        checks.positive_integer("n", n)
        if not np.all(np.isfinite(self._factor)):
            raise ValueError(
                "there is no Laplace approximation to draw from: the Hessian at the mode is not "
                "finite. Use hessian='finite-differences', or sample the posterior with MCMC."
            )
        noise = np.asarray(jax.random.normal(key, (n, self.mode.size)))
        return self._constrain(self.mode + noise @ self._factor.T)


def map_estimate(
    numpyro_model: Callable,
    *args: Any,
    init: Callable | Mapping[str, Any] | None = None,
    restarts: int = 4,
    seed: int = 0,
    model_kwargs: Mapping[str, Any] | None = None,
    jacobian: bool = True,
    hessian: str | None = None,
    forward_mode: bool | None = None,
    max_iterations: int = 1000,
) -> MAPResult:
    r"""Return the posterior mode of a NumPyro model and the Laplace approximation around it.

    With ``theta = T(z)``, ``z`` unconstrained, the mode maximises

        log p(y, T(z)) + log |dT/dz|     (jacobian=True, the default)
        log p(y, theta)                  (jacobian=False)

    The first is the mode of the density that MCMC explores. The mode depends on the parametrisation: only the second
    is the mode of the density of ``theta``. The covariance is the inverse Hessian over ``z`` of minus the maximised
    function. L-BFGS searches from several starts, and Newton's method polishes the best end point.

    Args:
        numpyro_model: a NumPyro model whose latent sites are continuous.
        *args: its positional arguments, data included.
        init: the first start: a NumPyro strategy, or site name -> constrained value (the prior median for other
            sites); by default ``init_to_median``. The other starts are prior draws.
        restarts: number of starts, at least one.
        seed: seed of the starts, a whole number.
        model_kwargs: keyword arguments of the model.
        jacobian: the kind of mode, see above.
        hessian: ``"autodiff"``, or ``"finite-differences"`` of the gradient: about 9 digits instead
            of 15, no second derivatives, and for a latent force model less than half the time to
            compile. By default differences for a model with a filter, and ``"autodiff"`` for others.
        forward_mode: take derivatives in forward mode, the only one for a Hessian by automatic differentiation of a
            model with a ``jax.lax.while_loop``; by default with up to three parameters, where it is faster.
        max_iterations: largest number of iterations of L-BFGS for each start.

    Returns:
        The mode, with ``parameters``, ``covariance``, ``log_evidence``, ``sample(key, n)``.

    Raises:
        ValueError: a discrete latent site or none at all, an unknown site in ``init``, a start or
            every prior draw with density zero, an unknown ``hessian``.

    Warns:
        UserWarning: the search did not converge; the density is flat in some direction; JAX runs in
            float32.

    Example:
        >>> import numpyro, numpyro.distributions as dist
        >>> def model(y):
        ...     mean = numpyro.sample("mean", dist.Normal(0.0, 1.0))
        ...     numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)
        >>> result = map_estimate(model, 3.0)
        >>> round(float(result.parameters["mean"]), 3), round(float(result.covariance[0, 0]), 3)
        (1.5, 0.5)

    Source:
        Tierney and Kadane (1986), Accurate approximations for posterior moments and marginal
        densities, Journal of the American Statistical Association 81, 82-86.
    """
    checks.positive_integer("restarts", restarts)
    checks.positive_integer("max_iterations", max_iterations)
    if hessian is not None:
        checks.one_of("hessian", hessian, _HESSIANS)
    if jnp.result_type(float) != jnp.float64:
        warnings.warn(
            "map_estimate runs in float32, which is too coarse for a Hessian. Call "
            "numpyro.enable_x64() before anything else.",
            stacklevel=2,
        )
    bound = bind_arguments(numpyro_model, args, model_kwargs or {}, "map_estimate")
    exact = not bound.has_likelihood if hessian is None else hessian == "autodiff"
    return mode_of(jax.random.key(seed), bound, bound.objective(jacobian, forward_mode, exact), init=init,
                   restarts=restarts, jacobian=jacobian, max_iterations=max_iterations)


def mode_of(key: jax.Array, bound: BoundModel, objective: Objective | None = None, *, init: Any = None,
            restarts: int = 4, jacobian: bool = True, max_iterations: int = 1000,
            negligible_rise: float | None = None) -> MAPResult:
    """Return the posterior mode of a bound model, from starts drawn by a key.

    The search has converged where one further step of Newton's method would raise the log density by less than
    ``negligible_rise``; None: 1e-6, or 1e-3 in single precision. A density whose integration steps follow a tolerance
    has small jumps, which end the search before that.

    Args:
        key: a JAX random key.
        bound: the model and its data.
        objective: minus the log density; None: with the default derivatives.
        init: starting point of the first search, as in `map_estimate`.
        restarts: number of searches.
        jacobian: whether the density is that of the unconstrained parameters.
        max_iterations: largest number of iterations of a search.
        negligible_rise: see above.
    """
    objective = objective or bound.objective(jacobian)
    starts = _starts(bound, key, objective.value, init, restarts)
    no_end = End(np.full(bound.size, np.nan), np.inf)
    search_ends = [no_end if start is None else quasi_newton(objective, start, max_iterations, options=_SEARCH)
                   for start in starts]
    minimum = newton(objective, min(search_ends, key=lambda end: end.value).point)
    if negligible_rise is None:
        negligible_rise = _smallest_rise()
    return _result(bound, objective, minimum, search_ends, jacobian, negligible_rise)


def _smallest_rise() -> float:
    """Return the rise of a log density that rounding errors leave."""
    return 1e-6 if jnp.result_type(float) == jnp.float64 else 1e-3


def _starts(
    model: BoundModel, key: jax.Array, value: Callable, init: Any, restarts: int
) -> list[np.ndarray | None]:
    """Return one vector (d,) of finite density for each start; None where there is none."""
    first, attempts = init or init_to_median, _ATTEMPTS
    check_sites(model, init)
    if isinstance(init, Mapping):
        first, attempts = partial(_init_to_values, init), 1
    keys = split_keys(key, restarts)
    start = _possible_start(model, value, keys(0), first, attempts)
    if isinstance(init, Mapping) and start is None:
        raise ValueError(
            f"the density is zero or not finite at init={dict(init)!r}. Give values inside the "
            "support of their priors at which the model can produce the data."
        )
    starts = [start, *(_possible_start(model, value, keys(index), init_to_sample, _ATTEMPTS)
                       for index in range(1, restarts))]
    if all(start is None for start in starts):
        raise StartError(
            f"found no point of finite density in {restarts} x {_ATTEMPTS} draws from the prior. "
            "Give a starting point, init={'site': value}, or check the model: its log density is "
            "-inf or NaN."
        )
    return starts


def check_sites(model: BoundModel, init: Any) -> None:
    """Raise where a starting point names a site that the model does not have."""
    for name in init if isinstance(init, Mapping) else ():
        if name not in model.sites:
            raise ValueError(checks.unknown("site in init", name, model.sites))


def _possible_start(
    model: BoundModel, value: Callable, key: jax.Array, strategy: Callable, attempts: int
) -> np.ndarray | None:
    keys = split_keys(key, attempts)
    for attempt in range(attempts):
        flat = model.draw(keys(attempt), strategy)
        if np.isfinite(value(flat)):
            return flat
    return None


def _init_to_values(values: Mapping[str, Any], site: dict) -> Any:
    if site["type"] != "sample" or site["is_observed"] or site["name"] not in values:
        return init_to_median(site)
    shape = tuple(site["kwargs"].get("sample_shape") or ()) + tuple(site["fn"].shape())
    value = np.asarray(values[site["name"]], float)
    try:
        return jnp.asarray(np.broadcast_to(value, shape))
    except ValueError:
        raise ValueError(
            f"init[{site['name']!r}] must be of shape {shape}, got shape {value.shape}."
        ) from None


def _result(
    bound: BoundModel, objective: Objective, minimum: Minimum, search_ends: list[End], jacobian: bool,
    negligible_rise: float
) -> MAPResult:
    point, curvature, names = minimum.point, minimum.curvature, bound.names
    unconstrained = {k: np.asarray(v) for k, v in bound.unravel(point).items()}
    values = {k: np.asarray(v) for k, v in bound.constrain(point).items()}
    factor, log_determinant, unidentified = np.full((point.size,) * 2, np.nan), math.nan, ()
    start_covariance = factor
    if curvature is not None:
        start_covariance = curvature.start_covariance
        factor, log_determinant = curvature.factor, curvature.log_determinant
        unidentified = tuple(names[i] for i in curvature.coordinates(curvature.flat))
    message = _verdict(minimum, names, negligible_rise)
    if message:
        warnings.warn(f"map_estimate did not converge: {message} {_REMEDY}", stacklevel=4)
    elif unidentified:
        warnings.warn(
            f"the posterior is flat at its mode in a direction of {', '.join(unidentified)}: their "
            "Laplace variances and the evidence mean nothing. Give these parameters an "
            "informative prior, or fix one of them.",
            stacklevel=4,
        )
    # The evidence includes the Jacobian for either kind of mode, since the Hessian is over z.
    energy = minimum.value if jacobian else -float(bound.log_density(point))
    return MAPResult(
        parameters={k: v for k, v in values.items() if k in unconstrained},
        deterministic={k: v for k, v in values.items() if k not in unconstrained},
        unconstrained=unconstrained,
        mode=point,
        coordinates=names,
        covariance=factor @ factor.T,
        start_covariance=start_covariance,
        log_density=-minimum.value,
        log_evidence=-energy + 0.5 * (point.size * math.log(2 * math.pi) - log_determinant),
        converged=not message,
        message=message or "converged",
        unidentified=unidentified,
        runaway=tuple(np.array(names)[_runaway(minimum, negligible_rise)]),
        restart_log_densities=np.array([-end.value for end in search_ends]),
        restart_ends=np.stack([end.point for end in search_ends]),
        evaluations=objective.evaluations,
        _factor=factor,
        _constrain=bound.constrain_draws,
    )


def _verdict(minimum: Minimum, names: tuple[str, ...], negligible_rise: float) -> str:
    """Return why the point is not a minimum; an empty string if it is one."""
    curvature = minimum.curvature
    if curvature is None:
        return "the derivatives are not finite at the end of the search."
    negative = curvature.values < -curvature.floor
    if np.any(negative):
        where = ", ".join(names[i] for i in curvature.coordinates(negative))
        return f"the search ended at a saddle point, in a direction of {where}."
    is_runaway = _runaway(minimum, negligible_rise)
    if np.any(is_runaway):
        where = ", ".join(np.array(names)[is_runaway])
        return f"{where} runs away; the mode may lie at the edge of the support or at infinity."
    flat_slope = curvature.flat_slope(minimum.gradient)
    if minimum.decrement > negligible_rise or flat_slope > _smallest_rise():
        return f"the log density still rises by about {max(minimum.decrement, flat_slope):.1e} within one step."
    return ""


def _runaway(minimum: Minimum, negligible_rise: float) -> np.ndarray:
    """Return whether Newton's step is long along each coordinate (d,) at the end of the search.

    With a standard deviation of one, a step that raises the log density by r has the length sqrt(2 r).
    """
    return np.abs(minimum.step) > math.sqrt(negligible_rise) * (1.0 + np.abs(minimum.point))
