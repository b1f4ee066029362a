"""New factors from cavities and marginals, and each entry's term of the log evidence.

With the smoothed marginal q of an entry, its cavity q_-i = q / t_i^a and its exact term p_i,

1. expectation propagation:  t_i^a = (Gaussian with the moments of q_-i p_i^a) / q_-i,
2. variational:              nu, tau from the derivatives of E_q log p_i by the mean and the variance of q,
3. Laplace:                  nu, tau from the derivatives of log p_i at the mean of q.

Source: Minka (2001), A family of algorithms for approximate Bayesian inference; Khan and Lin (2017), AISTATS.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from lfm_ppl.filtering.ep.cavities import FactorMarginals
from lfm_ppl.filtering.ep.quadrature import MeanVariance, expectations
from lfm_ppl.filtering.ep.settings import FactorSettings
from lfm_ppl.filtering.ep.terms import EntryTerms, FamilyTerms
from lfm_ppl.filtering.update import Factors


def ep_factors(terms: EntryTerms, factors: Factors, marginals: FactorMarginals, power: float,
               is_coarse: Any = False) -> tuple:
    """Return nu, tau and log Z_i of expectation propagation; NaN where the tilted variance is rounding error."""
    if not isinstance(terms, FamilyTerms):
        tilted = terms.tilted(marginals.cavity, marginals.marginal, power)
    elif isinstance(is_coarse, bool):
        tilted = terms.tilted(marginals.cavity, marginals.marginal, power, is_coarse)
    else:
        tilted = jax.lax.cond(is_coarse, lambda m: terms.tilted(m.cavity, m.marginal, power, True),
                              lambda m: terms.tilted(m.cavity, m.marginal, power), marginals)
    # Where one node holds all the mass the variance is a rounding error, and gives no new factor.
    usable = tilted.variance > 1e-13 * marginals.marginal.variance
    variance, nan_if_unusable = jnp.where(usable, tilted.variance, 1.0), jnp.where(usable, 0.0, jnp.nan)
    c, v = marginals.cavity.mean - factors.centre, marginals.cavity.variance
    tau = 1.0 / variance - 1.0 / v
    # Both are the same number. A term that hardly narrows a cavity moves it by less than its mean is rounded by.
    nu = jnp.where(variance > 0.5 * v, tilted.shift / variance + c * tau,
                   (tilted.mean - factors.centre) / variance - c / v)
    return nu / power + nan_if_unusable, tau / power + nan_if_unusable, tilted.log_partition


def variational_factors(terms: Any, factors: Factors, marginals: FactorMarginals, power: float,
                        is_coarse: Any = False) -> tuple:
    """Return nu and tau of the variational update, and zeros."""
    _, by_mean, by_variance = expectations(terms.log_prob, marginals.marginal)
    tau = -2.0 * by_variance
    return by_mean + tau * (marginals.marginal.mean - factors.centre), tau, jnp.zeros_like(tau)


def laplace_factors(terms: Any, factors: Factors, marginals: FactorMarginals, power: float,
                    is_coarse: Any = False) -> tuple:
    """Return nu and tau of a Newton step at the marginal means, and zeros."""
    m = marginals.marginal.mean
    slope_at = jax.grad(lambda f: terms.log_prob(f).sum())
    slope, curvature = jax.jvp(slope_at, (m,), (jnp.ones_like(m),))
    return slope - curvature * (m - factors.centre), -curvature, jnp.zeros_like(m)


_NEW_FACTORS: dict[str, Callable] = {"ep": ep_factors, "variational": variational_factors, "laplace": laplace_factors}


def new_factors(terms: EntryTerms, factors: Factors, marginals: FactorMarginals, settings: FactorSettings,
                damping: Any, is_coarse: Any = False) -> tuple[Factors, jax.Array, jax.Array]:
    """Return damped new factors, their largest change, and log Z_i of EP; a factor without a cavity does not change.

    Args:
        terms: exact terms, which the factors approximate.
        factors: present factors, (T, D) each.
        marginals: their marginals and cavities.
        settings: method and power.
        damping: fraction of the new factors that is taken.
        is_coarse: whether EP uses the coarse quadrature.
    """
    nu, tau, log_partition = _NEW_FACTORS[settings.method](terms, factors, marginals, settings.power, is_coarse)
    nu, tau = (jnp.where(marginals.deterministic, 0.0, new) for new in (nu, tau))
    usable = terms.present & marginals.valid & jnp.isfinite(nu) & jnp.isfinite(tau)
    nu, tau = (jnp.where(usable, new, old) for new, old in ((nu, factors.nu), (tau, factors.tau)))
    v = marginals.marginal.variance
    sd, eps = jnp.sqrt(v), jnp.finfo(v.dtype).eps
    change = jnp.maximum(jnp.abs(nu - factors.nu) * sd, jnp.abs(tau - factors.tau) * v)
    # A factor whose sd is not far above the spacing of numbers at the predictor is accurate to that spacing only.
    rounding = 16.0 * eps * jnp.abs(tau) * sd * jnp.abs(marginals.marginal.mean)
    change = jnp.where(change > rounding, change, 0.0)
    change = jnp.max(jnp.where(usable | ~terms.present, change, jnp.inf), initial=0.0)
    damped = factors._replace(nu=factors.nu + damping * (nu - factors.nu),
                              tau=factors.tau + damping * (tau - factors.tau))
    return damped, change, log_partition


def gaussian_terms(factors: Factors, cavity: MeanVariance, power: float) -> jax.Array:
    """Return log int N(f; cavity) t(f)^power df for each entry."""
    nu, tau, v = power * factors.nu, power * factors.tau, cavity.variance
    offset, growth = cavity.mean - factors.centre, 1.0 + tau * v
    growth = jnp.where(growth > 0, growth, 1.0)
    return ((nu - 0.5 * tau * offset) * offset + 0.5 * nu**2 * v) / growth - 0.5 * jnp.log(growth)


def log_evidence_terms(terms: Any, factors: Factors, marginals: FactorMarginals, settings: FactorSettings,
                       log_partition: jax.Array | None = None) -> jax.Array:
    """Return the term of each entry (T, D) in the log evidence besides the integral of all factors, zero where missing.

    Args:
        terms: exact terms, which the factors approximate.
        factors: (T, D) each.
        marginals: their marginals and cavities, which have no derivative where ``log_partition`` is given.
        settings: of the factors.
        log_partition: (T, D), that of EP's cavities where it is known.
    """
    nu, tau = factors.nu, factors.tau
    if settings.method == "ep":
        power = settings.power

        def integral() -> jax.Array:
            return terms.tilted(marginals.cavity, marginals.marginal, power).log_partition

        log_z = integral() if log_partition is None else with_known_primal(integral, log_partition)
        value = (log_z - gaussian_terms(factors, marginals.cavity, power)) / power
    else:
        m, v = marginals.marginal
        offset = m - factors.centre
        gaussian = (nu - 0.5 * tau * offset) * offset
        if settings.method == "variational":
            value = expectations(terms.log_prob, marginals.marginal)[0] - gaussian + 0.5 * tau * v
        else:
            value = terms.log_prob(m) - gaussian
    return jnp.where(terms.present, value, 0.0)


def with_known_primal(function: Callable[[], jax.Array], value: jax.Array) -> jax.Array:
    """Return ``function()`` whose value is known: it is evaluated for derivatives only, and only if it has any."""
    converted, closed_over = jax.closure_convert(function)

    @jax.custom_jvp
    def value_of(value: jax.Array, *closed_over: Any) -> jax.Array:
        return value

    @functools.partial(value_of.defjvp, symbolic_zeros=True)
    def _jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
        active = [i for i, tangent in enumerate(tangents[1:]) if not isinstance(tangent, SymbolicZero)]
        if not active:
            return primals[0], jnp.zeros_like(primals[0])

        def of_active(*values: Any) -> jax.Array:
            arguments = list(primals[1:])
            for i, argument in zip(active, values, strict=True):
                arguments[i] = argument
            return converted(*arguments)

        active_primals, active_tangents = (tuple(values[1 + i] for i in active) for values in (primals, tangents))
        return primals[0], jax.jvp(of_active, active_primals, active_tangents)[1]

    return value_of(value, *closed_over)
