r"""The evidence of data under constraints, Z(y, c) / Z(c).

Z(y, c) is the joint density of the data and of all constraints being met, Z(c) the prior probability that they are
met. Without the denominator the prior of the parameters would favour values for which the constraints hold anyway.

1. Expectation propagation with one factor for each box and row (`lfm_ppl.constrained.boxes`) and exact factors of the
   data gives a Gaussian approximation, and an approximate log Z.
2. A forward scan with the data and tempered factors of the constraints is the proposal of trajectories.
3. Trajectories that respect all constraints are drawn backwards, each with a weight
   (`lfm_ppl.constrained.feasible_paths`). The mean weight is an unbiased estimate of Z.
4. Steps 1 to 3 with all data missing give Z(c). The same random numbers in both reduce the variance of the ratio.

Source: Cunningham, Hennig and Lacoste-Julien (2011), Gaussian probabilities and expectation propagation; Geweke (1991)
and Keane (1994) for step 3.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.constrained.augmented import Rows, augmented_observations
from lfm_ppl.constrained.boxes import BoundedTerms, Boxes
from lfm_ppl.constrained.feasible_paths import FeasiblePaths, sample_feasible_paths
from lfm_ppl.filtering.ep.evidence import Evidence, evidence
from lfm_ppl.filtering.ep.settings import FactorSettings
from lfm_ppl.filtering.forward import FilterTrace, forward
from lfm_ppl.filtering.intervals import TimeGrid
from lfm_ppl.filtering.moments import Record
from lfm_ppl.filtering.problem import FilterProblem, filter_problem
from lfm_ppl.filtering.update import Factors, FactorUpdate
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.model.structure import pattern
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import matmul
from lfm_ppl.utils.random_keys import split_by_name

_LOG_2PI = 1.8378770664093453

_TEMPERING = 0.7
"""Power of the converged factors in the proposal. On dense grids the product of all factors is narrower than the
constraints, and powers from 1/2 to 4/5 give the smallest variance of the weights; on coarse grids power 1 does, and
powers below 4/5 are worse."""


class TruncatedPosterior(eqx.Module):
    """The posterior of a model under constraints: its evidence and its trajectories.

    Attributes:
        ssm: the model with outputs (h, c).
        rule: the linearisation rule.
        grid: time grid of the scan.
        rows: rows of the observations and of the constraints.
        boxes: the constraints.
        variance: (T, D), noise variances of the observations.
        settings: settings of expectation propagation.
    """

    ssm: StateSpaceModel
    rule: Rule
    grid: TimeGrid
    rows: Rows
    boxes: Boxes
    variance: jax.Array
    settings: FactorSettings

    @property
    def is_constrained(self) -> jax.Array:
        """Whether the constraints hold at a row, (K, B)."""
        return jnp.zeros((len(self.rows.times), self.boxes.count), bool).at[self.rows.grid].set(True)

    def _terms(self, y: jax.Array) -> tuple[BoundedTerms, Factors]:
        """Return the exact terms and the exact factors (K, D + B) of the data, zero for the constraints."""
        entries = augmented_observations(y, jnp.zeros((len(self.rows.grid), self.boxes.count)), self.rows)
        measured = entries[:, : y.shape[1]]
        noise = jnp.ones(measured.shape).at[self.rows.data].set(self.variance)
        is_present, zeros = jnp.isfinite(measured), jnp.zeros((len(entries), self.boxes.count))
        data_factors = Factors(jnp.concatenate([jnp.where(is_present, measured, 0.0), zeros], axis=1),
                               jnp.zeros_like(entries),
                               jnp.concatenate([jnp.where(is_present, 1.0 / noise, 0.0), zeros], axis=1))
        return BoundedTerms(measured, noise, self.is_constrained, self.boxes.widths), data_factors

    @property
    def problem(self) -> FilterProblem:
        """The filter problem of the model with the constraints as further outputs."""
        return filter_problem(self.ssm, self.rule, self.grid)

    def propagate_expectations(self, y: jax.Array, record: Record = Record.LIKELIHOOD) -> Evidence:
        """Run expectation propagation; its log evidence is an approximation of log Z(y, c)."""
        terms, data_factors = self._terms(y)
        return evidence(self.problem, terms, self.settings, first=data_factors, record=record)

    def proposal(self, y: jax.Array, propagated: Evidence) -> FilterTrace:
        """Return the forward scan for `sample_paths`: exact factors of the data, tempered ones of the constraints."""
        _, data_factors = self._terms(y)
        power = jnp.concatenate([jnp.zeros(y.shape[1]), jnp.full(self.boxes.count, _TEMPERING)])
        factors = propagated.refined.fixed_point.factors
        factors = Factors(jnp.where(power > 0, factors.centre, data_factors.centre), power * factors.nu,
                          jnp.where(power > 0, power * factors.tau, data_factors.tau))
        return forward(self.problem, FactorUpdate(factors), about=propagated.refined.points, record=Record.SMOOTHER)

    def sample_paths(self, key: jax.Array, forward_pass: FilterTrace, count: int) -> FeasiblePaths:
        """Draw weighted trajectories that respect the constraints, from a proposal."""
        is_constrained = jnp.zeros((forward_pass.phi.shape[0], self.boxes.count), bool)
        is_constrained = is_constrained.at[jnp.asarray(self.grid.observed)].set(self.is_constrained)
        return sample_feasible_paths(key, forward_pass, is_constrained, self.boxes.widths, count)

    def sample_trajectories(self, key: jax.Array, forward_pass: FilterTrace, draws: int, candidates: int) -> jax.Array:
        """Draw trajectories (K, M + R, draws) of (x, u) at the rows, each from weighted candidates.

        Bounded states and forces are computed from their drawn slacks, and so feasible in floating-point arithmetic.
        """
        keys = split_by_name(key, ("candidates", "choice"))
        paths = self.sample_paths(keys["candidates"], forward_pass, draws * candidates)
        # The second half of the paths mirrors the first: this order spreads mirrored pairs over different draws.
        order = jnp.arange(draws * candidates).reshape(candidates, draws).T
        candidate = jax.random.categorical(keys["choice"], paths.log_weights[order], axis=1)
        index = jnp.take_along_axis(order, candidate[:, None], axis=1)[:, 0]
        observed = jnp.asarray(self.grid.observed)
        is_possible = jnp.isfinite(jnp.take_along_axis(paths.log_weights, index, axis=0))
        states, values = (jnp.where(is_possible, a[observed][..., index], jnp.nan)
                          for a in (paths.states, paths.values))
        matrix, offset = jax.vmap(self.ssm.input_map)(jnp.asarray(self.rows.times))
        inputs = matmul(matrix, states) + offset[..., None]
        inputs, values = (jnp.moveaxis(a, 1, -1) for a in (inputs, values))  # (K, S, ...)
        feasible = self.boxes.constraints.impose_bounds(inputs, self.boxes.slacks(values))
        is_constrained = jnp.zeros(len(self.rows.times), bool).at[self.rows.grid].set(True)
        return jnp.moveaxis(jnp.where(is_constrained[:, None, None], feasible, inputs), -1, 1)

    def log_weights(self, key: jax.Array, y: jax.Array, count: int) -> jax.Array:
        """Return log weights (count,) of paths; the expectation of a weight is Z(y, c)."""
        propagated = self.propagate_expectations(y)
        forward_pass = self.proposal(y, propagated)
        variance = jnp.broadcast_to(self.variance, y.shape)
        # The factors of the data lack the normalising constants of its likelihood.
        data = -0.5 * jnp.where(jnp.isfinite(y), _LOG_2PI + jnp.log(variance), 0.0).sum()
        paths = self.sample_paths(key, forward_pass, count)
        weights = forward_pass.log_likelihood.sum() + data + paths.log_weights
        return jnp.where(propagated.refined.fixed_point.converged, weights, -jnp.inf)

    def log_evidence(self, y: jax.Array, draws: int, key: jax.Array | None = None) -> jax.Array:
        """Return log Z(y, c), from ``draws`` weights, or by expectation propagation alone if ``draws`` is 0."""
        if not draws:
            return self.propagate_expectations(y).log_evidence
        weights = self.log_weights(_fixed_key(key), y, draws)
        largest = jax.lax.stop_gradient(jnp.max(weights))
        safe = jnp.where(jnp.isfinite(largest), largest, 0.0)
        return jax.scipy.special.logsumexp(weights - safe) + safe - jnp.log(draws)

    def log_likelihood(self, y: jax.Array, draws: int, key: jax.Array | None = None) -> jax.Array:
        """Return log Z(y, c) - log Z(c), with the same random numbers in both."""
        joint, prior = _with_and_without_data(lambda y: self.log_evidence(y, draws, key), y)
        return joint - prior

    def converged(self, y: jax.Array) -> jax.Array:
        """Return whether the factors converge with the data and without them."""
        return _with_and_without_data(
            lambda y: self.propagate_expectations(y).refined.fixed_point.converged, y).all()

    def effective_sample_size(self, y: jax.Array, draws: int, key: jax.Array | None = None) -> jax.Array:
        """Return the smaller of the effective sample sizes of the weights with the data and without them."""
        return _with_and_without_data(
            lambda y: effective_sample_size(self.log_weights(_fixed_key(key), y, draws)), y).min()


def _with_and_without_data(function: Callable[[jax.Array], jax.Array], y: jax.Array) -> jax.Array:
    """Return the values (2,) of ``function`` for the data and for missing data, compiled once."""
    return jax.vmap(function)(jnp.stack([y, jnp.full_like(y, jnp.nan)]))


def _fixed_key(key: jax.Array | None) -> jax.Array:
    """Return the key, by default a constant one, for which a likelihood is a deterministic function."""
    return jax.random.key(0) if key is None else key


def effective_sample_size(log_weights: jax.Array) -> jax.Array:
    """Return (sum w)^2 / sum w^2 of weights (N,); zero if all weights are zero."""
    largest = log_weights.max()
    is_positive = jnp.isfinite(largest)
    weights = jnp.where(is_positive, jnp.exp(log_weights - jnp.where(is_positive, largest, 0.0)), 1.0)
    return jnp.where(is_positive, weights.sum() ** 2 / (weights**2).sum(), 0.0)


def check_variances(model: LatentForceModel, count: int) -> jax.Array:
    """Check that the observation noise is independent between outputs, and return its variances (count, D)."""
    if model.observation.angular:
        raise ValueError("the posterior under constraints takes no angular outputs; observe their sine and cosine, or "
                         "take lfm.full_information.")
    covariance = model.observation.covariance
    if callable(covariance):
        raise ValueError("the posterior under constraints takes a fixed observation covariance; the model's is a "
                         "function of (x, u, t).")
    value = jnp.asarray(covariance, float)
    if value.ndim > 1:
        concrete = checks.concrete(value)
        if concrete is not None and np.any(concrete * (1.0 - np.eye(concrete.shape[-1]))):
            raise ValueError("the posterior under constraints takes outputs with independent noise; the observation "
                             "covariance has entries off its diagonal.")
        value = jnp.diagonal(value, axis1=-2, axis2=-1)
    checks.positive("the observation covariance", value, "Factors need observations with noise.")
    return jnp.broadcast_to(value, (count, value.shape[-1]))


def check_linear(posterior: TruncatedPosterior, draws: int) -> None:
    """Raise ValueError if trajectories are to be drawn and a constraint is not linear in states and forces."""
    if not draws:
        return
    ssm, t = posterior.ssm, jnp.asarray(posterior.grid.initial_time, float)
    outputs = ssm.output_dim - posterior.boxes.count

    def constraint(w: jax.Array, index: int) -> jax.Array:
        return ssm.observe(w, t)[index : index + 1]

    for index, label in enumerate(posterior.boxes.labels, outputs):
        if pattern(functools.partial(constraint, index=index), ssm.input_dim).hessian.any():
            raise ValueError(f"the constraint {label!r} is not linear in states and forces, and draws={draws} "
                             "trajectories take linear ones. Set draws=0, for expectation propagation alone.")
