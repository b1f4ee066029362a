r"""Prediction: the mean and the transition matrix of the linearised system over one interval of the scan.

The filter's moments obey dm/dt = E[f] and dP/dt = A P + P A' + E[G G']. The covariance is carried as

    P(t) = Phi(t) (P0 + W(t)) Phi(t)',    dPhi/dt = A Phi,    dW/dt = Phi^-1 D Phi^-T,

and (m, Phi, W) is what the classical Runge-Kutta method integrates. Its weights are positive, so W, and with it P,
is positive semi-definite at every stage and at the end, and the order is four. The linear part of the model
(`transition`) is removed from A by its exact exponential, an integrating factor. Where what is left of A reads the
forces alone, the method is Simpson's rule. The forces' own noise is exact: the noise that reaches x through the nodes
is regressed on it, plus a semi-definite remainder.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name

from lfm_ppl.filtering.transition import Exact, IntegratingFactor, LinearPart, integrating_factor
from lfm_ppl.forces.sde import block_diagonal
from lfm_ppl.linalg import congruence, diagonal, matmul, outer_square, safe_sqrt, symmetric
from lfm_ppl.linearisation.rule import Inputs, Rule, selection
from lfm_ppl.linearisation.sigma_points import SigmaPointRule
from lfm_ppl.linearisation.structure import InputStructure
from lfm_ppl.model.state_space import Span, StateSpaceModel

FLOOR = "lfm_ppl: smallest standard deviation"
"""Under this name `minimum_sd` is kept for the derivative of an interval, and not computed again."""


class Moments(NamedTuple):
    """Mean (n,) and covariance (n, n) of the joint state."""

    mean: jax.Array
    covariance: jax.Array


class Prediction(NamedTuple):
    """The moments at the end of an interval, and its map s -> phi s + ... + N(0, process_cov) where asked for.

    ``steps`` holds what was asked for of each integration step (J, ...).
    """

    moments: Moments
    phi: Any
    process_cov: Any
    steps: Any = None


class Stage(NamedTuple):
    """What the dynamics gives at a Runge-Kutta node, the linear part removed.

    Attributes:
        rest: (M,), the drift's expectation less the linear part.
        jacobian: (M, n), that of the linearised drift less the linear part.
        diffusion: (M, M), expectation of G G'; None without process noise.
    """

    rest: jax.Array
    jacobian: jax.Array
    diffusion: jax.Array | None


class Node(NamedTuple):
    """What the dynamics gives at a node where only the forces bend it.

    Attributes:
        remainder: (M, nz + 1), the Jacobian of a `Stage` in the forces' states, and its ``rest`` as the last column.
        diffusion: as in a `Stage`.
    """

    remainder: jax.Array
    diffusion: jax.Array | None


_LARGEST_TABULATED = 8
"""Most force states whose transitions to all nodes of an interval are tabulated; those of more are chained in it."""

_FIRST_MIDDLE_LAST = slice(None, -2, 2), slice(1, None, 2), slice(2, None, 2)
"""Of each of J steps, among their 2 J + 1 nodes."""


class LastStage(NamedTuple):
    """The fourth stage of a step, at its end, and the covariance (n, n) about which it was linearised."""

    stage: Stage
    covariance: jax.Array


def compose(first: tuple[jax.Array, jax.Array], then: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """Return phi and process_cov of two maps s -> phi s + N(0, process_cov), one after the other."""
    return matmul(then[0], first[0]), congruence(then[0], first[1]) + then[1]


def moved(moments: Moments, phi: jax.Array, process_cov: jax.Array) -> Moments:
    """Return the moments of phi s + N(0, process_cov)."""
    return Moments(matmul(phi, moments.mean[:, None])[:, 0], congruence(phi, moments.covariance) + process_cov)


def predict_exact(ssm: StateSpaceModel, transition: Exact, steps: int, span: Span, length: jax.Array,
                  moments: Moments) -> Prediction:
    """Predict through the exact transition of a linear time-invariant model."""
    phi, process_cov = transition.phi, transition.process_cov
    mean, covariance = moved(moments, phi, process_cov)
    return Prediction(Moments(mean + exact_offset(ssm, transition, steps, span, length), covariance), phi, process_cov)


def exact_offset(ssm: StateSpaceModel, transition: Exact, steps: int, span: Span, length: jax.Array) -> jax.Array:
    """Return (n,), what an exact transition adds to phi s over an interval with the times ``span``."""
    if ssm.mean_invariant or not ssm.physical_dim:
        return transition.offset
    return _integrated_offset(ssm, transition, steps, span, length / steps)


def _integrated_offset(ssm: StateSpaceModel, transition: Exact, steps: int, span: Span, h: jax.Array) -> jax.Array:
    """Integrate E(H - s) c(s) by Simpson's rule, c the additive terms of the mean."""
    size = ssm.physical_dim

    def constant(t: jax.Array) -> jax.Array:
        return jnp.zeros((ssm.state_dim, 1)).at[:size, 0].set(ssm.drift(ssm.input_map(t)[1], t))

    def step(offset: jax.Array, index: jax.Array) -> tuple[jax.Array, None]:
        rest = span.after(index * h)
        first = matmul(transition.full, offset + h / 6 * constant(rest.time()))
        last = constant(rest.time(h))
        return first + h / 6 * (4 * matmul(transition.half, constant(rest.time(0.5 * h))) + last), None

    offset, _ = jax.lax.scan(step, jnp.zeros((ssm.state_dim, 1)), jnp.arange(steps))
    return offset[:, 0]


def predict_interval(ssm: StateSpaceModel, rule: Rule, linear: LinearPart, factor: IntegratingFactor, steps: int,
                     span: Span, length: jax.Array, moments: Moments, linearization_point: Moments | None = None,
                     with_map: bool = False, each: Callable[[Prediction], Any] | None = None) -> Prediction:
    """Predict over an interval in ``steps`` Runge-Kutta steps.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        linear: its constant linear part.
        factor: the integrating factor of one step.
        steps: number of steps.
        span: the interval's times.
        length: of the interval.
        moments: at its start.
        linearization_point: linearise about these moments, (steps + 1, ...) at the ends of the steps, and not about the
            filter's own.
        with_map: whether phi and process_cov of the whole interval are wanted (for the smoother).
        each: what is wanted of each step's prediction.
    """
    h = length / steps
    min_sd = minimum_sd(ssm, rule, factor, span.time(), h, moments)
    if bent_by_forces_only(ssm, rule):
        return _predict_by_quadrature(ssm, rule, linear, factor, steps, span, h, moments, min_sd, linearization_point,
                                      with_map, each)

    def step(carry: tuple, at: tuple) -> tuple[tuple, Any]:
        now, phi, process_cov = carry
        index, nodes = at
        one, _ = step_on(ssm, rule, linear, factor, span.after(index * h), h, now, min_sd, nodes)
        if with_map:
            phi, process_cov = compose((phi, process_cov), (one.phi, one.process_cov))
        return (one.moments, phi, process_cov), None if each is None else each(one)

    carry = tuple(unmoved(moments, with_map))[:3]
    nodes = jax.tree_util.tree_map(lambda ends: _by_steps(_with_middles(ends)), linearization_point)
    (moments, whole, added), within = jax.lax.scan(
        jax.checkpoint(step, prevent_cse=False), carry, (jnp.arange(steps), nodes))
    return Prediction(moments, whole, added, within)


def unmoved(moments: Moments, with_map: bool, each: Callable[[Prediction], Any] | None = None) -> Prediction:
    """Predict over an interval of length zero; the same structure as what `predict_interval` returns for one step."""
    size = moments.mean.shape[0]
    still = Prediction(moments, jnp.eye(size), jnp.zeros((size, size)))
    within = None if each is None else jax.tree_util.tree_map(lambda a: a[None], each(still))
    if not with_map:
        still = still._replace(phi=jnp.zeros(0), process_cov=jnp.zeros(0))
    return still._replace(steps=within)


def minimum_sd(ssm: StateSpaceModel, rule: Rule, factor: IntegratingFactor, t: jax.Array, h: jax.Array,
               moments: Moments) -> jax.Array:
    """The standard deviation below which a coordinate counts as known: 1e-6 of what it is or becomes in a step."""
    size = ssm.physical_dim
    matrix, offset = ssm.input_map(t)
    w = matmul(matrix, moments.mean[:, None])[:, 0] + offset
    change = jnp.abs(ssm.drift(w, t)) * h
    if (dispersion := ssm.dispersion(w, t)) is not None:
        change = change + jnp.sqrt(h * (dispersion**2).sum(1) + 1e-300)
    forces = jnp.sqrt(diagonal(factor.force_cov_full) + 1e-300)
    if isinstance(rule, SigmaPointRule) and rule.full_state:
        scale = jnp.abs(moments.mean) + jnp.concatenate([change, forces])
    else:
        outputs = jnp.sqrt(diagonal(congruence(matrix[size:, size:], factor.force_cov_full)) + 1e-300)
        scale = (jnp.abs(w) + jnp.concatenate([change, outputs]))[jnp.asarray(ssm.drift_structure.points, int)]
    scale = jnp.where(jnp.isfinite(scale), scale, 0.0)
    return checkpoint_name(jax.lax.stop_gradient(1e-6 * scale + 1e-150), FLOOR)


def linearise_state(ssm: StateSpaceModel, rule: Rule, function: Any, structure: InputStructure, jacobian: jax.Array,
                    t: jax.Array, mean: jax.Array, covariance: Any, min_sd: jax.Array) -> Any:
    """Linearise a function of w = K s + k about a Gaussian in s; the Jacobian that comes back is (D, n).

    ``covariance`` is a function of a matrix C that returns C P C', so that only what the rule needs is formed.
    """
    matrix, offset = ssm.input_map(t)
    if isinstance(rule, SigmaPointRule) and rule.full_state:
        total = ssm.state_dim
        everything = InputStructure(tuple(range(total)), (), (), (), True)
        inputs = Inputs(mean, covariance(jnp.eye(total), False), min_sd)
        on_state = lambda s: function(matmul(matrix, s[:, None])[:, 0] + offset)  # noqa: E731
        return rule.linearise(on_state, inputs, everything, jnp.zeros((jacobian.shape[0], total)))
    chosen = (*structure.points, *structure.averaged)
    needed = isinstance(rule, SigmaPointRule) and bool(structure.points)
    rows = matmul(selection(chosen, ssm.input_dim).T, matrix) if chosen else matrix[:0]
    of_forces = all(index >= ssm.physical_dim for index in chosen)
    chosen_covariance = covariance(rows, of_forces) if needed else jnp.zeros((0, 0))
    w = matmul(matrix, mean[:, None])[:, 0] + offset
    affine = rule.linearise(function, Inputs(w, chosen_covariance, min_sd), structure, jacobian)
    return affine._replace(jacobian=matmul(affine.jacobian, matrix))


def covariance_of(moments: Moments) -> Any:
    """Return the function C -> C P C' of given moments."""
    return lambda rows, of_forces: congruence(rows, moments.covariance)


def step_on(ssm: StateSpaceModel, rule: Rule, linear: LinearPart, factor: IntegratingFactor, span: Span, h: jax.Array,
            moments: Moments, min_sd: jax.Array, linearization_point: Moments | None = None,
            first: Stage | None = None) -> tuple[Prediction, LastStage]:
    """Make one Runge-Kutta step of length ``h`` from the start of ``span``.

    ``linearization_point`` holds the moments (3, ...) at its start, middle and end about which to linearise;
    ``first`` is its first stage where that is known.
    """
    m, p = moments
    size = ssm.physical_dim
    half, full, back_half, back_full = factor.half, factor.full, factor.back_half, factor.back_full
    half_x, full_x = half[:size], full[:size]
    identity = jnp.eye(ssm.state_dim)

    def stage(index: int, time: jax.Array, mean: jax.Array, covariance: Any) -> Stage:
        node = jax.tree_util.tree_map(lambda a: a[(0, 1, 1, 2)[index]], linearization_point)
        return _stage(ssm, rule, linear, time, mean, covariance, min_sd, node)

    # Increments of the mean and of the transition matrix are columns of one matrix (M, n + 1).
    def increment(node: Stage, phi: jax.Array) -> jax.Array:
        return jnp.concatenate([matmul(node.jacobian, phi), node.rest[:, None]], axis=1)

    start = jnp.concatenate([identity, m[:, None]], axis=1)
    at_half, at_full = matmul(half, start), matmul(full, start)

    def node(base: jax.Array, change: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = jnp.concatenate([base[:size] + change, base[size:]])
        return state[:, :-1], state[:, -1]

    one = stage(0, span.time(), m, covariance_of(moments)) if first is None else first
    k1 = increment(one, identity)
    phi2, m2 = node(at_half, 0.5 * h * matmul(half[:size, :size], k1))
    q2 = lambda: _process_cov(factor, 0, phi2[:size][None], _together(one), jnp.reshape(0.5 * h, 1), size)  # noqa: E731
    two = stage(1, span.time(0.5 * h), m2, _propagated(p, phi2, q2, factor.force_cov_half, size))
    k2 = increment(two, phi2)
    z2 = 0.5 * h * one.jacobian

    phi3, m3 = node(at_half, 0.5 * h * k2)
    transport3 = identity[:size] + matmul(_less(phi3[:size] - half_x, phi3, z2, size), back_half)
    q3 = lambda: _process_cov(factor, 1, transport3[None], _together(two), jnp.reshape(0.5 * h, 1), size)  # noqa: E731
    three = stage(2, span.time(0.5 * h), m3, _propagated(p, phi3, q3, factor.force_cov_half, size))
    k3 = increment(three, phi3)
    z3 = _inverse_transition(0.5 * h, z2, back_half, two.jacobian, half, size)

    phi4, m4 = node(at_full, h * matmul(half[:size, :size], k3))
    transport4 = half_x + matmul(_less(phi4[:size] - full_x, phi4, z3, size), back_half)
    q4 = lambda: _process_cov(factor, 2, transport4[None], _together(three), jnp.reshape(h, 1), size)  # noqa: E731
    covariance4 = _propagated(p, phi4, q4, factor.force_cov_full, size)
    four = stage(3, span.time(h), m4, covariance4)
    k4 = increment(four, phi4)
    z4 = _inverse_transition(h, z3, back_half, three.jacobian, half, size)

    weighted = matmul(full[:size, :size], k1) + 2.0 * matmul(half[:size, :size], k2 + k3) + k4
    phi, mean = node(at_full, h / 6 * weighted)
    change = phi[:size] - full_x
    transports = jnp.stack([phi[:size], half_x + matmul(_less(change, phi, z2, size), back_half),
                            half_x + matmul(_less(change, phi, z3, size), back_half),
                            identity[:size] + matmul(_less(change, phi, z4, size), back_full)])
    weights = h * np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])
    process_cov = _process_cov(factor, -1, transports, _together(one, two, three, four), weights, size)
    moments = Moments(mean, congruence(phi, p) + process_cov)
    return Prediction(moments, phi, process_cov), LastStage(four, covariance4(identity, False))


def _together(*stages: Stage | Node) -> jax.Array | None:
    """Return the diffusions (K, M, M) of the stages; None without process noise."""
    diffusions = [stage.diffusion for stage in stages if stage.diffusion is not None]
    return jnp.stack(diffusions) if diffusions else None


def linearised(ssm: StateSpaceModel, rule: Rule, linear: LinearPart, t: jax.Array, moments: Moments,
               min_sd: jax.Array) -> Stage:
    """Linearise the dynamics about given moments, the linear part removed."""
    return _stage(ssm, rule, linear, t, moments.mean, covariance_of(moments), min_sd, None)


def _stage(ssm: StateSpaceModel, rule: Rule, linear: LinearPart, t: jax.Array, mean: jax.Array, covariance: Any,
           min_sd: jax.Array, linearization_point: Moments | None) -> Stage:
    """Linearise the dynamics at a node about the filter's moments, or about ``linearization_point``."""

    def function(w: jax.Array) -> tuple[jax.Array, Any]:
        dispersion = ssm.dispersion(w, t)
        return ssm.drift(w, t), () if dispersion is None else outer_square(dispersion)

    centre, known = mean, covariance
    if linearization_point is not None:
        centre, known = linearization_point.mean, covariance_of(linearization_point)
    affine = linearise_state(ssm, rule, function, ssm.drift_structure, linear.jacobian, t, centre, known, min_sd)
    drift = affine.value
    if linearization_point is not None:
        drift = drift + matmul(affine.jacobian, (mean - centre)[:, None])[:, 0]
    rest = drift - matmul(linear.rows, mean[:, None])[:, 0]
    return Stage(rest, affine.jacobian - linear.rows, affine.extra if isinstance(affine.extra, jax.Array) else None)


def interval_factor(ssm: StateSpaceModel, rule: Rule, linear: LinearPart, length: jax.Array, steps: int,
                    tabulated: bool = False) -> IntegratingFactor:
    """Return the integrating factor of an interval's steps; one ``tabulated`` for many intervals may cost more."""
    stages = not bent_by_forces_only(ssm, rule)
    nodes = not stages and tabulated and ssm.force_dim <= _LARGEST_TABULATED
    return integrating_factor(ssm, linear, length / steps, stages, steps if nodes else None)


def bent_by_forces_only(ssm: StateSpaceModel, rule: Rule) -> bool:
    """Whether what is left of the dynamics without its constant linear part depends on the forces alone.

    Its Jacobian K then reads nothing but the forces, which nothing moves but their own exact transition: K E K = 0.
    """
    whole = isinstance(rule, SigmaPointRule) and rule.full_state
    structure = ssm.drift_structure
    return not whole and all(index >= ssm.physical_dim for index in (*structure.points, *structure.averaged))


def _predict_by_quadrature(ssm: StateSpaceModel, rule: Rule, linear: LinearPart, factor: IntegratingFactor, steps: int,
                           span: Span, h: jax.Array, moments: Moments, min_sd: jax.Array,
                           linearization_point: Moments | None, with_map: bool,
                           each: Callable[[Prediction], Any] | None) -> Prediction:
    """Predict over an interval in which only the forces bend the dynamics, to the numbers of the steps of `step_on`.

    The forces' moments at all nodes are then known at the interval's start, no stage changes what another one sees, and
    the Runge-Kutta method is Simpson's rule.
    """
    size = ssm.physical_dim
    half = factor.half[size:, size:]

    first = _forces_of(moments, size)
    if factor.halves is None:
        def half_step(now: Moments, _: None) -> tuple[Moments, Moments]:
            return moved(now, half, factor.force_cov_half), now

        last, before = jax.lax.scan(half_step, first, None, length=2 * steps)
        now = jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a, b[None]]), before, last)
    else:
        transitions, covariances = factor.halves
        now = Moments(matmul(transitions, first.mean[:, None])[..., 0],
                      congruence(transitions, first.covariance) + covariances)
    near = now
    if linearization_point is not None:
        near = jax.tree_util.tree_map(_with_middles, _forces_of(linearization_point, size))
    offsets = jnp.arange(steps) * h
    times = span.time(0.5 * h * jnp.arange(2 * steps + 1))

    def node(t: jax.Array, mean: jax.Array, near: Moments) -> Node:
        centre = jnp.concatenate([jnp.zeros(size), near.mean])  # the physical state drops out
        covariance = lambda rows, _: congruence(rows[:, size:], near.covariance)  # noqa: E731
        one = _stage(ssm, rule, linear, t, centre, covariance, min_sd, None)
        jacobian, rest = one.jacobian[:, size:], one.rest
        if linearization_point is not None:
            rest = rest + matmul(jacobian, (mean - near.mean)[:, None])[:, 0]
        return Node(jnp.concatenate([jacobian, rest[:, None]], axis=1), one.diffusion)

    if same_at_all_times(ssm):
        nodes = jax.vmap(node)(times, now.mean, near)
        stages = [jax.tree_util.tree_map(lambda a: a[part], nodes) for part in _FIRST_MIDDLE_LAST]  # noqa: B023
    else:
        times = jnp.stack([span.time(offsets), span.time(offsets + 0.5 * h), span.time(offsets + h)])
        by_node = lambda a: jnp.stack([a[part] for part in _FIRST_MIDDLE_LAST])  # noqa: E731
        nodes = jax.vmap(jax.vmap(node))(times, by_node(now.mean), jax.tree_util.tree_map(by_node, near))
        stages = [jax.tree_util.tree_map(lambda a: a[index], nodes) for index in range(3)]  # noqa: B023

    # Of all steps at once: what a loop computes it also stores, step by step, for its derivative.
    maps = jax.vmap(lambda *nodes: _simpson(factor, h, nodes, size))(*stages)

    def step(carry: tuple, of_step: tuple) -> tuple[tuple, Any]:
        now, phi, process_cov = carry
        own, offset, added = of_step
        mean = matmul(factor.full, now.mean[:, None])[:, 0]
        mean = jnp.concatenate([mean[:size] + offset, mean[size:]])
        now = Moments(mean, congruence(own, now.covariance) + added)
        if with_map:
            phi, process_cov = compose((phi, process_cov), (own, added))
        return (now, phi, process_cov), None if each is None else each(Prediction(now, own, added))

    (moments, whole, added), within = jax.lax.scan(step, tuple(unmoved(moments, with_map))[:3], maps)
    return Prediction(moments, whole, added, within)


def same_at_all_times(ssm: StateSpaceModel) -> bool:
    """Whether the dynamics is one function of the state at all times: the end of a step is the start of the next."""
    return (ssm.constant_measurement and ssm.constant_mean and not ssm.drift_structure.offset_varies
            and not callable(ssm.model.process_noise))


def _forces_of(moments: Moments, size: int) -> Moments:
    """Moments of the forces' states, which follow ``size`` physical ones."""
    return Moments(moments.mean[..., size:], moments.covariance[..., size:, size:])


def _with_middles(ends: jax.Array) -> jax.Array:
    """The ends (J + 1, ...) of the steps with their middles between them, (2 J + 1, ...)."""
    middles = 0.5 * (ends[:-1] + ends[1:])
    pairs = jnp.stack([ends[:-1], middles], axis=1)
    return jnp.concatenate([pairs.reshape(2 * len(middles), *ends.shape[1:]), ends[-1:]])


def _by_steps(nodes: jax.Array) -> jax.Array:
    """First, middle and last (J, 3, ...) of each step, from 2 J + 1 nodes."""
    return jnp.stack([nodes[:-2:2], nodes[1::2], nodes[2::2]], axis=1)


def _simpson(factor: IntegratingFactor, h: jax.Array, nodes: tuple[Node, ...],
             size: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return Phi (n, n), what the remainder adds to the mean (M,), and Q (n, n) of a step.

        Phi = E(h) + h / 6 (E(h) K_1 + 4 E(h/2) K_2 E(h/2) + K_3 E(h)).

    Its first, middle and last node are ``nodes``. The middle one is both the second and the third Runge-Kutta
    stage; their Z, where Psi~ = I - Z is the inverse transition to a stage's node, differ.
    """
    half, full = factor.half, factor.full
    half_x, full_x = half[:size, :size], full[:size, :size]
    # What the remainder adds to the mean is one more column, which the forces' transition leaves alone.
    beside = lambda forces: block_diagonal([forces, np.eye(1)])  # noqa: E731
    first, second, third = (node.remainder for node in nodes)
    middle = matmul(second, beside(half[size:, size:]))
    whole = h / 6 * (matmul(full_x, first) + 4.0 * matmul(half_x, middle) + matmul(third, beside(full[size:, size:])))
    bend, offset = whole[:, :-1], whole[:, -1]
    pulled = matmul(factor.back_half[:size, :size], middle[:, :-1])
    inverse = h * jnp.stack([0.5 * first[:, :-1], 0.5 * pulled, pulled])
    onward = jnp.stack([full[:size], half[:size], half[:size], jnp.eye(size, full.shape[0])])
    back = jnp.stack([factor.back_half, factor.back_half, factor.back_full])[:, size:, size:]
    bends = jnp.concatenate([bend[None], matmul(bend - matmul(full_x, inverse), back)])
    transports = jnp.concatenate([onward[:, :, :size], onward[:, :, size:] + bends], axis=2)
    diffusions = _together(nodes[0], nodes[1], nodes[1], nodes[2])
    process_cov = _process_cov(factor, -1, transports, diffusions, h * np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]), size)
    return jnp.concatenate([transports[0], full[size:]]), offset, process_cov


def _propagated(p: jax.Array, phi: jax.Array, process_cov: Any, force_cov: jax.Array, size: int) -> Any:
    """Return the function C -> C (Phi P Phi' + Q) C' of a stage."""

    def covariance(rows: jax.Array, of_forces: bool) -> jax.Array:
        if of_forces:
            inner = rows[:, size:]
            return congruence(matmul(inner, phi[size:, size:]), p[size:, size:]) + congruence(inner, force_cov)
        return congruence(matmul(rows, phi), p) + congruence(rows, process_cov())

    return covariance


def _less(change: jax.Array, phi: jax.Array, inverse: jax.Array, size: int) -> jax.Array:
    """Rows of E(c_i) (Phi~_i Psi~_j - I): the change of the transition matrix less what happened before the node j."""
    return change - matmul(phi[:size, :size], inverse)


def _inverse_transition(scale: jax.Array, before: jax.Array, back: jax.Array, jacobian: jax.Array, half: jax.Array,
                        size: int) -> jax.Array:
    """Next stage of Z, where Psi~ = I - Z is the inverse transition in the interaction picture."""
    pulled = matmul(back[:size, :size], matmul(jacobian, half))
    return scale * (pulled - matmul(before[:, :size], pulled))


def _process_cov(factor: IntegratingFactor, stage: int, transports: jax.Array, diffusions: jax.Array | None,
                 weights: jax.Array, size: int) -> jax.Array:
    """Return Q (n, n): noise at K nodes, carried on by ``transports`` (K, M, n), the forces' own part exact.

    The forces' noise at the nodes, ``columns``, is only a quadrature of the exact noise, but what reaches x together
    with it can be regressed on the exact one: N_x = G N_z + remainder, semi-definite for any G.
    """
    exact = factor.force_cov_half if stage in (0, 1) else factor.force_cov_full
    through = safe_sqrt(weights)[:, None, None] * matmul(transports[:, :, size:], factor.inputs)
    through = jnp.moveaxis(through, 0, 1).reshape(size, factor.columns[stage].shape[1])
    gain = matmul(through, factor.regressions[stage])
    cross = matmul(gain, exact)
    left = through - matmul(gain, factor.columns[stage])
    on_states = symmetric(matmul(cross, gain.T)) + outer_square(left)
    if diffusions is not None:
        on_states = on_states + (weights[:, None, None] * congruence(transports[:, :, :size], diffusions)).sum(0)
    return jnp.concatenate([jnp.concatenate([on_states, cross], axis=1),
                            jnp.concatenate([cross.T, exact], axis=1)])
