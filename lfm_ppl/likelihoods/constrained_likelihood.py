"""The likelihood of a latent force model under constraints on states, forces and outputs.

1. Constraints become boxes 0 <= c <= width at the rows of a grid (`lfm_ppl.constrained.boxes`).
2. Expectation propagation with truncated normal factors gives log Z(y, c) and log Z(c); their difference is the log
   density of the data given that the constraints hold (`lfm_ppl.constrained.evidence`).
3. Weighted trajectories that respect all constraints correct both for the error of the factors. Their random numbers
   are the same for all parameters, so that the density has no noise.
4. Samples and posterior trajectories are chosen by their weights among such trajectories.

Source: Cunningham, Hennig and Lacoste-Julien (2011), Gaussian probabilities and expectation propagation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.constrained.augmented import COARSE, add_times, build_rows, is_count, stacked_model
from lfm_ppl.constrained.boxes import build_boxes
from lfm_ppl.constrained.constraints import build_constraints
from lfm_ppl.constrained.evidence import TruncatedPosterior, check_linear, check_variances
from lfm_ppl.constrained.full_information import check_settings
from lfm_ppl.filtering.backward import backward
from lfm_ppl.filtering.ep.evidence import entry_leave_one_out
from lfm_ppl.filtering.ep.settings import FactorSettings
from lfm_ppl.filtering.integrators.methods import DEFAULT_METHOD
from lfm_ppl.filtering.moments import Record
from lfm_ppl.filtering.problem import at_intervals
from lfm_ppl.filtering.smoother import SmootherResult
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.filtering.update import Factors
from lfm_ppl.likelihoods.filter_settings import FilterSettings
from lfm_ppl.likelihoods.marginal_likelihood import CONSTRAINTS, MarginalLikelihood
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood, check_model, repeat_draw
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import noisy_observation
from lfm_ppl.model.resolution import check_resolution
from lfm_ppl.utils import checks
from lfm_ppl.utils.gradients import finite_or_minus_infinity

_CANDIDATES = 64
"""Number of weighted trajectories from which one draw is chosen."""


class ConstrainedLikelihood(SeriesLikelihood):
    """Distribution of a sequence of observations given that states and forces respect constraints.

        log p(y | c) = log Z(y, c) - log Z(c),

    the density of the data given that the constraints are respected: by expectation propagation, corrected by weighted
    trajectories. It is -inf where expectation propagation does not converge.

    Args:
        model: the latent force model, with Gaussian observations.
        times: (T,), non-decreasing.
        rule: linearisation rule; `Cubature()` by default.
        steps: integration steps between two rows of the grid or the data; 10 by default.
        lower: name of a state, force or output -> its lower bound.
        upper: the same for upper bounds.
        constraints: functions c(x, u, t), feasible where >= 0; with ``draws``, linear in x and u.
        grid: (K,) times at which the constraints hold, or how many at equal distances from the initial time to the last
            observation. By default the initial time and the times of the observations, and between those that are
            further apart than 1/20 of the record times at equal distances; 100 at equal distances where observations
            have more times. The cost is that of some tens of smoother passes over it, and the error of the importance
            sampling grows with the number of rows.
        draws: number of trajectories, an even one; 0: by expectation propagation alone, which may be off by .1 on a
            coarse grid, and by .5 on a dense one. They have the same random numbers for all parameters, so that the
            log density has no noise, but an error that varies slowly with the parameters.

    Raises:
        ValueError, TypeError: as `lfm_ppl.MarginalLikelihood`; no constraint, or an observation family.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.3), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.ConstrainedLikelihood(model, jnp.arange(3.0), lower={"u": 0.0}).constraints_in_words
        'u >= 0 at 21 times'
    """

    pytree_data_fields = ("lower", "upper")
    pytree_aux_fields = ("constraints", "grid", "draws")
    accepted: ClassVar[tuple[str, ...]] = ("rule", "steps")

    def __init__(self, model: LatentForceModel, times: Any, rule: Rule | None = None, steps: int | None = None, *,
                 lower: Mapping[str, Any] | None = None, upper: Mapping[str, Any] | None = None,
                 constraints: Callable[..., Any] | Sequence[Callable[..., Any]] = (), grid: Any = None,
                 draws: int = 256):
        check_model(model)
        self.lower, self.upper = (None if bounds is None else dict(bounds) for bounds in (lower, upper))
        self.constraints = (constraints,) if callable(constraints) else tuple(constraints or ())
        self.grid = grid if grid is None or is_count(grid) else tuple(np.atleast_1d(np.asarray(grid, float)).tolist())
        self.draws = draws
        if not (self.lower or self.upper or self.constraints):
            raise ValueError("give lower, upper or constraints; without any the likelihood is lfm.MarginalLikelihood.")
        check_settings(model, 1.0, 1)
        if draws != 0:
            checks.positive_integer("draws", draws)
            if draws % 2:
                raise ValueError(f"draws must be even, half of them mirror the other half; got {draws}.")
        super().__init__(model, times, *FilterSettings.of({"rule": rule, "steps": steps}))
        if checks.concrete(times) is not None:
            check_linear(self.truncated_posterior(), draws)

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of the constructor besides model and times, without settings that are left open."""
        return super().arguments | {name: getattr(self, name) for name in CONSTRAINTS}

    def with_settings(self, **settings: Any) -> SeriesLikelihood:
        """Return the same distribution with other settings of its filter, such as ``steps``, or other constraints."""
        return likelihood_with(self.model, self.times, self.arguments | settings)

    @property
    def has_gaussian_state(self) -> bool:
        """Whether the state given data and parameters is Gaussian: not under constraints."""
        return False

    @property
    def has_factors(self) -> bool:
        """Whether Gaussian factors approximate terms of the density."""
        return True

    @property
    def description(self) -> str:
        """How the likelihood is computed."""
        return f"approximate (constraints by expectation propagation and {self.draws} trajectories)"

    @property
    def constraints_in_words(self) -> str:
        """All constraints, and at how many times they hold."""
        bounds = [f"{name} {sign} {_format_bound(value)}" for limits, sign in ((self.lower, ">="), (self.upper, "<="))
                  for name, value in (limits or {}).items()]
        functions = [f"{getattr(constraint, '__name__', type(constraint).__name__)} >= 0"
                     for constraint in self.constraints]
        return f"{', '.join(bounds + functions)} at {len(self.truncated_posterior().rows.grid)} times"

    def truncated_posterior(self, at: Any = None) -> TruncatedPosterior:
        """Return the truncated posterior, whose evidence is the density under constraints.

        Args:
            at: (K,) further times for trajectories, at which the constraints need not hold.
        """
        boxes = build_boxes(build_constraints(self.model, self.lower, self.upper, self.constraints))
        rows = build_rows(self.model, self.times, np.asarray(self.grid) if isinstance(self.grid, tuple) else self.grid,
                          COARSE)
        if at is not None:
            rows = add_times(rows, np.asarray(at, float))
        ssm = stacked_model(self.model, boxes)
        grid = build_time_grid(ssm, rows.times, self.settings.steps)
        return TruncatedPosterior(ssm, self.settings.rule, grid, rows, boxes,
                                  check_variances(self.model, np.shape(self.times)[0]), FactorSettings())

    def log_prob(self, value: Any) -> jax.Array:
        """Return log p(value | c), NaN where missing; batch dimensions may lead."""
        value = jnp.asarray(checks.unmask(value), float)
        if value.ndim > 2:
            return jax.vmap(self.log_prob)(value)
        check_resolution(self.model, self.times, value)
        return finite_or_minus_infinity(lambda y: self.truncated_posterior().log_likelihood(y, self.draws),
                                        self.checked(value))

    def convergence(self, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return whether the factors converge, and whether the log density is finite."""
        posterior = self.truncated_posterior()
        return posterior.converged(y), jnp.isfinite(posterior.log_likelihood(y, self.draws))

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Simulate observations along trajectories that respect the constraints: (*sample_shape, T, D).

        Trajectories follow the (linearised) model, as far as 64 candidates represent it.
        """

        def draw(key: jax.Array) -> jax.Array:
            path_key, noise_key = jax.random.split(key)
            w, times = self.sample_path(path_key, jnp.full(self.event_shape, jnp.nan))
            return jax.vmap(lambda w, t, key, row: noisy_observation(self.ssm, w, t, key, row))(
                w, times, jax.random.split(noise_key, len(times)), jnp.arange(len(times)))

        return repeat_draw(draw, key, sample_shape)

    def sample_path(self, key: jax.Array, y: jax.Array, at: Any = None) -> tuple[jax.Array, jax.Array]:
        """Draw a trajectory under the constraints, chosen by its weight among 64; see the base class."""
        posterior = self.truncated_posterior(at)
        proposal = posterior.proposal(y, posterior.propagate_expectations(y))
        path = posterior.sample_trajectories(key, proposal, 1, _CANDIDATES)[..., 0]
        # The last row of a time is the one at which the constraint holds.
        times = np.asarray(self.times if at is None else at, float)
        index = np.searchsorted(posterior.rows.times, times, side="right") - 1
        return path[index], jnp.asarray(times)

    def leave_one_out(self, y: jax.Array, smoothed: SmootherResult) -> jax.Array:
        """Return (T, D), log p of each entry given all others and the constraints, by expectation propagation."""
        posterior = self.truncated_posterior()
        propagated = posterior.propagate_expectations(y, Record.SMOOTHER)
        predictor = backward(posterior.problem, propagated.trace).predictor
        assert predictor is not None
        data, outputs = jnp.asarray(posterior.rows.data), y.shape[1]
        at_data = jax.tree.map(lambda a: a[data], at_intervals(predictor, posterior.grid.observed))
        at_data = at_data._replace(mean=at_data.mean[:, :outputs],
                                   covariance=at_data.covariance[:, :outputs, :outputs])
        fixed_point = propagated.refined.fixed_point
        factors = Factors(*(a[data, :outputs] for a in fixed_point.factors))
        value = entry_leave_one_out(at_data, factors, propagated.entries[data, :outputs])
        return jnp.where(jnp.isnan(y), 0.0, jnp.where(fixed_point.converged, value, -jnp.inf))


def likelihood_with(model: LatentForceModel, times: Any, settings: Mapping[str, Any]) -> SeriesLikelihood:
    """Return the likelihood of one series with settings by name, under constraints where there are any.

    Raises:
        ValueError: a setting of the filter that a likelihood under constraints does not have.
    """
    settings = dict(settings)
    constraints = {name: settings.pop(name) for name in CONSTRAINTS if name in settings}
    if not any(constraints.get(name) for name in ("lower", "upper", "constraints")):
        return MarginalLikelihood(model, times, **settings)
    rule, steps = settings.pop("rule", None), settings.pop("steps", None)
    for name in ("max_step", "tolerance", "filter_steps"):
        if settings.get(name) is not None:
            raise ValueError(f"{name} is not supported under constraints, which add rows to the grid; raise steps.")
    if (method := settings.get("method") or DEFAULT_METHOD) != DEFAULT_METHOD:
        raise ValueError(f"method={method!r} is not supported under constraints; leave method out.")
    if settings.get("iterations"):
        raise ValueError("under constraints a non-linear model is always linearised about smoothed moments. Leave "
                         "iterations out.")
    if settings.get("factors") is not None:
        raise ValueError("factors are for an observation family without constraints. Leave out factors.")
    return ConstrainedLikelihood(model, times, rule, steps, **constraints)


def _format_bound(value: Any) -> str:
    concrete = checks.concrete(value)
    return "..." if concrete is None else f"{float(concrete):g}"
