"""Observations with the constraints as further outputs, and the rows of the scan.

1. `build_rows`: merge the observation times with the grid of times at which the constraints hold; each row of the scan
   may hold an observation, a constraint, or both. `add_times` adds rows with neither.
2. `augmented_model`: outputs (h, c) with Gaussian noise, for interior points. Each Newton step observes the constraints
   c by pseudo-observations whose variances differ from row to row; `augmented_observations` stacks them with the data.
3. `stacked_model`: outputs (h, c) without noise, for expectation propagation, whose factors observe them.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.constrained.boxes import Boxes
from lfm_ppl.constrained.constraints import Constraints
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.state_space import StateSpaceModel, check_times, state_space
from lfm_ppl.utils import checks

_TIME_TOLERANCE = 1e-9
"""Share of the record's length below which the distance of a grid time from an observation counts as rounding."""


class StackedOutputs(eqx.Module):
    """Observation function h(x, u, t) (D,) stacked with constraints c(x, u, t) (C,)."""

    observe: Any
    constraints: Constraints | Boxes

    def __call__(self, x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
        """Return (h, c), (D + C,)."""
        return jnp.concatenate([jnp.asarray(self.observe(x, u, t), float), self.constraints(x, u, t)])


class AugmentedObservation(GaussianObservation):
    """Measurements h and pseudo-observations of the constraints c, whose variances differ from row to row.

    Attributes:
        inner: observation of the model.
        variances: (K, C), variances of the pseudo-observations.
        data_rows: (K,), index of the observation whose noise covariance a row of the scan has.
    """

    inner: GaussianObservation
    variances: Any
    data_rows: Any

    def __init__(self, inner: GaussianObservation, constraints: Constraints, data_rows: Any):
        self.function = StackedOutputs(inner.function, constraints)
        self.covariance, self.angular, self.period = inner.covariance, inner.angular, inner.period
        self.inner = inner
        self.variances, self.data_rows = jnp.ones((len(data_rows), constraints.count)), data_rows

    def covariance_at(self, x: jax.Array, u: jax.Array, t: jax.Array, row: jax.Array) -> jax.Array:
        """Return the block-diagonal covariance (D + C, D + C) of measurements and pseudo-observations."""
        measurement_cov = self.inner.covariance_at(x, u, t, jnp.asarray(self.data_rows)[row])
        return jax.scipy.linalg.block_diag(measurement_cov, jnp.diag(self.variances[row]))


@dataclasses.dataclass(frozen=True)
class DefaultGrid:
    """Default times of the constraints: the initial time, the observation times, and more times in wide gaps.

    Attributes:
        gaps_per_record: gaps wider than the record's length over this number are divided equally.
        max_times: if there are more observation times, as many times at equal distances replace them.
    """

    gaps_per_record: int
    max_times: float = np.inf


FINE = DefaultGrid(200)
"""For trajectories and bands, which are returned at these times."""

COARSE = DefaultGrid(20, 100)
"""For evidences, whose cost and error grow with the number of times. The numbers do not depend on a lengthscale."""


class Rows(NamedTuple):
    """Rows of the scan, at the times of observations and of the grid.

    Attributes:
        times: (K,), non-decreasing.
        data: (T,), row of each observation.
        grid: (G,), rows at which the constraints hold.
        data_rows: (K,), index of the observation of each row, 0 for a row without one.
    """

    times: np.ndarray
    data: np.ndarray
    grid: np.ndarray
    data_rows: np.ndarray


def build_rows(model: LatentForceModel, times: Any, grid: Any = None, default: DefaultGrid = FINE) -> Rows:
    """Return the rows of the scan.

    Args:
        model: the latent force model.
        times: (T,) observation times.
        grid: (G,) times at which the constraints hold, or their number, at equal distances from the initial time to the
            last observation.
        default: rule for these times if ``grid`` is None.

    Raises:
        ValueError, TypeError: times that are not known before compilation, a grid that is not an increasing vector of
            finite times at or after the initial time, or fewer than two rows.
    """
    data_times = check_times(times, model.initial_time)
    initial_time = model.initial_time if model.initial_time is not None or data_times is None else data_times[0]
    initial_time = None if initial_time is None else checks.concrete(initial_time)
    if data_times is None or initial_time is None:
        raise ValueError("times and the model's initial_time must be known before compilation; pass NumPy arrays.")
    if grid is None:
        grid_times = _default_times(data_times, float(initial_time), default)
    elif is_count(grid):
        grid_times = _equidistant_times(data_times, float(initial_time), int(grid))
    else:
        grid_times = checks.time_vector("grid", grid, float(initial_time), "increasing")
    row_times, position = _merge(data_times, np.setdiff1d(grid_times, data_times))
    data = position[: len(data_times)]
    # Of several observations at one time, the row of the last one has the constraint.
    constrained = np.searchsorted(row_times, grid_times, side="right") - 1
    return Rows(row_times, data, constrained, _data_of_rows(data, len(row_times)))


def add_times(rows: Rows, times: np.ndarray) -> Rows:
    """Return the rows with new ones at times (L,) that are not among them, without observations and constraints."""
    row_times, position = _merge(rows.times, np.setdiff1d(times, rows.times))
    data = position[rows.data]
    return Rows(row_times, data, position[rows.grid], _data_of_rows(data, len(row_times)))


def _merge(times: np.ndarray, new_times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all times in order, and the position of each of (times, new_times) among them."""
    all_times = np.concatenate([times, new_times])
    order = np.argsort(all_times, kind="stable")
    position = np.empty(len(all_times), int)
    position[order] = np.arange(len(all_times))
    return all_times[order], position


def _data_of_rows(data: np.ndarray, count: int) -> np.ndarray:
    """Return the index of the observation of each of ``count`` rows, 0 for a row without one."""
    data_rows = np.zeros(count, int)
    data_rows[data] = np.arange(len(data))
    return data_rows


def is_count(grid: Any) -> bool:
    """Return whether a grid is given as a number of rows.

    Raises:
        ValueError, TypeError: fewer than two rows, or a single number that is not an integer.
    """
    if np.ndim(grid):
        return False
    if not isinstance(grid, (bool, int, np.integer)):
        raise TypeError(f"grid must be times, shape (G,), or a whole number of rows; got {grid!r}. One time is "
                        f"[{grid}].")
    checks.positive_integer("grid", grid, "Give times, or a number of rows.")
    if grid < 2:
        raise ValueError("grid must be at least 2 rows, the first and the last of the record, or the times at which "
                         f"the constraints hold; got {grid}.")
    return True


def _equidistant_times(times: np.ndarray, initial_time: float, count: int) -> np.ndarray:
    """Return ``count`` times at equal distances; a time that rounding separates from an observation is moved to it."""
    nodes = np.unique(np.append(times, initial_time))
    grid = np.linspace(nodes[0], nodes[-1], count)
    upper = np.clip(np.searchsorted(nodes, grid), 1, len(nodes) - 1) if len(nodes) > 1 else np.zeros(count, int)
    lower = np.maximum(upper - 1, 0)
    nearest = np.where(grid - nodes[lower] <= nodes[upper] - grid, nodes[lower], nodes[upper])
    is_same_time = np.abs(grid - nearest) <= _TIME_TOLERANCE * (nodes[-1] - nodes[0])
    return np.unique(np.where(is_same_time, nearest, grid))


def _default_times(times: np.ndarray, initial_time: float, default: DefaultGrid) -> np.ndarray:
    """Return the times at which the constraints hold by default."""
    nodes = np.unique(np.append(times, initial_time))
    if len(nodes) > default.max_times:
        return _equidistant_times(times, initial_time, int(default.max_times))
    longest = (nodes[-1] - nodes[0]) / default.gaps_per_record
    if longest == 0:
        return nodes
    counts = np.maximum(1, np.ceil(np.diff(nodes) / longest * (1 - 1e-9))).astype(int)
    divided = [start + (end - start) * np.arange(count) / count
               for start, end, count in zip(nodes[:-1], nodes[1:], counts, strict=True)]
    return np.concatenate([*divided, nodes[-1:]])


def augmented_model(model: LatentForceModel, constraints: Constraints, rows: Rows) -> StateSpaceModel:
    """Return the state-space model whose observation has the constraints as further outputs, with noise."""
    assert isinstance(model.observation, GaussianObservation)
    observation = AugmentedObservation(model.observation, constraints, rows.data_rows)
    return _replace_observation(model, observation, constraints)


def stacked_model(model: LatentForceModel, constraints: Constraints | Boxes) -> StateSpaceModel:
    """Return the state-space model with outputs (h, c) without noise, for factors."""
    noise = jnp.zeros(len(model.output_names) + constraints.count)
    function = StackedOutputs(model.observation.function, constraints)
    return _replace_observation(model, GaussianObservation(function, covariance=noise), constraints)


def _replace_observation(model: LatentForceModel, observation: GaussianObservation,
                         constraints: Constraints | Boxes) -> StateSpaceModel:
    return state_space(LatentForceModel(
        model.dynamics, tuple(model.forces.items()), observation, model.initial_state, model.process_noise,
        model.initial_time, model.nonlinear_inputs, model.state_names, (*model.output_names, *constraints.labels),
        model.units, events=model.events))


def augmented_observations(y: jax.Array, targets: jax.Array, rows: Rows) -> jax.Array:
    """Return the augmented observations (K, D + C), NaN for an entry that a row does not have.

    Args:
        y: (T, D).
        targets: (G, C), pseudo-observations of the constraints.
        rows: rows of the scan.
    """
    count = len(rows.times)
    measured = jnp.full((count, y.shape[1]), jnp.nan).at[rows.data].set(y)
    return jnp.concatenate([measured, jnp.full((count, targets.shape[1]), jnp.nan).at[rows.grid].set(targets)], 1)
