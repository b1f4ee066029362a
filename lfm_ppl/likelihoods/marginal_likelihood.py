"""The marginal likelihood of a latent force model as one NumPyro distribution.

1. A Gaussian observation: the filter's innovations give log p(y_k | y_1:k-1). For a model that is not linear, posterior
   linearisation repeats the filter about the smoothed moments.
2. An observation family: expectation propagation replaces each likelihood term by a Gaussian factor; the log density is
   the log evidence of the converged factors (`lfm_ppl.filtering.ep`).
3. A failure inside compiled code is a log density of -inf with zero gradients; outside of it a warning names the row.

Source: Hartikainen et al. (2012), section 4; Singer (2011), AStA 95.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from lfm_ppl.filtering.breakdown import warn_of_breakdown
from lfm_ppl.filtering.ep.evidence import Evidence, evidence
from lfm_ppl.filtering.ep.settings import FactorSettings, as_settings
from lfm_ppl.filtering.ep.terms import FamilyTerms
from lfm_ppl.filtering.forward import forward
from lfm_ppl.filtering.intervals import divide_intervals
from lfm_ppl.filtering.iterated import Anchor, converged_anchor, number_of_iterations, posterior_linearisation
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.likelihoods.filter_settings import FilterSettings
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood, check_model, repeat_draw
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.resolution import check_resolution
from lfm_ppl.model.simulate import SimulationProgram, input_breakpoints
from lfm_ppl.model.stiff_simulation import divide_steps, warn_of_infinite_states
from lfm_ppl.utils import checks
from lfm_ppl.utils.gradients import finite_or_minus_infinity

SIMULATION_STEPS = 5
"""Steps of the simulator for one integration step of the filter: its paths are rougher than moments."""


CONSTRAINTS = ("lower", "upper", "constraints", "grid", "draws")
"""Arguments of `lfm_ppl.ConstrainedLikelihood` that this likelihood does not have."""


class MarginalLikelihood(SeriesLikelihood):
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
        steps: integration steps between two consecutive times; 10 by default.
        max_step: longest step, in units of time; longer intervals get more steps. None: twice the median step. A linear
            model without known inputs is exact, and needs no steps.
        iterations: of posterior linearisation; 0 for none. By default 3 for a model that is not linear, and 0 for a
            linear model, an observation family, or with a ``tolerance``.
        damping: largest share of each new iterate that is taken, by default 0.7; less where the iterates turn back.
        tolerance: largest error of an integration step, in standard deviations. With it the length of the steps follows
            the moments, for every parameter anew, for posteriors over slow and fast models; up to five times ``steps``
            are tried. None: ``steps`` equal steps. Not with ``iterations``. A linear model has exact transitions, with
            equal steps over its known inputs.
        factors: of an observation family, how its factors are refined: "ep" (expectation propagation, the default),
            "variational", "laplace", or `lfm_ppl.FactorSettings`. The log density is then the log evidence of the
            converged factors. Where the model is not linear it is linearised about smoothed moments, ``iterations``
            times (8 by default). Where factors do not converge, the log density of a model that is not linear is that
            of assumed density filtering, which is rougher, and -inf in a linear one.
        method: of integration, "runge-kutta" (explicit, the default), or "exponential" for stiff dynamics: its steps of
            order three are stable at any rate of decay, and each costs about ten explicit steps. It works
            with a ``tolerance``.
        filter_steps: integration steps of the filter and the smoother, where fewer than ``steps`` suffice; simulations
            and particle filters still take ``steps``. None: ``steps``.
        about: smoothed moments from which the iterations start, which leaves a fifth of the errors at the same cost:
            ``bound.anchor(z)`` of a bound model or ``likelihood.anchor(y)`` at a point of high density, of the same
            model and rule; at other times, or with other steps, they are interpolated. They are held fixed in the
            gradient. With ``iterations=0`` the model is linearised about them. None: iterations start from the filter's
            moments. They have no effect in a linear model, with an observation family or a ``tolerance``.

    Raises:
        ValueError, TypeError: as `lfm_ppl.filter`; also where it is used in a ``numpyro.plate``. In compiled code a
            failure is a log density of -inf.

    Warns:
        FilterWarning: outside of compiled code, where a log density is -inf or factors do not converge: where and how;
            where the last iteration changes a smoothed mean by more than one standard deviation, or the log density by
            more than 0.5; where an explicit step is too long for a fast decay: which state and row, and the remedy.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.3), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.MarginalLikelihood(model, jnp.arange(3.0)).event_shape
        (3, 1)

    Source: Hartikainen et al. (2012), section 4; Singer (2011), AStA 95.
    """

    pytree_data_fields = ("about",)

    def __init__(self, model: LatentForceModel, times: ArrayLike, rule: Rule | None = None, steps: int | None = None,
                 max_step: float | None = None, iterations: int | None = None, damping: float | None = None,
                 tolerance: float | None = None, factors: FactorSettings | str | None = None, *,
                 method: str | None = None, filter_steps: int | None = None, about: Anchor | None = None,
                 validate_args: bool | None = None, **unknown: Any):
        for name in unknown:
            remedy = "; constraints are arguments of lfm.ConstrainedLikelihood" if name in CONSTRAINTS else ""
            raise TypeError(f"MarginalLikelihood has no argument {name!r}{remedy}.")
        check_model(model)
        arguments = {"rule": rule, "steps": steps, "max_step": max_step, "iterations": iterations, "damping": damping,
                     "tolerance": tolerance, "method": method, "factors": factors, "filter_steps": filter_steps}
        settings, setting_names = FilterSettings.of(arguments)
        if factors is not None and not isinstance(model.observation, ObservationFamily):
            raise ValueError("factors are for an observation family such as lfm.PoissonObservation; the observation of "
                             "this model is Gaussian, whose filter needs none. Leave out factors.")
        super().__init__(model, times, settings, setting_names)
        self.settings = replace(settings, iterations=number_of_iterations(iterations, self.ssm, settings.tolerance))
        self.about = about if self.is_iterated else None

    def with_settings(self, **settings: Any) -> MarginalLikelihood:
        """Return the same distribution with other settings of its filter, such as ``steps``."""
        return MarginalLikelihood(self.model, self.times, **self.arguments | settings).with_about(self.about)

    @property
    def is_iterated(self) -> bool:
        """Whether smoothed moments to linearise about have an effect: not for a family, a tolerance, a linear model."""
        return not (self.is_family or self.settings.tolerance is not None or self.ssm.plan.is_linear)

    def anchor(self, y: Any) -> Anchor:
        """Return the converged smoothed moments given ``y`` (T, D), for ``about`` of the same likelihood.

        There are as many iterations of posterior linearisation, 100 at most, as change a smoothed mean by 1e-9
        standard deviations. They have no derivative in reverse mode.

        Raises:
            ValueError: an observation family or a tolerance, which take no such moments.
        """
        if self.is_family or self.settings.tolerance is not None:
            raise ValueError("smoothed moments to start from are for a Gaussian observation and equal integration "
                             "steps; leave out tolerance.")
        about = None if self.about is None else self.about.on_grid(self.time_grid, True)
        return converged_anchor(self.problem, GaussianUpdate(self.checked(y)), self.settings.damping, about)

    def log_likelihood_after(self, y: jax.Array, iterations: jax.Array, steps: jax.Array,
                             most_steps: int | None = None) -> jax.Array:
        """Return the log likelihood of ``y`` (T, D) after a traced number of iterations from an anchor.

        It has no derivative in reverse mode, and one program serves all numbers.

        Args:
            y: (T, D), NaN where missing.
            iterations: number of iterations.
            steps: traced number of integration steps between two times; it has no effect without ``most_steps``.
            most_steps: largest number of them; None: the steps of the distribution.
        """
        assert self.about is not None
        grid = self.time_grid
        if most_steps is not None:
            # Where breakpoints divide an interval between two times, its parts have their share of the steps.
            part, whole = grid.steps, self.settings.integration_steps
            grid = divide_intervals(grid, -(-part * steps // whole), -(-part * most_steps // whole))
        problem, updater = filter_problem(self.ssm, self.settings.rule, grid), GaussianUpdate(y)
        points = posterior_linearisation(problem, updater, iterations, self.settings.damping,
                                         self.about.on_grid(grid, most_steps is None)).points
        return forward(problem, updater, about=points).log_likelihood.sum()

    @property
    def description(self) -> str:
        """How the likelihood is computed: exact or by which approximation."""
        if self.is_family:
            return f"approximate (factors by {self.factors_in_words})"
        settings = self.settings
        if self.ssm.plan.is_linear:
            if self.ssm.plan.has_exact_moments:
                return "exact (the model is linear)"
            if self.ssm.plan.has_exact_transition:
                ignored = "" if settings.tolerance is None else "; tolerance has no effect"
                return (f"exact transitions, known inputs integrated in {settings.steps} steps between two times"
                        f"{ignored}")
            return "linear model, integrated " + (
                f"in {settings.steps} steps between two times" if settings.tolerance is None
                else f"with tolerance {settings.tolerance:g}")
        steps = "" if settings.filter_steps is None else f", {settings.integration_steps} steps"
        if not settings.iterations:
            single = "a single pass of the filter" if self.about is None else "linearised about smoothed moments"
            return f"approximate ({single}{steps})"
        start = "" if self.about is None else " from smoothed moments"
        count = {1: "one iteration", 2: "two iterations", 3: "three iterations"}.get(
            settings.iterations, f"{settings.iterations} iterations")
        return f"approximate ({count} of posterior linearisation{start}{steps})"

    @property
    def factor_settings(self) -> FactorSettings:
        """Settings of the factors of an observation family."""
        return as_settings(self.settings.factors, self.settings.iterations)

    @property
    def factors_in_words(self) -> str:
        """Approximation of an observation family; empty for a Gaussian observation."""
        if not self.is_family:
            return ""
        settings = self.factor_settings
        count = f", linearised at most {settings.relinearisations} times"
        return settings.method + ("" if self.ssm.plan.is_linear else count)

    def log_prob(self, value: Any) -> jax.Array:
        """Return the log marginal likelihood of ``value`` (T, D), NaN where missing; batch dimensions may lead."""
        value = jnp.asarray(checks.unmask(value), float)
        if value.ndim > 2:
            return jax.vmap(self.log_prob)(value)
        check_resolution(self.model, self.times, value)
        y = self.checked(value)
        has_converged: Any = True
        if self.is_family:
            log_likelihood, has_converged = finite_or_minus_infinity(self._evidence_and_convergence, y)
        else:
            # The guard is around the sum: one failure makes it -inf, and the derivatives of all other terms zero.
            log_likelihood = self._guarded_terms(y, lambda terms: terms.sum(keepdims=True))[0]
        warn_of_breakdown(self.ssm, self.settings.rule, self.time_grid, y, None, log_likelihood, self.factor_settings,
                          has_converged)
        self.warn_of_long_steps(y, log_likelihood)
        return log_likelihood

    def evidence(self, y: jax.Array) -> Evidence:
        """Return the log evidence of an observation family and its parts; ``y`` (T, D) is not checked."""
        assert isinstance(self.model.observation, ObservationFamily)
        terms = FamilyTerms(self.model.observation, y)
        return evidence(self.problem, terms, self.factor_settings)

    def convergence(self, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return whether the factors converge, and whether the log evidence is finite."""
        result = self.evidence(y)
        return result.refined.fixed_point.converged, jnp.isfinite(result.log_evidence)

    def _evidence_and_convergence(self, y: jax.Array) -> jax.Array:
        result = self.evidence(y)
        has_converged = result.refined.fixed_point.converged
        return jnp.stack([result.log_evidence, has_converged.astype(result.log_evidence.dtype)])

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Simulate the real model: (*sample_shape, T, D).

        No step is longer than a fifth of the longest step of the filter. Outside of compiled code, fast rates divide
        the steps further, and a state that is not finite is a warning, as in `lfm_ppl.simulate`.
        """
        state, y = self.simulate(key, sample_shape)
        warn_of_infinite_states(state, self.times, self.model.state_names)
        return y

    def simulate(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> tuple[jax.Array, jax.Array]:
        """Return physical states (*sample_shape, T, M) and observations (*sample_shape, T, D); see `sample`."""
        initial_time, times = self.time_grid.initial_time, checks.concrete(self.times)
        steps, breakpoints = SIMULATION_STEPS * self.settings.steps, input_breakpoints(self.model, times, initial_time)
        program = SimulationProgram(self.ssm, steps, breakpoints, self.is_stiff)
        lengths = checks.concrete(self.time_grid.intervals.length)
        if times is not None and lengths is not None and not checks.traced(initial_time):
            if self.settings.tolerance is None:
                grid_steps = self.time_grid.steps * self.settings.steps / self.settings.integration_steps
                longest = float(lengths.max(initial=0.0)) / grid_steps / SIMULATION_STEPS
                program = replace(program, breakpoints=divide_steps(times, initial_time, steps, breakpoints, longest))
            program = program.resolved(times, float(initial_time))

        def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
            simulation, _ = program.run(key, jnp.asarray(self.times, float), jnp.asarray(initial_time, float))
            return simulation.state, simulation.y

        return repeat_draw(draw, key, sample_shape)
