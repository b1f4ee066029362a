"""The posterior under constraints: expectation propagation with truncated normal factors.

1. Combine the constraints into boxes 0 <= c <= width, and lay out rows of observations and constraints.
2. Run expectation propagation with one factor for each box and row of the grid (`lfm_ppl.constrained.evidence`).
3. A backward pass gives the posterior moments. The cavity of a box, truncated to the box, gives intervals that respect
   the bounds.
4. Draws are chosen by their weights among trajectories that respect all constraints
   (`lfm_ppl.constrained.feasible_paths`).

Source: Minka (2001), Expectation propagation for approximate Bayesian inference; Cunningham, Hennig and
Lacoste-Julien (2011), Gaussian probabilities and expectation propagation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from numpy.typing import ArrayLike

from lfm_ppl.constrained.augmented import build_rows, stacked_model
from lfm_ppl.constrained.boxes import Boxes, build_boxes
from lfm_ppl.constrained.constraints import build_constraints
from lfm_ppl.constrained.evidence import TruncatedPosterior, check_variances
from lfm_ppl.constrained.full_information import check_settings
from lfm_ppl.constrained.truncated import quantile
from lfm_ppl.filtering.arguments import as_rule, check_observations, warn_single_precision
from lfm_ppl.filtering.backward import backward
from lfm_ppl.filtering.ep.quadrature import MeanVariance
from lfm_ppl.filtering.ep.settings import FactorSettings
from lfm_ppl.filtering.forward import FilterTrace
from lfm_ppl.filtering.moments import Record
from lfm_ppl.filtering.problem import at_intervals
from lfm_ppl.filtering.smoother import MeanSd, Trajectories, moments_by_name
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import congruence, diagonal, matmul, safe_sqrt
from lfm_ppl.utils.programs import shared_jit

_CANDIDATES = 32
"""Number of weighted trajectories from which one draw is chosen."""

_BATCH = 64
"""Number of draws that are computed at a time."""


class ConstrainedPosterior(eqx.Module):
    """Result of `constrained_posterior`.

    Attributes:
        times: (K,), times at which the constraints hold.
        state_mean, state_sd: (K, M), moments of the physical state.
        force_mean, force_sd: (K, R), moments of the forces.
        sweeps: number of passes of expectation propagation.
        converged: whether the factors have converged.
    """

    times: jax.Array
    state_mean: jax.Array
    state_sd: jax.Array
    force_mean: jax.Array
    force_sd: jax.Array
    sweeps: jax.Array
    converged: jax.Array
    _cavity: MeanVariance
    _boxes: Boxes
    _posterior: TruncatedPosterior
    _proposal: FilterTrace
    state_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)

    def state(self, name: str) -> MeanSd:
        """Return mean (K,) and sd (K,) of a physical state.

        Raises:
            ValueError: an unknown name; the message lists similar names.
        """
        return moments_by_name("state", name, self.state_names, self.state_mean, self.state_sd)

    def force(self, name: str) -> MeanSd:
        """Return mean (K,) and sd (K,) of a force."""
        return moments_by_name("force", name, self.force_names, self.force_mean, self.force_sd)

    def interval(self, name: str, level: float = 0.95) -> tuple[jax.Array, jax.Array]:
        """Return the ends (K,), (K,) of the central interval of a state or force.

        The distribution of a bounded quantity is a truncated normal distribution, whose intervals respect the bounds.

        Raises:
            ValueError: an unknown name, or a level outside of (0, 1).
        """
        names = (*self.state_names, *self.force_names)
        checks.one_of("name", name, names)
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level!r}.")
        index = names.index(name)
        probabilities = 0.5 * (1.0 - level), 0.5 * (1.0 + level)
        box = self._boxes.box_of(index)
        if box is None:
            mean, sd = (jnp.concatenate(pair, axis=1)[:, index] for pair in (
                (self.state_mean, self.force_mean), (self.state_sd, self.force_sd)))
            low, high = (mean + sd * norm.ppf(probability) for probability in probabilities)
            return low, high
        entry, direction, bound = box
        cavity = MeanVariance(*(a[:, entry] for a in self._cavity))
        low, high = (quantile(cavity, self._boxes.widths[entry], probability) for probability in probabilities)
        return (bound + low, bound + high) if direction > 0 else (bound - high, bound - low)

    def sample(self, key: jax.Array, draws: int = 1) -> Trajectories:
        """Draw trajectories that respect all constraints.

        Each draw is chosen by its weight among 32 trajectories of `lfm_ppl.constrained.feasible_paths`. For a linear
        model the draws follow the truncated posterior, not a Gaussian approximation, as far as 32 weighted trajectories
        represent it.

        Args:
            key: a JAX random key.
            draws: number of trajectories.

        Returns:
            State (draws, K, M) and forces (draws, K) at the times of the grid.
        """
        checks.positive_integer("draws", draws)
        inputs = _sample_inputs(self._posterior, self._proposal, key, draws)[:, jnp.asarray(self._posterior.rows.grid)]
        size = len(self.state_names)
        forces = {name: inputs[:, :, size + i] for i, name in enumerate(self.force_names)}
        return Trajectories(self.times, inputs[:, :, :size], forces)


@shared_jit
def _sample_inputs(posterior: TruncatedPosterior, proposal: FilterTrace, key: jax.Array, draws: int) -> jax.Array:
    """Return trajectories (draws, K, M + R) of (x, u) at the rows of the scan."""
    batch = min(draws, _BATCH)

    def sample_batch(key: jax.Array) -> jax.Array:
        return jnp.moveaxis(posterior.sample_trajectories(key, proposal, batch, _CANDIDATES), -1, 0)

    keys = jax.random.split(key, -(-draws // batch))
    trajectories = jax.lax.map(sample_batch, keys)
    return trajectories.reshape(-1, *trajectories.shape[2:])[:draws]


def constrained_posterior(model: LatentForceModel, times: ArrayLike, y: ArrayLike,
                          lower: Mapping[str, ArrayLike] | None = None, upper: Mapping[str, ArrayLike] | None = None,
                          constraints: Callable[..., Any] | Sequence[Callable[..., Any]] = (),
                          grid: ArrayLike | int | None = None,
                          rule: Rule | None = None, steps: int = 10, sweeps: int = 200) -> ConstrainedPosterior:
    r"""Approximate the posterior of state and forces under constraints by expectation propagation.

    At every time of the grid a Gaussian factor approximates the term 1(c >= 0), such that the marginal of c has the
    mean and the variance of the truncated normal distribution N(c; cavity) 1(c >= 0).

    Args:
        model: the latent force model, with observation noise that is independent between outputs; its functions
            are read once, as by `jax.jit`.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        lower: name of a state, force or output -> its lower bound.
        upper: the same for upper bounds.
        constraints: functions c(x, u, t), feasible where >= 0.
        grid: (K,) times at which the constraints hold; as in `lfm_ppl.full_information`.
        rule: linearisation rule; `Cubature()` by default.
        steps: integration steps between two times of the grid or the data.
        sweeps: largest number of passes.

    Returns:
        Means, standard deviations, and intervals that respect the bounds.

    Raises:
        ValueError, TypeError: as `lfm_ppl.full_information`; noise of the outputs that is correlated, zero, or a
            function.

    Warns:
        UserWarning: the factors have not converged.

    Example:
        >>> import jax.numpy as jnp, numpy as np, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.3), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> times = np.arange(3.0)
        >>> posterior = lfm.constrained_posterior(model, times, jnp.ones((3, 1)), lower={"u": 0.0}, grid=times)
        >>> bool(posterior.interval("u")[0].min() >= 0)
        True

    Source: Minka (2001), Expectation propagation for approximate Bayesian inference; Cunningham, Hennig and
    Lacoste-Julien (2011), Gaussian probabilities and expectation propagation.
    """
    check_settings(model, 1.0, sweeps)
    boxes = build_boxes(build_constraints(model, lower, upper, constraints))
    rows = build_rows(model, times, grid)
    ssm = stacked_model(model, boxes)
    scan_grid = build_time_grid(ssm, rows.times, steps)
    model.check_at(scan_grid.initial_time, np.shape(times)[0])
    y = check_observations(y, np.shape(times)[0], len(model.output_names))
    variance = check_variances(model, np.shape(times)[0])
    warn_single_precision()
    posterior = TruncatedPosterior(ssm, as_rule(rule), scan_grid, rows, boxes, variance, FactorSettings(sweeps=sweeps))
    moments, proposal = _approximate(posterior, y)
    result = ConstrainedPosterior(*(*moments, boxes, posterior, proposal, model.state_names, model.force_names))
    if not checks.traced(result.converged) and not bool(result.converged):
        checks.warn(f"expectation propagation has not converged in {int(result.sweeps)} passes. Raise sweeps, take a "
                    "coarser grid, or see whether the constraints can be respected at all (lfm.full_information).")
    return result


@shared_jit
def _approximate(posterior: TruncatedPosterior, y: jax.Array) -> tuple[tuple, FilterTrace]:
    """Run expectation propagation.

    Returns:
        The fields of `ConstrainedPosterior` from ``times`` to ``_cavity``, and the proposal of trajectories.
    """
    ssm, rows, outputs = posterior.ssm, posterior.rows, y.shape[1]
    propagated = posterior.propagate_expectations(y, Record.SMOOTHER)
    smoothed = backward(posterior.problem, propagated.trace)
    grid_rows = jnp.asarray(rows.grid)
    times = jnp.asarray(rows.times)[grid_rows]
    matrix, offset = jax.vmap(ssm.input_map)(times)
    interval_index = jnp.asarray(posterior.grid.observed)[grid_rows]
    mean, covariance = (at_intervals(a[1:], interval_index) for a in smoothed.moments)
    mean = matmul(matrix, mean[..., None])[..., 0] + offset
    sd = safe_sqrt(jax.vmap(diagonal)(congruence(matrix, covariance)))
    size = ssm.physical_dim
    fixed_point = propagated.refined.fixed_point
    cavity = MeanVariance(*(a[grid_rows, outputs:] for a in fixed_point.cavity.cavity))
    proposal = posterior.proposal(y, propagated)
    return (times, mean[:, :size], sd[:, :size], mean[:, size:], sd[:, size:], fixed_point.sweeps,
            fixed_point.converged, cavity), proposal
