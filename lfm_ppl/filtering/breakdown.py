"""Where and how a filter breaks down, found after the fact so that it costs nothing where none does."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.filter import Pass, forward
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.sites import FamilyTerms, SiteSettings, assumed_density, refine, row_log_prob
from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, intervals_between
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel

_NEGATIVE = 1e-8
"""Share of the largest variance so far by which one must be negative to be no rounding error."""

_HUGE = 1e6
"""Growth of a standard deviation within a row, or beyond one, from which the message tells it."""


class FilterWarning(UserWarning):
    """The filter breaks down, its log likelihood is -inf, or sites do not converge. The message says where and how."""


def warn_of_breakdown(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: Any, start: Moments | None,
                      log_likelihood: Any, sites: SiteSettings | None = None, converged: Any = True) -> None:
    """Warn where a log likelihood is not finite or sites have not converged; nothing happens in compiled code.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        grid: the time grid.
        y: (T, D), NaN where missing.
        start: moments at the initial time; the model's by default.
        log_likelihood: what the filter found, of any shape.
        sites: how those of an observation family were refined; None where the filter ran alone.
        converged: whether they have.
    """
    if checks.traced((ssm, grid, y, start, log_likelihood, converged)):
        return
    finite = bool(np.isfinite(np.asarray(log_likelihood)).all())
    if finite and np.all(converged):
        return
    if isinstance(ssm.model.observation, ObservationFamily):
        checks.warn(_site_trouble(ssm, rule, grid, y, start, sites, finite), FilterWarning)
        return
    checks.warn(breakdown(ssm, rule, grid, y, start) or "the log likelihood is -inf, but the filter does not break "
                "down without posterior linearisation: try iterations=0, or a smaller damping, such as damping=0.5.",
                FilterWarning)


def _site_trouble(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: Any, start: Moments | None,
                  settings: SiteSettings | None, finite: bool) -> str:
    """Say which sites do not converge, or what else is wrong with a family's log likelihood, ``finite`` or not."""
    remedy = ("Try a smaller share of each new site, sites=lfm.SiteSettings(damping=0.5), half powers, "
              "sites=lfm.SiteSettings(power=0.5), or a tighter prior")
    y = jnp.asarray(y, float)
    family = ssm.model.observation
    assert isinstance(family, ObservationFamily)
    begin = Moments(*ssm.initial()) if start is None else start
    if not finite and (reason := _row_trouble(ssm, rule, grid, y, begin)) is not None:
        return f"{reason}. The log likelihood is -inf."
    if settings is None:
        return ("the log likelihood of the observation family is -inf: the data are impossible under the prediction, "
                "or the filter breaks down. Try a tighter prior, or more steps (steps=...).")
    found = eqx.filter_jit(refine)(ssm, rule, grid, y, FamilyTerms(family, y), settings, begin).found
    bad = ~np.asarray(found.cavity.valid) | ~np.isfinite(np.asarray(found.sites.tau))
    where = ""
    if bad.any():
        row, column = np.argwhere(bad)[0]
        where = f"; the first without a cavity is y[{row}, {column}]"
    if bool(found.converged):
        return "the log likelihood of the observation family is not finite, though its sites converge. " + remedy + "."
    return (f"the sites of the observation family do not converge in {int(found.sweeps)} sweeps (the last changes one "
            f"by {float(found.change):.2g}){where}. The log likelihood is "
            f"{'that of assumed density filtering, which is rougher' if finite else '-inf'}. {remedy}.")


def family_breakdown(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: Any, settings: SiteSettings) -> str:
    """Return why the log likelihood of an observation family is not finite. Arguments must be concrete."""
    return _site_trouble(ssm, rule, grid, y, None, settings, finite=False)


def _row_trouble(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments) -> str | None:
    """Return the first row at which the state, its predictor or the density of the data is not finite, and which."""
    family = ssm.model.observation
    assert isinstance(family, ObservationFamily)
    passed = _run_assumed(ssm, rule, grid, y, start)
    at_data = jax.tree_util.tree_map(lambda a: np.asarray(a)[np.asarray(grid.observed)], passed)
    good = np.isfinite(at_data.predictor).all(1) & np.isfinite(at_data.log_likelihood)
    good &= np.isfinite(at_data.predicted.mean).all(1) & np.isfinite(at_data.predicted.covariance).all((1, 2))
    if good.all():
        return None
    row = int(np.argmin(good))
    interval = jax.tree_util.tree_map(lambda a: np.asarray(a)[grid.observed[row]], grid.intervals)
    place = f"at row {row} (time {float(interval.start + interval.length):.6g})"
    if not np.isfinite(at_data.predicted.mean[row]).all():
        return f"the predicted mean of the state is not finite {place}: try more steps (steps=...) or a tighter prior"
    if not np.isfinite(at_data.predicted.covariance[row]).all():
        return f"the predicted covariance is not finite {place}: try more steps (steps=...) or a tighter prior"
    predictor, names = at_data.predictor[row], ssm.model.output_names
    if not np.isfinite(predictor).all():
        output = int(np.argmin(np.isfinite(predictor)))
        return (f"the observation function gives {predictor[output]:g} for the output {names[output]!r} {place}: look "
                "for a logarithm, a root or a division outside of its domain")
    density = np.asarray(row_log_prob(family, row, jnp.asarray(predictor), y[row]))
    if np.isfinite(density).all():
        return f"the integral of the observation family's density is not finite {place}"
    output = int(np.argmin(np.isfinite(density)))
    return (f"y[{row}, {output}] = {float(y[row, output]):g} has the log density {density[output]:g} {place} under the "
            f"predictor {predictor[output]:g} of the output {names[output]!r}: check the link and the initial state")


@eqx.filter_jit
def _run_assumed(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments) -> Pass:
    family = ssm.model.observation
    assert isinstance(family, ObservationFamily)
    return forward(ssm, rule, grid, y, start=start, keep="moments", sites=assumed_density(family))


def breakdown(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: Any, start: Moments | None = None) -> str | None:
    """Return where and how the filter breaks down and what to try, None where it does not. Arguments must be concrete.

    The filter runs once more, and through the row that breaks down step by step.
    """
    y = jnp.asarray(y, float)
    start = Moments(*ssm.initial()) if start is None else start
    passed = _run(ssm, rule, grid, y, start)
    row = _first_bad(passed)
    if row is None:
        return None
    rows = jax.tree_util.tree_map(np.asarray, grid.intervals)
    before = start if row == 0 else Moments(passed.filtered.mean[row - 1], passed.filtered.covariance[row - 1])
    count = 1 if ssm.time_invariant or grid.tolerance is not None else grid.steps
    one = Intervals(*(column[row:row + 1] for column in rows))
    stepped = _run(ssm, rule, _in_pieces(grid, one, count), y, before)
    step = _first_bad(stepped)
    # Steps of their own differ by rounding, and need not break down.
    found, at = (passed, row) if step is None else (stepped, step)
    largest = float(np.sqrt(np.max(np.diagonal(before.covariance), initial=0.0)))
    reason = _reason(found, at, largest)
    later = np.flatnonzero(np.asarray(grid.observed) >= row)
    end = grid.observed[later[0]] if later.size else row
    time = float(rows.end[end])
    where = f"row {later[0]} (time {time:.6g})" if later.size else f"time {time:.6g}, after the last observation"
    if count > 1 and step is not None:
        where += f", step {step + 1} of {count} from time {one.start[0]:.6g} to {one.start[0] + one.length[0]:.6g}"
    remedy = ("Try a tighter prior, an observation noise that is not so small, or other units" if ssm.time_invariant
              else "Try more steps (up to five times their number are tried), a larger tolerance, another rule, or a "
              "tighter prior" if grid.tolerance is not None
              else "Try more steps (steps=...), a longest step (max_step=...), steps that follow a tolerance "
              "(tolerance=1e-3), another rule, or a tighter prior")
    return f"the filter breaks down at {where}: {reason}. The log likelihood is -inf. {remedy}."


def _in_pieces(grid: TimeGrid, one: Intervals, count: int) -> TimeGrid:
    """Return the grid of a single interval cut into ``count``, each a step of its own but where a tolerance cuts it."""
    index, length = np.arange(count), np.repeat(one.length, count) / count
    at_end = lambda column: np.where(index == count - 1, column, -1)  # noqa: E731
    start = one.start + index * length
    intervals = intervals_between(start, np.append(start[1:], one.end), length, at_end(one.observation),
                                  at_end(one.jump))
    last = np.array([count - 1])
    return grid._replace(intervals=intervals, lengths=None, steps=1 if grid.tolerance is None else grid.steps,
                         observed=last, requested=last, requested_times=one.start, replicated=False)


@eqx.filter_jit
def _run(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments) -> Pass:
    return forward(ssm, rule, grid, y, start=start, keep="moments")


def _first_bad(passed: Pass) -> int | None:
    """Return the first row that is not finite, whose observation is impossible, or None."""
    good = np.isfinite(np.asarray(passed.log_likelihood))
    for moments in (passed.predicted, passed.filtered):
        good &= np.isfinite(np.asarray(moments.mean)).all(1) & np.isfinite(np.asarray(moments.covariance)).all((1, 2))
    return None if good.all() else int(np.argmin(good))


def _reason(passed: Pass, row: int, largest: float) -> str:
    """Say what is wrong in a row; ``largest`` is the largest standard deviation before it."""
    predicted = jax.tree_util.tree_map(lambda a: np.asarray(a[row]), passed.predicted)
    variance = np.diagonal(predicted.covariance)
    if not np.isfinite(predicted.mean).all():
        return "the predicted mean is not finite"
    if not np.isfinite(predicted.covariance).all():
        return "the predicted covariance is not finite"
    reached = float(np.sqrt(np.max(np.abs(variance), initial=0.0)))
    grown = (f"; the largest predicted standard deviation is {reached:.3g}, and was {largest:.3g} before"
             if reached > _HUGE * max(largest, 1.0) else "")
    if variance.min(initial=0.0) < -_NEGATIVE * np.abs(variance).max(initial=0.0):
        return "the predicted covariance has a negative variance" + grown
    innovation, chol = np.asarray(passed.innovation[row]), np.asarray(passed.chol[row])
    if not (np.isfinite(innovation).all() and np.isfinite(chol).all()):
        return "the predicted observation or its covariance is not finite" + grown
    if grown:
        return "the filtered moments are lost to rounding" + grown
    return "the innovation covariance is not positive definite, or the filtered moments are lost to rounding"
