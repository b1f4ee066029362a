"""Factors from the prediction of a row: assumed density filtering, the first pass of expectation propagation.

1. The entries of a row are taken one after the other, each with the prediction given the earlier ones as its cavity.
2. The mode of the tilted distribution, by a safeguarded Newton search, locates the nodes of a quadrature, whose moments
   locate the nodes of a second quadrature.
3. The factor is the ratio of the Gaussian of the tilted moments and the cavity. Prediction times factors has the
   moments of the last tilted distribution: a positive definite covariance, whatever the signs of the precisions.
4. The product of the entries' Z is a density of the row, given the rows before.

Where the density of the data is not log-concave a tilted distribution far from the data may have two modes. The
quadrature has its nodes about the nearer one: log Z is then off by up to a nat, and its derivative by more.

Source: Maybeck (1982), Stochastic Models, Estimation and Control 2, section 12.7.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri

from lfm_ppl.filtering.ep.cavities import is_deterministic, with_positive_variance
from lfm_ppl.filtering.ep.quadrature import MeanVariance, TiltedMoments, expectation, tilted_moments
from lfm_ppl.filtering.forward import FilterTrace, forward
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.problem import FilterProblem, at_intervals
from lfm_ppl.filtering.update import (
    Factors,
    LinearisedObservation,
    RowUpdate,
    Update,
    multiply_by_factors,
    predictor_variance,
)
from lfm_ppl.model.observation_noise import row_log_prob
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.utils.linalg import diagonal

_NEWTON_STEPS, _PLAIN_STEPS, _UNROLLED_STEPS, _NEWTON_TOLERANCE = 60, 12, 3, 0.1
"""Largest number of steps of the search for a mode, number before they grow, least number, and last step in sds."""

_START_DISTANCES = np.concatenate([-(2.0 ** np.arange(6)), 2.0 ** np.arange(6)])
"""Starts of the search in standard deviations from the mean, where the density at the mean is zero."""

NEARLY_CONSTANT = 1e-13
"""Relative changes of a cavity's mean, squared, and of its variance, below which its term is nearly constant."""

_FAR = 1e3
"""Distance in standard deviations from which a factor's centre is moved."""

_LARGEST_ROUNDING = 1e-10
"""Rounding error of nu, in units of the marginal, from which a factor's centre is moved: far below the tolerance."""

_LEAST_PROBABILITY = 1e-15
"""Least probability of a residual, which then is -7.9."""


class MomentMatchingUpdate(NamedTuple):
    """Multiply with factors that have the moments of the row's tilted prediction.

    Attributes:
        family: the observation family.
        y: (T, D), NaN where missing.
    """

    family: ObservationFamily
    y: jax.Array

    def rows(self) -> jax.Array:
        """Return the data."""
        return jnp.asarray(self.y, float)

    def bind(self, problem: FilterProblem, initial: Moments) -> RowUpdate:
        """Return the update of one row."""

        def update(observation: LinearisedObservation, index: jax.Array, y: jax.Array, predicted: Moments) -> Update:
            variance = predictor_variance(observation, predicted)
            factors, log_likelihood = row_factors(self.family, observation.value, variance, index, y)
            return multiply_by_factors(observation, factors, predicted)._replace(log_likelihood=log_likelihood)

        return update


def row_factors(family: ObservationFamily, mean: jax.Array, covariance: jax.Array, row: jax.Array,
                y: jax.Array) -> tuple[Factors, jax.Array]:
    """Return the factors (D,) of a row and log p(y_k | y_1:k-1).

    Args:
        family: the observation family.
        mean: (D,), of the predictor.
        covariance: (D, D), of the predictor.
        row: index of the row.
        y: (D,), NaN where missing.
    """

    def entry(moments: tuple[jax.Array, jax.Array], index: Any) -> tuple:
        m, covariance = moments
        middle, spread = m[index], covariance[index, index]

        def log_prob(f: jax.Array) -> jax.Array:
            return row_log_prob(family, row, m.at[index].set(f[0]), y)[index][None]

        cavity, tilted = jax.tree.map(lambda a: a[0], tilted_prediction(log_prob, middle[None], spread[None]))
        deterministic = is_deterministic(middle, spread)
        # A quadrature has the value of a nearly constant term, but not its slope.
        is_flat = ((tilted.shift**2 < NEARLY_CONSTANT * cavity.variance)
                   & (jnp.abs(tilted.variance - cavity.variance) < NEARLY_CONSTANT * cavity.variance))
        log_partition = jnp.where(deterministic | is_flat, log_prob(middle[None])[0], tilted.log_partition)
        usable = ~deterministic & jnp.isfinite(y[index]) & jnp.isfinite(log_partition) & (tilted.variance > 0)
        variance = jnp.where(usable, tilted.variance, cavity.variance)
        shift = jnp.where(usable, tilted.shift, 0.0)
        gain = covariance[:, index] / cavity.variance
        moments = m + gain * shift, covariance + jnp.outer(gain, gain) * (variance - cavity.variance)
        factors = factors_of_moments(MeanVariance(middle, cavity.variance), shift, variance)
        return moments, (factors, jnp.where(jnp.isfinite(y[index]), log_partition, 0.0))

    if mean.shape[0] == 1:
        factors, log_partition = jax.tree.map(lambda a: a[None], entry((mean, covariance), 0)[1])
    else:
        factors, log_partition = jax.lax.scan(entry, (mean, covariance), jnp.arange(mean.shape[0]))[1]
    return factors, log_partition.sum()


def factors_of_moments(cavity: MeanVariance, shift: jax.Array, variance: jax.Array) -> Factors:
    """Return the factors by which a cavity gets other moments: the mean changes by ``shift``, arrays of one shape.

    The centre is the cavity's mean, or the new mean where that is many sds away: nu would be a large number there, and
    log evidences differences of its squares. The same holds where the rounding of a predictor, as a share of the sd,
    would move nu.
    """
    eps = jnp.finfo(variance.dtype).eps
    is_far = ((shift**2 > _FAR**2 * variance)
              | (eps * jnp.abs(shift * (cavity.mean + shift)) > _LARGEST_ROUNDING * variance))
    return Factors(jnp.where(is_far, cavity.mean + shift, cavity.mean),
                   shift / jnp.where(is_far, cavity.variance, variance), 1.0 / variance - 1.0 / cavity.variance)


def tilted_prediction(log_prob: Callable, mean: jax.Array, variance: jax.Array) -> tuple[MeanVariance, TiltedMoments]:
    """Return a prediction (D,) with positive variances, and its moments tilted by log p."""
    cavity = with_positive_variance(mean, variance)

    def centre(cavity: MeanVariance) -> MeanVariance:
        mode = tilted_mode(log_prob, cavity)
        tilted = tilted_moments(jax.vmap(log_prob), cavity, mode)
        usable = jnp.isfinite(tilted.log_partition) & (tilted.variance > 0)
        return MeanVariance(jnp.where(usable, tilted.mean, mode.mean),
                            jnp.where(usable, tilted.variance, mode.variance))

    # The integral of a product with one mode does not depend on the location of its nodes.
    return cavity, tilted_moments(jax.vmap(log_prob), cavity, stop_gradient_of_call(centre, cavity))


def tilted_mode(log_prob: Callable, cavity: MeanVariance) -> MeanVariance:
    """Return the mode of N(f; cavity) p(f), entry by entry, and the variance from the curvature there.

    Newton's steps are longest where the curvature is constant. Where it grows exponentially, as under a log link, they
    have length one far from the mode: after `_PLAIN_STEPS` each successful step doubles the next.
    """
    slope_at = jax.grad(lambda f: log_prob(f).sum())

    def objective(f: jax.Array) -> jax.Array:
        return log_prob(f) - 0.5 * (f - cavity.mean) ** 2 / cavity.variance

    def slope_and_precision(f: jax.Array) -> tuple[jax.Array, jax.Array]:
        slope, curvature = jax.jvp(slope_at, (f,), (jnp.ones_like(f),))
        curvature = jnp.where(jnp.isfinite(curvature), jnp.minimum(curvature, 0.0), 0.0)
        return slope, 1.0 / cavity.variance - curvature

    def step(carry: tuple) -> tuple:
        f, value, radius, stretch, _, count = carry
        slope, precision = slope_and_precision(f)
        newton = (slope - (f - cavity.mean) / cavity.variance) / precision
        newton = jnp.where(jnp.isfinite(newton), newton, 0.0)
        move = jnp.clip(stretch * newton, -radius, radius)
        trial = f + move
        new = objective(trial)
        is_better = new > value
        radius = jnp.where(is_better, 3.0, 0.25) * jnp.where(stretch > 1.0, jnp.abs(move), radius)
        stretch = jnp.where(is_better & (count >= _PLAIN_STEPS), 2.0 * stretch, 1.0)
        return (jnp.where(is_better, trial, f), jnp.where(is_better, new, value), radius, stretch,
                (newton**2 * precision > _NEWTON_TOLERANCE**2).any(), count + 1)

    sd, value = jnp.sqrt(cavity.variance), objective(cavity.mean)

    def best_start() -> tuple[jax.Array, jax.Array]:
        trials = cavity.mean + sd * _START_DISTANCES.reshape(-1, *(1,) * jnp.ndim(sd))
        values = jax.vmap(objective)(trials)
        best = jnp.argmax(jnp.where(jnp.isnan(values), -jnp.inf, values), axis=0)[None]
        is_zero = ~jnp.isfinite(value)
        return (jnp.where(is_zero, jnp.take_along_axis(trials, best, axis=0)[0], cavity.mean),
                jnp.where(is_zero, jnp.take_along_axis(values, best, axis=0)[0], value))

    f, value = jax.lax.cond(jnp.isfinite(value).all(), lambda: (cavity.mean, value), best_start)
    start = (f, value, 4.0 * sd, jnp.ones_like(sd), jnp.array(True), jnp.zeros((), int))
    # A loop of a few steps costs more than the steps.
    carry = functools.reduce(lambda carry, _: step(carry), range(_UNROLLED_STEPS), start)
    f = jax.lax.while_loop(lambda carry: carry[4] & (carry[5] < _NEWTON_STEPS), step, carry)[0]
    return MeanVariance(f, 1.0 / slope_and_precision(f)[1])


def stop_gradient_of_call(function: Callable, *arguments: Any) -> Any:
    """Return ``function(*arguments)`` without a derivative, by its arguments or by what it closes over."""
    converted, closed_over = jax.closure_convert(function, *arguments)

    def stop(tree: Any) -> Any:
        return jax.tree.map(
            lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, (jax.Array, np.ndarray)) else leaf, tree)

    return stop(converted(*stop(arguments), *stop(closed_over)))


class PrequentialResult(NamedTuple):
    """Result of assumed density filtering.

    Attributes:
        log_likelihood: (T,), log p(y_k | y_1:k-1).
        trace: the forward scan, (N, ...).
        prediction: (T, D), of the predictor, given the rows before.
    """

    log_likelihood: jax.Array
    trace: FilterTrace
    prediction: MeanVariance


def assumed_density_filter(problem: FilterProblem, y: jax.Array, initial: Moments | None = None) -> PrequentialResult:
    """Filter data of a family: the factor of each observation is made from its prediction, once."""
    updater = MomentMatchingUpdate(observation_family(problem), y)
    trace = forward(problem, updater, initial=initial, record=Record.MOMENTS)
    at_data = at_intervals(trace._replace(initial=None), problem.grid.observed)
    terms = at_data.update.factor_terms
    return PrequentialResult(at_data.log_likelihood, trace,
                             with_positive_variance(terms.value, diagonal(terms.variance)))


def observation_family(problem: FilterProblem) -> ObservationFamily:
    """Return the observation family of the problem's model."""
    family = problem.ssm.model.observation
    assert isinstance(family, ObservationFamily)
    return family


def quantile_residuals(family: ObservationFamily, prediction: MeanVariance, y: jax.Array) -> jax.Array:
    """Return randomised quantile residuals (T, D), NaN where an entry is missing or its family has no distribution.

        e = Phi^-1(P(data < y) + v P(data = y)),    v ~ U(0, 1),

    with the probabilities of one entry given all rows before: standard normal, and independent from row to row, where
    the model holds. v is the same in every call, so that draws of the parameters do not differ by it.

    Args:
        family: the observation family.
        prediction: of the predictor, (T, D), given the rows before.
        y: (T, D).

    Source: Dunn and Smyth (1996), Journal of Computational and Graphical Statistics 5.
    """

    def row(index: jax.Array, prediction: MeanVariance, y: jax.Array, v: jax.Array) -> jax.Array:
        row_family, present = family.select_row(index), jnp.isfinite(y)
        filled = jnp.where(present, y, row_family.possible(prediction.mean))

        def probability(f: jax.Array) -> jax.Array:
            below, up_to = row_family.cumulative(f, filled)
            return below + v * (up_to - below)

        probabilities = jnp.clip(expectation(jax.vmap(probability), prediction), _LEAST_PROBABILITY,
                                 1.0 - _LEAST_PROBABILITY)
        return jnp.where(present, ndtri(probabilities), jnp.nan)

    uniform = jax.random.uniform(jax.random.key(0), y.shape, y.dtype)
    return jax.vmap(row)(jnp.arange(len(y)), prediction, y, uniform)
