r"""The forward scan: filtered moments and log likelihoods, for any rule and any model.

For each interval of the time grid, in one fused scan,

1. predict the moments over the interval: by its exact transition, by integration, or by a given affine map;
2. let the forces jump, where they do, and apply the event at its end;
3. linearise the observation about the predicted moments, or about given ones;
4. update the moments by an `Updater`: a Gaussian observation, Gaussian sites, or sites by moment matching;
5. record what the caller asks for (`Record`).

The body of the scan is checkpointed, which matters in reverse mode only: of each interval, the derivative stores its
inputs and a few numbers that take many operations.

Source: Särkkä and Sarmavuori (2013), Signal Processing 93, section 3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.adaptive import predict_interval_adaptively
from lfm_ppl.filtering.dynamics import MINIMUM_SD, columns, embed_in_state, linearization_indices
from lfm_ppl.filtering.intervals import Intervals, as_arrays, with_observations
from lfm_ppl.filtering.moments import Moments, Prediction, Record
from lfm_ppl.filtering.predict import (
    StepRecord,
    apply_event,
    apply_jump,
    identity_prediction,
    jump_map,
    predict_by_map,
    predict_exact,
    predict_interval,
)
from lfm_ppl.filtering.problem import FilterProblem
from lfm_ppl.filtering.update import (
    INNOVATION_FACTOR,
    UPDATE_FAILED,
    RowUpdate,
    Update,
    Updater,
    linearize_observation,
)
from lfm_ppl.utils.linalg import matmul

_STORED = jax.checkpoint_policies.save_only_these_names(MINIMUM_SD, UPDATE_FAILED, INNOVATION_FACTOR)
"""What reverse mode stores of an interval besides its inputs."""


class LinearizationPoints(NamedTuple):
    """Moments about which a pass is linearised.

    Attributes:
        nodes: (N, J + 1, k), (N, J + 1, k, k) of the linearised states (`linearization_indices`) at the ends of the
            steps of each interval, before a jump.
        end_moments: (N, n), (N, n, n) at the intervals' ends, after a jump; None unless the observation is non-linear.
    """

    nodes: Moments
    end_moments: Moments | None


class NodeRecord(NamedTuple):
    """Moments of the linearised states at the ends of the steps of an interval; k states, J steps.

    Attributes:
        moments: predicted, (J, k) and (J, k, k).
        cross: (J, k, n), covariance with the whole state at the interval's end, after a jump.
    """

    moments: Moments
    cross: jax.Array


class IntervalMaps(NamedTuple):
    """Known affine maps of the intervals: s -> mean + phi (s - point) + N(0, process_cov).

    Attributes:
        point: (N, n), states at the intervals' starts about which the dynamics is linearised.
        mean: (N, n), their images, after a jump at the end.
        phi, process_cov: (N, n, n).
    """

    point: jax.Array
    mean: jax.Array
    phi: jax.Array
    process_cov: jax.Array


class FilterTrace(NamedTuple):
    """Output of a forward pass, one entry per interval; None where the `Record` leaves it out.

    Attributes:
        initial: moments at the initial time (without the axis of intervals).
        log_likelihood: (N,), of each interval's observation, zero without one.
        predicted, filtered: moments (N, n), (N, n, n) at the interval's end, before and after the observation.
        phi, process_cov: (N, n, n), affine map of the interval.
        update: of the observation; None for `Record.LIKELIHOOD`, without gains for `Record.MOMENTS`.
        nodes: `NodeRecord` of the steps, for `Record.LINEARIZATION`.
        predictor: (N, D), predicted mean of an observation family's predictor, of any update by sites.
    """

    initial: Any
    log_likelihood: jax.Array
    predicted: Any = None
    filtered: Any = None
    phi: Any = None
    process_cov: Any = None
    update: Any = None
    nodes: Any = None
    predictor: Any = None


def forward(problem: FilterProblem, updater: Updater, *, initial: Moments | None = None,
            about: LinearizationPoints | None = None, record: Record = Record.LIKELIHOOD,
            maps: IntervalMaps | None = None) -> FilterTrace:
    """Run the forward scan.

    Args:
        problem: the model, the rule and the time grid.
        updater: how observations update the moments.
        initial: moments at the initial time; None: the model's.
        about: moments to linearise about; None: the filter's moments.
        record: recorded output.
        maps: affine maps of the intervals, where they are known; of ``about`` only the ``end_moments`` are used then.
    """
    ssm, rule, grid, _ = problem
    start = problem.initial(initial)
    update = updater.bind(problem, start)
    has_map = record is Record.SMOOTHER or (record is Record.LINEARIZATION and grid.tolerance is not None)

    def step(moments: Moments, inputs: tuple) -> tuple[Moments, FilterTrace]:
        interval, row, points, interval_map = inputs
        if interval_map is None:
            nodes = None if points is None else embed_in_state(ssm, rule, points.nodes)
            prediction = predict(problem, interval, moments, nodes, record)
        else:
            prediction = predict_by_map(moments, interval_map.phi, interval_map.process_cov, interval_map.point,
                                        interval_map.mean)
        centre = None if points is None else points.end_moments
        updated = update_at_end(problem, update, interval, row, prediction.moments, centre)
        terms = updated.site_terms
        trace = FilterTrace(None, updated.log_likelihood, predictor=None if terms is None else terms.value)
        if record is not Record.LIKELIHOOD:
            trace = trace._replace(predicted=prediction.moments, filtered=updated.moments,
                                   update=_recorded_update(updated, record))
        if record in (Record.LINEARIZATION, Record.SMOOTHER):
            trace = trace._replace(phi=prediction.phi, process_cov=prediction.process_cov if has_map else None,
                                   nodes=prediction.nodes)
        return updated.moments, trace

    # The data enter here: each field of the updater, a row for each observation, gets a row for each interval.
    rows = jax.tree.map(lambda a: with_observations(grid.intervals, a)[1], updater.rows())
    inputs = as_arrays(grid.intervals), rows, about, maps
    trace = jax.lax.scan(jax.checkpoint(step, prevent_cse=False, policy=_STORED), start, inputs)[1]
    return trace._replace(initial=start)


def update_at_end(problem: FilterProblem, update: RowUpdate, interval: Intervals, row: Any, predicted: Moments,
                  centre: Moments | None = None) -> Update:
    """Update predicted moments by the observation at the end of an interval.

    Args:
        problem: the model, the rule and the time grid.
        update: of a row, from `Updater.bind`.
        interval: one interval.
        row: its data.
        predicted: moments at its end.
        centre: moments about which the observation is linearised; None: the predicted ones.
    """
    ssm, rule, _, shared = problem
    index = jnp.maximum(interval.observation, 0)
    observation = linearize_observation(ssm, rule, shared.observation_jacobian, interval.end, index,
                                        predicted if centre is None else centre)
    if centre is not None:
        observation = observation.shifted(predicted.mean - centre.mean)
    return update(observation, index, row, predicted)


def _recorded_update(update: Update, record: Record) -> Update:
    update = update._replace(moments=None, log_likelihood=None)
    if record is Record.MOMENTS:
        return update._replace(gain=None, jacobian=None, obs_cov=None)
    return update


def predict(problem: FilterProblem, interval: Intervals, moments: Moments, about: Moments | None = None,
            record: Record = Record.LIKELIHOOD) -> Prediction:
    """Predict over an interval, a jump or an event at its end included.

    Args:
        problem: the model, the rule and the time grid.
        interval: one interval.
        moments: at its start.
        about: moments (J + 1, ...) at the ends of its steps to linearise about; None: the filter's moments.
        record: recorded output; ``nodes`` of the result is a `NodeRecord` for `Record.LINEARIZATION`.
    """
    ssm, _, grid, shared = problem
    dynamics, transition = problem.dynamics, shared.transition(interval)
    is_exact = ssm.plan.has_exact_transition
    has_nodes = record is Record.LINEARIZATION and grid.tolerance is None and not is_exact
    if record is Record.LINEARIZATION and not has_nodes:
        record = Record.SMOOTHER

    def integrate() -> Prediction:
        if grid.tolerance is not None:
            return predict_interval_adaptively(dynamics, grid.steps, grid.tolerance, interval.span, interval.length,
                                               moments, record)
        return collect(predict_interval(dynamics, transition, grid.steps, interval.span, interval.length, moments,
                                        about, record))

    def keep_moments() -> Prediction:
        return collect(identity_prediction(dynamics, moments, record, grid.steps))

    def collect(prediction: Prediction) -> Prediction:
        return _collect_nodes(problem, interval, prediction) if has_nodes else prediction

    if is_exact:
        prediction = predict_exact(ssm, shared.linear, transition, grid.steps, interval.span, interval.length, moments)
    elif grid.replicated:
        prediction = jax.lax.cond(interval.length > 0, integrate, keep_moments)
    else:
        prediction = integrate()
    has_map = record is Record.SMOOTHER or is_exact
    if shared.jumps is not None:
        prediction = apply_jump(prediction, jump_map(ssm, shared.jumps, interval.jump), has_map)
    return prediction if interval.state_map is None else apply_event(prediction, interval.state_map, has_map)


def _collect_nodes(problem: FilterProblem, interval: Intervals, prediction: Prediction) -> Prediction:
    """Reduce the recorded steps to a `NodeRecord`, and set phi of the interval, jumps at its end included."""
    ssm = problem.ssm
    steps: StepRecord = prediction.nodes
    to_end = jnp.eye(ssm.state_dim)
    if problem.shared.jumps is not None:
        to_end, _ = jump_map(ssm, problem.shared.jumps, interval.jump)
    if interval.state_map is not None and interval.state_map.keep is not None:
        to_end = interval.state_map.keep[:, None] * to_end

    def previous_step(to_end: jax.Array, step: tuple) -> tuple[jax.Array, jax.Array]:
        covariance, phi = step
        return matmul(to_end, phi), matmul(covariance, to_end.T)

    phi, cross = jax.lax.scan(previous_step, to_end, (steps.covariance, steps.phi), reverse=True)
    covariance = columns(steps.covariance, linearization_indices(ssm, problem.rule))
    return prediction._replace(phi=phi, nodes=NodeRecord(Moments(steps.mean, covariance), cross))


def maps_about(problem: FilterProblem, points: LinearizationPoints | None) -> IntervalMaps | None:
    """Return the affine maps of all intervals of a model that is linearised about given points.

    They are None for a time-invariant model or adaptive steps, whose passes compute them at no cost or need the moments
    for them. A linear model with constant coefficients, but a dispersion that varies with time, has maps: only its
    transition is tabulated, while the noise is integrated anew in each pass. A linear model is linearised about no
    points.
    """
    ssm, rule, grid, _ = problem
    if ssm.plan.has_exact_noise or grid.tolerance is not None:
        return None

    def interval_map(inputs: tuple[Intervals, Moments | None]) -> IntervalMaps:
        interval, nodes = inputs
        nodes = None if nodes is None else embed_in_state(ssm, rule, nodes)
        point = jnp.zeros(ssm.state_dim) if nodes is None else nodes.mean[0]
        moments = Moments(point, jnp.zeros((ssm.state_dim,) * 2))
        prediction = predict(problem, interval, moments, nodes, Record.SMOOTHER)
        return IntervalMaps(point, prediction.moments.mean, prediction.phi, prediction.process_cov)

    return jax.lax.map(jax.checkpoint(interval_map, prevent_cse=False, policy=_STORED),
                       (as_arrays(problem.grid.intervals), None if points is None else points.nodes))
