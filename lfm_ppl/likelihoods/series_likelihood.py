"""The likelihood of one series of observations: what distributions with and without constraints share.

1. The latent force model becomes a state-space model, its times a time grid (both computed when first used).
2. `filter` and `smooth` run on that grid with the settings of the distribution.
3. `_terms_and_changes` computes the terms of a Gaussian observation: filter problem, iterations, last forward scan.
4. Subclasses define the log density from them, and its samples: `MarginalLikelihood`, `ConstrainedLikelihood` and
   `Switching`.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.distributions import constraints
from numpyro.primitives import _PYRO_STACK

from lfm_ppl.filtering.arguments import check_observations, warn_single_precision
from lfm_ppl.filtering.breakdown import warn_of_breakdown, warn_of_iterations
from lfm_ppl.filtering.ep.moment_matching import assumed_density_filter
from lfm_ppl.filtering.ep.settings import FactorSettings
from lfm_ppl.filtering.filter import FilterResult, filter_on
from lfm_ppl.filtering.forward import forward
from lfm_ppl.filtering.grid_layout import GridLayout
from lfm_ppl.filtering.integrators.integrator import Integrator
from lfm_ppl.filtering.integrators.methods import DEFAULT_METHOD, METHODS, choose_integrator
from lfm_ppl.filtering.intervals import TimeGrid
from lfm_ppl.filtering.iterated import Anchor, posterior_linearisation
from lfm_ppl.filtering.problem import FilterProblem, at_intervals, filter_problem
from lfm_ppl.filtering.smoother import SmootherResult, filtered_mean, smooth_on
from lfm_ppl.filtering.stiffness import ExplicitSteps, explicit_steps, warn_of_long_steps
from lfm_ppl.filtering.time_grid import build_time_grid, lay_out_time_grid
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.likelihoods.filter_settings import FilterSettings
from lfm_ppl.likelihoods.likelihood import Likelihood
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.events import EventTable, event_table
from lfm_ppl.model.inputs import InputRead
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import replicate
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.utils import checks
from lfm_ppl.utils.gradients import finite_or_minus_infinity
from lfm_ppl.utils.random_keys import split_by_name


class SeriesLikelihood(Likelihood):
    """Distribution of the observations of one series, with state and forces integrated out.

    Args:
        model: the latent force model; it may hold traced parameters.
        times: (T,), non-decreasing.
        settings: of its filter.
        given: names of the settings that the model names; the others have their defaults.
    """

    support = constraints.real_matrix
    pytree_data_fields: tuple[str, ...] = ("model", "times")
    pytree_aux_fields: tuple[str, ...] = ("settings", "given")
    accepted: ClassVar[tuple[str, ...]] = FilterSettings.names()
    """Names of the settings that the constructor takes."""
    layout: GridLayout | None = None
    about: Anchor | None = None
    """Smoothed moments from which the iterations of posterior linearisation start; None: the filter's."""
    regime_names: tuple[str, ...] = ()

    def __init__(self, model: LatentForceModel, times: Any, settings: FilterSettings, given: frozenset[str]) -> None:
        refuse_times_by_site(times)
        self.model, self.times, self.settings, self.given = model, times, settings, given
        concrete_times = checks.concrete(times)
        if concrete_times is None:
            # The time grid of traced times may come from outside, by `with_times`.
            model.check_at(times[0] if model.initial_time is None else model.initial_time, np.shape(times)[0])
        else:
            model.check_at(self._laid_out[0].grid.initial_time, len(concrete_times))
            model.check_span(float(concrete_times[0]), float(concrete_times[-1]))
        warn_single_precision()
        super().__init__((), (np.shape(times)[0], self.ssm.output_dim), validate_args=False)

    @property
    def first(self) -> SeriesLikelihood:
        """The distribution itself."""
        return self

    @property
    def members(self) -> list[SeriesLikelihood]:
        """The distribution itself, as the only member."""
        return [self]

    def mapped(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return ``function(distribution, *arguments)``."""
        return function(self, *arguments)

    def split_key(self, key: jax.Array) -> jax.Array:
        """Return the key."""
        return key

    # Both are functions of the fields above, and are computed again in a copy that JAX builds from other leaves.
    @functools.cached_property
    def ssm(self) -> StateSpaceModel:
        """The state-space model."""
        return state_space(self.model)

    @functools.cached_property
    def time_grid(self) -> TimeGrid:
        """The time grid of the scan."""
        if self.layout is not None:
            return self.grid_of(self.layout)
        layout, reads, events = self._laid_out
        return layout.complete(reads, events)._replace(method=self.settings.method)

    @functools.cached_property
    def _laid_out(self) -> tuple[GridLayout, list[InputRead], EventTable]:
        settings = self.settings
        return lay_out_time_grid(self.ssm, self.times, settings.integration_steps, settings.max_step,
                                 tolerance=settings.tolerance)

    def lay_out(self, requested_times: Any = None) -> GridLayout:
        """Return the layout of the time grid with requested times (K,); None: the times of the data."""
        if requested_times is None:
            return self._laid_out[0]
        settings = self.settings
        return lay_out_time_grid(self.ssm, self.times, settings.integration_steps, settings.max_step, requested_times,
                                 tolerance=settings.tolerance)[0]

    def grid_of(self, layout: GridLayout) -> TimeGrid:
        """Return the time grid of a layout of this likelihood, for its parameters."""
        reads = self.model.input_reads(0.0, 1.0) if any(layout.is_lagged + layout.is_event_lagged) else ()
        return layout.complete(reads, event_table(self.model.events))._replace(method=self.settings.method)

    # Not cached: it is computed from traced parameters, inside the function that `finite_or_minus_infinity` guards.
    @property
    def problem(self) -> FilterProblem:
        """The filter problem: model, rule and time grid, with what all intervals share."""
        return filter_problem(self.ssm, self.settings.rule, self.time_grid)

    @property
    def is_family(self) -> bool:
        """Whether the observation is a family such as `lfm_ppl.PoissonObservation`, and not Gaussian."""
        return isinstance(self.model.observation, ObservationFamily)

    @property
    def ssms(self) -> tuple[StateSpaceModel, ...]:
        """The state-space models of all regimes; one but for a likelihood with several."""
        return (self.ssm,)

    @property
    def integrators(self) -> tuple[Integrator, ...]:
        """The integrators of all regimes; one but for a likelihood with several."""
        settings = self.settings
        return tuple(choose_integrator(ssm, settings.rule, settings.method, settings.tolerance) for ssm in self.ssms)

    @property
    def is_stiff(self) -> bool:
        """Whether the method of integration is one for stiff dynamics, so that simulated steps are exponential, too."""
        return not METHODS[self.settings.method].is_explicit

    @property
    def has_gaussian_state(self) -> bool:
        """Whether the state given data and parameters is Gaussian; if not, there is a method `sample_path`."""
        return True

    @property
    def has_factors(self) -> bool:
        """Whether Gaussian factors approximate terms of the density."""
        return self.is_family

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of the constructor besides model and times, without settings that are left open."""
        return {name: getattr(self.settings, name) for name in sorted(self.given)}

    @property
    def description(self) -> str:
        """How the likelihood is computed: exact or by which approximation."""
        raise NotImplementedError

    @property
    def recorded_settings(self) -> dict[str, Any]:
        """Settings of the filter as a result records them; what is None is not stored."""
        settings = self.settings
        recorded = {"rule": settings.rule.name, "steps": settings.steps, "max_step": settings.max_step,
                    "iterations": settings.iterations, "tolerance": settings.tolerance,
                    "method": None if settings.method == DEFAULT_METHOD else settings.method}
        return {name: value for name, value in recorded.items() if name in self.accepted}

    @property
    def factor_settings(self) -> FactorSettings:
        """Settings of the factors of an observation family."""
        return FactorSettings()

    @property
    def factors_in_words(self) -> str:
        """Approximation of an observation family; empty for a Gaussian observation."""
        return ""

    @property
    def constraints_in_words(self) -> str:
        """All constraints, and at how many times they hold; empty without constraints."""
        return ""

    def with_times(self, times: Any, layout: GridLayout | None = None) -> SeriesLikelihood:
        """Return the same distribution with other times, and with the layout of its time grid if that is known."""
        likelihood = copy.copy(self)
        for name in ("time_grid", "_laid_out"):
            likelihood.__dict__.pop(name, None)
        likelihood.times, likelihood.layout = times, layout
        return likelihood

    @property
    def is_iterated(self) -> bool:
        """Whether smoothed moments to linearise about have an effect."""
        return False

    def with_about(self, about: Anchor | None) -> SeriesLikelihood:
        """Return the same distribution with other moments from which its iterations start, if `is_iterated`."""
        likelihood = copy.copy(self)
        likelihood.about = about if self.is_iterated else None
        return likelihood

    def expand(self, batch_shape: tuple[int, ...]) -> dist.Distribution:
        """Return independent series with the same parameters; in a ``numpyro.plate`` that is an error.

        Raises:
            ValueError: in a plate, where several series are an `lfm_ppl.panel`.
        """
        if tuple(batch_shape) and any(isinstance(handler, numpyro.plate) for handler in _PYRO_STACK):
            several = ("give each a site of its own" if self.regime_names else
                       "take lfm.panel(build, parameters, times) in the plate, with a leading axis of its size in "
                       "parameters")
            raise ValueError(f"an lfm.{type(self).__name__} is the distribution of one series, and cannot be repeated "
                             f"to the batch shape {tuple(batch_shape)} of a numpyro.plate. For several series "
                             f"{several}; for one series put the site outside of the plate.")
        return super().expand(batch_shape)

    def filter(self, y: Any) -> FilterResult:
        """Filter with this distribution's rule and steps; see `lfm_ppl.filter`. Constraints are ignored.

        It is a single pass, also where `log_prob` and `smooth` iterate posterior linearisation.
        """
        y = self.checked(y)
        result = self._filter(y)
        warn_of_long_steps(self.ssm, self.settings.rule, self.time_grid, self.settings.integration_steps,
                           result.filtered_mean, result.log_likelihood)
        return result

    def _filter(self, y: jax.Array) -> FilterResult:
        return filter_on(self.ssm, self.settings.rule, self.time_grid, y, jnp.asarray(self.times, float))

    def warn_of_long_steps(self, y: jax.Array, log_likelihood: jax.Array) -> None:
        """Warn where a step is too long for a fast decay, outside of compiled code; y (T, D) is checked."""
        warn_of_long_steps(self.ssm, self.settings.rule, self.time_grid, self.settings.integration_steps,
                           lambda: self._filter(y).filtered_mean, log_likelihood)

    @property
    def has_explicit_steps(self) -> bool:
        """Whether a filter takes explicit steps of fixed length, see `lfm_ppl.filtering.stiffness`."""
        return any(integrator.is_explicit for integrator in self.integrators)

    def explicit_steps(self, y: jax.Array, requested_times: Any = None) -> ExplicitSteps | None:
        """Return what limits the explicit steps of the filter of ``y`` (T, D); None where there are none.

        Several regimes are a leading axis; ``requested_times`` (K,) as in `smooth`.
        """
        if not self.has_explicit_steps:
            return None
        grid = self.smoother_grid(requested_times)
        # Linearised at the mean: the rates need no more, and this compiles fastest.
        result = filter_on(self.ssm, Taylor(), grid, y, jnp.asarray(self.times, float))
        return explicit_steps(self.ssm, grid, result.filtered_mean)

    def smoother_grid(self, requested_times: Any = None, steps: int | None = None) -> TimeGrid:
        """Return the time grid of `smooth`, with its arguments."""
        if requested_times is None and steps is None:
            return self.time_grid
        if isinstance(requested_times, GridLayout):
            return self.grid_of(requested_times)
        settings = self.settings
        return build_time_grid(self.ssm, self.times, settings.integration_steps if steps is None else steps,
                               settings.max_step, requested_times,
                               tolerance=settings.tolerance)._replace(method=settings.method)

    def smooth(self, y: Any, at: Any = None, steps: int | None = None) -> SmootherResult:
        """Smooth with this distribution's settings, or with other ``steps``; see `lfm_ppl.smooth`.

        Constraints are ignored. Moments to start from are interpolated at requested times.

        Args:
            y: (T, D), NaN where missing.
            at: (K,) requested times, or the result of `lay_out` for them; None: the times of the data.
            steps: integration steps between two consecutive times; None: as many as the distribution takes.
        """
        grid, y = self.smoother_grid(at, steps), self.checked(y)
        about = None if self.about is None else self.about.on_grid(grid, at is None and steps is None)
        result = smooth_on(self.ssm, self.settings.rule, grid, y, self.settings.iterations, self.settings.damping,
                           self.factor_settings, about)
        if not self.is_family:
            warn_of_iterations(result.change, result.log_likelihood_change)
        warn_of_long_steps(self.ssm, self.settings.rule, grid,
                           self.settings.integration_steps if steps is None else steps,
                           lambda: filtered_mean(result, grid), result.log_likelihood)
        return result

    def log_prob_per_observation(self, value: Any) -> jax.Array:
        """Return (T,): log p(y_k | y_1:k-1) of the present entries of each observation.

        Under constraints these are terms of the unconstrained model, which do not sum to `log_prob`.
        """
        y = self.checked(value)
        log_likelihood = self._guarded_terms(y, lambda terms: terms)
        warn_of_breakdown(self.ssm, self.settings.rule, self.time_grid, y, None, log_likelihood, None, True)
        return log_likelihood

    def sample_path(self, key: jax.Array, y: jax.Array, at: Any = None) -> tuple[jax.Array, jax.Array]:
        """Draw a trajectory given the data, for a state that is not Gaussian.

        Args:
            key: a JAX random key.
            y: (T, D), NaN where missing.
            at: (L,) times; None: the times of the data.

        Returns:
            (x, u) (L, M + R), and the times (L,).
        """
        raise NotImplementedError

    def scores(self, key: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
        """Return scores of ``y`` (T, D), and new data along a path given ``y``.

        Returns:
            "leave_one_out" (T, D), log p of each entry given all others, zero where it is missing;
            "one_step_ahead" (T,); "residual" and "replicate" (T, D).
        """
        keys = split_by_name(key, ("path", "noise"))
        result = self.smooth(y)
        if self.has_gaussian_state:
            states, times = result.sample_joint(keys["path"], 1)[0], result.times
            w = jax.vmap(self.ssm.inputs)(states, times)
        else:
            w, times = self.sample_path(keys["path"], y)
        return {"leave_one_out": self.leave_one_out(y, result), "one_step_ahead": result.log_likelihood,
                "residual": result.whitened_innovation, "replicate": replicate(self.ssm, keys["noise"], w, times)}

    def leave_one_out(self, y: jax.Array, smoothed: SmootherResult) -> jax.Array:
        """Return (T, D), log p of each entry given all others, given the result of `smooth`."""
        return smoothed.entry_leave_one_out

    def convergence(self, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return whether the factors converge, and whether the log density is finite."""
        raise NotImplementedError

    def checked(self, y: Any) -> jax.Array:
        """Return the observations (T, D) as an array after checking them."""
        count, outputs = self.event_shape
        return check_observations(y, count, outputs, model=self.model)

    def _terms_and_changes(self, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return (T,): log p(y_k | y_1:k-1), and (2,): both changes in the last iteration, see `SmootherResult`.

        The terms of an observation family come from the assumed density filter.
        """
        problem, updater = self.problem, GaussianUpdate(y)
        if self.is_family:
            return assumed_density_filter(problem, y).log_likelihood, jnp.full(2, jnp.nan)
        about = None if self.about is None else self.about.on_grid(self.time_grid, True)
        points, change, previous = posterior_linearisation(problem, updater, self.settings.iterations,
                                                           self.settings.damping, about)
        terms = at_intervals(forward(problem, updater, about=points).log_likelihood, self.time_grid.observed)
        return terms, jnp.stack([change, terms.sum() - previous])

    def _guarded_terms(self, y: jax.Array, reduce: Callable[[jax.Array], jax.Array]) -> jax.Array:
        """Return an array, such as their sum, of the terms log p(y_k | y_1:k-1), -inf where it is not finite.

        Outside of compiled code there is a warning where the iterations have not settled.
        """
        if self.is_family or self.settings.iterations < 2 or checks.traced((self.ssm, self.time_grid, y)):
            return finite_or_minus_infinity(lambda y: reduce(self._terms_and_changes(y)[0]), y)

        def values_and_changes(y: jax.Array) -> jax.Array:
            terms, changes = self._terms_and_changes(y)
            # User functions may hold tracers that the model's leaves do not show.
            return jnp.append(reduce(terms), jax.lax.stop_gradient(changes))

        values = finite_or_minus_infinity(values_and_changes, y)
        warn_of_iterations(*values[-2:])
        return values[:-2]


def check_model(model: Any) -> None:
    """Raise TypeError unless ``model`` is a latent force model."""
    if not isinstance(model, LatentForceModel):
        raise TypeError(f"model must be an lfm.LatentForceModel, got {type(model).__name__}.")


def refuse_times_by_site(times: Any) -> None:
    """Raise TypeError if the times of one site are a dict of the times of several sites."""
    if isinstance(times, Mapping):
        name = next(iter(times), "y")
        raise TypeError("times must be an array, the times of one site, got a dict of "
                        f"{', '.join(map(str, times)) or 'none'}: write times[{name!r}], and obs=y[{name!r}].")


def repeat_draw(draw: Callable[[jax.Array], Any], key: jax.Array, sample_shape: tuple[int, ...]) -> Any:
    """Return independent draws (*sample_shape, ...) of the arrays ``draw(key)``; one draw where the shape is empty."""
    if not sample_shape:
        return draw(key)
    draws = jax.vmap(draw)(jax.random.split(key, int(np.prod(sample_shape))))
    return jax.tree.map(lambda a: a.reshape(*sample_shape, *a.shape[1:]), draws)
