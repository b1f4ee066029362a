"""THE filter: one forward scan over the intervals, for any rule and any model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.adaptive import predict_interval_adaptively
from lfm_ppl.filtering.jumps import after_jump, jump_map
from lfm_ppl.filtering.predict import (
    FLOOR,
    Moments,
    Prediction,
    interval_factor,
    predict_exact,
    predict_interval,
    unmoved,
)
from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, as_arrays, build_time_grid, by_length, with_observations
from lfm_ppl.filtering.transition import IntegratingFactor, LinearPart, constant_jacobian, exact, linear_part
from lfm_ppl.filtering.update import (
    FACTOR,
    FAILED,
    Sites,
    linearise_observation,
    predictor_variance,
    update,
    update_by_sites,
)
from lfm_ppl.linalg import congruence, diagonal, matmul, safe_sqrt, solve_lower
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import Cubature, SigmaPointRule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.resolution import check_resolution
from lfm_ppl.model.state_space import Span, StateSpaceModel, state_space

_FEW_LENGTHS = 16
"""Distinct lengths of the intervals up to which it costs nothing to tabulate more of each than is needed."""

_MANY_INTERVALS = 32
"""Intervals for each distinct length from which it costs little, however many lengths: regular times, rounded."""

_KEPT = jax.checkpoint_policies.save_only_these_names(FLOOR, FAILED, FACTOR)
"""What an interval keeps for its derivative besides its inputs: a few numbers that take many operations."""


class Pass(NamedTuple):
    """What a forward scan leaves, one entry per interval; ``None`` where it was not asked for.

    Attributes:
        log_likelihood: (N,) of each interval's observation, zero without one.
        predicted, filtered: moments (N, n), (N, n, n) at the interval's end, before and after the observation.
        phi, process_cov: (N, n, n), the affine map of the interval.
        innovation, present, chol, gain, jacobian, obs_cov: of the update, (N, D), (N, D), (N, D, D), (N, n, D), (N, D,
            n), (N, D, D).
        steps: of the integration steps of each interval, predictions (N, J, ...) or `Inside` (N, J, ...).
        site_terms: (N, ...), of updates by sites; these leave no chol and no obs_cov.
        predictor: (N, D), predicted mean of an observation family's predictor, of updates by sites.
    """

    log_likelihood: jax.Array
    predicted: Any = None
    filtered: Any = None
    phi: Any = None
    process_cov: Any = None
    innovation: Any = None
    present: Any = None
    chol: Any = None
    gain: Any = None
    jacobian: Any = None
    obs_cov: Any = None
    steps: Any = None
    site_terms: Any = None
    predictor: Any = None


class Inside(NamedTuple):
    """The states that a linearisation of the dynamics needs, k of them, at the ends of steps within an interval.

    Attributes:
        moments: predicted, (J, k) and (J, k, k).
        cross: (J, k, n), their covariance with the whole state at the interval's end, a jump there included.
    """

    moments: Moments
    cross: jax.Array


class Points(NamedTuple):
    """Moments about which a pass is linearised.

    Attributes:
        nodes: (N, J + 1, k), (N, J + 1, k, k) of the `needed` states at the ends of the steps of each interval, before
            a jump.
        ends: (N, n), (N, n, n) at the intervals' ends, after it; None where no observation `bends`.
    """

    nodes: Moments
    ends: Moments | None


class Transitions(NamedTuple):
    """Maps of the intervals that are known ahead of a pass: s -> mean + phi (s - point) + N(0, process_cov).

    Attributes:
        point: (N, n), states at the intervals' starts about which the dynamics is linearised.
        mean: (N, n), where it takes them; a jump at the end included.
        phi, process_cov: (N, n, n).
    """

    point: jax.Array
    mean: jax.Array
    phi: jax.Array
    process_cov: jax.Array

    def predict(self, moments: Moments) -> Prediction:
        """Return the prediction over one interval."""
        moved_by = matmul(self.phi, (moments.mean - self.point)[:, None])[:, 0]
        covariance = congruence(self.phi, moments.covariance) + self.process_cov
        return Prediction(Moments(self.mean + moved_by, covariance), self.phi, self.process_cov)


def bends(ssm: StateSpaceModel) -> bool:
    """Whether the linearisation of an observation depends on the moments about which it is made."""
    observation = ssm.model.observation
    return bool(not ssm.observation_structure.linear or observation.angular or observation.varies_with_state)


def needed(ssm: StateSpaceModel, rule: Rule) -> np.ndarray:
    """Return (k,), the joint states whose moments a linearisation of the dynamics needs."""
    if isinstance(rule, SigmaPointRule) and rule.full_state:
        return np.arange(ssm.state_dim)
    structure = ssm.drift_structure
    inputs = np.isin(np.arange(ssm.input_dim), (*structure.points, *structure.averaged))
    size = ssm.physical_dim
    states = [np.full(force.state_dim, used) for force, used in zip(ssm.stack.forces, inputs[size:], strict=True)]
    return np.flatnonzero(np.concatenate([inputs[:size], *states]))


def completed(ssm: StateSpaceModel, rule: Rule, nodes: Moments) -> Moments:
    """Return moments (..., n), (..., n, n) of the whole state from those of the needed ones; the others are zero."""
    used = needed(ssm, rule)
    if _contiguous(used):
        first = int(used[0]) if used.size else 0
        width = first, ssm.state_dim - first - used.size
        still = ((0, 0),) * (nodes.mean.ndim - 1)
        return Moments(jnp.pad(nodes.mean, (*still, width)), jnp.pad(nodes.covariance, (*still, width, width)))
    pick = np.eye(ssm.state_dim)[used]
    return Moments(matmul(nodes.mean[..., None, :], pick)[..., 0, :], congruence(pick.T, nodes.covariance))


def _inside(ssm: StateSpaceModel, rule: Rule, prepared: Preparation, interval: Intervals,
            one: Prediction) -> Prediction:
    """Give a prediction its phi, and `Inside` as its steps, from (mean, covariance with all, phi) of these."""
    mean, own, phi = one.steps
    to_end = jnp.eye(ssm.state_dim)
    if prepared.jumps is not None:
        to_end, _ = jump_map(ssm, prepared.jumps, interval.jump)

    def back(to_end: jax.Array, at: tuple) -> tuple[jax.Array, jax.Array]:
        own, phi = at
        return matmul(to_end, phi), matmul(own, to_end.T)

    whole, cross = jax.lax.scan(back, to_end, (own, phi), reverse=True)
    return one._replace(phi=whole, steps=Inside(Moments(mean, columns(own, needed(ssm, rule))), cross))


def at_intervals(a: jax.Array, intervals: Any) -> jax.Array:
    """Return entries of ``a`` (N, ...) at some intervals; for all of them without a gather, a scatter in reverse."""
    if isinstance(intervals, np.ndarray) and np.array_equal(intervals, np.arange(a.shape[0])):
        return a
    return a[jnp.asarray(intervals)]


def columns(a: jax.Array, indices: np.ndarray) -> jax.Array:
    """Return the entries at ``indices`` along the last axis; XLA fuses a slice, not a gather."""
    if not _contiguous(indices):
        return a[..., indices]
    first = int(indices[0]) if indices.size else 0
    return a[..., first:first + indices.size]


def _contiguous(indices: np.ndarray) -> bool:
    return bool((np.diff(indices) == 1).all())


class Preparation(NamedTuple):
    """What the intervals of a scan share.

    Attributes:
        linear: the constant linear part of the dynamics.
        jacobian: (D, M + R), the constant part of the observation's.
        transition: from an interval to what `step_transition` gives for its length.
        jumps: G and Q of the forces' jumps, None without any.
    """

    linear: LinearPart
    jacobian: jax.Array
    transition: Callable[[Intervals], Any]
    jumps: tuple[jax.Array, jax.Array] | None


def preparation(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid) -> Preparation:
    """Compute what the intervals of a scan share."""
    linear = linear_part(ssm, jnp.asarray(grid.initial_time, float))
    count = np.shape(grid.intervals.length)[0]
    few = grid.lengths is not None and len(grid.lengths) <= max(_FEW_LENGTHS, count // _MANY_INTERVALS)
    transition = by_length(grid, lambda length: step_transition(ssm, rule, linear, grid, length, few))
    return Preparation(linear, _observation_jacobian(ssm, grid), transition, ssm.stack.jump_table())


def step_transition(ssm: StateSpaceModel, rule: Rule, linear: LinearPart, grid: TimeGrid, length: jax.Array,
                    tabulated: bool = False) -> Any:
    """Return the exact transition over this length, or the integrating factor of its steps.

    None where the steps have lengths of their own. What an interval would compute for itself is ``tabulated``, too.
    """
    if ssm.time_invariant:
        return exact(ssm, length, grid.steps, linear)
    if grid.tolerance is not None:
        return None
    return interval_factor(ssm, rule, linear, length, grid.steps, tabulated)


class FilterState(NamedTuple):
    """Where a filter stands: the time and the moments of the joint state, to pass on as ``start``."""

    time: Any
    mean: jax.Array
    covariance: jax.Array


class FilterResult(eqx.Module):
    """The outcome of `filter`.

    Attributes:
        times: (T,).
        log_likelihood: (T,), log p(y_k | y_1:k-1) of the entries that are present.
        predicted_mean, predicted_covariance: (T, n), (T, n, n) of the joint state, before each observation.
        filtered_mean, filtered_covariance: after it.
        whitened_innovation: (T, D), innovations whitened by their Cholesky factor: independent standard normals for a
            true linear model, and so are the randomised quantile residuals of an observation family; NaN where missing.
        state: time and moments after the last observation.
    """

    times: jax.Array
    log_likelihood: jax.Array
    predicted_mean: jax.Array
    predicted_covariance: jax.Array
    filtered_mean: jax.Array
    filtered_covariance: jax.Array
    whitened_innovation: jax.Array
    state: FilterState


def predict(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, prepared: Preparation, interval: Intervals,
            moments: Moments, nodes: Moments | None = None, with_map: bool = False,
            each: Callable[[Prediction], Any] | None = None,
            gathered: Callable[[Prediction], Prediction] = lambda one: one) -> Prediction:
    """Predict over an interval, a jump at its end included; arguments as in `predict_interval`.

    ``gathered`` makes of the steps, before the jump, what is kept of them.
    """
    transition = prepared.transition(interval)
    if ssm.time_invariant:
        one = predict_exact(ssm, transition, grid.steps, interval.span, interval.length, moments)
    else:
        move = lambda: gathered(integrate(  # noqa: E731
            ssm, rule, grid, prepared.linear, transition, interval.span, interval.length, moments, nodes, with_map,
            each))

        def stay() -> Prediction:
            one = gathered(unmoved(moments, with_map, each))
            return one._replace(steps=jax.tree_util.tree_map(
                lambda a: jnp.broadcast_to(a, (grid.steps, *a.shape[1:])), one.steps))

        one = jax.lax.cond(interval.length > 0, move, stay) if grid.replicated else move()
    if prepared.jumps is not None:
        one = after_jump(ssm, prepared.jumps, interval.jump, one, with_map=with_map or ssm.time_invariant)
    return one


def integrate(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, linear: LinearPart, factor: IntegratingFactor | None,
              span: Span, length: jax.Array, moments: Moments, nodes: Moments | None = None,
              with_map: bool = False, each: Callable[[Prediction], Any] | None = None) -> Prediction:
    """Predict over an interval, or a part of one, in the grid's steps; arguments as in `predict_interval`."""
    if grid.tolerance is not None:
        return predict_interval_adaptively(ssm, rule, linear, grid.steps, grid.tolerance, span, length, moments,
                                           with_map)
    assert factor is not None
    return predict_interval(ssm, rule, linear, factor, grid.steps, span, length, moments, nodes, with_map, each)


def transitions_about(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, points: Points | None,
                      prepared: Preparation | None = None) -> Transitions | None:
    """Return the maps of all intervals of a model that is linearised about fixed points.

    Passes over the same points then integrate nothing.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        grid: the time grid.
        points: about which it is linearised; None: its dynamics is linear.
        prepared: as in `forward`.

    Returns:
        None where a pass has its transitions at hand, or where the moments decide on its steps.
    """
    if ssm.time_invariant or grid.tolerance is not None:
        return None
    prepared = preparation(ssm, rule, grid) if prepared is None else prepared

    def one(at: tuple[Intervals, Moments | None]) -> Transitions:
        interval, nodes = at
        nodes = None if nodes is None else completed(ssm, rule, nodes)
        begin = jnp.zeros(ssm.state_dim) if nodes is None else nodes.mean[0]
        found = predict(ssm, rule, grid, prepared, interval, Moments(begin, jnp.zeros((ssm.state_dim,) * 2)), nodes,
                        with_map=True)
        return Transitions(begin, found.moments.mean, found.phi, found.process_cov)

    return jax.lax.map(jax.checkpoint(one, prevent_cse=False, policy=_KEPT),
                       (as_arrays(grid.intervals), None if points is None else points.nodes))


def forward(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, *, start: Moments | None = None,
            linearization_point: Points | None = None, keep: str = "likelihood",
            sites: Sites | Callable[..., Any] | None = None, transitions: Transitions | None = None,
            prepared: Preparation | None = None) -> Pass:
    """Run the one forward scan.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        grid: the time grid.
        y: (T, D), NaN where missing.
        start: moments at the initial time; the model's by default.
        linearization_point: linearise about these moments; the filter's own by default.
        keep: "likelihood" (log likelihoods only), "moments" (and the moments), "all" (what the smoother needs),
            "steps" (and the steps within the intervals), "inside" (what the adjoint and the iterations need).
        sites: (T, D) each, of an observation family: pseudo-observations in the place of ``y``, whose log likelihoods
            are then integrals of the sites. Or what makes those of a row, and its log likelihood, from the mean (D,)
            and the covariance (D, D) of the predictor as predicted, the row's index, and its entries of y.
        transitions: of the intervals, where they are known; of ``linearization_point`` only the ends are used then.
        prepared: what the intervals share, where several passes share it.
    """
    prepared = preparation(ssm, rule, grid) if prepared is None else prepared
    # Steps whose length follows the moments are not kept.
    equal = grid.tolerance is None
    with_map = keep in ("all", "steps") or (keep == "inside" and not equal)
    each: Callable[[Prediction], Any] | None = None
    if keep == "steps" and equal:
        each = lambda one: one  # noqa: E731
    inside = keep == "inside" and equal and not ssm.time_invariant
    if inside:
        used = needed(ssm, rule)
        each = lambda one: (columns(one.moments.mean, used), columns(one.moments.covariance, used).T,  # noqa: E731
                            one.phi)

    def step(moments: Moments, inputs: tuple) -> tuple[Moments, Pass]:
        interval, observed, point, given, transition = inputs
        if transition is None:
            nodes = None if point is None else completed(ssm, rule, point.nodes)
            gathered = (lambda one: _inside(ssm, rule, prepared, interval, one)) if inside else (lambda one: one)
            one = predict(ssm, rule, grid, prepared, interval, moments, nodes, with_map, each, gathered)
        else:
            one = transition.predict(moments)
        centre = one.moments if point is None or point.ends is None else point.ends
        affine = linearise_observation(ssm, rule, prepared.jacobian, interval.end,
                                       jnp.maximum(interval.observation, 0), centre)
        if centre is not one.moments:
            affine = affine.shifted(one.moments.mean - centre.mean)
        if sites is None:
            new = update(ssm, affine, observed, jnp.isfinite(observed), one.moments, scale)
        else:
            made = sites(affine.value, predictor_variance(affine, one.moments), jnp.maximum(interval.observation, 0),
                         observed) if callable(sites) else None
            new = update_by_sites(affine, Sites(*given) if made is None else made.sites, one.moments)
            if made is not None:
                new = new._replace(log_likelihood=made.log_likelihood)
        out = Pass(new.log_likelihood, predictor=None if sites is None else affine.value)
        if keep != "likelihood":
            out = out._replace(predicted=one.moments, filtered=new.moments, innovation=new.innovation,
                               present=jnp.isfinite(observed), chol=new.chol, site_terms=new.site_terms)
        if with_map or keep == "inside":
            out = out._replace(phi=one.phi, process_cov=one.process_cov if with_map else None, gain=new.gain,
                               jacobian=new.jacobian, obs_cov=new.obs_cov, steps=one.steps)
        return new.moments, out

    first = Moments(*ssm.initial()) if start is None else start
    scale = _output_scale(ssm, grid, prepared, jnp.asarray(y, float), first) if sites is None else None
    by_row = None
    if sites is not None and not callable(sites):
        padded = with_observations(grid.intervals, jnp.stack(sites, axis=1))[1]
        by_row = jnp.moveaxis(jnp.where(jnp.isnan(padded), 0.0, padded), 1, 0)
    inputs = (*with_observations(grid.intervals, y), linearization_point,
              by_row if by_row is None else tuple(by_row), transitions)
    return jax.lax.scan(jax.checkpoint(step, prevent_cse=False, policy=_KEPT), first, inputs)[1]


def _output_scale(ssm: StateSpaceModel, grid: TimeGrid, prepared: Preparation, y: jax.Array,
                  start: Moments) -> jax.Array:
    """Return (D,), how large outputs are: their largest observation, or the prior's standard deviation if that is more.

    The prior's is that through the constant part of the observation's Jacobian. An angle is at least one radian large.
    """
    matrix, _ = ssm.input_map(jnp.asarray(grid.initial_time, float))
    prior = safe_sqrt(diagonal(congruence(matmul(prepared.jacobian, matrix), start.covariance)))
    scale = jnp.maximum(jnp.max(jnp.where(jnp.isfinite(y), jnp.abs(y), 0.0), axis=0), prior)
    for index in ssm.model.observation.angular:
        scale = scale.at[index].max(1.0)
    return jax.lax.stop_gradient(scale)


def _observation_jacobian(ssm: StateSpaceModel, grid: TimeGrid) -> jax.Array:
    """The constant part of the observation's Jacobian; the same at every point and time."""
    t = jnp.asarray(grid.initial_time, float)
    w = ssm.inputs(ssm.initial()[0], t)
    return constant_jacobian(lambda v: (ssm.observe(v, t), ()), w, ssm.observation_structure, ssm.output_dim)


def check_observations(y: Any, count: int, outputs: int, empty: bool = False,
                       model: LatentForceModel | None = None) -> jax.Array:
    """Return y as an array (T, D) after checking it; that nothing is observed is fine if ``empty``.

    Of a ``model`` with an observation family the entries must be such as the family gives.

    Raises:
        ValueError: a wrong shape, infinite entries, nothing observed at all, or data that the family cannot give.
    """
    y = checks.unmask(y)
    shape = np.shape(y)
    if shape == (count,) and outputs == 1:
        y, shape = jnp.reshape(jnp.asarray(y), (count, 1)), (count, 1)
    if shape != (count, outputs):
        raise ValueError(f"y must have one row for each of the {count} times and one column for each of the {outputs} "
                         f"outputs, shape ({count}, {outputs}); got {shape}.")
    known = checks.concrete(y)
    if known is not None:
        if known.dtype.kind not in "biuf":
            raise TypeError(f"y must be numeric, got dtype {known.dtype}.")
        if np.isinf(known).any():
            row, column = np.argwhere(np.isinf(known))[0]
            raise ValueError(f"y[{row}, {column}] is infinite; use NaN for a missing entry.")
        if np.isnan(known).all() and not empty:
            raise ValueError("every entry of y is missing (NaN); there is nothing to learn from.")
        if model is not None and isinstance(model.observation, ObservationFamily):
            model.observation.check_data(known, names=model.output_names)
    return jnp.asarray(y, float)


def filter(model: LatentForceModel, times: Any, y: Any, rule: Rule | None = None, steps: int = 10,
           max_step: float | None = None, start: FilterState | None = None,
           tolerance: float | None = None) -> FilterResult:
    """Run the continuous-discrete Gaussian filter.

    Between observations the moments obey dm/dt = E[f], dP/dt = A P + P A' + E[G G'] with the rule's A; at an
    observation they are conditioned on it. Of an observation family the moments of the predictor given an observation
    are those of its tilted prediction (assumed density filtering).

    Args:
        model: the latent force model.
        times: (T,), non-decreasing; equal times are replicates.
        y: (T, D), NaN where missing.
        rule: linearisation rule; `Cubature()` by default.
        steps: integration steps between two consecutive times.
        max_step: longest step, in units of time; longer intervals get more steps. None: twice the median step. A linear
            model without known inputs is exact, and needs no steps.
        start: the ``state`` of an earlier result, to go on with new observations; times continue from there, and
            nothing need be observed at them (a prediction). The numbers are those of one pass, and as many new times
            as in an earlier call take no new compilation. (An observation covariance for each time holds those of the
            new times.)
        tolerance: largest error of an integration step, in standard deviations, as in `lfm_ppl.MarginalLikelihood`.

    Returns:
        Log likelihoods, moments and residuals, by observation.

    Raises:
        ValueError, TypeError: unsorted times, a wrong shape of y, and so on; each says what to do.

    Warns:
        FilterWarning: outside of compiled code, where a log likelihood is -inf or not finite: which row and step breaks
            down, and how.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.filter(model, jnp.arange(3.0), jnp.zeros((3, 1))).log_likelihood.shape
        (3,)

    Source: Särkkä and Sarmavuori (2013), Signal Processing 93; Hartikainen et al. (2012), section 4.
    """
    rule = as_rule(rule)
    ssm = state_space(model)
    if start is not None:
        _check_start(start, times, ssm.state_dim)
    grid = build_time_grid(ssm, times, steps, max_step, initial_time=None if start is None else start.time,
                           tolerance=tolerance)
    model.check_at(grid.initial_time, len(grid.observed))
    check_resolution(model, times, y)
    y = check_observations(y, len(grid.observed), ssm.output_dim, start is not None, model)
    warn_single_precision()
    begin = None if start is None else Moments(start.mean, start.covariance)
    result = filter_on(ssm, rule, grid, y, jnp.asarray(times, float), begin)
    known = checks.concrete(times)
    if known is not None:
        # A number also in a trace, so that another call there can go on from it with a time grid of its own.
        last = np.asarray(known[-1], float)
        result = eqx.tree_at(lambda r: r.state.time, result, last)
    # It runs the filter itself, so that its module imports this one.
    from lfm_ppl.filtering.breakdown import warn_of_breakdown

    warn_of_breakdown(ssm, rule, grid, y, begin, result.log_likelihood)
    return result


def _check_start(start: Any, times: Any, size: int) -> None:
    if not isinstance(start, FilterState):
        hint = " Pass result.state." if isinstance(start, FilterResult) else ""
        raise TypeError(f"start must be the state of an earlier filter result, got {type(start).__name__}.{hint}")
    checks.refuse_dates("times", times)
    if np.shape(start.mean) != (size,):
        raise ValueError(f"start has {np.shape(start.mean)[0]} entries, but the joint state of this model has {size}.")
    begin, known = checks.concrete(start.time), checks.concrete(times)
    if begin is not None and known is not None and known.size and known.flat[0] < begin:
        raise ValueError(f"times[0] = {known.flat[0]:g} lies before {float(begin):g}, where `start` stands.")


@eqx.filter_jit
def filter_on(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, times: jax.Array,
              begin: Moments | None = None) -> FilterResult:
    """Filter observations (T, D) at ``times`` on the intervals of a time grid; see `filter`."""
    log_likelihood, residual = None, None
    if isinstance(ssm.model.observation, ObservationFamily):
        # Sites are refined by passes of this filter, so that their module imports this one.
        from lfm_ppl.filtering.sites import assumed_density_filter, quantile_residuals

        log_likelihood, passed, prediction = assumed_density_filter(ssm, rule, grid, y, begin)
        residual = quantile_residuals(ssm.model.observation, prediction, y)
    else:
        passed = forward(ssm, rule, grid, y, start=begin, keep="moments")
    at = jax.tree_util.tree_map(lambda a: at_intervals(a, grid.observed), passed)
    state = FilterState(times[-1], at.filtered.mean[-1], at.filtered.covariance[-1])
    return FilterResult(times, at.log_likelihood if log_likelihood is None else log_likelihood, at.predicted.mean,
                        at.predicted.covariance, at.filtered.mean, at.filtered.covariance,
                        whitened_innovations(at, y) if residual is None else residual, state)


def whitened_innovations(passed: Pass, y: jax.Array) -> jax.Array:
    """Return innovations whitened by their Cholesky factor, (T, D), NaN where missing."""
    return jnp.where(jnp.isfinite(y), jax.vmap(solve_lower)(passed.chol, passed.innovation), jnp.nan)


def as_rule(rule: Any) -> Rule:
    """Return the rule, `Cubature()` for None; raise TypeError for anything else."""
    if rule is None:
        return Cubature()
    if not isinstance(rule, Rule):
        hint = " Call it: lfm.Cubature()." if isinstance(rule, type) else ""
        raise TypeError(f"rule must be a linearisation rule such as lfm.Cubature(), got {rule!r}.{hint}")
    return rule


_warned = False


def warn_single_precision() -> None:
    """Warn once when JAX runs in single precision."""
    global _warned
    if not _warned and jnp.result_type(float) != jnp.float64:
        import warnings

        _warned = True
        warnings.warn("JAX runs in single precision (float32), in which filters lose most of their digits. Call "
                      'jax.config.update("jax_enable_x64", True) before anything else.', stacklevel=3)
