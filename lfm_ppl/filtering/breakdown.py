"""Messages on where and how a filter breaks down, by another pass, so that other filters cost no more.

1. A log likelihood that is not finite, outside of compiled code, starts the search.
2. Run the filter again and find the first row with moments or a log likelihood that are not finite.
3. Divide this interval into its steps, and find the first bad step.
4. State the reason (growth, a negative variance, a function that is not finite) and the remedy.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.ep.evidence import refine
from lfm_ppl.filtering.ep.fixed_point import FixedPoint
from lfm_ppl.filtering.ep.moment_matching import assumed_density_filter
from lfm_ppl.filtering.ep.settings import FactorSettings
from lfm_ppl.filtering.ep.terms import FamilyTerms
from lfm_ppl.filtering.forward import FilterTrace, forward
from lfm_ppl.filtering.integrators.integrator import Stepping
from lfm_ppl.filtering.integrators.methods import METHODS, choose_integrator
from lfm_ppl.filtering.intervals import Intervals, TimeGrid, intervals_between
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.observation_noise import row_log_prob
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import shared_jit

_NEGATIVE = 1e-8
"""Share of the largest variance so far by which one must be negative to be no rounding error."""

_HUGE = 1e6
"""Growth of a standard deviation within a row, or size of it, above which the message mentions it."""

_LARGEST_CHANGE = 1.0
"""Change of a smoothed mean in the last iteration, in standard deviations, above which iterations have not settled."""

_LARGEST_LOG_LIKELIHOOD_CHANGE = 0.5
"""The same for the change of the log likelihood."""


class FilterWarning(UserWarning):
    """The filter breaks down, its log likelihood is -inf, or factors or iterations do not converge.

    The message says where and how.
    """


def warn_of_breakdown(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: Any, start: Moments | None,
                      log_likelihood: Any, factors: FactorSettings | None = None, converged: Any = True) -> None:
    """Warn where a log likelihood is not finite or factors have not converged; nothing happens in compiled code.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        grid: the time grid.
        y: (T, D), NaN where missing.
        start: moments at the initial time; the model's by default.
        log_likelihood: result of the filter, of any shape.
        factors: settings of the factors of an observation family; None for assumed density filtering.
        converged: whether the factors have converged.
    """
    if checks.traced((ssm, grid, y, start, log_likelihood, converged)):
        return
    is_finite = bool(np.isfinite(np.asarray(log_likelihood)).all())
    if is_finite and np.all(converged):
        return
    if isinstance(ssm.model.observation, ObservationFamily):
        checks.warn(family_breakdown(ssm, rule, grid, y, factors, start, is_finite), FilterWarning)
        return
    checks.warn(breakdown(ssm, rule, grid, y, start) or "the log likelihood is -inf, but the filter does not break "
                "down without posterior linearisation: try iterations=0, or a smaller damping, such as damping=0.5.",
                FilterWarning)


def warn_of_iterations(change: Any, log_likelihood_change: Any) -> None:
    """Warn where iterations of posterior linearisation have not settled; nothing happens in compiled code.

    Args:
        change: largest change of a smoothed mean in the last iteration, in standard deviations; NaN for none.
        log_likelihood_change: change of the log likelihood in the last iteration; NaN for none.
    """
    if checks.traced((change, log_likelihood_change)):
        return
    sds, difference = float(change), abs(float(log_likelihood_change))
    # A log likelihood that is not finite has its own warning.
    if not np.isfinite(difference) or not (sds > _LARGEST_CHANGE or difference > _LARGEST_LOG_LIKELIHOOD_CHANGE):
        return
    checks.warn(f"the last iteration of posterior linearisation changes a smoothed mean by {sds:.2g} standard "
                f"deviations and the log likelihood by {difference:.2g}, so that both may be wrong: try more "
                "iterations (iterations=10), more integration steps (steps=...), a smaller damping, such as "
                "damping=0.3, or a single pass (iterations=0), and compare with lfm.check_accuracy.", FilterWarning)


def family_breakdown(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: Any, settings: FactorSettings | None,
                     start: Moments | None = None, is_finite: bool = False) -> str:
    """Return why the log likelihood of an observation family is not finite, or its factors do not converge.

    Arguments must be concrete.
    """
    remedy = ("Try a smaller share of each new factor, factors=lfm.FactorSettings(damping=0.5), half powers, "
              "factors=lfm.FactorSettings(power=0.5), or a tighter prior")
    y = jnp.asarray(y, float)
    family = ssm.model.observation
    assert isinstance(family, ObservationFamily)
    initial = Moments(*ssm.initial()) if start is None else start
    if not is_finite and (reason := _explain_row(ssm, rule, grid, y, initial)) is not None:
        return f"{reason}. The log likelihood is -inf."
    if settings is None:
        return ("the log likelihood of the observation family is -inf: the data are impossible under the prediction, "
                "or the filter breaks down. Try a tighter prior, or more steps (steps=...).")
    fixed_point = _run_refine(ssm, rule, grid, FamilyTerms(family, y), settings, initial)
    is_bad = ~np.asarray(fixed_point.cavity.valid) | ~np.isfinite(np.asarray(fixed_point.factors.tau))
    where = ""
    if is_bad.any():
        row, column = np.argwhere(is_bad)[0]
        where = f"; the first without a cavity is y[{row}, {column}]"
    if bool(fixed_point.converged):
        return f"the log likelihood of the observation family is not finite, although its factors converge. {remedy}."
    return (f"the factors of the observation family do not converge in {int(fixed_point.sweeps)} sweeps (the last "
            f"changes a factor by {float(fixed_point.change):.2g}){where}. The log likelihood is "
            f"{'that of assumed density filtering, which is rougher' if is_finite else '-inf'}. {remedy}.")


def _explain_row(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments) -> str | None:
    """Return a message on the first row where the state, its predictor or the density of the data is not finite."""
    family = ssm.model.observation
    assert isinstance(family, ObservationFamily)
    trace = _run_moment_matching(ssm, rule, grid, y, start)
    at_data = jax.tree.map(lambda a: np.asarray(a)[np.asarray(grid.observed)], trace._replace(initial=None))
    is_good = np.isfinite(at_data.predictor).all(1) & np.isfinite(at_data.log_likelihood)
    is_good &= np.isfinite(at_data.predicted.mean).all(1) & np.isfinite(at_data.predicted.covariance).all((1, 2))
    if is_good.all():
        return None
    row = int(np.argmin(is_good))
    interval = jax.tree_util.tree_map(lambda a: np.asarray(a)[grid.observed[row]], grid.intervals)
    where = f"at row {row} (time {float(interval.start + interval.length):.6g})"
    remedy = 'try more steps (steps=...), for stiff dynamics method="exponential", or a tighter prior'
    if not np.isfinite(at_data.predicted.mean[row]).all():
        return f"the predicted mean of the state is not finite {where}: {remedy}"
    if not np.isfinite(at_data.predicted.covariance[row]).all():
        return f"the predicted covariance is not finite {where}: {remedy}"
    predictor, names = at_data.predictor[row], ssm.model.output_names
    if not np.isfinite(predictor).all():
        output = int(np.argmin(np.isfinite(predictor)))
        return (f"the observation function gives {predictor[output]:g} for the output {names[output]!r} {where}: look "
                "for a logarithm, a root or a division outside of its domain")
    density = np.asarray(row_log_prob(family, row, jnp.asarray(predictor), y[row]))
    if np.isfinite(density).all():
        return f"the integral of the observation family's density is not finite {where}"
    output = int(np.argmin(np.isfinite(density)))
    return (f"y[{row}, {output}] = {float(y[row, output]):g} has the log density {density[output]:g} {where} under the "
            f"predictor {predictor[output]:g} of the output {names[output]!r}: check the link and the initial state")


@shared_jit
def _run_refine(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, terms: FamilyTerms, settings: FactorSettings,
                start: Moments) -> FixedPoint:
    return refine(filter_problem(ssm, rule, grid), terms, settings, start).fixed_point


@shared_jit
def _run_moment_matching(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments) -> FilterTrace:
    return assumed_density_filter(filter_problem(ssm, rule, grid), y, start).trace


def breakdown(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: Any, start: Moments | None = None) -> str | None:
    """Return where and how the filter breaks down and what to try, None where it does not. Arguments must be concrete.

    The filter runs once more, and through the row that breaks down step by step.
    """
    y = jnp.asarray(y, float)
    start = Moments(*ssm.initial()) if start is None else start
    trace = _run_filter(ssm, rule, grid, y, start)
    row = _first_bad_row(trace)
    if row is None:
        return None
    rows = jax.tree.map(np.asarray, grid.intervals)
    previous = start if row == 0 else Moments(trace.filtered.mean[row - 1], trace.filtered.covariance[row - 1])
    stepping = choose_integrator(ssm, rule, grid.method, grid.tolerance).stepping
    count = grid.steps if stepping is Stepping.EQUAL else 1
    interval: Intervals = jax.tree.map(lambda column: column[row:row + 1], rows)
    stepwise = _run_filter(ssm, rule, _divide_interval(grid, interval, count), y, previous)
    step = _first_bad_row(stepwise)
    # Separate steps differ by rounding, and need not break down.
    reason_trace, reason_row = (trace, row) if step is None else (stepwise, step)
    largest = float(np.sqrt(np.max(np.diagonal(previous.covariance), initial=0.0)))
    reason = _reason(reason_trace, reason_row, largest)
    later = np.flatnonzero(np.asarray(grid.observed) >= row)
    end = grid.observed[later[0]] if later.size else row
    time = float(rows.end[end])
    where = f"row {later[0]} (time {time:.6g})" if later.size else f"time {time:.6g}, after the last observation"
    if count > 1 and step is not None:
        where += f", step {step + 1} of {count} from time {interval.start[0]:.6g} to {interval.end[0]:.6g}"
    stiff = 'method="exponential" for stiff dynamics, ' if METHODS[grid.method].is_explicit else ""
    remedy = ("Try a longest step (max_step=...), more steps (steps=...) where known inputs vary fast, an observation "
              "noise that is not so small, or other units" if stepping is Stepping.NONE
              else f"Try {stiff}more steps (the limit is 5 x steps={grid.steps}), a larger tolerance, "
              "another rule, or a tighter prior" if stepping is Stepping.ADAPTIVE
              else f"Try {stiff}more steps (steps=...), a longest step (max_step=...), steps that follow a tolerance "
              "(tolerance=1e-3), another rule, or a tighter prior")
    return f"the filter breaks down at {where}: {reason}. The log likelihood is -inf. {remedy}."


def _divide_interval(grid: TimeGrid, interval: Intervals, count: int) -> TimeGrid:
    """Return the grid of a single interval that is divided into ``count`` intervals of one step each."""
    index, length = np.arange(count), np.repeat(interval.length, count) / count
    is_last = index == count - 1
    start = interval.start + index * length
    intervals = intervals_between(start, np.append(start[1:], interval.end), length,
                                  np.where(is_last, interval.observation, -1), np.where(is_last, interval.jump, -1),
                                  event=np.where(is_last, interval.event, -1))
    last = np.array([count - 1])
    return grid._replace(intervals=intervals, lengths=None, steps=1 if grid.tolerance is None else grid.steps,
                         observed=last, requested=last, requested_times=interval.start, replicated=False)


@shared_jit
def _run_filter(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments) -> FilterTrace:
    return forward(filter_problem(ssm, rule, grid), GaussianUpdate(y), initial=start, record=Record.MOMENTS)


def _first_bad_row(trace: FilterTrace) -> int | None:
    """Return the first row with moments or a log likelihood that are not finite, or None."""
    is_good = np.isfinite(np.asarray(trace.log_likelihood))
    for moments in (trace.predicted, trace.filtered):
        is_good &= np.isfinite(np.asarray(moments.mean)).all(1)
        is_good &= np.isfinite(np.asarray(moments.covariance)).all((1, 2))
    return None if is_good.all() else int(np.argmin(is_good))


def _reason(trace: FilterTrace, row: int, largest: float) -> str:
    """Return the reason why a row breaks down; ``largest`` is the largest standard deviation before it."""
    predicted = jax.tree.map(lambda a: np.asarray(a[row]), trace.predicted)
    variance = np.diagonal(predicted.covariance)
    if not np.isfinite(predicted.mean).all():
        return "the predicted mean is not finite"
    if not np.isfinite(predicted.covariance).all():
        return "the predicted covariance is not finite"
    reached = float(np.sqrt(np.max(np.abs(variance), initial=0.0)))
    growth = (f"; the largest predicted standard deviation is {reached:.3g}, and was {largest:.3g} before"
             if reached > _HUGE * max(largest, 1.0) else "")
    if variance.min(initial=0.0) < -_NEGATIVE * np.abs(variance).max(initial=0.0):
        return "the predicted covariance has a negative variance" + growth
    innovation, chol = np.asarray(trace.update.innovation[row]), np.asarray(trace.update.chol[row])
    if not (np.isfinite(innovation).all() and np.isfinite(chol).all()):
        return "the predicted observation or its covariance is not finite" + growth
    if growth:
        return "the filtered moments are lost to rounding" + growth
    return "the innovation covariance is not positive definite, or the filtered moments are lost to rounding"
