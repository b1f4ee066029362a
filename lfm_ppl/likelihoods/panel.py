"""Independent series with shared parameters as one NumPyro distribution with a batch shape.

1. A function builds the latent force model of one series from its parameters.
2. Each series has a `MarginalLikelihood`. `jax.vmap` maps it over parameters, data and, where they differ, times.
3. Inside ``numpyro.plate`` the panel is one site whose log density has one entry for each series.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from numpyro.distributions import constraints

from lfm_ppl.filtering.ep.settings import FactorSettings
from lfm_ppl.filtering.iterated import Anchor
from lfm_ppl.filtering.stiffness import long_step_message, warn_of_message
from lfm_ppl.likelihoods.constrained_likelihood import likelihood_with
from lfm_ppl.likelihoods.likelihood import Likelihood
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood, refuse_times_by_site, repeat_draw
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.events import check_start, event_table
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import check_times
from lfm_ppl.model.stiff_simulation import warn_of_infinite_states
from lfm_ppl.utils import checks
from lfm_ppl.utils.batching import mapped
from lfm_ppl.utils.programs import Program


class Panel(Likelihood):
    """Many independent series as one distribution with a batch shape; made by `panel`."""

    support = constraints.real_matrix
    pytree_data_fields = ("parameters", "times", "about")
    pytree_aux_fields = ("build", "arguments")
    arguments: dict[str, Any] = {}
    about: Anchor | None = None

    def __init__(self, build: Callable[..., LatentForceModel], parameters: Any, times: ArrayLike,
                 arguments: dict[str, Any], about: Anchor | None = None):
        leaves = jax.tree_util.tree_leaves(parameters)
        if not leaves:
            raise ValueError("parameters must hold at least one array with a leading axis for the series.")
        sizes = {np.shape(leaf)[0] if np.ndim(leaf) else None for leaf in leaves}
        if len(sizes) > 1 or None in sizes:
            shapes = [np.shape(leaf) for leaf in leaves]
            raise ValueError("every array in parameters needs the same leading axis, one entry a series; got "
                             f"{shapes}. Repeat a shared parameter with jnp.broadcast_to, or close over it in build.")
        refuse_times_by_site(times)
        self.build, self.parameters, self.times, self.about = build, parameters, times, about
        self.arguments = {name: value for name, value in arguments.items() if value is not None}
        (count,) = sizes
        if self._has_series_times and np.shape(times)[0] != count:
            raise ValueError(f"times has {np.shape(times)[0]} rows for {count} series; give one row a series, or one "
                             "vector for all.")
        concrete_times = checks.concrete(times)
        if self._has_series_times and arguments.get("max_step") is not None:
            raise ValueError("max_step is not supported in a panel whose series have different times, because all "
                             "series share one number of rows. Raise steps, or give all series one vector of times.")
        for series, row in enumerate(concrete_times) if self._has_series_times and concrete_times is not None else ():
            try:
                check_times(row, None)
            except ValueError as error:
                raise ValueError(f"series {series}: {error}") from None
        # Times that all series share stay concrete, because jumps of a force and longest steps depend on them.
        has_events = []

        def zero_event(p: Any, t: jax.Array) -> jax.Array:
            likelihood = self._likelihood(p, t if self._has_series_times else times)
            has_events.append(bool(likelihood.model.events))
            return jnp.zeros(likelihood.event_shape)

        example = jax.eval_shape(zero_event, jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], parameters),
                                 jnp.zeros(np.shape(times)[-1]))
        if not self._has_series_times:
            _ = self.first  # eager checks of concrete values
        if any(has_events) and not checks.traced((parameters, times)):
            self._check_events(np.shape(leaves[0])[0])
        super().__init__((count,), example.shape, validate_args=False)

    @property
    def _has_series_times(self) -> bool:
        return np.ndim(self.times) == 2

    def _likelihood(self, parameters: Any, times: Any, about: Anchor | None = None) -> SeriesLikelihood:
        return likelihood_with(self.build(parameters), times, self.arguments).with_about(about)

    def _check_events(self, count: int) -> None:
        """Raise ValueError if an event of a series lies before its initial time."""

        def event_times(parameters: Any, times: jax.Array) -> tuple[jax.Array, jax.Array]:
            model = self.build(parameters)
            start = times[0] if model.initial_time is None else jnp.asarray(model.initial_time)
            return jnp.asarray(event_table(model.events).all_times), start

        parameters = jax.tree_util.tree_map(jnp.asarray, self.parameters)
        times = jnp.broadcast_to(jnp.asarray(self.times, float), (count, np.shape(self.times)[-1]))
        events, starts = jax.vmap(event_times)(parameters, times)
        if checks.traced((events, starts)):  # build may close over traced parameters
            return
        for series, (row, start) in enumerate(zip(np.asarray(events), np.asarray(starts), strict=True)):
            try:
                check_start(row, float(start))
            except ValueError as error:
                raise ValueError(f"series {series}: {error}") from None

    @property
    def first(self) -> SeriesLikelihood:
        """The distribution of the first series."""
        return self.series(0)

    @property
    def members(self) -> list[SeriesLikelihood]:
        """The distributions of all series."""
        return [self.series(index) for index in range(self.batch_shape[0])]

    def split_key(self, key: jax.Array) -> jax.Array:
        """Return a random key for each series (B,)."""
        return jax.random.split(key, self.batch_shape[0])

    def series(self, index: int) -> SeriesLikelihood:
        """Return the distribution of one series."""
        times = jnp.asarray(self.times, float)[index] if self._has_series_times else self.times
        parameters, about = jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf)[index], (self.parameters, self.about))
        return self._likelihood(parameters, times, about)

    def with_settings(self, **settings: Any) -> Panel:
        """Return the same distribution with other settings of the filter of each series, such as ``steps``."""
        return Panel(self.build, self.parameters, self.times, self.arguments | settings, self.about)

    def with_about(self, about: Anchor | None) -> Panel:
        """Return the same distribution with other moments, by series, from which its iterations start."""
        panel = copy.copy(self)
        panel.about = about
        return panel

    def with_times(self, times: ArrayLike) -> Panel:
        """Return the same distribution with concrete times instead of traced ones."""
        panel = copy.copy(self)
        panel.times = times
        return panel

    def mapped(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return ``function(distribution of a series, *its arguments)``, with the series as leading axis."""
        times = jnp.asarray(self.times, float) if self._has_series_times else None
        return mapped(
            lambda p, t, about, *values: function(self._likelihood(p, self.times if t is None else t, about), *values),
            jax.tree_util.tree_map(jnp.asarray, self.parameters), times, self.about, *arguments)

    def log_prob_per_observation(self, value: Any) -> jax.Array:
        """Return (B, T): the one-step-ahead log densities of each series."""
        return self.mapped(lambda series, y: series.log_prob_per_observation(y), self.checked(value))

    def log_prob(self, value: Any) -> jax.Array:
        """Return (B,): the log marginal likelihood of each series; zero where a series is all missing."""
        value = jnp.asarray(checks.unmask(value), float)
        if value.ndim > 3:
            return jax.vmap(self.log_prob)(value)
        y = self.checked(value)
        log_likelihood = self.mapped(lambda series, y: series.log_prob(y), y)
        self._warn_of_long_steps(y, log_likelihood)
        return log_likelihood

    def _warn_of_long_steps(self, y: jax.Array, log_likelihood: jax.Array) -> None:
        """Warn where a step of a series is too long for a fast decay, outside of compiled code."""
        if checks.traced((self.parameters, self.times, log_likelihood)):
            return
        first = self.first
        if not first.has_explicit_steps or not np.isfinite(np.asarray(log_likelihood)).all():
            return
        explicit_steps = Program(lambda y: self.mapped(lambda series, y: series.explicit_steps(y), y))
        warn_of_message(long_step_message(explicit_steps(y), first.model.state_names, first.settings.integration_steps))

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Simulate every series: (*sample_shape, B, T, D)."""

        def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
            return self.mapped(lambda series, key: series.simulate(key), self.split_key(key))

        state, y = repeat_draw(draw, key, sample_shape)
        warn_of_infinite_states(state, self.times, self.first.model.state_names)
        return y

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
                    model.observation.check_data(concrete.reshape(-1, concrete.shape[-1]), names=model.output_names)
                    break
                try:
                    model.observation.check_data(rows, names=model.output_names)
                except ValueError as error:
                    raise ValueError(f"series {index}: {error}") from None
        return jnp.asarray(value, float)


def panel(build: Callable[..., LatentForceModel], parameters: Any, times: ArrayLike, rule: Rule | None = None,
          steps: int | None = None, max_step: float | None = None, iterations: int | None = None,
          damping: float | None = None, tolerance: float | None = None, factors: FactorSettings | str | None = None,
          method: str | None = None, filter_steps: int | None = None, about: Anchor | None = None) -> Panel:
    """Return many independent series as one distribution, for use inside ``numpyro.plate``.

    The plate's name is the dimension of the series in the result of `lfm_ppl.fit`; `lfm_ppl.select_series` returns one
    of them, and `lfm_ppl.stack_series` pads series of a file.

    Args:
        build: maps the parameters of ONE series to its `LatentForceModel`; it may close over shared parameters.
        parameters: pytree of arrays with a leading axis (B,), one entry a series.
        times: (T,) for all, or (B, T); ragged series are padded: NaN in y, and times that repeat the last one.
        rule: as in `MarginalLikelihood`, and so are the next seven.
        steps: integration steps between two consecutive times; 10 by default.
        max_step: longest step.
        iterations: of posterior linearisation; by default 3 for models that are not linear, see `MarginalLikelihood`.
        damping: largest share of each new iterate that is taken; less where the iterates turn back.
        tolerance: largest error of an integration step, in standard deviations; None for equal steps.
        factors: of an observation family.
        method: of integration.
        filter_steps: of filter and smoother, where fewer than ``steps`` suffice; see `MarginalLikelihood`.
        about: smoothed moments of all series from which the iterations start, ``bound.anchor(z)``, with a leading
            axis (B,).

    Returns:
        A distribution with batch shape (B,) and event shape (T, D).

    Raises:
        ValueError: arrays without a common leading axis; a wrong number of rows of times.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> def build(p):
        ...     return lfm.LatentForceModel(
        ...         lambda x, u, t: u - p["rate"] * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.panel(build, {"rate": jnp.array([0.5, 1.0])}, jnp.arange(3.0)).batch_shape
        (2,)
    """
    arguments = {"rule": rule, "steps": steps, "max_step": max_step, "iterations": iterations, "damping": damping,
                 "tolerance": tolerance, "factors": factors, "method": method, "filter_steps": filter_steps}
    return Panel(build, parameters, times, arguments, about)
