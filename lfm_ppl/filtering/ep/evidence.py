r"""The log evidence of a model with factors, refined until they do not change.

An entry of the data, or a constraint, is a term p_i(f_i) of the predictor f = h(x, u, t) at a row. Its factor
t_i(f_i) = exp(nu (f_i - c) - tau (f_i - c)^2 / 2) replaces it in the forward and the backward scan.

1. First factors: from the prior's marginals in a linear model, by `moment_matching` in the forward scan of another.
2. A non-linear model is smoothed a fixed number of times; after each pass it is linearised about the smoothed moments
   and its factors are refined. All of that has a derivative.
3. With the linearisation held fixed, sweeps refine the factors until they do not change (`fixed_point`). A sweep is one
   forward and one backward scan, which give marginals, cavities and new factors. It has no derivative.
4. The log evidence, with I the integral of all factors that the forward scan gives, is

       EP            log I + sum_i [log Z_i - log int q_-i t_i^a] / a,    Z_i = int q_-i p_i^a,
       variational   log I + sum_i [E_q log p_i - E_q log t_i],
       Laplace       log I + sum_i [log p_i - log t_i](mean of q).

   The first two are stationary in the factors and in the cavities, so that a gradient holds both fixed and costs that
   of one filter. That of Laplace's goes through one more step to the mode.

Source: Minka (2001), A family of algorithms for approximate Bayesian inference; Nickisch, Solin and Grigorevskiy
(2018), ICML; Wilkinson, Särkkä and Solin (2023), Journal of Machine Learning Research 24.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.backward import SmoothedPredictor, SmootherTrace, backward
from lfm_ppl.filtering.ep.cavities import (
    FactorMarginals,
    cavities,
    clip_to_proper,
    is_deterministic,
    is_valid,
    with_positive_variance,
)
from lfm_ppl.filtering.ep.factor_updates import laplace_factors, log_evidence_terms, new_factors
from lfm_ppl.filtering.ep.fixed_point import FixedPoint, Sweep, iterate_factors
from lfm_ppl.filtering.ep.moment_matching import (
    NEARLY_CONSTANT,
    MomentMatchingUpdate,
    factors_of_moments,
    observation_family,
    stop_gradient_of_call,
    tilted_mode,
)
from lfm_ppl.filtering.ep.settings import FactorSettings, FixedPointOptions
from lfm_ppl.filtering.ep.terms import EntryTerms, FamilyTerms
from lfm_ppl.filtering.forward import FilterTrace, IntervalMaps, LinearisationPoints, forward, maps_about
from lfm_ppl.filtering.iterated import smoothed_points
from lfm_ppl.filtering.moments import Moments, Record, matvec
from lfm_ppl.filtering.problem import FilterProblem, at_intervals
from lfm_ppl.filtering.update import Factors, FactorUpdate, Updater
from lfm_ppl.utils.linalg import diagonal, inverse_and_log_det, matmul


class RefinedFactors(NamedTuple):
    """Factors and the points of linearisation.

    Attributes:
        fixed_point: result of the sweeps; constants for a derivative.
        points: moments about which the model is linearised; None for a linear model.
        maps: of the intervals, linearised about them; None where a pass computes its own.
        assumed: log likelihood of assumed density filtering, the first pass of a non-linear model; -inf if linear.
    """

    fixed_point: FixedPoint
    points: LinearisationPoints | None
    maps: IntervalMaps | None
    assumed: jax.Array


class Evidence(NamedTuple):
    """The log evidence and its parts.

    Attributes:
        log_evidence: log p(y). Where the factors do not converge, that of assumed density filtering in a non-linear
            model, -inf in a linear one.
        entries: (T, D), term of each entry besides the integral of the factors.
        trace: the forward scan with the factors.
        refined: the factors.
    """

    log_evidence: jax.Array
    entries: jax.Array
    trace: FilterTrace
    refined: RefinedFactors


def evidence(problem: FilterProblem, terms: EntryTerms, settings: FactorSettings, *, first: Factors | None = None,
             record: Record = Record.LIKELIHOOD) -> Evidence:
    """Return the log evidence of a model with factors, with a derivative.

    Args:
        problem: the model, the rule and the time grid.
        terms: exact terms, which the factors approximate.
        settings: how the factors are refined.
        first: first factors; None: see step 1 above, for an observation family.
        record: recorded output of the last forward scan.
    """
    initial = problem.initial()
    refined = refine(problem, terms, settings, initial, first)
    fixed_point = refined.fixed_point
    cavity = fixed_point.cavity
    if isinstance(terms, FamilyTerms):
        uses_moments = settings.method == "ep"
        fixed_point = fixed_point._replace(factors=stop_gradient_of_call(
            lambda fixed_point: _final_factors(terms, fixed_point, uses_moments), fixed_point))
        refined = refined._replace(fixed_point=fixed_point)
    factors = fixed_point.factors
    if settings.method == "laplace":
        newton, cavity = _newton_step(problem, terms, settings, initial, refined)
        factors = jax.tree.map(functools.partial(jnp.where, fixed_point.converged), newton, factors)
    maps = None if record is Record.LINEARIZATION else refined.maps
    trace = forward(problem, FactorUpdate(factors), initial=initial, about=refined.points, record=record, maps=maps)
    entries = log_evidence_terms(terms, factors, cavity, settings, fixed_point.log_partition)
    if isinstance(terms, FamilyTerms):
        predicted = at_intervals(trace.predictor, problem.grid.observed)
        # Where the predictor is not deterministic, its mean is not used and must not put NaN into a derivative.
        mean = jnp.where(cavity.deterministic, predicted, jax.lax.stop_gradient(cavity.marginal.mean))
        entries = jnp.where(cavity.deterministic, terms.log_prob(mean), entries)
    total = trace.log_likelihood.sum() + entries.sum()
    return Evidence(jnp.where(fixed_point.converged, total, refined.assumed), entries, trace, refined)


def refine(problem: FilterProblem, terms: EntryTerms, settings: FactorSettings, initial: Moments,
           first: Factors | None = None) -> RefinedFactors:
    """Refine factors until they do not change; ``initial`` are moments, other arguments as in `evidence`.

    Where the factors of a non-linear model do not converge, the result has the factors of assumed density filtering,
    without negative precisions: with them a variance could be negative about other points.
    """
    if problem.ssm.plan.is_linear:
        maps = maps_about(problem, None)
        if first is None:
            assert isinstance(terms, FamilyTerms)
            first = stop_gradient_of_call(lambda *a: _factors_from_prior(problem, terms, *a), initial, maps)
        fixed_point = stop_gradient_of_call(
            lambda *a: _sweep_until_converged(problem, terms, settings, *a), initial, first, None, maps)
        return RefinedFactors(fixed_point, None, maps, jnp.asarray(-jnp.inf))
    updater: Updater
    if first is None:
        assert isinstance(terms, FamilyTerms)
        updater = MomentMatchingUpdate(observation_family(problem), terms.y)
    else:
        updater = FactorUpdate(first)
    factors, points, trace = _joint_sweeps(problem, terms, settings, initial, updater)
    maps = maps_about(problem, points)
    # The terms hold functions, so that they are closed over, and no argument.
    fixed_point = stop_gradient_of_call(
        lambda *a: _sweep_until_converged(problem, terms, settings, *a), initial, factors, points, maps)
    if first is not None:
        return RefinedFactors(fixed_point, points, maps, jnp.asarray(-jnp.inf))
    fallback = stop_gradient_of_call(lambda fixed_point, factors: jax.tree.map(
        functools.partial(jnp.where, fixed_point.converged), fixed_point.factors, factors), fixed_point,
        clip_to_proper(at_intervals(trace.update.factor_terms.factors, problem.grid.observed)))
    return RefinedFactors(fixed_point._replace(factors=fallback), points, maps, trace.log_likelihood.sum())


def _factors_from_prior(problem: FilterProblem, terms: FamilyTerms, initial: Moments,
                        maps: IntervalMaps | None) -> Factors:
    """Return factors with the moments of the prior's marginals times the data's terms.

    All rows at once, which is faster than one after the other in the scan; in a non-linear model the prior may run
    away from the data.
    """
    empty = jnp.zeros_like(terms.y)
    updater = FactorUpdate(Factors(empty, empty, empty))
    trace = forward(problem, updater, initial=initial, record=Record.MOMENTS, maps=maps)
    prior = at_intervals(trace.update.factor_terms, problem.grid.observed)
    mean, variance = prior.value, diagonal(prior.variance)
    cavity = with_positive_variance(mean, variance)
    tilted = terms.tilted(cavity, tilted_mode(terms.log_prob, cavity), 1.0, is_coarse=True)
    usable = (terms.present & jnp.isfinite(tilted.log_partition) & (tilted.variance > 0)
              & ~is_deterministic(mean, variance))
    return factors_of_moments(cavity, jnp.where(usable, tilted.shift, 0.0),
                              jnp.where(usable, tilted.variance, cavity.variance))


def _smooth_with_factors(problem: FilterProblem, updater: Updater, initial: Moments, points: LinearisationPoints | None,
                         record: Record, maps: IntervalMaps | None
                         ) -> tuple[FilterTrace, SmootherTrace, SmoothedPredictor]:
    """Return a forward and an adjoint scan, and the smoothed predictor (T, ...)."""
    trace = forward(problem, updater, initial=initial, about=points, record=record, maps=maps)
    smoothed = backward(problem, trace, adjoint_only=True)
    return trace, smoothed, at_intervals(smoothed.predictor, problem.grid.observed)


def _joint_sweeps(problem: FilterProblem, terms: EntryTerms, settings: FactorSettings, initial: Moments,
                  updater: Updater) -> tuple[Factors, LinearisationPoints, FilterTrace]:
    """Return factors and points of linearisation, and the first forward scan."""
    grid = problem.grid
    needs_ends_only = grid.steps == 1 and not problem.has_jumps

    # A sweep in which an entry has no cavity gives no new factors and points.
    def sweep(updater: Updater, points: LinearisationPoints | None) -> tuple[tuple, FilterTrace]:
        # Without nodes inside of an interval its map is all that is needed of it.
        maps = maps_about(problem, points) if points is not None and needs_ends_only else None
        record = Record.LINEARIZATION if maps is None else Record.SMOOTHER
        trace, smoothed, predictor = _smooth_with_factors(problem, updater, initial, points, record, maps)
        factors = at_intervals(trace.update.factor_terms.factors, grid.observed)
        cavity = cavities(predictor, factors, terms.present, settings.power)
        # Points of linearisation take the derivative of these factors, and that of coarse ones is not exact enough.
        refined = new_factors(terms, factors, cavity, settings, settings.damping)[0]
        new_points = smoothed_points(problem, trace, smoothed)
        choose = functools.partial(jax.tree.map, functools.partial(jnp.where, is_valid(predictor, cavity)))
        return (choose(refined, clip_to_proper(factors)),
                new_points if points is None else choose(new_points, points)), trace

    (factors, points), trace = sweep(updater, None)
    count = max(settings.relinearisations - 1, 0)
    if count == 1:
        # A loop would take the derivative of the last factors, which nothing needs.
        factors, points = sweep(FactorUpdate(factors), points)[0]
    else:
        (factors, points), _ = jax.lax.scan(lambda carry, _: (sweep(FactorUpdate(carry[0]), carry[1])[0], None),
                                            (factors, points), None, length=count)
    return factors, points, trace


def _sweep_until_converged(problem: FilterProblem, terms: EntryTerms, settings: FactorSettings, initial: Moments,
                           first: Factors, points: LinearisationPoints | None, maps: IntervalMaps | None) -> FixedPoint:
    def sweep(factors: Factors, is_coarse: jax.Array) -> Sweep:
        _, _, predictor = _smooth_with_factors(problem, FactorUpdate(factors), initial, points, Record.SMOOTHER, maps)
        cavity = cavities(predictor, factors, terms.present, settings.power)
        new, change, log_partition = new_factors(terms, factors, cavity, settings, 1.0, is_coarse)
        return Sweep(new, cavity, log_partition, jnp.where(is_valid(predictor, cavity), change, jnp.inf))

    # Points of linearisation come from sweeps of the same factors, whose changes do not grow any more.
    options = FixedPointOptions() if points is None else FixedPointOptions(growing_sweeps=1)
    return iterate_factors(sweep, first, settings.damping, settings.sweeps, options)


def _newton_step(problem: FilterProblem, terms: EntryTerms, settings: FactorSettings, initial: Moments,
                 refined: RefinedFactors) -> tuple[Factors, FactorMarginals]:
    """Make one more step to the mode, whose derivative is that of the mode.

    Laplace's evidence is not stationary in its factors. A Newton step from the mode leads back to it and, to first
    order, does not depend on its start, so that it depends on everything else as the mode does.
    """
    fixed_point = refined.fixed_point
    factors = new_factors(terms, fixed_point.factors, fixed_point.cavity, settings, 1.0)[0]
    _, _, predictor = _smooth_with_factors(problem, FactorUpdate(factors), initial, refined.points, Record.SMOOTHER,
                                           refined.maps)
    cavity = cavities(predictor, factors, terms.present, 1.0)
    return new_factors(terms, factors, cavity, settings, 1.0)[0], cavity


def _final_factors(terms: FamilyTerms, fixed_point: FixedPoint, uses_moments: bool) -> Factors:
    """Return the factors, empty ones for deterministic predictors and exact ones for nearly deterministic ones.

    Over a small variance v a term hardly differs from a constant, and moments of the tilted distribution have its
    slope to eps / sd only. The derivatives of log p at the mean are the slope and the curvature to a relative error v.
    ``uses_moments``: whether the factors come from moments, as in expectation propagation.
    """
    factors, cavity = fixed_point.factors, fixed_point.cavity
    nu, tau = factors.nu, factors.tau
    if uses_moments:
        mean, variance = cavity.marginal
        exact_nu, exact_tau, _ = laplace_factors(terms, factors, cavity, 1.0)
        slope = exact_nu - exact_tau * (mean - factors.centre)
        is_flat = (slope**2 * variance < NEARLY_CONSTANT) & (jnp.abs(exact_tau) * variance < NEARLY_CONSTANT)
        is_flat &= terms.present & cavity.valid & fixed_point.converged
        nu, tau = jnp.where(is_flat, exact_nu, nu), jnp.where(is_flat, exact_tau, tau)
    return factors._replace(nu=jnp.where(cavity.deterministic, 0.0, nu), tau=jnp.where(cavity.deterministic, 0.0, tau))


def leave_one_out(predictor: SmoothedPredictor, factors: Factors, entries: jax.Array) -> jax.Array:
    """Return log p(y_k | all other rows), (T,), from the predictor that is smoothed with the converged factors.

    It is the integral of a row's factors under the predictor without them, plus the terms of its entries.

    Args:
        predictor: smoothed, (T, ...).
        factors: (T, D) each.
        entries: (T, D), of `log_evidence_terms`.
    """
    return jax.vmap(_integral_of_factors)(predictor.mean, predictor.covariance, factors) + entries.sum(1)


def entry_leave_one_out(predictor: SmoothedPredictor, factors: Factors, entries: jax.Array) -> jax.Array:
    """Return log p of each entry given all other entries (T, D), with the arguments of `leave_one_out`."""

    def entry(mean: jax.Array, variance: jax.Array, factor: Factors) -> jax.Array:
        return _integral_of_factors(mean[None], variance[None, None], jax.tree.map(lambda a: a[None], factor))

    return jax.vmap(jax.vmap(entry))(predictor.mean, diagonal(predictor.covariance), factors) + entries


def _integral_of_factors(mean: jax.Array, covariance: jax.Array, factors: Factors) -> jax.Array:
    """Return the log integral of factors (D,) under the predictor N(m, F) without them.

    With V = F (I + T F)^-1 and m smoothed, F = V (I - T V)^-1. ``mean`` (D,) and ``covariance`` V (D, D) are smoothed.
    """
    # log|I + T F| = -log|I - T V|; and with a = m - c the exponent is that of the smoothed moments.
    i_tv, log_det = inverse_and_log_det(jnp.eye(mean.shape[0]) - factors.tau[:, None] * covariance)
    offset = matvec(i_tv.T, mean - factors.centre - matmul(covariance, factors.nu[:, None])[:, 0])
    slope = factors.nu - factors.tau * offset
    return (((factors.nu - 0.5 * factors.tau * offset) * offset).sum() + 0.5 * log_det
            + 0.5 * (slope * matvec(covariance, slope)).sum())
