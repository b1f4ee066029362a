"""Forces on a grid of times: the physical state as an explicit function of them, and the exact posterior density.

The dynamics must be linear in the state with constant coefficients, dx/dt = A x + p(u, t), without process noise.

1. The forces u are Gaussian: their values on the grid are u = m + L v with independent standard normal numbers v.
2. The production p is evaluated at the grid points.
3. The state at the observation times is an integral of p, which a quadrature turns into a weighted sum over the
   grid points since the previous observation (`lfm_ppl.latent_grid.quadrature_weights`).
4. The states are accumulated over the observations by the transitions e^(A (t_k - t_(k-1))).
5. log p(y | u) follows from states and forces at the observation times.

Laplace's approximation, elliptical slice sampling and Hamiltonian Monte Carlo work on this model.

Source: Lawrence, Sanguinetti and Rattray (2006), NIPS 19.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.filtering.arguments import check_observations, warn_single_precision
from lfm_ppl.filtering.transition import linear_part
from lfm_ppl.forces.sde import Force
from lfm_ppl.latent_grid.quadrature_weights import (
    cut_cells,
    map_distinct,
    matrix_integrals,
    quadrature_weights,
    scalar_integrals,
)
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import check_noise, log_density, noisy_observation
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel, check_times, state_space
from lfm_ppl.utils import checks
from lfm_ppl.utils.semidefinite import semidefinite_root

QUADRATURES = ("riemann", "trapezoid", "linear")

JITTER = 1e-10
"""Multiple of a force's largest variance that is added to the diagonal of its covariance, for a Cholesky factor."""

FEW = 64
"""Number of observations up to which they are processed together, without a scan."""


class LatentGrid(eqx.Module):
    r"""A latent force model whose forces are represented by their values on a grid.

    With s_0 < ... < s_G-1 the grid, and cell i cut to [a_i, b_i] by the observations at t_(k-1) and t_k,

        x(t_k) = e^(A (t_k - t_(k-1))) x(t_(k-1)) + sum_i int_(a_i)^(b_i) e^(A (t_k - s)) p(u(s), s) ds,

    where the integral over a cell is one of

        riemann:    (b_i - a_i) times the integrand at s_i, as in the source,
        trapezoid:  (b_i - a_i) times the mean of the integrand at a_i and b_i, where p is interpolated,
        linear:     exact for p linear in time within the cell.

    The error of the first is proportional to the width of the cells, that of the others to its square. The last stays
    accurate if a decay is fast compared with the cells.

    Args:
        model: the latent force model, with dynamics that are linear in the state with constant coefficients, any
            function of the forces, and no process noise. The initial state may be Gaussian. With an observation
            family the model may lack states and observe the forces; they are interpolated between the grid points,
            so choose a grid with points at the observation times.
        times: (T,), observation times, non-decreasing.
        points: number of equally spaced points from the initial time to the last observation, or the grid (G,),
            increasing from the initial time.
        quadrature: "riemann", "trapezoid" or "linear".

    Each observation depends on the points since the previous observation. For coupled states the weights need a matrix
    exponential for each distinct distance; their number is small if the observations lie on the grid or at regular
    distances from its points.

    Attributes:
        ssm: the model in state-space form.
        times: (T,), observation times.
        grid: (G,), times of the points.
        interpolation: (T, G), weights of the grid points in the forces at the observation times.
        weights: weights of the production at the K points that an observation needs, (M, T, K) if A is diagonal, else
            (M, M, T, K) with the index of the state first.
        transition: e^(A (t_k - t_(k-1))), its diagonal (T, M) if A is diagonal, else (T, M, M).
        transitions: (M, T, T), e^(A_j (t_k - t_l)) for l <= k, else 0, if A is diagonal and there are at most `FEW`
            observations; else None.
        mean: (R, G), prior mean of the forces.
        root: (R, G, G), lower triangular factor of their prior covariance.
        quadrature: name of the quadrature.
        first: T indices, of the first grid point that each observation needs.

    Raises:
        TypeError: ``model`` is not a latent force model.
        ValueError: the dynamics are not linear in the state with constant coefficients; there is process noise; there
            are no forces, or no states; a force jumps; the grid does not cover the data; the dynamics are not finite
            for forces within three prior standard deviations; singular observation noise; traced times.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: jnp.exp(u) - x, {"u": lfm.Matern(1.0, 2.0, order=1)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.1), lfm.Gaussian(jnp.zeros(1), jnp.zeros(1)))
        >>> grid = LatentGrid(model, jnp.arange(4.0), points=61)
        >>> grid.state(jnp.zeros((1, 61))).shape
        (4, 1)

    Source: Lawrence, Sanguinetti and Rattray (2006), NIPS 19; Hartikainen, Seppanen and Sarkka (2012), ICML,
    section 5.1.
    """

    ssm: StateSpaceModel
    times: np.ndarray
    grid: np.ndarray
    interpolation: np.ndarray
    weights: jax.Array
    transition: jax.Array
    transitions: jax.Array | None
    mean: jax.Array
    root: jax.Array
    quadrature: str = eqx.field(static=True)
    first: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, model: LatentForceModel, times: ArrayLike, points: ArrayLike = 363, quadrature: str = "linear"):
        if not isinstance(model, LatentForceModel):
            raise TypeError(f"model must be an lfm.LatentForceModel, got {type(model).__name__}.")
        warn_single_precision()
        ssm = state_space(model)
        checks.one_of("quadrature", quadrature, QUADRATURES)
        _check_model(ssm)
        concrete_times = check_times(times, model.initial_time)
        if concrete_times is None:
            raise ValueError("times must be known when the grid is built, but they are traced.")
        initial_time = float(concrete_times[0] if model.initial_time is None else model.initial_time)
        check_noise(ssm, initial_time)
        self.ssm, self.times, self.quadrature = ssm, concrete_times, quadrature
        self.grid = _build_grid(points, initial_time, self.times)
        # Interpolation is linear in the values: its matrix consists of the interpolated unit vectors.
        self.interpolation = np.stack([np.interp(self.times, self.grid, unit) for unit in np.eye(len(self.grid))],
                                      axis=1)
        jacobian = linear_part(ssm, jnp.zeros(())).jacobian[:, : ssm.physical_dim]
        cells = cut_cells(self.grid, self.times)
        self.first = tuple(cells.first.tolist())
        is_diagonal = _is_diagonal(ssm)
        rates = jnp.diagonal(jacobian)

        def transition(lengths: Any) -> jax.Array:
            if is_diagonal:
                return jnp.exp(rates * jnp.asarray(lengths)[..., None])
            return map_distinct(lambda h: matrix_integrals(jacobian, h)[0], lengths)

        def integrals(lengths: Any) -> tuple[jax.Array, jax.Array]:
            if is_diagonal:
                return scalar_integrals(rates * lengths[..., None])
            return map_distinct(lambda h: matrix_integrals(jacobian, h)[1:], lengths)

        self.weights = quadrature_weights(cells, transition, integrals, 1 if is_diagonal else 2, quadrature)
        self.transition, self.transitions = transition(np.diff(self.times, prepend=self.grid[0])), None
        if is_diagonal and len(self.times) <= FEW:
            elapsed = np.maximum(self.times[:, None] - self.times, 0.0)
            self.transitions = jnp.moveaxis(transition(elapsed), -1, 0) * np.tri(len(self.times))
        self.mean = jax.vmap(ssm.stack.mean_at)(jnp.asarray(self.grid)).T
        self.root = jnp.stack([_covariance_factor(force, self.grid) for force in ssm.stack.forces])
        _check_factor(self)
        _check_production(self)

    @property
    def force_names(self) -> tuple[str, ...]:
        """Names of the R forces."""
        return self.ssm.model.force_names

    def force(self, white: jax.Array) -> jax.Array:
        """Return forces (R, G) from independent standard normal numbers (R, G)."""
        _check_shape("white", "(R, G)", white, self.mean.shape)
        return self.mean + jnp.einsum("rij,rj->ri", self.root, white)

    def start(self, white: jax.Array) -> jax.Array:
        """Return the physical state (M,) at the initial time from independent standard normal numbers (M,)."""
        prior = self.ssm.model.initial_state
        _check_shape("white", "(M,)", white, prior.mean.shape)
        return prior.mean + semidefinite_root(prior.covariance) @ white

    def state(self, u: jax.Array, start: jax.Array | None = None) -> jax.Array:
        """Return the physical state (T, M) at the observation times.

        Args:
            u: (R, G), the forces on the grid.
            start: (M,), the state at the initial time; None: its prior mean.
        """
        initial_state = self.ssm.model.initial_state.mean if start is None else start
        _check_shape("u", "(R, G)", u, self.mean.shape)
        _check_shape("start", "(M,)", initial_state, self.ssm.model.initial_state.mean.shape)
        increments = self._increments(u)
        if self.transitions is not None:
            return jnp.einsum("jkl,lj->kj", self.transitions,
                              increments.at[0].add(self.transition[0] * initial_state))
        multiply = jnp.multiply if self.transition.ndim == 2 else jnp.matmul

        def step(x: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            transition, increment = row
            x = multiply(transition, x) + increment
            return x, x

        return jax.lax.scan(step, initial_state, (self.transition, increments))[1]

    def _increments(self, u: jax.Array) -> jax.Array:
        """Return the contribution (T, M) of the production since the previous observation to the state."""
        count, size = len(self.first), self.weights.shape[-1]
        production_at = jax.vmap(self._production, in_axes=(1, 0))
        grid = jnp.asarray(self.grid)
        if count * size > 2 * len(self.grid):
            production = jnp.moveaxis(self._window(production_at(u, grid).T), 0, -1)
        else:  # windows of a few forces are cheaper than windows of as many states
            production = jax.vmap(production_at, in_axes=(1, 0))(self._window(u), self._window(grid[None])[0])
        subscripts = "jkg,kgj->kj" if self.weights.ndim == 3 else "ijkg,kgj->ki"
        return jnp.einsum(subscripts, self.weights, production)

    def _window(self, values: jax.Array) -> jax.Array:
        """Return values (R, G) at the points that each observation needs, (R, T, K)."""
        size = self.weights.shape[-1]
        if len(self.first) > FEW:
            return values[:, np.asarray(self.first)[:, None] + np.arange(size)]
        # Slices are twice as fast as a gather, but each adds to the compilation time.
        return jnp.stack([values[:, start:start + size] for start in self.first], axis=1)

    def log_likelihood(self, u: jax.Array, y: jax.Array, start: jax.Array | None = None) -> jax.Array:
        """Return log p(y | u, start) of the entries that are present; NaN becomes -inf.

        Args:
            u: (R, G).
            y: (T, D), NaN where missing.
            start: as in `state`.
        """
        return self.log_likelihood_and_residuals(u, y, start)[0]

    def log_likelihood_and_residuals(self, u: jax.Array, y: jax.Array,
                                     start: jax.Array | None = None) -> tuple[jax.Array, jax.Array]:
        """Return log p(y | u, start) and the whitened residuals (T, D), zero where y is missing."""
        _check_shape("y", "(T, D)", y, (len(self.times), self.ssm.output_dim))
        rows = jnp.arange(len(self.times))
        value, white = jax.vmap(lambda w, t, row, y: log_density(self.ssm, w, t, row, y))(
            self._inputs(u, start), jnp.asarray(self.times), rows, y)
        total = value.sum()
        return jnp.where(jnp.isnan(total), -jnp.inf, total), white

    def observe(self, key: jax.Array, u: jax.Array, start: jax.Array | None = None) -> jax.Array:
        """Draw observations (T, D) given the forces; arguments as in `state`."""
        rows = jnp.arange(len(self.times))
        keys = jax.random.split(key, len(self.times))
        return jax.vmap(lambda w, t, k, row: noisy_observation(self.ssm, w, t, k, row))(
            self._inputs(u, start), jnp.asarray(self.times), keys, rows)

    def _inputs(self, u: jax.Array, start: jax.Array | None) -> jax.Array:
        """Return w (T, M + R) at the observation times, with zeros for the forces if no observation depends on them."""
        state = self.state(u, start)
        uses_forces = self.ssm.model.observation.varies_with_state or any(
            any(row[self.ssm.physical_dim:]) for row in self.ssm.observation_structure.jacobian)
        forces = jnp.asarray(self.interpolation) @ u.T if uses_forces else jnp.zeros((len(state), len(u)))
        return jnp.concatenate([state, forces], axis=1)

    def checked(self, y: ArrayLike) -> jax.Array:
        """Check observations (T, D), and return them as an array."""
        return check_observations(y, len(self.times), self.ssm.output_dim, model=self.ssm.model)

    def _production(self, u: jax.Array, t: jax.Array) -> jax.Array:
        """Return the production p (M,), the dynamics at state zero."""
        return self.ssm.drift(jnp.concatenate([jnp.zeros(self.ssm.physical_dim), u]), t)


def _check_shape(name: str, label: str, value: Any, expected: tuple[int, ...]) -> None:
    if np.shape(value) != expected:
        raise ValueError(f"{name} must have shape {label} = {expected}, got {np.shape(value)}.")


def _check_factor(latent: LatentGrid) -> None:
    """Raise ValueError if the Cholesky factor of a force's covariance is not finite."""
    for name, root in zip(latent.force_names, latent.root, strict=True):
        concrete = checks.concrete(root)
        if concrete is not None and not np.isfinite(concrete).all():
            raise ValueError(f"the covariance of the force {name!r} on the grid has no Cholesky factor. Use double "
                             'precision, jax.config.update("jax_enable_x64", True), or fewer points.')


def _check_model(ssm: StateSpaceModel) -> None:
    """Raise ValueError unless the state is an explicit function of the forces, as `LatentGrid` requires."""
    model = ssm.model
    if not model.state_names and not isinstance(model.observation, ObservationFamily):
        raise ValueError("the model has no physical state and observes its forces directly; use lfm.filter and "
                         "lfm.smooth.")
    if not model.force_names:
        raise ValueError("the model has no forces: there is nothing to put on a grid.")
    if model.events:
        raise ValueError("a grid of forces does not support events; use lfm.filter and lfm.smooth.")
    noise = model.process_noise
    concrete = None if callable(noise) or noise is None else checks.concrete(noise)
    if noise is not None and (concrete is None or concrete.any()):
        raise ValueError("the state is a function of the forces only without process_noise; use the particle "
                         "smoother, lfm.particle_smoother, instead.")
    varying = [name for index, name in enumerate(model.state_names)
               if index in ssm.drift_structure.nonlinear or index in ssm.drift_structure.averaged]
    if varying:
        raise ValueError(f"the dynamics must be linear in the state with constant coefficients, but their derivative "
                         f"in {', '.join(varying)} varies; use the particle smoother, lfm.particle_smoother, instead.")


def _build_grid(points: Any, initial: float, times: np.ndarray) -> np.ndarray:
    """Return the grid (G,) from a number of points, or check a given one."""
    last = float(times[-1])
    if np.ndim(points) == 0:
        checks.positive_integer("points", points)
        if points < 2 or last <= initial:
            raise ValueError(f"a grid needs at least 2 points and observations after the initial time; got "
                             f"{points} points from {initial:g} to {last:g}.")
        return np.linspace(initial, last, int(points))
    grid = np.asarray(points, float)
    if grid.ndim != 1 or grid.size < 2 or not np.isfinite(grid).all() or (np.diff(grid) <= 0).any():
        raise ValueError("points must be a number of points, or at least two finite times that increase; got shape "
                         f"{grid.shape}.")
    rounding = 1e-9 * (last - initial)
    if abs(grid[0] - initial) > rounding:
        raise ValueError(f"the grid must start at the initial time {initial:g}, but starts at {grid[0]:g}.")
    if grid[-1] < last - rounding:
        raise ValueError(f"the grid ends at {grid[-1]:g}, before the last observation at {last:g}; it has to cover "
                         "the data.")
    return grid


def _is_diagonal(ssm: StateSpaceModel) -> bool:
    """Return whether no state enters the drift of another one."""
    size = ssm.physical_dim
    pattern = np.asarray(ssm.drift_structure.jacobian, bool).reshape(size, ssm.input_dim)[:, :size]
    return not (pattern & ~np.eye(size, dtype=bool)).any()


def _covariance_factor(force: Force, grid: np.ndarray) -> jax.Array:
    """Return the Cholesky factor (G, G) of a force's covariance on the grid."""
    t, s = jnp.asarray(grid)[:, None], jnp.asarray(grid)[None, :]
    try:
        covariance = force.covariance_in_model(t, s, grid[0])
    except NotImplementedError:
        raise ValueError("a force with jumps has no covariance between arbitrary times; use the particle smoother, "
                         "lfm.particle_smoother, instead.") from None
    jitter = JITTER * jnp.max(jnp.diagonal(covariance))
    return jnp.linalg.cholesky(covariance + jitter * jnp.eye(len(grid)))


def _check_production(latent: LatentGrid) -> None:
    """Raise ValueError if the dynamics are not finite for forces within three prior standard deviations."""
    if checks.traced(latent):
        return
    sd = np.sqrt((np.asarray(latent.root) ** 2).sum(axis=2))
    for distance in (0.0, -3.0, 3.0):
        production = np.asarray(jax.vmap(latent._production)(latent.mean.T + distance * sd.T,
                                                             jnp.asarray(latent.grid)))
        is_finite = np.isfinite(production).all(axis=1)
        if not is_finite.all():
            index = int(np.flatnonzero(~is_finite)[0])
            forces = ("the forces' prior mean" if distance == 0
                      else f"{abs(distance):g} prior standard deviations from their mean")
            raise ValueError(f"the dynamics are not finite at {forces} (at t = {latent.grid[index]:g}): check the "
                             "function of the forces.")
