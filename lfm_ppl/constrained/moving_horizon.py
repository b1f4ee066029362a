"""Moving horizon estimation: the constrained problem over a window of the last observations, with an arrival cost.

1. The state of the estimator (`HorizonState`) holds the last W observations and the arrival moments, the Gaussian of
   the joint state given all observations before the window, without the constraints.
2. A new observation enters the window (`_advance`). If the window is full, its first observation leaves it, and a step
   of the filter over this observation advances the arrival moments.
3. The MAP problem of the window, with the arrival moments as its prior, is solved by an interior point
   (`_solve_window`).
4. The estimate is the state ``delay`` observations before the last one.
5. `MovingHorizon.update` does this for one observation. `MovingHorizon.estimate` starts with the first full window and
   scans over the other observations of a record.

Source: Wolff, Lopez, Müller and Beckers, section 3.3; Rawlings, Mayne and Diehl (2017), Model predictive control,
chapter 4.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.constrained.augmented import Rows, augmented_model
from lfm_ppl.constrained.constraints import Constraints, build_constraints
from lfm_ppl.constrained.full_information import ConstrainedEstimate, check_settings, most_probable, solve_problem
from lfm_ppl.constrained.gauss_newton import ConstrainedDynamics
from lfm_ppl.constrained.interior_point import ConstrainedProblem
from lfm_ppl.filtering.arguments import check_observations, warn_single_precision
from lfm_ppl.filtering.forward import forward
from lfm_ppl.filtering.intervals import TimeGrid, intervals_between
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.smoother import MeanSd
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.inputs import breakpoints_within
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import check_noise
from lfm_ppl.model.state_space import StateSpaceModel, check_times, state_space
from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import shared_jit


class HorizonState(NamedTuple):
    """State of a moving horizon estimator: a tuple of arrays, which can be saved.

    Attributes:
        times: (W,), times of the observations in the window; the initial time for an empty place.
        y: (W, D), observations in the window; NaN for an empty place.
        seen: number of observations so far.
        arrival_time: time of the arrival moments.
        mean, covariance: (n,), (n, n), arrival moments: of the joint state given all observations before the window.
    """

    times: jax.Array
    y: jax.Array
    seen: jax.Array
    arrival_time: jax.Array
    mean: jax.Array
    covariance: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class HorizonEstimate:
    """Estimate of one window.

    Attributes:
        time: time of the estimate; NaN as long as there are not more than ``delay`` observations.
        state_mean: (M,), physical state.
        force_mean: (R,), forces.
        converged: whether the window's problem was solved.
        passes: number of smoother passes.
        state_names, force_names: names of the M states and the R forces.
    """

    time: jax.Array
    state_mean: jax.Array
    force_mean: jax.Array
    converged: jax.Array
    passes: jax.Array
    state_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)

    def state(self, name: str) -> MeanSd:
        """Return a physical state at the time of the estimate as ``mean`` (); its ``sd`` is NaN.

        Raises:
            ValueError: an unknown name; the message lists similar names.
        """
        return most_probable("state", name, self.state_names, self.state_mean)

    def force(self, name: str) -> MeanSd:
        """Return a force at the time of the estimate as ``mean`` (); its ``sd`` is NaN."""
        return most_probable("force", name, self.force_names, self.force_mean)


class HorizonSettings(eqx.Module):
    """Model, constraints and settings of a moving horizon estimator.

    Attributes:
        ssm: the model with the constraints as further outputs.
        filter_ssm: the model without constraints, for the arrival moments.
        constraints: the constraints.
        linear: whether model and constraints are linear.
        window: number of observations W in the window.
        delay: number of observations after the one that is estimated.
        steps: integration steps between two observations.
        tolerance: tolerance of the duality gap.
        max_passes: largest number of smoother passes for a window.
    """

    ssm: StateSpaceModel
    filter_ssm: StateSpaceModel
    constraints: Constraints
    linear: bool
    window: int
    delay: int
    steps: int
    tolerance: float
    max_passes: int

    @property
    def estimated_row(self) -> int:
        """Row of the window that is estimated."""
        return self.window - 1 - self.delay


class MovingHorizon(eqx.Module):
    r"""A moving horizon estimator, for a record (`estimate`) or one observation at a time (`start`, `update`).

    For each observation it finds the most probable trajectory over the last W observations,

        minimise  (s - m)' P^-1 (s - m) / 2 + (the costs of `lfm_ppl.full_information` within the window)

    subject to the constraints at the observation times (not at the initial time), and returns the estimate ``delay``
    observations before the last one: 0 is the present, W // 2 the middle of the window. The arrival moments m and P
    come from the filter: the Gaussian of the state given all observations before the window, without constraints. If no
    constraint is active, the estimates for a linear model equal the Kalman filter (delay 0) or the fixed-lag smoother.

    Args:
        model: the latent force model; its functions are read once, as by `jax.jit`.
        window: number of observations W in the window.
        delay: number of observations after the one that is estimated, less than W; W // 2 by default.
        lower: lower bounds by name, as in `lfm_ppl.full_information`.
        upper: upper bounds by name.
        constraints: functions c(x, u, t), as in `lfm_ppl.full_information`.
        steps: integration steps between two observations; without effect for a linear model.
        tolerance: tolerance of the duality gap, in units of the log density.
        max_passes: largest number of smoother passes for a window.

    Raises:
        ValueError, TypeError: a window shorter than two observations, a delay outside of the window, and as
            `lfm_ppl.full_information` for the model and the constraints.

    Example:
        >>> import jax.numpy as jnp, numpy as np, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.3), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)),
        ...     initial_time=0.0)
        >>> horizon = lfm.MovingHorizon(model, window=3, delay=0, lower={"u": 0.0})
        >>> bool(horizon.estimate(np.arange(6.0), -jnp.ones((6, 1))).force("u").mean.min() >= 0)
        True

        The same for one observation after the other:

        >>> state, estimate = horizon.update(horizon.start(), 0.5, [-1.0])
        >>> state, estimate = horizon.update(state, 1.0, [-1.0])
        >>> float(estimate.time), bool(estimate.force("u").mean >= 0)
        (1.0, True)

    Source: Wolff, Lopez, Müller and Beckers, section 3.3 and equations 13 to 17; Rawlings, Mayne and Diehl (2017),
    Model predictive control, chapter 4.
    """

    settings: HorizonSettings

    def __init__(self, model: LatentForceModel, window: int, delay: int | None = None,
                 lower: Mapping[str, ArrayLike] | None = None, upper: Mapping[str, ArrayLike] | None = None,
                 constraints: Callable[..., Any] | Sequence[Callable[..., Any]] = (), steps: int = 10,
                 tolerance: float = 1e-10, max_passes: int = 100):
        check_settings(model, tolerance, max_passes)
        self.settings = _build_settings(model, build_constraints(model, lower, upper, constraints), window, delay,
                                        steps, tolerance, max_passes)

    def estimate(self, times: ArrayLike, y: ArrayLike) -> ConstrainedEstimate:
        """Run the estimator over a record.

        Row k is estimated from the window that ends ``delay`` observations later; the first rows come from the first
        full window, and the last rows from the last window. A window as long as the record is equivalent to
        `lfm_ppl.full_information` with ``grid=times``.

        Args:
            times: (T,), non-decreasing, at least as many as the window holds.
            y: (T, D), NaN where missing.

        Returns:
            Trajectories at ``times``. Gap and passes are the largest of all windows; ``converged`` is whether all
            windows have converged; the objective is that of the last window.

        Raises:
            ValueError, TypeError: a window longer than the record, traced times, and as `lfm_ppl.full_information`.

        Warns:
            UserWarning: not all windows have converged.
        """
        settings, model = self.settings, self.settings.filter_ssm.model
        row_times = check_times(times, model.initial_time)
        if row_times is None:
            raise ValueError("times must be known before compilation; pass a NumPy array.")
        if settings.window > len(row_times):
            raise ValueError(f"the window holds {settings.window} observations, but there are {len(row_times)}. Take a "
                             "window of at most their number (of exactly it: lfm.full_information).")
        initial_time = row_times[0] if model.initial_time is None else model.initial_time
        model.check_at(initial_time, len(row_times))
        if not settings.linear and model.initial_time is None and not checks.traced(initial_time):
            check_noise(settings.ssm, initial_time)
        y = check_observations(y, len(row_times), len(model.output_names))
        if not checks.traced(initial_time):
            _warn_of_breakpoints(model, row_times, float(initial_time))
        result = _estimate_record(settings, jnp.asarray(row_times), y, jnp.asarray(initial_time, float))
        if not checks.traced(result) and not bool(result.converged):
            checks.warn("some windows of the moving horizon estimate have not converged: the largest duality gap is "
                        f"{float(result.gap):.2g}, the largest violation of a constraint "
                        f"{float(np.max(result.violation)):.2g} standard deviations. Raise max_passes, or loosen a "
                        "constraint that no trajectory respects.")
        return result

    def start(self) -> HorizonState:
        """Return the state before the first observation.

        Raises:
            ValueError: the model has no ``initial_time``, the time of its initial state.
        """
        if self.settings.filter_ssm.model.initial_time is None:
            raise ValueError("an estimator that processes one observation at a time needs a model with an "
                             "initial_time, the time of its initial state; pass initial_time to lfm.LatentForceModel.")
        window, ssm = self.settings.window, self.settings.filter_ssm
        initial_time = jnp.asarray(ssm.model.initial_time, float)
        # The types are those after an update, so that one program serves all: a Python number would be weakly typed.
        return HorizonState(jnp.full(window, initial_time),
                            jnp.full((window, len(ssm.model.output_names)), jnp.nan, float), jnp.asarray(0, int),
                            initial_time, *ssm.initial())

    def update(self, state: HorizonState, t: ArrayLike, y: ArrayLike) -> tuple[HorizonState, HorizonEstimate]:
        """Process one observation.

        Args:
            state: state of the estimator.
            t: time of the observation, not before the last one.
            y: (D,), NaN where missing.

        Returns:
            The new state and the estimate. Nothing is compiled after the second call.

        Raises:
            ValueError: a time before the last one, or an observation of the wrong shape.
        """
        outputs = len(self.settings.filter_ssm.model.output_names)
        checks.refuse_dates("t", t)
        y = checks.unmask(y)
        if np.shape(y) != (outputs,):
            raise ValueError(f"y must hold one entry for each of the {outputs} outputs, shape ({outputs},), got "
                             f"{np.shape(y)}.")
        time, last_time = checks.concrete(t), checks.concrete(state.times[-1])
        if time is not None and last_time is not None and not time >= last_time:
            raise ValueError(f"t = {float(time):g} lies before {float(last_time):g}, the time of the last observation.")
        return _update(self.settings, state, jnp.asarray(t, float), jnp.asarray(y, float))


def _build_settings(model: LatentForceModel, constraints: Constraints, window: int, delay: int | None, steps: int,
                    tolerance: float, max_passes: int) -> HorizonSettings:
    """Check the settings of an estimator, and return them with its models."""
    checks.positive_integer("window", window, "It is the number of observations in the window.")
    checks.positive_integer("steps", steps)
    if window < 2:
        raise ValueError("window must hold at least 2 observations, got 1. For none but the last take lfm.filter.")
    delay = window // 2 if delay is None else delay
    if isinstance(delay, bool) or not isinstance(delay, (int, np.integer)) or not 0 <= delay < window:
        raise ValueError(f"delay must be a whole number from 0 to {window - 1} (less than the window), got {delay!r}.")
    if np.ndim(model.observation.covariance) == 3:
        raise ValueError("a moving horizon estimator takes one observation covariance, or a function of (x, u, t); "
                         "the model has one matrix for each row.")
    filter_ssm = state_space(model)
    if filter_ssm.stack.jump_times:
        raise ValueError("a moving window does not support forces that jump at given times; leave out their jumps.")
    if model.events:
        raise ValueError("a moving window does not support events; leave them out, or take lfm.full_information.")
    index = np.arange(window)
    ssm = augmented_model(model, constraints, Rows(index, index, index, np.zeros(window, int)))
    linear = ssm.plan.has_fixed_weights
    if not linear and model.initial_time is not None:
        check_noise(ssm, model.initial_time)
    warn_single_precision()
    return HorizonSettings(ssm, filter_ssm, constraints, linear, int(window), int(delay), int(steps), float(tolerance),
                           max_passes)


def _warn_of_breakpoints(model: LatentForceModel, times: np.ndarray, initial_time: float) -> None:
    """Warn if a known input jumps between two observations, whose interval a moving window does not divide."""
    breakpoints, traced_breakpoints = breakpoints_within(model.input_reads(initial_time, float(times[-1])),
                                                         initial_time, float(times[-1]))
    between = np.setdiff1d(breakpoints, times)
    if len(between) or len(traced_breakpoints):
        where = f"at time {between[0]:g}, between two observations" if len(between) else "at a lag that is traced"
        checks.warn(f"a known input jumps {where}, and a moving window does not divide its intervals there, so that a "
                    "short pulse may be stepped over. Add rows at these times with missing observations (NaN).")


def _window_grid(settings: HorizonSettings, times: jax.Array, start_time: jax.Array) -> TimeGrid:
    """Return a time grid with an interval up to each of ``times`` (K,), the first one from ``start_time``."""
    starts = jnp.concatenate([start_time[None], times[:-1]])
    index = jnp.arange(times.shape[0])
    intervals = intervals_between(starts, times, times - starts, index, jnp.full_like(index, -1))
    return TimeGrid(intervals, None, index, index, times, settings.steps, start_time)


def _advance(settings: HorizonSettings, state: HorizonState, t: jax.Array, y: jax.Array) -> HorizonState:
    """Return the state after an observation: it enters the window, and the first one of a full window leaves it."""
    arrival = Moments(state.mean, state.covariance)
    problem = filter_problem(settings.filter_ssm, Taylor(),
                             _window_grid(settings, state.times[:1], state.arrival_time))
    filtered = forward(problem, GaussianUpdate(state.y[:1]), initial=arrival, record=Record.MOMENTS).filtered
    is_full = state.seen >= settings.window
    arrival = jax.tree_util.tree_map(lambda new, old: jnp.where(is_full, new[0], old), filtered, arrival)
    return HorizonState(
        jnp.append(state.times[1:], t), jnp.concatenate([state.y[1:], y[None]]), state.seen + 1,
        jnp.where(is_full, state.times[0], state.arrival_time), *arrival)


def _solve_window(settings: HorizonSettings, state: HorizonState) -> tuple[ConstrainedEstimate, jax.Array]:
    """Solve the problem of the window.

    Returns:
        The estimate at the W rows of the window, and whether a row holds an observation (W,).
    """
    is_observed = jnp.arange(settings.window) >= settings.window - state.seen
    index = jnp.arange(settings.window)
    rows = Rows(state.times, index, index, jnp.zeros_like(index))  # type: ignore[arg-type]
    problem = ConstrainedProblem(settings.ssm, _window_grid(settings, state.times, state.arrival_time), rows, state.y,
                                 Moments(state.mean, state.covariance), is_observed)
    if settings.linear:
        # The maps of a linear model do not depend on the trajectory: they are computed once for all passes.
        nodes = jnp.zeros((settings.window + 1, settings.ssm.state_dim))
        problem = dataclasses.replace(problem, transitions=ConstrainedDynamics(problem).linearise(nodes))
    estimate, _ = solve_problem(problem, settings.constraints, settings.tolerance, settings.max_passes,
                                settings.linear)
    return estimate, is_observed


@shared_jit
def _update(settings: HorizonSettings, state: HorizonState, t: jax.Array,
            y: jax.Array) -> tuple[HorizonState, HorizonEstimate]:
    """Advance the state by one observation, and estimate from the new window."""
    state = _advance(settings, state, t, y)
    estimate, is_observed = _solve_window(settings, state)
    row = settings.estimated_row
    time = jnp.where(is_observed[row], state.times[row], jnp.nan)
    return state, HorizonEstimate(time, estimate.state_mean[row], estimate.force_mean[row], estimate.converged,
                                  estimate.passes, estimate.state_names, estimate.force_names)


_ROW_FIELDS = ("times", "state_mean", "force_mean", "slack", "multiplier", "violation", "scale")
"""Fields of `ConstrainedEstimate` with one entry for each row."""


@shared_jit
def _estimate_record(settings: HorizonSettings, times: jax.Array, y: jax.Array,
                     initial_time: jax.Array) -> ConstrainedEstimate:
    """Estimate all rows of a record, from its first full window to its last."""
    window, row = settings.window, settings.estimated_row
    state = HorizonState(times[:window], y[:window], jnp.asarray(window, int), initial_time,
                         *settings.filter_ssm.initial())
    first, _ = _solve_window(settings, state)

    def step(carry: tuple, observation: tuple[jax.Array, jax.Array]) -> tuple[tuple, tuple]:
        state = _advance(settings, carry[0], *observation)
        estimate, _ = _solve_window(settings, state)
        estimated_row = tuple(getattr(estimate, name)[row] for name in _ROW_FIELDS)
        return (state, estimate), (estimated_row, estimate.gap, estimate.passes, estimate.converged)

    (_, last), (rows, gap, passes, converged) = jax.lax.scan(step, (state, first), (times[window:], y[window:]))
    trajectories = {
        name: jnp.concatenate([getattr(first, name)[: row + 1], values, getattr(last, name)[row + 1:]])
        for name, values in zip(_ROW_FIELDS, rows, strict=True)}
    return ConstrainedEstimate(
        **trajectories, gap=jnp.append(gap, first.gap).max(), objective=last.objective,
        passes=jnp.append(passes, first.passes).max(), converged=converged.all() & first.converged,
        labels=last.labels, state_names=last.state_names, force_names=last.force_names)
