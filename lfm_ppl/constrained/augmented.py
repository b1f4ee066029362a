"""The observation with the constraints as further outputs, and the rows of the scan at which each is met."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.constrained.boxes import Boxes
from lfm_ppl.constrained.constraints import Constraints
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.state_space import StateSpaceModel, check_times, state_space

_SMALLEST_SHARE = 1e-9
"""Of the record: a row at equal distances that is nearer to an observation than this is at its time."""


class _Stacked(eqx.Module):
    """h(x, u, t) (D,), then c(x, u, t) (C,)."""

    observe: Any
    constraints: Constraints | Boxes

    def __call__(self, x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
        return jnp.concatenate([jnp.asarray(self.observe(x, u, t), float), self.constraints(x, u, t)])


class AugmentedObservation(GaussianObservation):
    """Measurements h and pseudo-observations of the constraints c, whose variances differ from row to row.

    Attributes:
        inner: the model's own observation.
        variances: (K, C), of the pseudo-observations.
        data_rows: (K,), row of the data whose noise covariance a row of the scan has.
    """

    inner: GaussianObservation
    variances: Any
    data_rows: Any

    def __init__(self, inner: GaussianObservation, constraints: Constraints, data_rows: Any):
        self.function = _Stacked(inner.function, constraints)
        self.covariance, self.angular, self.inner = inner.covariance, inner.angular, inner
        self.variances, self.data_rows = jnp.ones((len(data_rows), constraints.count)), data_rows

    def covariance_at(self, x: jax.Array, u: jax.Array, t: jax.Array, row: jax.Array) -> jax.Array:
        """Return the covariance (D + C, D + C): that of the measurements, and a diagonal."""
        own = self.inner.covariance_at(x, u, t, jnp.asarray(self.data_rows)[row])
        return jax.scipy.linalg.block_diag(own, jnp.diag(self.variances[row]))


class DefaultGrid(NamedTuple):
    """Where constraints hold by default: at the initial time, at the observations, and in wide gaps between them.

    Attributes:
        pieces: gaps wider than 1 / pieces of the record are cut into equal parts that are not.
        most: more times of observations than these are replaced by as many at equal distances.
    """

    pieces: int
    most: float = np.inf


FINE = DefaultGrid(200)
"""Of a trajectory or a band, which is given at these rows."""

COARSE = DefaultGrid(20, 100)
"""Of an evidence, whose cost and error grow with the rows. Both numbers are chosen without knowing a lengthscale."""


class Rows(NamedTuple):
    """The rows of the scan: times of observations and of the grid.

    Attributes:
        times: (K,), non-decreasing.
        data: (T,), row of each observation.
        grid: (G,), rows at which the constraints hold.
        data_rows: (K,), observation of each row, 0 where it has none.
    """

    times: np.ndarray
    data: np.ndarray
    grid: np.ndarray
    data_rows: np.ndarray


def rows(model: LatentForceModel, times: Any, grid: Any = None, default: DefaultGrid = FINE) -> Rows:
    """Lay out the rows of the scan.

    Args:
        model: the latent force model.
        times: (T,) observation times.
        grid: (G,) times at which the constraints hold, or how many at equal distances from the initial time to the last
            observation.
        default: what they are where no grid is given.

    Raises:
        ValueError, TypeError: times that are not known before compilation, a grid that is not an increasing vector of
            finite times at or after the initial time, or fewer than two rows.
    """
    known = check_times(times, model.initial_time)
    origin = model.initial_time if model.initial_time is not None or known is None else known[0]
    origin = None if origin is None else checks.concrete(origin)
    if known is None or origin is None:
        raise ValueError("times and the model's initial_time must be known before compilation; pass NumPy arrays.")
    if grid is None:
        wanted = _default_grid(known, float(origin), default)
    elif is_count(grid):
        wanted = _spread(known, float(origin), int(grid))
    else:
        wanted = checks.time_vector("grid", grid, float(origin), "increasing")
    extra = np.setdiff1d(wanted, known)
    every = np.concatenate([known, extra])
    order = np.argsort(every, kind="stable")
    position = np.empty(len(every), int)
    position[order] = np.arange(len(every))
    every = every[order]
    data = position[: len(known)]
    # Of several observations at one time the last has the constraint.
    held = np.searchsorted(every, wanted, side="right") - 1
    data_rows = np.zeros(len(every), int)
    data_rows[data] = np.arange(len(known))
    return Rows(every, data, held, data_rows)


def with_times(laid_out: Rows, at: np.ndarray) -> Rows:
    """Return the rows with further ones at times (L,) that are not among them; nothing is observed or held there."""
    extra = np.setdiff1d(at, laid_out.times)
    every = np.concatenate([laid_out.times, extra])
    order = np.argsort(every, kind="stable")
    position = np.empty(len(every), int)
    position[order] = np.arange(len(every))
    data = position[laid_out.data]
    data_rows = np.zeros(len(every), int)
    data_rows[data] = np.arange(len(data))
    return Rows(every[order], data, position[laid_out.grid], data_rows)


def is_count(grid: Any) -> bool:
    """Whether a grid is given as a number of rows.

    Raises:
        ValueError, TypeError: they are fewer than two, or a single number that is not whole.
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


def _spread(times: np.ndarray, origin: float, count: int) -> np.ndarray:
    """Return ``count`` times at equal distances; no time lies next to one of an observation."""
    nodes = np.unique(np.append(times, origin))
    wanted = np.linspace(nodes[0], nodes[-1], count)
    after = np.clip(np.searchsorted(nodes, wanted), 1, len(nodes) - 1) if len(nodes) > 1 else np.zeros(count, int)
    before = np.maximum(after - 1, 0)
    nearest = np.where(wanted - nodes[before] <= nodes[after] - wanted, nodes[before], nodes[after])
    return np.unique(np.where(np.abs(wanted - nearest) <= _SMALLEST_SHARE * (nodes[-1] - nodes[0]), nearest, wanted))


def _default_grid(times: np.ndarray, origin: float, default: DefaultGrid) -> np.ndarray:
    nodes = np.unique(np.append(times, origin))
    if len(nodes) > default.most:
        return _spread(times, origin, int(default.most))
    longest = (nodes[-1] - nodes[0]) / default.pieces
    if longest == 0:
        return nodes
    pieces = np.maximum(1, np.ceil(np.diff(nodes) / longest * (1 - 1e-9))).astype(int)
    inside = [begin + (end - begin) * np.arange(count) / count
              for begin, end, count in zip(nodes[:-1], nodes[1:], pieces, strict=True)]
    return np.concatenate([*inside, nodes[-1:]])


def augmented(model: LatentForceModel, constraints: Constraints, laid_out: Rows) -> StateSpaceModel:
    """Return the state-space model whose observation has the constraints as further outputs."""
    own = model.observation
    assert isinstance(own, GaussianObservation)
    return _observed_by(model, AugmentedObservation(own, constraints, laid_out.data_rows), constraints)


def stacked_model(model: LatentForceModel, constraints: Constraints | Boxes) -> StateSpaceModel:
    """Return the same with outputs (h, c) without noise, which sites observe."""
    noise = jnp.zeros(len(model.output_names) + constraints.count)
    function = _Stacked(model.observation.function, constraints)
    return _observed_by(model, GaussianObservation(function, noise), constraints)


def _observed_by(model: LatentForceModel, observation: GaussianObservation,
                 constraints: Constraints | Boxes) -> StateSpaceModel:
    return state_space(LatentForceModel(
        model.dynamics, tuple(model.forces.items()), observation, model.initial_state, model.process_noise,
        model.initial_time, model.nonlinear_inputs, model.state_names, (*model.output_names, *constraints.labels),
        model.units))


def with_rows(y: jax.Array, targets: jax.Array, laid_out: Rows) -> jax.Array:
    """Return the augmented observations (K, D + C), NaN where a row has none.

    Args:
        y: (T, D).
        targets: (G, C), of the constraints.
        laid_out: the rows.
    """
    count = len(laid_out.times)
    measured = jnp.full((count, y.shape[1]), jnp.nan).at[laid_out.data].set(y)
    return jnp.concatenate([measured, jnp.full((count, targets.shape[1]), jnp.nan).at[laid_out.grid].set(targets)], 1)
