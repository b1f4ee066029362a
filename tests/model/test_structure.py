"""Which inputs are non-linear: the paper models, many primitives, and never fewer than there are."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import DoubleWell, Motif, Oscillator, identity, softplus, whole_state

import lfm_ppl as lfm
from lfm_ppl.model.state_space import state_space
from lfm_ppl.model.structure import pattern

M = lfm.Matern


def structure(dynamics, size, forces=("u",), **options):
    model = lfm.LatentForceModel(
        dynamics, {name: M(1.0, 1.0) for name in forces}, lfm.GaussianObservation(whole_state, jnp.ones(size)),
        lfm.Gaussian(jnp.ones(size), jnp.eye(size)), **options)
    result = state_space(model).drift_structure
    names = (*model.state_names, *model.force_names)
    return tuple({names[i] for i in indices} for indices in (result.nonlinear, result.averaged, result.constant))


def ballistic(x, u, t):
    """Position, velocity, drag: R(r, v) u with R from position and velocity."""
    r, v = x[:2], x[2:]
    distance = jnp.sqrt(r @ r)
    radial, along = r / distance, v / jnp.sqrt(v @ v)
    normal = jnp.stack([-along[1], along[0]])
    return jnp.concatenate([v, -r / distance**3 + jnp.stack([radial, normal], axis=1) @ u])


def test_transcription():
    result = structure(Motif(jnp.array([0.8, 1.0, 1.3]), jnp.ones(3), 0.1, softplus), 3)
    assert result == ({"u"}, set(), {"x0", "x1", "x2"})


@pytest.mark.thorough
def test_linear_motif_and_spring():
    assert structure(Motif(jnp.ones(2), jnp.ones(2), 0.1, identity), 2) == (set(), set(), {"x0", "x1", "u"})
    assert structure(Oscillator(1.0, 0.5, 0.0).__class__(2.0, 0.3), 2)[0] == {"x0"}  # the cubic term may be there
    def spring(x, u, t):
        position, velocity = x[0::2], x[1::2]
        return jnp.stack([velocity, u[0] - 0.3 * velocity - 2.0 * position], axis=1).ravel()
    assert structure(spring, 4) == (set(), set(), {"x0", "x1", "x2", "x3", "u"})


def test_double_well():
    assert structure(DoubleWell(), 1, ())[0] == {"x0"}


def test_ballistic():
    points, averaged, constant = structure(ballistic, 4, ("a", "b"))
    assert points == {"x0", "x1", "x2", "x3"} and averaged == {"a", "b"} and not constant


@pytest.mark.parametrize("function, points, averaged", [
    (lambda x, u, t: jnp.where(t > 1.0, u - x, -x), set(), {"x0", "u"}),  # linear at every time
    (lambda x, u, t: jnp.where(x > 0.0, u - x, -x), {"x0"}, {"u"}),
    (lambda x, u, t: x * u, {"x0"}, {"u"}),
    (lambda x, u, t: x * jnp.sin(t) + u, set(), {"x0"}),
    (lambda x, u, t: jnp.abs(x) + u, {"x0"}, set()),
    (lambda x, u, t: jax.nn.relu(u) - x, {"u"}, set()),
    (lambda x, u, t: x / (1.0 + u**2), {"u"}, {"x0"}),
    (lambda x, u, t: x**1 + 3.0 * u, set(), set()),
    (lambda x, u, t: jnp.zeros(1).at[0].set(u[0] - x[0]), set(), set()),
    (lambda x, u, t: jnp.zeros(1).at[0].add(u[0] ** 2 - x[0]), {"u"}, set()),
    (lambda x, u, t: jnp.array([[1.0, 2.0]]) @ jnp.concatenate([x, u]), set(), set()),
    (lambda x, u, t: jnp.tanh(jnp.array([[1.0, 0.5]]) @ jnp.concatenate([x, u])) + u, {"x0", "u"}, set()),
    (lambda x, u, t: (x[:, None] * u[None, :]).sum(1), {"x0"}, {"u"}),
    (lambda x, u, t: jnp.cumsum(jnp.concatenate([x, u]))[1:], None, None),  # may be unknown: then all are points
    (lambda x, u, t: jax.lax.cond(t > 0, lambda v: -v, lambda v: v, x) + u, None, None),
    (lambda x, u, t: jnp.concatenate([x, u])[::-1][:1] * jnp.exp(-t), None, None),
    (lambda x, u, t: jax.jit(lambda v: v**2)(u) - x, {"u"}, set()),
    (lambda x, u, t: jnp.interp(t, jnp.arange(3.0), jnp.ones(3)) * x + u, set(), {"x0"}),
    (lambda x, u, t: lfm.Input([0.0, 1.0], [0.0, 1.0])(t) + u - x, set(), set()),
])
def test_primitives(function, points, averaged):
    result = structure(function, 1)
    if points is not None:
        assert result[:2] == (points, averaged)


def numeric_hessian(function, size, seed):
    generator = np.random.default_rng(seed)
    points = generator.normal(size=(4, size))
    hessians = [np.abs(np.asarray(jax.jacfwd(jax.jacfwd(function))(jnp.asarray(v)))) for v in points]
    return np.max([hessian.max(axis=0) for hessian in hessians], axis=0) > 1e-9


@pytest.mark.parametrize("function", [
    lambda v: jnp.stack([v[0] * v[1] + v[2], jnp.sin(v[3])]),
    lambda v: jnp.linalg.solve(jnp.eye(2) * (2.0 + v[0] ** 2), v[1:3]),
    lambda v: jax.lax.scan(lambda c, s: (c * v[0] + s, c), v[1], jnp.arange(3.0))[1],
    lambda v: jax.lax.fori_loop(0, 3, lambda i, c: c * v[1] + v[0], v[2:4]),
    lambda v: jax.lax.while_loop(lambda c: c[0] < 3.0, lambda c: (c[0] + 1.0, c[1] * v[0]), (0.0, v[1:2]))[1],
    lambda v: jax.lax.cond(v[0] > 0, lambda w: w[1:] ** 2, lambda w: w[1:], v),
    lambda v: jnp.outer(v[:2], v[2:]).ravel(),
    lambda v: (v[:2, None] * v[None, 2:] + v[None, :2]).sum(1),
    lambda v: jnp.where(v[:2, None] > 0, v[None, 2:], v[:2, None] / v[None, 1:3]).ravel(),
    lambda v: jnp.clip(v, v[0], 2.0),
    lambda v: jnp.zeros(3).at[jnp.array([0, 2, 2])].add(v[:3] * v[1:]) + v[3],
    lambda v: jax.ops.segment_sum(v**2, jnp.array([0, 0, 1, 1]), num_segments=2),
    lambda v: jnp.einsum("ij,j,i->i", jnp.ones((4, 4)), v, v),
    lambda v: jnp.sort(v) * 2.0,
    lambda v: jnp.cumsum(v) * v[3],
    lambda v: jnp.cumprod(v),
    lambda v: jnp.prod(v)[None],
    lambda v: jnp.max(v)[None] ** 2,
    lambda v: jnp.roll(v, 1) * jnp.array([1.0, 0.0, 2.0, 0.0]),
    lambda v: jax.nn.softmax(v),
    lambda v: jnp.linalg.norm(v)[None],
    lambda v: jnp.cross(v[:3], v[1:]),
    lambda v: v.at[1].multiply(v[0]),
    lambda v: v.at[jnp.array([0, 2])].set(v[1] * v[3]),
    lambda v: jax.vmap(lambda a, b: a * b + a)(v[:2], v[2:]),
    lambda v: jax.checkpoint(lambda w: w**2)(v[:2]) + v[2:],
    lambda v: jnp.take(v, jnp.array([3, 0])) / v[1],
    lambda v: jnp.power(v[:2], 2.0) + v[2],
    lambda v: jax.scipy.special.erf(v[0])[None] * v[1],
    lambda v: jnp.logaddexp(v[0], v[1])[None] + v[2],
    lambda v: jnp.polyval(jnp.array([1.0, 0.0, 2.0]), v[:2]),
    lambda v: jnp.convolve(v[:2], v[2:]),
    lambda v: jax.lax.dynamic_slice(v, (1,), (2,)) * v[0],
    lambda v: jnp.where(v[0] > 0, v[1], v[2] * v[3])[None],
    lambda v: jax.jvp(lambda w: w**3, (v,), (v,))[1],
    lambda v: jax.grad(lambda w: (w[0] ** 2 * w[1]).sum())(v),
])
def test_never_smaller_than_the_hessian(function):
    result = pattern(function, 4)
    true = numeric_hessian(function, 4, 0)
    assert not (true & ~result.hessian).any()
    assert np.array_equal(result.hessian, result.hessian.T)
    jacobian = np.max([np.abs(np.asarray(jax.jacfwd(function)(jnp.asarray(v)))) for v in
                       np.random.default_rng(1).normal(size=(4, 4))], axis=0) > 1e-12
    assert not (jacobian & ~result.jacobian).any()


def test_custom_rules_are_seen_through_or_taken_as_non_linear():
    @jax.custom_vjp
    def cube(v):
        return v**3

    cube.defvjp(lambda v: (v**3, v), lambda v, g: (3 * v**2 * g,))

    @jax.custom_jvp
    def square(v):
        return v**2

    square.defjvp(lambda primals, tangents: (primals[0] ** 2, 2 * primals[0] * tangents[0]))

    def callback(v):
        return jax.pure_callback(
            lambda a: np.sin(a), jax.ShapeDtypeStruct((2,), float), v)

    for function in (cube, square, callback):
        result = pattern(lambda v, f=function: f(v[:2]) + v[2:], 4).hessian
        assert result[0, 0] and result[1, 1] and not result[2:].any()


def test_under_transformations():
    """Parameters that are traced count as constants, under jit, grad and vmap."""

    def total(decay):
        seen.append(structure(lambda x, u, t: -decay * x + jax.nn.softplus(decay * u), 1))
        return decay

    seen = []
    jax.jit(total)(1.0), jax.grad(total)(1.0), jax.vmap(total)(jnp.ones(2))
    jax.jit(jax.grad(total))(1.0)
    assert len(seen) == 4 and all(result == ({"u"}, set(), {"x0"}) for result in seen)


class Network(eqx.Module):
    layer: eqx.nn.MLP

    def __call__(self, x, u, t):
        return self.layer(x) + u


def test_a_neural_network():
    network = Network(eqx.nn.MLP(2, 2, 4, 1, key=jax.random.key(0)))
    assert structure(network, 2, ("a", "b")) == ({"x0", "x1"}, set(), {"a", "b"})


def test_declared_inputs_override():
    result = structure(Motif(jnp.ones(1), jnp.ones(1), 0.1, softplus), 1, nonlinear_inputs=("x0", "u"))
    assert result[0] == {"x0", "u"}
    # Of a product either factor will do.
    assert structure(lambda x, u, t: x * u, 1, nonlinear_inputs=("u",))[:2] == ({"u"}, {"x0"})


@pytest.mark.thorough
def test_a_wrong_declaration_names_the_coordinate():
    with pytest.raises(ValueError, match="leaves out 'u', but the dynamics is not linear in it. Add it, or leave"):
        structure(Motif(jnp.ones(1), jnp.ones(1), 0.1, softplus), 1, nonlinear_inputs=())
    with pytest.raises(ValueError, match="leaves out 'x0' together with 'u'"):
        structure(lambda x, u, t: x * u, 1, nonlinear_inputs=())
    with pytest.raises(ValueError, match="leaves out 'x0'"):
        jax.jit(lambda b: (structure(DoubleWell(-1.0, b), 1, (), nonlinear_inputs=()), b)[1])(2.0)
    with pytest.raises(ValueError, match="unknown name in nonlinear_inputs 'p5'. Did you mean 'p53'"):
        structure(Motif(jnp.ones(1), jnp.ones(1), 0.1, softplus), 1, ("p53",), nonlinear_inputs=("p5",))
    # What is linear after all, though its pattern cannot be seen, is accepted.
    assert structure(lambda x, u, t: jnp.cumsum(jnp.concatenate([x, u]))[1:], 1, nonlinear_inputs=())[0] == set()


@pytest.mark.parametrize("step", [lambda v: v.astype(int).astype(float), lambda v: v.astype(bool) * 1.0])
def test_steps_are_not_linear(step):
    points, averaged, constant = structure(lambda x, u, t: u[0] - step(x), 1)
    assert points == {"x0"} and constant == {"u"} and not averaged


def test_precision_does_not_matter():
    assert structure(lambda x, u, t: u - x.astype(jnp.float32).astype(float), 1)[2] == {"x0", "u"}
