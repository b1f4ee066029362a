"""The marginal likelihood of a latent force model as one NumPyro distribution."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.distributions import constraints
from numpyro.primitives import _PYRO_STACK

from lfm_ppl.constrained.augmented import COARSE, add_times, build_rows, is_count, stacked_model
from lfm_ppl.constrained.boxes import build_boxes
from lfm_ppl.constrained.constraints import build_constraints
from lfm_ppl.constrained.evidence import TruncatedPosterior, check_linear, check_variances
from lfm_ppl.constrained.full_information import check_settings
from lfm_ppl.filtering.arguments import as_rule, check_iterations, check_observations, warn_single_precision
from lfm_ppl.filtering.backward import backward
from lfm_ppl.filtering.breakdown import warn_of_breakdown
from lfm_ppl.filtering.ep.evidence import Evidence, evidence, leave_one_out
from lfm_ppl.filtering.ep.moment_matching import assumed_density_filter
from lfm_ppl.filtering.ep.settings import SiteSettings, as_settings
from lfm_ppl.filtering.ep.terms import FamilyTerms
from lfm_ppl.filtering.filter import FilterResult, filter_on
from lfm_ppl.filtering.forward import forward
from lfm_ppl.filtering.intervals import TimeGrid
from lfm_ppl.filtering.iterated import posterior_linearisation
from lfm_ppl.filtering.moments import Record
from lfm_ppl.filtering.problem import FilterProblem, at_intervals, filter_problem, is_linear, is_observation_nonlinear
from lfm_ppl.filtering.smoother import SmootherResult, smooth_on
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.filtering.update import GaussianUpdate, Sites
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import noisy_observation
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.resolution import check_resolution
from lfm_ppl.model.simulate import input_breakpoints, simulate_on
from lfm_ppl.model.state_space import StateSpaceModel, check_times, state_space
from lfm_ppl.utils import checks
from lfm_ppl.utils.batching import mapped
from lfm_ppl.utils.gradients import finite_or_minus_infinity

SIMULATION_STEPS = 5
"""Steps of the simulator for one integration step of the filter: its paths are rougher than moments."""

DEFAULT_ITERATIONS = 3
"""Iterations of posterior linearisation of models that are not linear."""

_CANDIDATES = 64
"""Trajectories under constraints of which one is chosen by its weight."""


class MarginalLikelihood(dist.Distribution):
    """Distribution of a whole sequence of observations, state and forces integrated out.

        log p(y_1:T | theta) = sum_k log N(y_k; mu_k, S_k),

    with the innovations' moments from the Gaussian filter. It is exact for a linear model with Gaussian noise.
    Otherwise it is the likelihood of the model linearised about the smoothed marginals, which three iterations of
    posterior linearisation find by default, and with ``iterations=0`` that of a single pass of the filter.

    ``sample`` simulates the real, non-linear model: in NumPyro's ``Predictive`` it gives the prior predictive, and with
    posterior draws of the parameters the predictive of a NEW realisation of the forces. The posterior predictive given
    the data, along the smoothed forces, is what `lfm_ppl.fit` stores.

    Args:
        model: the latent force model; it may hold traced parameters.
        times: (T,), non-decreasing.
        rule: linearisation rule; `Cubature()` by default.
        steps: integration steps between two consecutive times.
        max_step: longest step, in units of time; longer intervals get more steps. None: twice the median step. A linear
            model without known inputs is exact, and needs no steps.
        iterations: of posterior linearisation; 0 for none. By default 3 for a model that is not linear, and 0 for a
            linear model, an observation family, constraints, or with a ``tolerance``.
        damping: largest share of each new iterate that is taken; less where the iterates turn back.
        tolerance: largest error of an integration step, in standard deviations. With it the length of the steps follows
            the moments, for every parameter anew, for stiff models and for posteriors over slow and fast ones; up to
            five times ``steps`` are tried. None: ``steps`` equal steps. Not with ``iterations``.
        sites: of an observation family, how its sites are refined: "ep" (expectation propagation, the default),
            "variational", "laplace", or `lfm_ppl.SiteSettings`. The log density is then the log evidence of the
            converged sites. Where the model is not linear it is linearised about smoothed moments, ``iterations`` times
            (8 by default). Where sites do not converge, the log density of a model that is not linear is that of
            assumed density filtering, which is rougher, and -inf in a linear one.
        lower: name of a state, force or output -> its lower bound. Under constraints the log density is
            log Z(y, c) - log Z(c), that of the data given that the constraints are respected: by expectation
            propagation, made right with ``draws`` trajectories that respect them. It is -inf where that does not
            converge. Not with an observation family, ``iterations``, ``max_step`` or ``tolerance``.
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
        ValueError, TypeError: as `lfm_ppl.filter`; also where it is used in a ``numpyro.plate``. In compiled code a
            failure is a log density of -inf.

    Warns:
        FilterWarning: outside of compiled code, where a log density is -inf or sites do not converge: where and how.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.MarginalLikelihood(model, jnp.arange(3.0)).event_shape
        (3, 1)

    Source: Hartikainen et al. (2012), section 4; Singer (2011), AStA 95.
    """

    support = constraints.real_matrix
    pytree_data_fields = ("model", "times", "lower", "upper")
    pytree_aux_fields = ("rule", "steps", "max_step", "iterations", "damping", "tolerance", "sites", "constraints",
                         "grid", "draws")

    def __init__(self, model: LatentForceModel, times: Any, rule: Rule | None = None, steps: int = 10,
                 max_step: float | None = None, iterations: int | None = None, damping: float = 0.7,
                 tolerance: float | None = None, sites: SiteSettings | str | None = None, *,
                 lower: Mapping[str, Any] | None = None, upper: Mapping[str, Any] | None = None,
                 constraints: Callable[..., Any] | Sequence[Callable[..., Any]] = (), grid: Any = None,
                 draws: int = 256, validate_args: bool | None = None):
        if not isinstance(model, LatentForceModel):
            raise TypeError(f"model must be an lfm.LatentForceModel, got {type(model).__name__}.")
        check_iterations(iterations or 0, damping, tolerance)
        self.model, self.times = model, times
        self.rule, self.steps, self.max_step = as_rule(rule), steps, max_step
        self.damping = damping
        if tolerance is not None:
            checks.positive("tolerance", tolerance, "It is in standard deviations, 0.001 for example.")
        self.tolerance = None if tolerance is None else float(tolerance)
        self.sites = None if sites is None else as_settings(sites)
        self.lower, self.upper = (None if bounds is None else dict(bounds) for bounds in (lower, upper))
        self.constraints = (constraints,) if callable(constraints) else tuple(constraints or ())
        self.grid = grid if grid is None or is_count(grid) else tuple(np.atleast_1d(np.asarray(grid, float)).tolist())
        self.draws = draws
        self.iterations = self._default_iterations() if iterations is None else iterations
        if self.constrained:
            self._check_constraints()
        if sites is not None and not isinstance(model.observation, ObservationFamily):
            raise ValueError("sites are for an observation family such as lfm.PoissonObservation; the observation of "
                             "this model is Gaussian, whose filter needs none. Leave out sites.")
        model.check_at(self.time_grid.initial_time, np.shape(times)[0])
        concrete_times = checks.concrete(times)
        if concrete_times is not None:
            model.check_span(float(concrete_times[0]), float(concrete_times[-1]))
        warn_single_precision()
        super().__init__((), (np.shape(times)[0], self.ssm.output_dim), validate_args=False)

    # Both are functions of the fields above, and are computed again in a copy that JAX builds from other leaves.
    @functools.cached_property
    def ssm(self) -> StateSpaceModel:
        """The state-space model."""
        return state_space(self.model)

    @functools.cached_property
    def time_grid(self) -> TimeGrid:
        """The time grid of the scan."""
        return build_time_grid(self.ssm, self.times, self.steps, self.max_step, tolerance=self.tolerance)

    @property
    def problem(self) -> FilterProblem:
        """The filter problem: model, rule and time grid, with what all intervals share."""
        return filter_problem(self.ssm, self.rule, self.time_grid)

    def _default_iterations(self) -> int:
        """Return the number of iterations of posterior linearisation where the user gives none."""
        is_family = isinstance(self.model.observation, ObservationFamily)
        if is_family or self.constrained or self.tolerance is not None or self.is_affine:
            return 0
        return DEFAULT_ITERATIONS

    @property
    def is_affine(self) -> bool:
        """Whether dynamics and observation are affine in states and forces, with noise independent of them."""
        return is_linear(self.ssm) and not is_observation_nonlinear(self.ssm)

    @property
    def description(self) -> str:
        """How the likelihood is computed: exact or by which approximation."""
        if self.constrained:
            return f"approximate (constraints by expectation propagation and {self.draws} trajectories)"
        if isinstance(self.model.observation, ObservationFamily):
            return f"approximate (sites by {self.sites_in_words})"
        if self.is_affine:
            return "exact (the model is linear)"
        if not self.iterations:
            return "approximate (a single pass of the filter)"
        count = {1: "one iteration", 2: "two iterations", 3: "three iterations"}.get(
            self.iterations, f"{self.iterations} iterations")
        return f"approximate ({count} of posterior linearisation)"

    @property
    def constrained(self) -> bool:
        """Whether there are constraints."""
        return bool(self.lower or self.upper or self.constraints)

    @property
    def bounds(self) -> list[str]:
        """Each constraint in words, ``factor >= 0``."""
        bounds = [f"{name} {sign} {_number(value)}" for limits, sign in ((self.lower, ">="), (self.upper, "<="))
                  for name, value in (limits or {}).items()]
        return bounds + [f"{getattr(constraint, '__name__', type(constraint).__name__)} >= 0"
                         for constraint in self.constraints]

    @property
    def constraints_in_words(self) -> str:
        """All constraints, and at how many times they hold."""
        return f"{', '.join(self.bounds)} at {len(self.bounded().rows.grid)} times"

    def refuse_constraints(self, caller: str) -> None:
        """Raise ValueError where there are constraints, which ``caller`` does not support."""
        if self.constrained:
            raise ValueError(f"{caller} does not support constraints, and the likelihood has some: "
                             f"{', '.join(self.bounds)}. Use NUTS, RAM or MAP, or leave the constraints out.")

    def _check_constraints(self) -> None:
        check_settings(self.model, 1.0, 1)
        for name in ("max_step", "tolerance"):
            if getattr(self, name) is not None:
                raise ValueError(f"{name} is not supported under constraints, which add rows to the grid; raise steps.")
        if self.iterations:
            raise ValueError("under constraints a non-linear model is always linearised about smoothed moments. Leave "
                             "iterations out.")
        if self.draws != 0:
            checks.positive_integer("draws", self.draws)
            if self.draws % 2:
                raise ValueError(f"draws must be even, half of them mirror the other half; got {self.draws}.")
        if checks.concrete(self.times) is not None:
            check_linear(self.bounded(), self.draws)

    def bounded(self, at: Any = None) -> TruncatedPosterior:
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
        return TruncatedPosterior(ssm, self.rule, build_time_grid(ssm, rows.times, self.steps), rows, boxes,
                                  check_variances(self.model, np.shape(self.times)[0]), SiteSettings())

    def with_times(self, times: Any) -> MarginalLikelihood:
        """Return the same distribution with concrete times instead of traced ones."""
        likelihood = copy.copy(self)
        likelihood.__dict__.pop("time_grid", None)
        likelihood.times = times
        return likelihood

    def log_prob_per_observation(self, value: Any) -> jax.Array:
        """Return (T,): log p(y_k | y_1:k-1) of the present entries of each observation.

        Under constraints these are terms of the unconstrained model, which do not sum to `log_prob`.
        """
        y = self._checked(value)
        return self._warn_of_breakdown(y, finite_or_minus_infinity(self._one_step_ahead, y), has_sites=False)

    def log_prob(self, value: Any) -> jax.Array:
        """Return the log marginal likelihood of ``value`` (T, D), NaN where missing; batch dimensions may lead."""
        value = jnp.asarray(checks.unmask(value), float)
        if value.ndim > 2:
            return jax.vmap(self.log_prob)(value)
        check_resolution(self.model, self.times, value)
        # One failure makes the sum -inf, and the derivatives of all other terms zero.
        y = self._checked(value)
        if self.constrained:
            return finite_or_minus_infinity(lambda y: self.bounded().log_likelihood(y, self.draws), y)
        if isinstance(self.model.observation, ObservationFamily):
            return self._warn_of_breakdown(y, *finite_or_minus_infinity(self._evidence_and_convergence, y))
        return self._warn_of_breakdown(y, finite_or_minus_infinity(lambda y: self._one_step_ahead(y).sum(), y))

    def _checked(self, y: Any) -> jax.Array:
        count, outputs = self.event_shape
        return check_observations(y, count, outputs, model=self.model)

    @property
    def site_settings(self) -> SiteSettings:
        """Settings of the sites of an observation family."""
        return as_settings(self.sites, self.iterations)

    @property
    def sites_in_words(self) -> str:
        """Approximation of an observation family; empty for a Gaussian observation."""
        if not isinstance(self.model.observation, ObservationFamily):
            return ""
        settings = self.site_settings
        linear = not (self.ssm.drift_structure.points or self.ssm.observation_structure.points)
        return f"{settings.method}" + ("" if linear else f", linearised at most {settings.relinearisations} times")

    def evidence(self, y: jax.Array) -> Evidence:
        """Return the log evidence of an observation family and its parts; ``y`` (T, D) is not checked."""
        assert isinstance(self.model.observation, ObservationFamily)
        terms = FamilyTerms(self.model.observation, y)
        return evidence(self.problem, terms, self.site_settings)

    def _evidence_and_convergence(self, y: jax.Array) -> jax.Array:
        result = self.evidence(y)
        converged = result.refined.fixed_point.converged
        return jnp.stack([result.log_evidence, converged.astype(result.log_evidence.dtype)])

    def _warn_of_breakdown(self, y: jax.Array, log_likelihood: jax.Array, converged: Any = True,
                           has_sites: bool = True) -> jax.Array:
        """Return the log likelihood, after a warning outside of compiled code if the filter breaks down.

        Args:
            y: (T, D).
            log_likelihood: result of the filter.
            converged: whether the sites of a family have converged.
            has_sites: whether the sites of a family were refined; False for assumed density filtering.
        """
        warn_of_breakdown(self.ssm, self.rule, self.time_grid, y, None, log_likelihood,
                          self.site_settings if has_sites else None, converged)
        return log_likelihood

    def expand(self, batch_shape: tuple[int, ...]) -> dist.Distribution:
        """Return independent series with the same parameters; in a ``numpyro.plate`` that is an error.

        Raises:
            ValueError: in a plate, where several series are an `lfm_ppl.panel`.
        """
        if tuple(batch_shape) and any(isinstance(handler, numpyro.plate) for handler in _PYRO_STACK):
            raise ValueError("an lfm.MarginalLikelihood is the distribution of one series, and cannot be repeated to "
                             f"the batch shape {tuple(batch_shape)} of a numpyro.plate. For several series take "
                             "lfm.panel(build, parameters, times) in the plate, with a leading axis of its size in "
                             "parameters; for one series put the site outside of the plate.")
        return super().expand(batch_shape)

    def _one_step_ahead(self, y: jax.Array) -> jax.Array:
        problem, updater, points = self.problem, GaussianUpdate(y), None
        if isinstance(self.model.observation, ObservationFamily):
            return assumed_density_filter(problem, y).log_likelihood
        if self.iterations:
            points = posterior_linearisation(problem, updater, self.iterations, self.damping).points
        return at_intervals(forward(problem, updater, about=points).log_likelihood, self.time_grid.observed)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Simulate the real model: (*sample_shape, T, D).

        Under constraints: along trajectories that respect them, from the (linearised) model as far as 64 candidates
        represent it.
        """
        if self.constrained:
            return repeat_draw(self._constrained_sample, key, sample_shape)
        start = jnp.asarray(self.time_grid.initial_time, float)
        breakpoints = input_breakpoints(self.model, checks.concrete(self.times), self.time_grid.initial_time)

        def simulate(key: jax.Array) -> jax.Array:
            return simulate_on(self.ssm, key, jnp.asarray(self.times, float), start, SIMULATION_STEPS * self.steps,
                               breakpoints).y

        return repeat_draw(simulate, key, sample_shape)

    def _constrained_sample(self, key: jax.Array) -> jax.Array:
        keys = jax.random.split(key)
        w, when = self.feasible_path(keys[0], jnp.full(self.event_shape, jnp.nan))
        return jax.vmap(lambda w, t, key, row: noisy_observation(self.ssm, w, t, key, row))(
            w, when, jax.random.split(keys[1], len(when)), jnp.arange(len(when)))

    def feasible_path(self, key: jax.Array, y: jax.Array, at: Any = None) -> tuple[jax.Array, jax.Array]:
        """Draw a trajectory under the constraints, one of 64 by their weights.

        Args:
            key: a JAX random key.
            y: (T, D), NaN where missing.
            at: (L,) times; those of the data where None.

        Returns:
            (x, u) (L, M + R), and the times (L,).
        """
        problem = self.bounded(at)
        proposal = problem.proposal(y, problem.propagate_expectations(y))
        path = problem.sample_trajectories(key, proposal, 1, _CANDIDATES)[..., 0]
        # The last row of a time is the one at which the constraint holds.
        times = np.asarray(self.times if at is None else at, float)
        index = np.searchsorted(problem.rows.times, times, side="right") - 1
        return path[index], jnp.asarray(times)

    def constrained_leave_one_out(self, y: jax.Array) -> jax.Array:
        """Return (T,), log p(y_k | y_-k, c), by expectation propagation."""
        problem = self.bounded()
        propagated = problem.propagate_expectations(y, Record.SMOOTHER)
        predictor = backward(problem.problem, propagated.trace).predictor
        assert predictor is not None
        data, outputs = jnp.asarray(problem.rows.data), y.shape[1]
        at_data = jax.tree.map(lambda a: at_intervals(a, problem.grid.observed)[data], predictor)
        at_data = at_data._replace(mean=at_data.mean[:, :outputs],
                                   covariance=at_data.covariance[:, :outputs, :outputs])
        fixed_point = propagated.refined.fixed_point
        sites = Sites(*(a[data, :outputs] for a in fixed_point.sites))
        value = leave_one_out(at_data, sites, propagated.entries[data, :outputs])
        return jnp.where(fixed_point.converged, value, -jnp.inf)

    def filter(self, y: Any) -> FilterResult:
        """Filter with this distribution's rule and steps; see `lfm_ppl.filter`. Constraints are ignored."""
        y = self._checked(y)
        return filter_on(self.ssm, self.rule, self.time_grid, y, jnp.asarray(self.times, float))

    def smooth(self, y: Any, at: Any = None) -> SmootherResult:
        """Smooth with this distribution's settings; see `lfm_ppl.smooth`. Constraints are ignored."""
        grid = build_time_grid(self.ssm, self.times, self.steps, self.max_step, at, tolerance=self.tolerance)
        y = self._checked(y)
        return smooth_on(self.ssm, self.rule, grid, y, self.iterations, self.damping, self.site_settings)


def _number(value: Any) -> str:
    concrete = checks.concrete(value)
    return "..." if concrete is None else f"{float(concrete):g}"


class Panel(dist.Distribution):
    """Many independent series as one distribution with a batch shape; made by `panel`."""

    support = constraints.real_matrix
    pytree_data_fields = ("parameters", "times")
    pytree_aux_fields = ("build", "settings")

    def __init__(self, build: Callable[..., LatentForceModel], parameters: Any, times: Any, settings: dict[str, Any]):
        leaves = jax.tree_util.tree_leaves(parameters)
        if not leaves:
            raise ValueError("parameters must hold at least one array with a leading axis for the series.")
        sizes = {np.shape(leaf)[0] if np.ndim(leaf) else None for leaf in leaves}
        if len(sizes) > 1 or None in sizes:
            shapes = [np.shape(leaf) for leaf in leaves]
            raise ValueError("every array in parameters needs the same leading axis, one entry a series; got "
                             f"{shapes}. Repeat a shared parameter with jnp.broadcast_to, or close over it in build.")
        self.build, self.parameters, self.times, self.settings = build, parameters, times, settings
        (count,) = sizes
        if self._has_series_times and np.shape(times)[0] != count:
            raise ValueError(f"times has {np.shape(times)[0]} rows for {count} series; give one row a series, or one "
                             "vector for all.")
        concrete_times = checks.concrete(times)
        if self._has_series_times and settings.get("max_step") is not None:
            raise ValueError("max_step is not supported in a panel whose series have different times, because all "
                             "series share one number of rows. Raise steps, or give all series one vector of times.")
        for series, row in enumerate(concrete_times) if self._has_series_times and concrete_times is not None else ():
            try:
                check_times(row, None)
            except ValueError as error:
                raise ValueError(f"series {series}: {error}") from None
        # Times that all series share stay concrete, because jumps of a force and longest steps depend on them.
        example = jax.eval_shape(
            lambda p, t: jnp.zeros(self._likelihood(p, t if self._has_series_times else times).event_shape),
            jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], parameters), jnp.zeros(np.shape(times)[-1]))
        if not self._has_series_times:
            _ = self.first  # eager checks of concrete values
        super().__init__((count,), example.shape, validate_args=False)

    @property
    def _has_series_times(self) -> bool:
        return np.ndim(self.times) == 2

    def _likelihood(self, parameters: Any, times: Any) -> MarginalLikelihood:
        return MarginalLikelihood(self.build(parameters), times, **self.settings)

    @property
    def first(self) -> MarginalLikelihood:
        """The distribution of the first series."""
        return self.series(0)

    def series(self, index: int) -> MarginalLikelihood:
        """Return the distribution of one series."""
        times = jnp.asarray(self.times, float)[index] if self._has_series_times else self.times
        return self._likelihood(jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf)[index], self.parameters), times)

    def with_times(self, times: Any) -> Panel:
        """Return the same distribution with concrete times instead of traced ones."""
        panel = copy.copy(self)
        panel.times = times
        return panel

    def mapped(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return ``function(distribution of a series, *its arguments)``, with the series as leading axis."""
        times = jnp.asarray(self.times, float) if self._has_series_times else None
        return mapped(
            lambda p, t, *others: function(self._likelihood(p, self.times if t is None else t), *others),
            jax.tree_util.tree_map(jnp.asarray, self.parameters), times, *arguments)

    def log_prob_per_observation(self, value: Any) -> jax.Array:
        """Return (B, T): the one-step-ahead log densities of each series."""
        return self.mapped(lambda series, y: series.log_prob_per_observation(y), self.checked(value))

    def log_prob(self, value: Any) -> jax.Array:
        """Return (B,): the log marginal likelihood of each series; zero where a series is all missing."""
        value = jnp.asarray(checks.unmask(value), float)
        if value.ndim > 3:
            return jax.vmap(self.log_prob)(value)
        return self.mapped(lambda series, y: series.log_prob(y), self.checked(value))

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Simulate every series: (*sample_shape, B, T, D)."""

        def draw(key: jax.Array) -> jax.Array:
            keys = jax.random.split(key, self.batch_shape[0])
            return self.mapped(lambda series, key: series.sample(key), keys)

        return repeat_draw(draw, key, sample_shape)

    def checked(self, value: Any) -> jax.Array:
        """Return ``value`` as an array (B, T, D) after checking it."""
        value = checks.unmask(value)
        expected = (*self.batch_shape, *self.event_shape)
        if np.shape(value) != expected:
            raise ValueError(f"y must have shape {expected} (series, times, outputs), got {np.shape(value)}; pad a "
                             "shorter series with NaN.")
        concrete = checks.concrete(value)
        if concrete is not None and np.isinf(concrete).any():
            raise ValueError("y has infinite entries; use NaN for a missing entry.")
        if concrete is not None:
            for index, rows in enumerate(concrete):
                model = self.series(index).model if self._has_series_times else self.first.model
                if not isinstance(model.observation, ObservationFamily):
                    break
                try:
                    model.observation.check_data(rows, names=model.output_names)
                except ValueError as error:
                    raise ValueError(f"series {index}: {error}") from None
        return jnp.asarray(value, float)


def repeat_draw(draw: Callable[[jax.Array], jax.Array], key: jax.Array, sample_shape: tuple[int, ...]) -> jax.Array:
    """Return independent draws (*sample_shape, ...) of ``draw(key)``; one draw where the shape is empty."""
    if not sample_shape:
        return draw(key)
    draws = jax.vmap(draw)(jax.random.split(key, int(np.prod(sample_shape))))
    return draws.reshape(*sample_shape, *draws.shape[1:])


def panel(build: Callable[..., LatentForceModel], parameters: Any, times: Any, rule: Rule | None = None,
          steps: int = 10, max_step: float | None = None, iterations: int | None = None, damping: float = 0.7,
          tolerance: float | None = None, sites: SiteSettings | str | None = None) -> Panel:
    """Return many independent series as one distribution, for use inside ``numpyro.plate``.

    Args:
        build: maps the parameters of ONE series to its `LatentForceModel`; it may close over shared parameters.
        parameters: pytree of arrays with a leading axis (B,), one entry a series.
        times: (T,) for all, or (B, T); ragged series are padded: NaN in y, and times that repeat the last one.
        rule: as in `MarginalLikelihood`, and so are the next six.
        steps: integration steps between two consecutive times.
        max_step: longest step.
        iterations: of posterior linearisation; by default 3 for models that are not linear, see `MarginalLikelihood`.
        damping: largest share of each new iterate that is taken; less where the iterates turn back.
        tolerance: largest error of an integration step, in standard deviations; None for equal steps.
        sites: of an observation family.

    Returns:
        A distribution with batch shape (B,) and event shape (T, D).

    Raises:
        ValueError: arrays without a common leading axis; a wrong number of rows of times.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> def build(p):
        ...     return lfm.LatentForceModel(
        ...         lambda x, u, t: u - p["rate"] * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.panel(build, {"rate": jnp.array([0.5, 1.0])}, jnp.arange(3.0)).batch_shape
        (2,)
    """
    settings = {"rule": as_rule(rule), "steps": steps, "max_step": max_step, "iterations": iterations,
                "damping": damping, "tolerance": tolerance, "sites": sites}
    return Panel(build, parameters, times, settings)
