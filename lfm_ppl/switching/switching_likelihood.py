"""The marginal likelihood of a model that switches between regimes, as one NumPyro distribution.

1. `regimes` builds the filter problem of each regime on a common time grid, and the transition probabilities.
2. `log_prob` runs the filter of all regimes, in which the states are merged by their moments (`switching.regimes`).
3. `smooth` gives probabilities of the regimes and moments of the state, as averages over draws of regimes.
4. `sample_path` draws states and regimes given the data; `lfm_ppl.fit` stores such paths.
5. `sample` simulates the real model by `switching.switched_simulation`, with the chain as its controller.

Source: Blom and Bar-Shalom (1988), IEEE Transactions on Automatic Control 33(8); Lindsten and others (2016), IEEE
Journal of Selected Topics in Signal Processing 10(2).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.filtering.breakdown import FilterWarning
from lfm_ppl.filtering.intervals import TimeGrid, with_state_maps
from lfm_ppl.filtering.moments import Moments
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.smoother import MeanSd, input_marginal
from lfm_ppl.filtering.stiffness import (
    ExplicitSteps,
    explicit_steps,
    long_step_message,
    warn_of_message,
)
from lfm_ppl.likelihoods.filter_settings import FilterSettings
from lfm_ppl.likelihoods.marginal_likelihood import SIMULATION_STEPS
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood, repeat_draw
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import replicate
from lfm_ppl.model.resolution import check_resolution
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.model.stiff_simulation import warn_of_infinite_states
from lfm_ppl.particles.stochastic_steps import choose_scheme
from lfm_ppl.switching.chain import MarkovChain, check_probabilities, check_rates, transition_matrices
from lfm_ppl.switching.regime_model import check_models, joint_model
from lfm_ppl.switching.regimes import (
    MERGINGS,
    RegimeProblem,
    filter_regimes,
    merge,
    regime_transitions,
    sample_regimes,
    sample_states,
    smooth_path,
)
from lfm_ppl.switching.switched_model import SwitchedProblem, with_forces_of
from lfm_ppl.switching.switched_simulation import simulate_paths
from lfm_ppl.utils import checks
from lfm_ppl.utils.gradients import finite_or_minus_infinity
from lfm_ppl.utils.programs import Program
from lfm_ppl.utils.random_keys import split_by_name

SMOOTHER_DRAWS = 256
"""Draws of regimes over which the smoother averages; they have the same random numbers in each call."""


class RegimeSmootherResult(eqx.Module):
    """Result of `Switching.smooth`.

    Attributes:
        times: (K,), requested times.
        probability: (K, R), of the R regimes given all observations.
        mean, covariance: (K, n), (K, n, n), of the joint state of mechanism and forces, merged over the regimes.
        input_mean, input_covariance: (K, M + R), (K, M + R, M + R) of w = (x, u), merged over the regimes.
        log_likelihood: (T,), log p(y_k | y_1:k-1).
        regimes: names of the regimes.
        state_names, force_names: names of the M states and the R forces.
    """

    times: jax.Array
    probability: jax.Array
    mean: jax.Array
    covariance: jax.Array
    input_mean: jax.Array
    input_covariance: jax.Array
    log_likelihood: jax.Array
    regimes: tuple[str, ...] = eqx.field(static=True)
    state_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)

    def state(self, name: str) -> MeanSd:
        """Return mean (K,) and sd (K,) of a physical state, over the regimes.

        Raises:
            ValueError: an unknown name; the message lists similar names.
        """
        return input_marginal(self, "state", name)

    def force(self, name: str) -> MeanSd:
        """Return mean (K,) and sd (K,) of a force, over the regimes."""
        return input_marginal(self, "force", name)


class Switching(SeriesLikelihood):
    """Distribution of observations of a system that switches between regimes by a Markov chain.

    Regime r(t) is a Markov chain in continuous time; in regime r the system is the latent force model of r,

        p(r(t + dt) = j | r(t) = i) = exp(rates dt)_ij,    dx = f_r(x, u, t) dt + ...,    y_k ~ N(h_r(x, u, t_k), R_r).

    Between two rows the system follows the regime of the later row. The K regimes share one scan; states that come
    from different regimes are merged by their mean and covariance. The density is exact where the merged states have
    equal moments, and where a regime begins with a state that does not depend on the past.

    Args:
        models: name of a regime -> its `LatentForceModel`. All have the same states, forces and outputs by name, linear
            observations or not, Gaussian noise, and the same events.
        rates: (K, K), rates of the transitions from regime i (row) to regime j, in 1/(unit of time), in the order of
            ``models``; zero on the diagonal, or with rows that sum to zero. They may be sampled.
        times: (T,), non-decreasing.
        rule: linearisation rule; `Cubature()` by default.
        steps: integration steps between two consecutive times, by default 10; a linear time-invariant model is exact
            with any number.
        max_step: longest step, in units of time; longer intervals get more steps.
        initial: (K,), probabilities of the regimes at the first observation; None: equal ones.
        merging: "gpb2", K^2 filters a row; "gpb3" and "gpb4", K^3 and K^4 filters, for regimes whose states stay
            apart; or "imm", K filters, which is faster and merges earlier.
        method: of integration, as in `lfm_ppl.MarginalLikelihood`.

    Raises:
        ValueError, TypeError: the models differ in states or outputs; a rate or a probability is invalid; and as
            `lfm_ppl.filter`. In compiled code a failure is a log density of -inf.

    Warns:
        FilterWarning: outside of compiled code, where the log density is -inf: the first row at which it is; where an
            explicit step of a regime is too long for a fast decay: which regime, state and row, and the remedy.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> def build(scale):
        ...     return lfm.LatentForceModel(
        ...         lambda x, u, t: u - x, {"u": lfm.Matern(scale, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> switching = Switching({"calm": build(0.1), "rough": build(2.0)}, [[0.0, 0.2], [0.5, 0.0]], jnp.arange(5.0))
        >>> result = switching.smooth(jnp.array([[0.0], [0.1], [2.0], [-1.0], [0.0]]))
        >>> result.regimes, result.probability.shape, result.force("u").mean.shape
        (('calm', 'rough'), (5, 2), (5,))

    Source: Blom and Bar-Shalom (1988), IEEE Transactions on Automatic Control 33(8), for IMM; Tugnait (1982),
    Automatica 18(5), for GPBn; Lindsten and others (2016), IEEE Journal of Selected Topics in Signal Processing 10(2),
    for the draws.
    """

    pytree_data_fields = ("models", "rates", "initial")
    pytree_aux_fields = ("regime_names", "merging")
    accepted: ClassVar[tuple[str, ...]] = ("rule", "steps", "max_step", "method")

    def __init__(self, models: Mapping[str, LatentForceModel], rates: ArrayLike, times: ArrayLike,
                 rule: Rule | None = None, steps: int | None = None, max_step: float | None = None, *,
                 initial: ArrayLike | None = None, merging: str = "gpb2", method: str | None = None) -> None:
        checks.one_of("merging", merging, MERGINGS)
        by_name = check_models(models)
        count = len(by_name)
        self.models, self.regime_names = tuple(by_name.values()), tuple(by_name)
        self.rates = check_rates(rates, count)
        self.initial = check_probabilities(jnp.full(count, 1.0 / count) if initial is None else initial, count)
        self.merging = merging
        settings, setting_names = FilterSettings.of(
            {"rule": rule, "steps": steps, "max_step": max_step, "method": method})
        super().__init__(joint_model(by_name, self.initial), times, settings, setting_names)

    @property
    def has_gaussian_state(self) -> bool:
        """Whether the state given data and parameters is Gaussian, so that one filter describes it."""
        return False

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of the constructor besides models, rates and times, without settings that are left open."""
        return super().arguments | {"initial": self.initial, "merging": self.merging}

    def with_settings(self, **settings: Any) -> Switching:
        """Return the same distribution with another ``rule``, ``steps``, ``max_step`` or ``method``.

        They are the numerics of each regime. ``merging`` is none: it is the approximation itself, with the number of
        filters, as ``initial`` is a part of the model. For another one construct the distribution again.
        """
        for name in settings:
            if name not in self.accepted:
                raise ValueError(f"{name} is not a setting of lfm.Switching, whose settings are "
                                 f"{', '.join(self.accepted)}.")
        models = dict(zip(self.regime_names, self.models, strict=True))
        return Switching(models, self.rates, self.times, **self.arguments | settings)

    @property
    def description(self) -> str:
        """How the likelihood is computed."""
        return f"approximate (states of {len(self.models)} regimes merged by their moments, {self.merging})"

    @property
    def ssms(self) -> tuple[StateSpaceModel, ...]:
        """The state-space models of the regimes, with a common state of the forces."""
        return tuple(state_space(with_forces_of(model, self.models[0])) for model in self.models)

    def regimes(self, grid: TimeGrid | None = None) -> RegimeProblem:
        """Return the filter problems of the regimes and the chain on a time grid; None: that of the data."""
        grid = self.time_grid if grid is None else grid
        problems = tuple(filter_problem(ssm, self.settings.rule, grid) for ssm in self.ssms)
        return RegimeProblem(problems, self.initial, *regime_transitions(self.rates, grid), MERGINGS[self.merging])

    def log_prob(self, value: Any) -> jax.Array:
        """Return the log density of ``value`` (T, D), NaN where missing; batch dimensions may lead."""
        value = jnp.asarray(checks.unmask(value), float)
        if value.ndim > 2:
            return jax.vmap(self.log_prob)(value)
        for model in self.models:
            check_resolution(model, self.times, value)
        y = self.checked(value)
        log_likelihood = finite_or_minus_infinity(lambda y: self._one_step_ahead(y).sum(), y)
        if checks.concrete(log_likelihood) == -np.inf:
            checks.warn(self.breakdown(y), FilterWarning)
        self._warn_of_long_steps(self.time_grid, self.settings.steps, y, log_likelihood)
        return log_likelihood

    def explicit_steps(self, y: jax.Array, requested_times: Any = None) -> ExplicitSteps | None:
        """Return what limits the explicit steps of each of the regimes (K, ...); None where there are none.

        Each regime is followed from the filtered means, merged over all regimes.
        """
        return self._explicit_steps_on(self.smoother_grid(requested_times), y) if self.has_explicit_steps else None

    def _explicit_steps_on(self, grid: TimeGrid, y: jax.Array) -> ExplicitSteps:
        probability, moments, _ = filter_regimes(self.regimes(grid), y).filtered
        mean = jnp.einsum("nkm,nkmi->ni", probability, moments.mean)[jnp.asarray(grid.observed)]
        steps = []
        for ssm, integrator in zip(self.ssms, self.integrators, strict=True):
            limits = explicit_steps(ssm, grid, mean)
            # A regime that is integrated exactly has no step.
            steps.append(limits if integrator.is_explicit else limits._replace(step=jnp.zeros_like(limits.step)))
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *steps)

    def _warn_of_long_steps(self, grid: TimeGrid, steps: int, y: jax.Array, log_likelihood: jax.Array) -> None:
        """Warn where a step of a regime is too long for a fast decay, outside of compiled code; y (T, D) is checked."""
        if checks.traced((self.models, self.rates, log_likelihood)) or not self.has_explicit_steps:
            return
        if not np.isfinite(np.asarray(log_likelihood)).all():
            return
        # One program: eager operations take longer to compile, one by one.
        limits = Program(lambda y: self._explicit_steps_on(grid, y))(y)
        warn_of_message(long_step_message(limits, self.models[0].state_names, steps, regime_names=self.regime_names))

    def breakdown(self, y: jax.Array) -> str:
        """Return a sentence on the first row at which the density is not finite."""
        row = int(jnp.argmin(jnp.isfinite(self._one_step_ahead(y))))
        return (f"the filter breaks down in all regimes at row {row}, t = {float(self.times[row]):g}: the observation "
                "is impossible, or the innovation covariance is not positive definite.")

    def log_prob_per_observation(self, value: Any) -> jax.Array:
        """Return (T,): log p(y_k | y_1:k-1) of the present entries of each observation."""
        return finite_or_minus_infinity(self._one_step_ahead, self.checked(value))

    def _one_step_ahead(self, y: jax.Array) -> jax.Array:
        return filter_regimes(self.regimes(), y).log_likelihood[jnp.asarray(self.time_grid.observed)]

    def convergence(self, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return whether factors converge, of which there are none, and whether the log density is finite."""
        return jnp.asarray(True), jnp.isfinite(self._one_step_ahead(y).sum())

    def filter(self, y: Any) -> Any:
        """Raise ValueError: the moments of one filter do not describe the state."""
        raise ValueError("a model that switches between regimes has no single filter; use smooth, whose result has "
                         "the probabilities of the regimes.")

    def smooth(self, y: Any, at: Any = None, steps: int | None = None) -> Any:
        """Smooth: the probabilities of the regimes, and the state, given all observations.

        Both are averages over 256 draws of the regimes, so that probabilities have standard errors of up to 0.03.

        Args:
            y: (T, D), NaN where missing.
            at: (K,) requested times; None: the times of the data.
            steps: integration steps between two consecutive times; None: the number of the distribution.
        """
        y = self.checked(y)
        grid = self.smoother_grid(at, steps)
        # One program: eager operations take longer to compile, one by one.
        result = Program(lambda y: self._smooth(y, grid))(y)
        self._warn_of_long_steps(grid, self.settings.steps if steps is None else steps, y, result.log_likelihood)
        return result

    def _smooth(self, y: jax.Array, grid: TimeGrid) -> RegimeSmootherResult:
        regimes, requested = self.regimes(grid), jnp.asarray(grid.requested)
        trace = filter_regimes(regimes, y)
        paths, probability = sample_regimes(jax.random.key(0), regimes, trace, y, SMOOTHER_DRAWS)

        times, model = jnp.asarray(grid.requested_times, float), self.models[0]
        maps = [jax.vmap(ssm.input_map)(times) for ssm in self.ssms]
        matrices, offsets = jax.tree.map(lambda *leaves: jnp.stack(leaves), *maps)

        def smooth(path: jax.Array) -> tuple[Moments, Moments]:
            """Return the moments of the joint state, and of w = (x, u) by the map of the regime at each time."""
            # The nodes of the smoother begin with the initial time.
            state = jax.tree.map(lambda a: a[requested + 1], smooth_path(regimes, y, path).moments)
            row = (path[requested], jnp.arange(len(times)))
            matrix, offset = matrices[row], offsets[row]
            return state, Moments(jnp.einsum("kwn,kn->kw", matrix, state.mean) + offset,
                                  jnp.einsum("kwn,knm,kvm->kwv", matrix, state.covariance, matrix))

        equal = jnp.ones(SMOOTHER_DRAWS)
        state, inputs = (jax.vmap(lambda row: merge(equal, row), in_axes=1)(moments)
                         for moments in jax.vmap(smooth)(paths.T))
        return RegimeSmootherResult(
            times, probability[requested], *state, *inputs, trace.log_likelihood[jnp.asarray(grid.observed)],
            self.regime_names, model.state_names, model.force_names)

    def scores(self, key: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
        """Return scores and new data, with a path of regimes r as a further parameter of the draw; see the base class.

        The leave-one-out density is log p(y_kd | y_-kd, r), so that leave-one-out cross-validation weights the paths
        with the parameters. The new data belong to the same path.
        """
        regimes, observed = self.regimes(), jnp.asarray(self.time_grid.observed)
        keys = split_by_name(key, ("path", "states", "noise"))
        trace = filter_regimes(regimes, y)
        path = sample_regimes(keys["path"], regimes, trace, y, 1)[0][:, 0]
        left_out = smooth_path(regimes, y, path).entry_leave_one_out
        states, times = sample_states(keys["states"], regimes, y, path)[observed], jnp.asarray(self.times, float)
        w = self._inputs_of_regimes(states, path[observed], times)
        return {"leave_one_out": left_out[observed], "one_step_ahead": trace.log_likelihood[observed],
                "residual": trace.residual[observed], "replicate": replicate(self.ssm, keys["noise"], w, times)}

    def sample_path(self, key: jax.Array, y: jax.Array, at: Any = None) -> tuple[jax.Array, jax.Array]:
        """Draw a trajectory given the data, whose state is (x, indicators of the regimes); see the base class."""
        grid = self.smoother_grid(at)
        regimes, requested = self.regimes(grid), jnp.asarray(grid.requested)
        path_key, state_key = jax.random.split(key)
        path = sample_regimes(path_key, regimes, filter_regimes(regimes, y), y, 1)[0][:, 0]
        states = sample_states(state_key, regimes, y, path)[requested]
        indices, times = path[requested], jnp.asarray(grid.requested_times, float)
        return self._inputs_of_regimes(states, indices, times), times

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Simulate the real model: (*sample_shape, T, D).

        Outside of compiled code, a state that is not finite is a warning, as in `lfm_ppl.simulate`.
        """
        inputs, y = repeat_draw(self.simulate, key, sample_shape)
        state_names = self.models[0].state_names
        warn_of_infinite_states(inputs[..., :len(state_names)], self.times, state_names)
        return y

    def simulate(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Simulate the real model: (x, indicators of the regimes, u) (T, M + K + R), and observations (T, D)."""
        ssms, times = self.ssms, np.asarray(self.times, float)
        initial_key, path_key = jax.random.split(key)
        grid = with_state_maps(ssms[0], self.smoother_grid(None, SIMULATION_STEPS * self.settings.steps))
        distinct = np.unique(times)
        # The decision at the last time has no consequences.
        chain = MarkovChain(distinct, transition_matrices(self.rates, jnp.diff(distinct, append=distinct[-1])))
        index = jax.random.categorical(initial_key, jnp.log(self.initial))
        starts = jax.tree.map(lambda *leaves: jnp.stack(leaves)[index], *(Moments(*ssm.initial()) for ssm in ssms))
        is_decision = np.zeros(len(np.asarray(grid.intervals.observation)), bool)
        is_decision[np.asarray(grid.observed)[np.append(np.diff(times) > 0, True)]] = True
        problem = SwitchedProblem(ssms, chain, grid, jnp.asarray(is_decision), starts, index[None])
        schemes = tuple(choose_scheme(ssm, "auto") for ssm in ssms)
        w, y, indices, _ = simulate_paths(problem, schemes, jnp.asarray(times), path_key)
        return self._with_indicators(w[:, 0], indices[:, 0]), y[:, 0]

    def _inputs_of_regimes(self, states: jax.Array, indices: jax.Array, times: jax.Array) -> jax.Array:
        """Return (x, indicators of the regimes, u) (T, M + K + R) of joint states (T, n) in the regimes (T,)."""
        candidates = jnp.stack([jax.vmap(ssm.inputs)(states, times) for ssm in self.ssms])
        return self._with_indicators(candidates[indices, jnp.arange(len(times))], indices)

    def _with_indicators(self, w: jax.Array, indices: jax.Array) -> jax.Array:
        size = len(self.models[0].state_names)
        return jnp.concatenate([w[:, :size], jax.nn.one_hot(indices, len(self.models)), w[:, size:]], axis=1)
