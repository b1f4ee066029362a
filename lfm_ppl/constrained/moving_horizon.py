"""Moving horizon estimation: the constrained problem over a window of the latest observations, from an arrival cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.constrained.augmented import Rows, augmented
from lfm_ppl.constrained.constraints import Constraints, build_constraints
from lfm_ppl.constrained.full_information import ConstrainedEstimate, check_settings, estimate_on, is_linear
from lfm_ppl.constrained.gauss_newton import Dynamics
from lfm_ppl.constrained.interior_point import Problem
from lfm_ppl.filtering.filter import check_observations, forward, warn_single_precision
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.time_grid import TimeGrid, intervals_between
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.inputs import breakpoints_within
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import check_noise
from lfm_ppl.model.state_space import StateSpaceModel, check_times, state_space


class HorizonState(NamedTuple):
    """Where a moving horizon estimator stands: arrays, which can be saved and passed on.

    Attributes:
        times: (W,), of the observations in the window; the initial time where there is none yet.
        y: (W, D), these, NaN where there is none.
        seen: number of observations so far.
        arrival_time: when the moments below hold.
        mean, covariance: (n,), (n, n), of the joint state given all observations before the window.
    """

    times: jax.Array
    y: jax.Array
    seen: jax.Array
    arrival_time: jax.Array
    mean: jax.Array
    covariance: jax.Array


class HorizonEstimate(NamedTuple):
    """The estimate that a window leaves.

    Attributes:
        time: that it is of; NaN as long as fewer than ``delay`` observations came after the first.
        state_mean: (M,).
        force_mean: (R,).
        converged: whether the window's problem was solved.
        passes: smoother passes that it took.
    """

    time: jax.Array
    state_mean: jax.Array
    force_mean: jax.Array
    converged: jax.Array
    passes: jax.Array


class _Setting(NamedTuple):
    """Everything about an estimator that does not change from window to window."""

    ssm: StateSpaceModel
    plain: StateSpaceModel
    constraints: Constraints
    linear: bool
    window: int
    delay: int
    steps: int
    tolerance: float
    most: int


class MovingHorizon(eqx.Module):
    r"""A moving horizon estimator, fed one observation at a time.

    At each observation it finds the most probable trajectory of the last W observations,

        minimise  (s - m)' P^-1 (s - m) / 2 + (the costs of `lfm_ppl.full_information` within the window)

    subject to the constraints at the observations' times (not at the initial time), and gives the estimate ``delay``
    observations before the last: 0 is the present, W // 2 the middle of the window. The arrival cost, m and P, is the
    filter's: the Gaussian of the state given all observations before the window, constraints aside. Without active
    constraints the estimates of a linear model are those of the Kalman filter (delay 0) and of the fixed-lag smoother.

    Args:
        model: the latent force model, with an ``initial_time``.
        window: W, number of observations in the window.
        delay: number of observations after the one that is estimated, less than W; W // 2 by default.
        lower: bounds by name, as in `lfm_ppl.full_information`.
        upper: the same.
        constraints: functions c(x, u, t), as there.
        steps: integration steps between two observations; of no account for a linear model.
        tolerance: of the duality gap, in units of the log density.
        max_passes: number of smoother passes for a window, at most.

    Raises:
        ValueError, TypeError: a window shorter than two observations, a delay outside of it, and what
            `lfm_ppl.full_information` raises of the model and the constraints.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)),
        ...     initial_time=0.0)
        >>> horizon = lfm.MovingHorizon(model, window=3, delay=0, lower={"u": 0.0})
        >>> state, estimate = horizon.update(horizon.start(), 0.5, [-1.0])
        >>> state, estimate = horizon.update(state, 1.0, [-1.0])
        >>> float(estimate.time), bool(estimate.force_mean[0] >= 0)
        (1.0, True)

    Source: Wolff, Lopez, Müller and Beckers, section 3.3; Rawlings, Mayne and Diehl (2017), Model predictive control,
    chapter 4.
    """

    setting: _Setting

    def __init__(self, model: LatentForceModel, window: int, delay: int | None = None,
                 lower: Mapping[str, Any] | None = None, upper: Mapping[str, Any] | None = None,
                 constraints: Callable[..., Any] | Sequence[Callable[..., Any]] = (), steps: int = 10,
                 tolerance: float = 1e-10, max_passes: int = 100):
        if model.initial_time is None:
            raise ValueError("a moving horizon estimator needs a model with an initial_time, when its initial state "
                             "holds; pass initial_time to lfm.LatentForceModel.")
        self.setting = _set_up(model, window, delay, lower, upper, constraints, steps, tolerance, max_passes)

    def start(self) -> HorizonState:
        """Return the state before the first observation."""
        window, outputs = self.setting.window, len(self.setting.plain.model.output_names)
        origin = jnp.asarray(self.setting.plain.model.initial_time, float)
        # Types as after an update, for one program: a Python number would be a weaker one.
        return HorizonState(jnp.full(window, origin), jnp.full((window, outputs), jnp.nan, float),
                            jnp.asarray(0, int), origin, *self.setting.plain.initial())

    def update(self, state: HorizonState, t: Any, y: Any) -> tuple[HorizonState, HorizonEstimate]:
        """Take one observation.

        Args:
            state: where the estimator stands.
            t: time of the observation, not before the last one.
            y: (D,), NaN where missing.

        Returns:
            The new state and the estimate. After two calls nothing is compiled any more.

        Raises:
            ValueError: a time before the last one, or an observation of a wrong shape.
        """
        outputs = len(self.setting.plain.model.output_names)
        checks.refuse_dates("t", t)
        y = checks.unmask(y)
        if np.shape(y) != (outputs,):
            raise ValueError(f"y must hold one entry for each of the {outputs} outputs, shape ({outputs},), got "
                             f"{np.shape(y)}.")
        known, last = checks.concrete(t), checks.concrete(state.times[-1])
        if known is not None and last is not None and not known >= last:
            raise ValueError(f"t = {float(known):g} lies before {float(last):g}, the time of the last observation.")
        return _update(self.setting, state, jnp.asarray(t, float), jnp.asarray(y, float))


def moving_horizon(model: LatentForceModel, times: Any, y: Any, window: int, delay: int | None = None,
                   lower: Mapping[str, Any] | None = None, upper: Mapping[str, Any] | None = None,
                   constraints: Callable[..., Any] | Sequence[Callable[..., Any]] = (), steps: int = 10,
                   tolerance: float = 1e-10, max_passes: int = 100) -> ConstrainedEstimate:
    """Run a moving horizon estimator over a record.

    Row k is estimated from the window that ends ``delay`` observations later; the first rows come from the first whole
    window, and the last from the last one. See `lfm_ppl.MovingHorizon`, which does the same one observation at a time.
    A window as long as the record is `lfm_ppl.full_information` with ``grid=times``.

    Args:
        model: the latent force model.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        window: W, number of observations in the window, from 2 to T.
        delay: number of observations after the one that is estimated, less than W; W // 2 by default.
        lower: bounds by name, as in `lfm_ppl.full_information`; they hold at ``times``.
        upper: the same.
        constraints: functions c(x, u, t), as there.
        steps: integration steps between two observations; of no account for a linear model.
        tolerance: of the duality gap, in units of the log density.
        max_passes: number of smoother passes for a window, at most.

    Returns:
        Trajectories at ``times``. Gap, passes and violations are the largest of all windows; ``converged`` is whether
        all have; the objective is that of the last window.

    Raises:
        ValueError, TypeError: a window longer than the record or shorter than two observations, a delay outside of it,
            and what `lfm_ppl.full_information` raises.

    Warns:
        UserWarning: not all windows have converged.

    Example:
        >>> import jax.numpy as jnp, numpy as np, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> y = -jnp.ones((6, 1))
        >>> bool(lfm.moving_horizon(model, np.arange(6.0), y, window=4, lower={"u": 0.0}).force("u").min() >= 0)
        True

    Source: Wolff, Lopez, Müller and Beckers, equations 13 to 17.
    """
    known = check_times(times, model.initial_time)
    if known is None:
        raise ValueError("times must be known before compilation; pass a NumPy array.")
    setting = _set_up(model, window, delay, lower, upper, constraints, steps, tolerance, max_passes)
    if window > len(known):
        raise ValueError(f"the window holds {window} observations, but there are {len(known)}. Take a window of at "
                         "most their number (of exactly it: lfm.full_information).")
    origin = known[0] if model.initial_time is None else model.initial_time
    model.check_at(origin, len(known))
    y = check_observations(y, len(known), len(model.output_names))
    if not checks.traced(origin):
        _warn_of_breakpoints(model, known, float(origin))
    result = _run(setting, jnp.asarray(known), y, jnp.asarray(origin, float))
    if not checks.traced(result) and not bool(result.converged):
        checks.warn("some windows of the moving horizon estimate have not converged: the largest duality gap is "
                    f"{float(result.gap):.2g}, the largest violation of a constraint "
                    f"{float(np.max(result.violation)):.2g} standard deviations. Raise max_passes, or loosen a "
                    "constraint that no trajectory respects.")
    return result


def _set_up(model: LatentForceModel, window: int, delay: int | None, lower: Any, upper: Any, constraints: Any,
            steps: int, tolerance: float, max_passes: int) -> _Setting:
    check_settings(model, tolerance, max_passes)
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
    plain = state_space(model)
    if plain.stack.jump_times:
        raise ValueError("forces that jump at given times cannot be had in a moving window; leave out their jumps.")
    found = build_constraints(model, lower, upper, constraints)
    every = np.arange(window)
    ssm = augmented(model, found, Rows(every, every, every, np.zeros(window, int)))
    linear = is_linear(ssm)
    if not linear:
        check_noise(ssm, 0.0 if model.initial_time is None else model.initial_time)
    warn_single_precision()
    return _Setting(ssm, plain, found, linear, int(window), int(delay), int(steps), float(tolerance), max_passes)


def _warn_of_breakpoints(model: LatentForceModel, times: np.ndarray, origin: float) -> None:
    """Warn where a known input jumps between two observations, whose interval a moving window does not divide."""
    breakpoints, moving = breakpoints_within(model.input_reads(origin, float(times[-1])), origin, float(times[-1]))
    apart = np.setdiff1d(breakpoints, times)
    if len(apart) or len(moving):
        where = f"at time {apart[0]:g}, between two observations" if len(apart) else "at a lag that is traced"
        checks.warn(f"a known input jumps {where}, and a moving window does not divide its intervals there, so that a "
                    "short pulse may be stepped over. Add rows at these times with missing observations (NaN).")


def _grid(setting: _Setting, times: jax.Array, origin: jax.Array) -> TimeGrid:
    """Return an interval up to each of ``times`` (K,), the first one from ``origin``."""
    begin = jnp.concatenate([origin[None], times[:-1]])
    every = jnp.arange(times.shape[0])
    intervals = intervals_between(begin, times, times - begin, every, jnp.full_like(every, -1))
    return TimeGrid(intervals, None, every, every, times, setting.steps, origin)


def _solved(setting: _Setting, times: jax.Array, y: jax.Array, held: jax.Array | None, origin: jax.Array,
            start: Moments) -> ConstrainedEstimate:
    """Solve the problem of one window (W,), (W, D)."""
    every = jnp.arange(setting.window)
    laid_out = Rows(times, every, every, jnp.zeros_like(every))  # type: ignore[arg-type]
    problem = Problem(setting.ssm, _grid(setting, times, origin), laid_out, y, start, held)
    if setting.linear:
        nodes = jnp.zeros((setting.window + 1, setting.ssm.state_dim))
        problem = problem._replace(transitions=Dynamics(problem).linearised(nodes))
    return estimate_on(setting.ssm, setting.constraints, problem, setting.tolerance, setting.most, setting.linear)[0]


def _filtered(setting: _Setting, times: jax.Array, y: jax.Array, origin: jax.Array, start: Moments) -> Moments:
    """Return the filtered moments (K, ...) at ``times``."""
    return forward(setting.plain, Taylor(), _grid(setting, times, origin), y, start=start, keep="moments").filtered


@eqx.filter_jit
def _update(setting: _Setting, state: HorizonState, t: jax.Array, y: jax.Array) -> tuple[HorizonState, HorizonEstimate]:
    arrival = Moments(state.mean, state.covariance)
    passed = jax.tree_util.tree_map(
        lambda a: a[0], _filtered(setting, state.times[:1], state.y[:1], state.arrival_time, arrival))
    full = state.seen >= setting.window
    arrival = jax.tree_util.tree_map(lambda new, old: jnp.where(full, new, old), passed, arrival)
    new = HorizonState(
        jnp.append(state.times[1:], t), jnp.concatenate([state.y[1:], y[None]]), state.seen + 1,
        jnp.where(full, state.times[0], state.arrival_time), *arrival)
    held = jnp.arange(setting.window) >= setting.window - new.seen
    found = _solved(setting, new.times, new.y, held, new.arrival_time, arrival)
    row = setting.window - 1 - setting.delay
    time = jnp.where(held[row], new.times[row], jnp.nan)
    return new, HorizonEstimate(time, found.state_mean[row], found.force_mean[row], found.converged, found.passes)


@eqx.filter_jit
def _run(setting: _Setting, times: jax.Array, y: jax.Array, origin: jax.Array) -> ConstrainedEstimate:
    window, row = setting.window, setting.window - 1 - setting.delay
    first = Moments(*setting.plain.initial())
    before = jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a[None], b]), first,
                                    _filtered(setting, times, y, origin, first))
    since = jnp.append(origin, times)

    def solved(begin: jax.Array) -> ConstrainedEstimate:
        part = lambda a: jax.lax.dynamic_slice_in_dim(a, begin, window)  # noqa: E731
        return _solved(setting, part(times), part(y), None, since[begin],
                       jax.tree_util.tree_map(lambda a: a[begin], before))

    def kept(begin: jax.Array) -> tuple:
        one = solved(begin)
        return tuple(getattr(one, name)[row] for name in _BY_ROW), (one.gap, one.passes, one.converged)

    count = times.shape[0] - window + 1
    middle, (gap, passes, converged) = jax.lax.map(kept, jnp.arange(count))
    ends = solved(jnp.asarray(0)), solved(jnp.asarray(count - 1))
    trajectories = {
        name: jnp.concatenate([getattr(ends[0], name)[:row], inside, getattr(ends[1], name)[row + 1:]])
        for name, inside in zip(_BY_ROW, middle, strict=True)}
    last = ends[1]
    return ConstrainedEstimate(
        **trajectories, gap=gap.max(), objective=last.objective, passes=passes.max(), converged=converged.all(),
        labels=last.labels, state_names=last.state_names, force_names=last.force_names)


_BY_ROW = ("times", "state_mean", "force_mean", "slack", "multiplier", "violation", "scale")
