"""The forces on a grid of times: the physical state as an explicit function of them, and the exact posterior's density.

Where the dynamics are linear in the state with constant coefficients, dx/dt = A x + p(u, t), the state follows from
the forces by an integral, and the integral from their values on a grid by a rule. That is the model on which Laplace's
approximation, elliptical slice sampling and Hamiltonian Monte Carlo over the force itself work.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.filter import check_observations, warn_single_precision
from lfm_ppl.filtering.transition import linear_part
from lfm_ppl.forces.sde import Force
from lfm_ppl.linalg import semidefinite_root
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import check_noise, log_density, noisy_observation
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel, check_times, state_space

RULES = ("riemann", "trapezoid", "linear")

JITTER = 1e-10
"""Share of a force's variance that is added to the diagonal of its covariance on the grid, so that it has a factor."""


FEW = 64
"""Observations up to which each is treated by itself, without a loop over them."""


class LatentGrid(eqx.Module):
    r"""A latent force model whose forces are their values on a grid.

    With s_0 < ... < s_G-1 the grid, and cell i cut to [a_i, b_i] by the observations at t_(k-1) and t_k,

        x(t_k) = e^(A (t_k - t_(k-1))) x(t_(k-1)) + sum_i int_(a_i)^(b_i) e^(A (t_k - s)) p(u(s), s) ds,

    where the integral over a cell is one of

        riemann:    (b_i - a_i) times the integrand at s_i, as in the source,
        trapezoid:  (b_i - a_i) times the mean of the integrand at a_i and b_i, where p is interpolated,
        linear:     exact for p linear in time within the cell.

    The first has an error of the order of the cells' width, the others of its square; the last stays accurate where a
    decay is fast compared with the cells.

    Args:
        model: the latent force model: dynamics linear in the state with constant coefficients, any use of the forces,
            no process noise. A Gaussian initial state is legal; of an observation family there need be no state, where
            the forces are what is observed: between the points they are interpolated, so put the observations on these.
        times: (T,) of the observations, non-decreasing.
        points: number of equally spaced points from the initial time to the last observation, or the grid itself (G,),
            increasing, which starts at the initial time.
        rule: "riemann", "trapezoid" or "linear".

    Each observation needs the points since the one before it only. Where the states are coupled their weights take a
    matrix exponential for each distinct distance: few if the observations lie on the grid or regularly beside it.

    Attributes:
        ssm: the model in state-space form.
        times: (T,).
        grid: (G,).
        interpolation: (T, G), the forces at the observation times as combinations of those on the grid.
        weights: (M, T, K) of p_j at the K points that an observation needs, where A is diagonal; else (M, M, T, K), the
            first index for the state.
        transition: e^(A (t_k - t_(k-1))), its diagonal (T, M) where A is diagonal, else (T, M, M).
        transitions: (M, T, T), e^(A_j (t_k - t_l)) for l <= k, else 0, where A is diagonal and the observations are
            few; else None.
        mean: (R, G), the forces' prior mean.
        root: (R, G, G), lower triangular factor of their prior covariance.
        rule: as given.
        first: T numbers, each the first of the points that an observation needs.

    Raises:
        TypeError: ``model`` is something else.
        ValueError: the dynamics are not linear in the state with constant coefficients; there is process noise; there
            are no forces, or no states; a force jumps; the grid does not cover the data; the dynamics are not finite
            at ordinary forces; observation noise without a density; traced times.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: jnp.exp(u) - x, {"u": lfm.Matern(1.0, 2.0, order=1)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])), lfm.Gaussian(jnp.zeros(1), jnp.zeros(1)))
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
    rule: str = eqx.field(static=True)
    first: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, model: LatentForceModel, times: Any, points: Any = 363, rule: str = "linear"):
        if not isinstance(model, LatentForceModel):
            raise TypeError(f"model must be an lfm.LatentForceModel, got {type(model).__name__}.")
        warn_single_precision()
        ssm = state_space(model)
        checks.one_of("rule", rule, RULES)
        _check_model(ssm)
        known = check_times(times, model.initial_time)
        if known is None:
            raise ValueError("times must be known when the grid is built, but they are traced.")
        initial = float(known[0] if model.initial_time is None else model.initial_time)
        check_noise(ssm, initial)
        self.ssm, self.times, self.rule = ssm, known, rule
        self.grid = _grid(points, initial, known)
        self.interpolation = np.stack([np.interp(known, self.grid, one) for one in np.eye(len(self.grid))], axis=1)
        decay = linear_part(ssm, jnp.zeros(())).jacobian[:, : ssm.physical_dim]
        first, pieces = _pieces(self.grid, known)
        self.first = tuple(first.tolist())
        gaps = np.diff(known, prepend=self.grid[0])
        if _diagonal(ssm):
            rates = jnp.diagonal(decay)
            transition = lambda lengths: jnp.exp(rates * jnp.asarray(lengths)[..., None])  # noqa: E731
            self.weights = _weights(pieces, transition, lambda h: _integrals(rates * h[..., None]), 1, rule)
            self.transition, self.transitions = transition(gaps), None
            if len(known) <= FEW:
                elapsed = np.maximum(known[:, None] - known, 0.0)
                self.transitions = jnp.moveaxis(transition(elapsed), -1, 0) * np.tri(len(known))
        else:
            transition = lambda lengths: _distinct(lambda h: _transition(decay, h)[0], lengths)  # noqa: E731
            integrals = lambda lengths: _distinct(lambda h: _transition(decay, h)[1:], lengths)  # noqa: E731
            self.weights = _weights(pieces, transition, integrals, 2, rule)
            self.transition, self.transitions = transition(gaps), None
        self.mean = jax.vmap(ssm.stack.mean_at)(jnp.asarray(self.grid)).T
        self.root = jnp.stack([_root(force, self.grid) for force in ssm.stack.forces])
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
        first = self.ssm.model.initial_state.mean if start is None else start
        _check_shape("u", "(R, G)", u, self.mean.shape)
        _check_shape("start", "(M,)", first, self.ssm.model.initial_state.mean.shape)
        gained = self._gained(u)
        if self.transitions is not None:
            return jnp.einsum("jkl,lj->kj", self.transitions, gained.at[0].add(self.transition[0] * first))
        after = jnp.multiply if self.transition.ndim == 2 else jnp.matmul
        return jax.lax.scan(lambda x, row: (after(row[0], x) + row[1],) * 2, first, (self.transition, gained))[1]

    def _gained(self, u: jax.Array) -> jax.Array:
        """Return what the production since the observation before adds to the state (T, M)."""
        count, size = len(self.first), self.weights.shape[-1]
        at_times = jax.vmap(self._production, in_axes=(1, 0))
        grid = jnp.asarray(self.grid)
        if count * size > 2 * len(self.grid):
            made = jnp.moveaxis(self._window(at_times(u, grid).T), 0, -1)
        else:  # a few forces cost less to cut out than as many states
            made = jax.vmap(at_times, in_axes=(1, 0))(self._window(u), self._window(grid[None])[0])
        kind = "jkg,kgj->kj" if self.weights.ndim == 3 else "ijkg,kgj->ki"
        return jnp.einsum(kind, self.weights, made)

    def _window(self, values: jax.Array) -> jax.Array:
        """Return values (R, G) at the points that each observation needs, (R, T, K)."""
        size = self.weights.shape[-1]
        if len(self.first) > FEW:
            return values[:, np.asarray(self.first)[:, None] + np.arange(size)]
        # Slices are copied twice as fast as elements that are gathered, but each takes its time to compile.
        return jnp.stack([values[:, start:start + size] for start in self.first], axis=1)

    def log_likelihood(self, u: jax.Array, y: jax.Array, start: jax.Array | None = None) -> jax.Array:
        """Return log p(y | u, start); missing entries are left out, and what is not finite counts as impossible.

        Args:
            u: (R, G).
            y: (T, D), NaN where missing.
            start: as in `state`.
        """
        return self.scored(u, y, start)[0]

    def scored(self, u: jax.Array, y: jax.Array, start: jax.Array | None = None) -> tuple[jax.Array, jax.Array]:
        """Return log p(y | u, start) and the residuals (T, D) in units of the noise, zero where y is missing."""
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
        """Return w (T, M + R) at the observation times; the forces are zero where no observation asks for them."""
        state = self.state(u, start)
        uses_forces = self.ssm.model.observation.varies_with_state or any(
            any(row[self.ssm.physical_dim:]) for row in self.ssm.observation_structure.jacobian)
        forces = jnp.asarray(self.interpolation) @ u.T if uses_forces else jnp.zeros((len(state), len(u)))
        return jnp.concatenate([state, forces], axis=1)

    def checked(self, y: Any) -> jax.Array:
        """Check observations (T, D), and return them as an array."""
        return check_observations(y, len(self.times), self.ssm.output_dim, model=self.ssm.model)

    def _production(self, u: jax.Array, t: jax.Array) -> jax.Array:
        """Return p (M,): the dynamics without the state."""
        return self.ssm.drift(jnp.concatenate([jnp.zeros(self.ssm.physical_dim), u]), t)


def _check_shape(name: str, what: str, value: Any, expected: tuple[int, ...]) -> None:
    if np.shape(value) != expected:
        raise ValueError(f"{name} must have shape {what} = {expected}, got {np.shape(value)}.")


def _check_factor(latent: LatentGrid) -> None:
    for name, root in zip(latent.force_names, latent.root, strict=True):
        known = checks.concrete(root)
        if known is not None and not np.isfinite(known).all():
            raise ValueError(f"the covariance of the force {name!r} on the grid has no Cholesky factor. Use double "
                             'precision, jax.config.update("jax_enable_x64", True), or fewer points.')


def _check_model(ssm: StateSpaceModel) -> None:
    model = ssm.model
    if not model.state_names and not isinstance(model.observation, ObservationFamily):
        raise ValueError("the model has no physical state; its forces are what is observed, so that lfm.filter and "
                         "lfm.smooth serve it.")
    if not model.force_names:
        raise ValueError("the model has no forces: there is nothing to put on a grid.")
    noise = model.process_noise
    known = None if callable(noise) or noise is None else checks.concrete(noise)
    if noise is not None and (known is None or known.any()):
        raise ValueError("the state is a function of the forces only without process_noise; use the particle "
                         "smoother, lfm.particle_smoother, instead.")
    varying = [name for index, name in enumerate(model.state_names)
               if index in ssm.drift_structure.points or index in ssm.drift_structure.averaged]
    if varying:
        raise ValueError(f"the dynamics must be linear in the state with constant coefficients, but their derivative "
                         f"in {', '.join(varying)} varies; use the particle smoother, lfm.particle_smoother, instead.")


def _grid(points: Any, initial: float, times: np.ndarray) -> np.ndarray:
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
    slack = 1e-9 * (last - initial)
    if abs(grid[0] - initial) > slack:
        raise ValueError(f"the grid must start at the initial time {initial:g}, but starts at {grid[0]:g}.")
    if grid[-1] < last - slack:
        raise ValueError(f"the grid ends at {grid[-1]:g}, before the last observation at {last:g}; it has to cover "
                         "the data.")
    return grid


def _diagonal(ssm: StateSpaceModel) -> bool:
    size = ssm.physical_dim
    pattern = np.asarray(ssm.drift_structure.jacobian, bool).reshape(size, ssm.input_dim)[:, :size]
    return not (pattern & ~np.eye(size, dtype=bool)).any()


class _Pieces(NamedTuple):
    """Cells as the observations cut them, (T, C): those that observation k needs, with [a, b] in (t_(k-1), t_k].

    Attributes:
        length: b - a, zero for a cell that has no part in it.
        left, right: a and b as shares of the cell, from its first point on.
        since_point: t_k - s_i, at least 0.
        since_left, since_right: t_k - a and t_k - b.
    """

    length: np.ndarray
    left: np.ndarray
    right: np.ndarray
    since_point: np.ndarray
    since_left: np.ndarray
    since_right: np.ndarray


def _pieces(grid: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, _Pieces]:
    """Return the first point that each observation needs (T,), and the cells from there on."""
    before = np.concatenate([grid[:1], times[:-1]])
    cells = len(grid) - 1
    first = np.clip(np.searchsorted(grid, before, side="right") - 1, 0, cells - 1)
    last = np.clip(np.searchsorted(grid, times, side="left") - 1, first, cells - 1)
    count = int((last - first).max()) + 1
    first = np.minimum(first, cells - count)
    cell = first[:, None] + np.arange(count)
    start, end, t = grid[cell], grid[cell + 1], times[:, None]
    a, b = np.clip(start, before[:, None], t), np.clip(end, before[:, None], t)
    wide = end - start
    since = np.maximum(t - start, 0.0)
    return first, _Pieces(b - a, (a - start) / wide, (b - start) / wide, since, t - a, t - b)


def _weights(pieces: _Pieces, transition: Callable, integrals: Callable, rank: int, rule: str) -> jax.Array:
    """Return the weights of the points, (M, T, C + 1) or (M, M, T, C + 1), from functions of arrays of lengths.

    Args:
        pieces: the cells.
        transition: e^(A h).
        integrals: 1/h int_0^h e^(A (h - s)) ds and 1/h int_0^h e^(A (h - s)) s/h ds.
        rank: of a transition: 1 for the diagonal of one, 2 for a matrix.
        rule: of integration.
    """
    def of(a: np.ndarray) -> jax.Array:
        return jnp.asarray(a).reshape(*a.shape, *[1] * rank)

    after = jnp.multiply if rank == 1 else jnp.matmul
    length = of(pieces.length)
    if rule == "riemann":
        at_point, at_next = length * transition(pieces.since_point), jnp.zeros(())
    else:
        if rule == "trapezoid":
            at_left = 0.5 * length * transition(pieces.since_left)
            at_right = 0.5 * length * transition(pieces.since_right)
        else:
            whole, rising = integrals(pieces.length)
            back = transition(pieces.since_right)
            at_left, at_right = length * after(back, whole - rising), length * after(back, rising)
        at_next = of(pieces.left) * at_left + of(pieces.right) * at_right
        at_point = at_left + at_right - at_next
    width = [(0, 0)] * at_point.ndim
    width[1] = (0, 1)
    weights = jnp.pad(at_point, width)
    return jnp.moveaxis(weights.at[:, 1:].add(at_next), (0, 1), (-2, -1))


def _integrals(z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return (e^z - 1)/z and (e^z - 1 - z)/z^2, by their series near zero."""
    near = jnp.abs(z) < 0.5
    safe = jnp.where(near, 1.0, z)
    small = jnp.where(near, z, 0.0)
    second = jnp.ones_like(z)
    for order in range(15, 2, -1):
        second = 1.0 + small * second / order
    second = 0.5 * second
    far = (jnp.expm1(safe) - safe) / safe**2
    second = jnp.where(near, second, far)
    return 1.0 + z * second, second


def _transition(jacobian: jax.Array, length: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return e^(A h), 1/h int_0^h e^(A (h - s)) ds and 1/h int_0^h e^(A (h - s)) s/h ds, from one exponential."""
    size = jacobian.shape[0]
    eye, zero = jnp.eye(size), jnp.zeros((size, size))
    block = jnp.block([[jacobian * length, eye, zero], [zero, zero, eye], [zero, zero, zero]])
    found = jax.scipy.linalg.expm(block)
    return found[:size, :size], found[:size, size:2 * size], found[:size, 2 * size:]


def _distinct(function: Any, lengths: np.ndarray) -> Any:
    """Return ``function`` of every length, computed once for lengths that are equal up to rounding."""
    scale = max(float(np.max(lengths, initial=0.0)), np.finfo(float).tiny)
    _, first, inverse = np.unique(np.round(lengths / scale, 12), return_index=True, return_inverse=True)
    found = jax.vmap(function)(jnp.asarray(np.ravel(lengths)[first]))
    return jax.tree_util.tree_map(lambda a: a[inverse.reshape(np.shape(lengths))], found)


def _root(force: Force, grid: np.ndarray) -> jax.Array:
    t, s = jnp.asarray(grid)[:, None], jnp.asarray(grid)[None, :]
    try:
        covariance = force.covariance_in_model(t, s, grid[0])
    except NotImplementedError:
        raise ValueError("a force with jumps has no covariance between arbitrary times; use the particle smoother, "
                         "lfm.particle_smoother, instead.") from None
    jitter = JITTER * jnp.max(jnp.diagonal(covariance))
    return jnp.linalg.cholesky(covariance + jitter * jnp.eye(len(grid)))


def _check_production(latent: LatentGrid) -> None:
    """Raise where the dynamics are not finite at forces that the prior deems ordinary."""
    if checks.traced(latent):
        return
    sd = np.sqrt((np.asarray(latent.root) ** 2).sum(axis=2))
    for sign in (0.0, -3.0, 3.0):
        made = np.asarray(jax.vmap(latent._production)(latent.mean.T + sign * sd.T, jnp.asarray(latent.grid)))
        if not np.isfinite(made).all():
            where = int(np.flatnonzero(~np.isfinite(made).all(axis=1))[0])
            what = "the forces' prior mean" if sign == 0 else f"{abs(sign):g} prior standard deviations from their mean"
            raise ValueError(f"the dynamics are not finite at {what} (at t = {latent.grid[where]:g}): check the "
                             "function of the forces.")
