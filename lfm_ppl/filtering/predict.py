"""Prediction: the moments, and the affine map if it is recorded, over one interval of the scan.

1. The integrator of the problem moves the moments from the start of the interval to its end
   (`lfm_ppl.filtering.integrators`).
2. About given linearisation points the prediction is an affine map, which is stored or composed.
3. A jump of a force, or an event, at the end of the interval is one more affine map.
4. Recorded steps are reduced to what posterior linearisation needs of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.dynamics import columns, linearisation_indices
from lfm_ppl.filtering.integrators.integrator import Section, Stepping, StepRecord, identity_prediction
from lfm_ppl.filtering.intervals import Intervals
from lfm_ppl.filtering.moments import Moments, Prediction, Record, compose, matvec, transform
from lfm_ppl.filtering.problem import FilterProblem
from lfm_ppl.model.events import StateMap
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils.linalg import matmul


class NodeRecord(NamedTuple):
    """Moments of the linearised states at the ends of the steps of an interval; k states, J steps.

    Attributes:
        moments: predicted, (J, k) and (J, k, k).
        cross: (J, k, n), covariance with the whole state at the interval's end, after a jump.
    """

    moments: Moments
    cross: jax.Array


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
    ssm, grid, integrator, shared = problem.ssm, problem.grid, problem.integrator, problem.shared
    dynamics, table = problem.dynamics, shared.table(interval)
    is_exact = integrator.stepping is Stepping.NONE
    has_nodes = record is Record.LINEARIZATION and integrator.stepping is Stepping.EQUAL
    if record is Record.LINEARIZATION and not has_nodes:
        record = Record.SMOOTHER

    def integrate() -> Prediction:
        section = Section(interval.span, interval.length, moments, about)
        return collect(integrator.predict(dynamics, table, section, grid.steps, record))

    def keep_moments() -> Prediction:
        return collect(identity_prediction(dynamics, moments, record, grid.steps))

    def collect(prediction: Prediction) -> Prediction:
        return _collect_nodes(problem, interval, prediction) if has_nodes else prediction

    if grid.replicated and not is_exact:
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
    covariance = columns(steps.covariance, linearisation_indices(ssm, problem.rule))
    return prediction._replace(phi=phi, nodes=NodeRecord(Moments(steps.mean, covariance), cross))


def jump_map(ssm: StateSpaceModel, jumps: tuple[jax.Array, jax.Array], index: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return phi and process_cov (n, n) of a jump of the forces, s -> phi s + N(0, process_cov).

    Args:
        ssm: the model.
        jumps: G and Q of all jumps, from `lfm_ppl.forces.sde.Stack.jump_table`.
        index: index of the jump; -1 for none.
    """
    size = ssm.physical_dim
    return (jax.scipy.linalg.block_diag(jnp.eye(size), jumps[0][index]),
            jax.scipy.linalg.block_diag(jnp.zeros((size, size)), jumps[1][index]))


def apply_jump(prediction: Prediction, jump: tuple[Any, Any], has_map: bool) -> Prediction:
    """Return the prediction after a jump at the end of the interval; its map, too, if it has one."""
    prediction = prediction._replace(moments=transform(prediction.moments, *jump))
    if not has_map:
        return prediction
    phi, process_cov = compose((prediction.phi, prediction.process_cov), jump)
    return prediction._replace(phi=phi, process_cov=process_cov)


def apply_event(prediction: Prediction, state_map: StateMap, has_map: bool) -> Prediction:
    """Return the prediction after an event at the end of the interval; its map, too, if it has one."""
    mean, covariance = prediction.moments
    keep, mean = state_map.keep, state_map.apply(mean)
    if keep is None:
        return prediction._replace(moments=Moments(mean, covariance))
    keep_pairs = keep[:, None] * keep
    prediction = prediction._replace(moments=Moments(mean, keep_pairs * covariance))
    if not has_map:
        return prediction
    return prediction._replace(phi=keep[:, None] * prediction.phi, process_cov=keep_pairs * prediction.process_cov)


def predict_by_map(moments: Moments, phi: jax.Array, process_cov: jax.Array, point: jax.Array,
                   mean: jax.Array) -> Prediction:
    """Predict by the affine map s -> mean + phi (s - point) + N(0, process_cov)."""
    covariance = transform(moments, phi, process_cov).covariance
    return Prediction(Moments(mean + matvec(phi, moments.mean - point), covariance), phi, process_cov)
