r"""The evidence of data under constraints, Z(y, c) / Z(c), and what it is made of.

Z(y, c) is the probability density of the data and of the constraints being respected, Z(c) the prior probability of
the latter. Without the denominator the prior of the parameters would be tilted towards values under which the
constraints are respected by themselves.

Both are found by expectation propagation with a box a bounded quantity (`lfm_ppl.constrained.boxes`), and made right
by importance sampling with trajectories that respect all constraints (`lfm_ppl.constrained.feasible_paths`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.constrained.augmented import Rows, with_rows
from lfm_ppl.constrained.boxes import BoundedTerms, Boxes
from lfm_ppl.constrained.feasible_paths import Paths, feasible_paths
from lfm_ppl.filtering.filter import Pass, forward
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.sites import Evidence, SiteSettings, evidence
from lfm_ppl.filtering.time_grid import TimeGrid
from lfm_ppl.filtering.update import Sites
from lfm_ppl.linalg import matmul
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.model.structure import pattern

_LOG_2PI = 1.8378770664093453

_TEMPER = 0.7
"""Share of the converged sites that draws look ahead by. On dense grids the sites of all rows together say more than
their constraints do, and 1/2 to 4/5 has the smallest variance; on coarse grids 1 has, and less than 4/5 is worse."""


class Bounded(NamedTuple):
    """A model under constraints, laid out.

    Attributes:
        ssm: with the outputs (h, c).
        rule: the linearisation rule.
        grid: of the scan.
        rows: which rows hold observations, and which constraints.
        boxes: the constraints.
        variance: (T, D), of the observations' noise.
        settings: of the sites.
    """

    ssm: StateSpaceModel
    rule: Rule
    grid: TimeGrid
    rows: Rows
    boxes: Boxes
    variance: jax.Array
    settings: SiteSettings

    @property
    def held(self) -> jax.Array:
        """(K, B), at which rows the constraints hold."""
        return jnp.zeros((len(self.rows.times), self.boxes.count), bool).at[self.rows.grid].set(True)

    def _data(self, y: jax.Array) -> tuple[BoundedTerms, jax.Array, Sites]:
        """Return the factors, entries (K, D + B) that are NaN where there is none, and exact sites of the data."""
        whole = with_rows(y, jnp.zeros((len(self.rows.grid), self.boxes.count)), self.rows)
        measured = whole[:, : y.shape[1]]
        noise = jnp.ones(measured.shape).at[self.rows.data].set(self.variance)
        present, nothing = jnp.isfinite(measured), jnp.zeros((len(whole), self.boxes.count))
        first = Sites(jnp.concatenate([jnp.where(present, measured, 0.0), nothing], axis=1), jnp.zeros_like(whole),
                      jnp.concatenate([jnp.where(present, 1.0 / noise, 0.0), nothing], axis=1))
        return BoundedTerms(measured, noise, self.held, self.boxes.widths), whole, first

    def propagated(self, y: jax.Array, keep: str = "likelihood") -> Evidence:
        """Run expectation propagation; its log evidence is that of data and constraints."""
        terms, whole, first = self._data(y)
        return evidence(self.ssm, self.rule, self.grid, whole, terms, self.settings, Moments(*self.ssm.initial()),
                        first, keep)

    def proposal(self, y: jax.Array, found: Evidence) -> Pass:
        """Return the forward scan that draws go back over: exact sites of the data, tempered ones of constraints."""
        _, whole, first = self._data(y)
        share = jnp.concatenate([jnp.zeros(y.shape[1]), jnp.full(self.boxes.count, _TEMPER)])
        sites = found.refined.found.sites
        mixed = Sites(jnp.where(share > 0, sites.centre, first.centre), share * sites.nu,
                      jnp.where(share > 0, share * sites.tau, first.tau))
        return forward(self.ssm, self.rule, self.grid, whole, linearization_point=found.refined.points, keep="all",
                       sites=mixed)

    def paths(self, key: jax.Array, passed: Pass, count: int) -> Paths:
        """Draw trajectories that respect the constraints."""
        held = jnp.zeros((passed.phi.shape[0], self.boxes.count), bool).at[jnp.asarray(self.grid.observed)].set(
            self.held)
        return feasible_paths(key, passed, held, self.boxes.widths, count)

    def chosen(self, key: jax.Array, passed: Pass, draws: int, candidates: int) -> jax.Array:
        """Return trajectories (K, M + R, draws) of (x, u) at the rows, each one of some by their weights.

        Bounded states and forces are what was drawn for them, and so feasible to the last bit.
        """
        keys = jax.random.split(key)
        found = self.paths(keys[0], passed, draws * candidates)
        # Trajectories with mirrored random numbers are not to stand beside each other.
        order = jnp.arange(draws * candidates).reshape(candidates, draws).T
        index = jax.random.categorical(keys[1], found.log_weights[order], axis=1)
        picked = jnp.take_along_axis(order, index[:, None], axis=1)[:, 0]
        at = jnp.asarray(self.grid.observed)
        possible = jnp.isfinite(jnp.take_along_axis(found.log_weights, picked, axis=0))
        states, values = (jnp.where(possible, a[at][..., picked], jnp.nan) for a in (found.states, found.values))
        matrix, offset = jax.vmap(self.ssm.input_map)(jnp.asarray(self.rows.times))
        inputs = matmul(matrix, states) + offset[..., None]
        # (K, S, ...): the bounded ones where the constraints hold.
        inputs, values = (jnp.moveaxis(a, 1, -1) for a in (inputs, values))
        exact = self.boxes.constraints.respected(inputs, self.boxes.slacks(values))
        held = jnp.zeros(len(self.rows.times), bool).at[self.rows.grid].set(True)
        return jnp.moveaxis(jnp.where(held[:, None, None], exact, inputs), -1, 1)

    def log_weights(self, key: jax.Array, y: jax.Array, count: int) -> jax.Array:
        """Return log weights (count,) whose exponentials have the evidence of data and constraints as their mean."""
        found = self.propagated(y)
        passed = self.proposal(y, found)
        variance = jnp.broadcast_to(self.variance, y.shape)
        data = -0.5 * jnp.where(jnp.isfinite(y), _LOG_2PI + jnp.log(variance), 0.0).sum()
        weights = passed.log_likelihood.sum() + data + self.paths(key, passed, count).log_weights
        return jnp.where(found.refined.found.converged, weights, -jnp.inf)

    def log_evidence(self, y: jax.Array, draws: int, key: jax.Array | None = None) -> jax.Array:
        """Return log Z(y, c); by expectation propagation alone where ``draws`` is 0."""
        if not draws:
            return self.propagated(y).log_evidence
        weights = self.log_weights(_key(key), y, draws)
        largest = jax.lax.stop_gradient(jnp.max(weights))
        safe = jnp.where(jnp.isfinite(largest), largest, 0.0)
        return jax.scipy.special.logsumexp(weights - safe) + safe - jnp.log(draws)

    def log_likelihood(self, y: jax.Array, draws: int, key: jax.Array | None = None) -> jax.Array:
        """Return log Z(y, c) - log Z(c), with the same random numbers in both."""
        both = _with_and_without(lambda one: self.log_evidence(one, draws, key), y)
        return both[0] - both[1]

    def converged(self, y: jax.Array) -> jax.Array:
        """Whether the sites converge, with the data and without them."""
        return _with_and_without(lambda one: self.propagated(one).refined.found.converged, y).all()

    def worth(self, y: jax.Array, draws: int, key: jax.Array | None = None) -> jax.Array:
        """Return how many of the weighted trajectories count, with the data or without them, whichever is fewer."""
        return _with_and_without(lambda one: effective_number(self.log_weights(_key(key), one, draws)), y).min()


def _with_and_without(function: Callable[[jax.Array], jax.Array], y: jax.Array) -> jax.Array:
    """Return ``function`` of the data and of none, compiled once, (2,)."""
    return jax.vmap(function)(jnp.stack([y, jnp.full_like(y, jnp.nan)]))


def _key(key: jax.Array | None) -> jax.Array:
    return jax.random.key(0) if key is None else key


def effective_number(log_weights: jax.Array) -> jax.Array:
    """Return (sum w)^2 / sum w^2 of weights (N,), zero where all are."""
    largest = log_weights.max()
    possible = jnp.isfinite(largest)
    weights = jnp.where(possible, jnp.exp(log_weights - jnp.where(possible, largest, 0.0)), 1.0)
    return jnp.where(possible, weights.sum() ** 2 / (weights**2).sum(), 0.0)


def check_variances(model: LatentForceModel, count: int) -> jax.Array:
    """Return the noise variances (T, D), after checking that there is nothing else."""
    if model.observation.angular:
        raise ValueError("the posterior under constraints takes no angular outputs; observe their sine and cosine, or "
                         "take lfm.full_information.")
    covariance = model.observation.covariance
    if callable(covariance):
        raise ValueError("the posterior under constraints takes a fixed observation covariance; the model's is a "
                         "function of (x, u, t).")
    value = jnp.asarray(covariance, float)
    if value.ndim > 1:
        known = checks.concrete(value)
        if known is not None and np.any(known * (1.0 - np.eye(known.shape[-1]))):
            raise ValueError("the posterior under constraints takes outputs with independent noise; the observation "
                             "covariance has entries off its diagonal.")
        value = jnp.diagonal(value, axis1=-2, axis2=-1)
    checks.positive("the observation covariance", value, "Sites need observations with noise.")
    return jnp.broadcast_to(value, (count, value.shape[-1]))


def check_linear(problem: Bounded, draws: int) -> None:
    """Raise where constraints are not linear in states and forces, and trajectories are to be drawn."""
    if not draws:
        return
    ssm, t = problem.ssm, jnp.asarray(problem.grid.initial_time, float)
    first = ssm.output_dim - problem.boxes.count
    for number, label in enumerate(problem.boxes.labels, first):
        one = lambda w, n=number: ssm.observe(w, t)[n : n + 1]  # noqa: E731
        if pattern(one, ssm.input_dim).hessian.any():
            raise ValueError(f"the constraint {label!r} is not linear in states and forces, and draws={draws} "
                             "trajectories take linear ones. Set draws=0, for expectation propagation alone.")
