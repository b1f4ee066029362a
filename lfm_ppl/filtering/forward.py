r"""The forward scan: filtered moments and log likelihoods, for any rule and any model.

For each interval of the time grid, in one fused scan,

1. predict the moments over the interval, by the integrator of the problem or by a given affine map;
2. let the forces jump, where they do, and apply the event at its end;
3. linearise the observation about the predicted moments, or about given ones;
4. update the moments by an `Updater`: a Gaussian observation, Gaussian factors, or factors by moment matching;
5. record what the caller asks for (`Record`).

The body of the scan is checkpointed, which matters in reverse mode only: of each interval, the derivative stores its
inputs and a few numbers that take many operations.

Source: Särkkä and Sarmavuori (2013), Signal Processing 93, section 3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.dynamics import MINIMUM_SD, embed_in_state
from lfm_ppl.filtering.integrators.integrator import Stepping
from lfm_ppl.filtering.intervals import Intervals, as_arrays, with_observations
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.predict import predict, predict_by_map
from lfm_ppl.filtering.problem import FilterProblem
from lfm_ppl.filtering.update import (
    INNOVATION_FACTOR,
    UPDATE_FAILED,
    RowUpdate,
    Update,
    Updater,
    linearise_observation,
)

_STORED = jax.checkpoint_policies.save_only_these_names(MINIMUM_SD, UPDATE_FAILED, INNOVATION_FACTOR)
"""What reverse mode stores of an interval besides its inputs."""


class LinearisationPoints(NamedTuple):
    """Moments about which a pass is linearised.

    Attributes:
        nodes: (N, J + 1, k), (N, J + 1, k, k) of the linearised states (`linearisation_indices`) at the ends of the
            steps of each interval, before a jump.
        end_moments: (N, n), (N, n, n) at the intervals' ends, after a jump; None unless the observation is non-linear.
    """

    nodes: Moments
    end_moments: Moments | None


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
        predictor: (N, D), predicted mean of an observation family's predictor, of any update by factors.
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
            about: LinearisationPoints | None = None, record: Record = Record.LIKELIHOOD,
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
    ssm, rule, grid = problem.ssm, problem.rule, problem.grid
    start = problem.initial(initial)
    update = updater.bind(problem, start)

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
        terms = updated.factor_terms
        trace = FilterTrace(None, updated.log_likelihood, predictor=None if terms is None else terms.value)
        if record is not Record.LIKELIHOOD:
            trace = trace._replace(predicted=prediction.moments, filtered=updated.moments,
                                   update=_recorded_update(updated, record))
        if record in (Record.LINEARIZATION, Record.SMOOTHER):
            trace = trace._replace(phi=prediction.phi, nodes=prediction.nodes)
        if record is Record.SMOOTHER:
            trace = trace._replace(process_cov=prediction.process_cov)
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
    index = jnp.maximum(interval.observation, 0)
    observation = linearise_observation(problem.ssm, problem.rule, problem.shared.observation_jacobian, interval.end,
                                        index, predicted if centre is None else centre)
    if centre is not None:
        observation = observation.shifted(predicted.mean - centre.mean)
    return update(observation, index, row, predicted)


def _recorded_update(update: Update, record: Record) -> Update:
    update = update._replace(moments=None, log_likelihood=None)
    if record is Record.MOMENTS:
        return update._replace(gain=None, jacobian=None, obs_cov=None)
    return update


def maps_about(problem: FilterProblem, points: LinearisationPoints | None) -> IntervalMaps | None:
    """Return the affine maps of all intervals of a model that is linearised about given points.

    They are None for a time-invariant model or adaptive steps, whose passes compute them at no cost or need the moments
    for them. A linear model with constant coefficients, but a dispersion that varies with time, has maps: only its
    transition is tabulated, while the noise is integrated anew in each pass. A linear model is linearised about no
    points.
    """
    ssm, rule = problem.ssm, problem.rule
    if ssm.plan.has_exact_noise or problem.integrator.stepping is Stepping.ADAPTIVE:
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
