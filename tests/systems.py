"""Systems that several tests share, as modules, so that new parameter values compile nothing new."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm


class Linear(eqx.Module):
    """J x + B u + c + additive(t)."""

    system: Any
    coupling: Any
    constant: Any = 0.0
    additive: Any = None

    def __call__(self, x, u, t):
        value = self.system @ x + self.coupling @ u + self.constant
        return value if self.additive is None else value + self.additive(t)


class DoubleWell(eqx.Module):
    """-(a x + b x^3)."""

    a: Any = -1.0
    b: Any = 1.0

    def __call__(self, x, u, t):
        return -(self.a * x + self.b * x**3)


class Motif(eqx.Module):
    """basal + sensitivity link(u) - decay x."""

    decay: Any
    sensitivity: Any
    basal: Any
    link: Any = eqx.field(static=True)

    def __call__(self, x, u, t):
        return self.basal + self.sensitivity * self.link(u[0]) - self.decay * x


class Oscillator(eqx.Module):
    """Two states: x1 and -stiffness x1 - damping x2 - cubic x1^3 + u."""

    stiffness: Any = 1.0
    damping: Any = 0.5
    cubic: Any = 0.0

    def __call__(self, x, u, t):
        return jnp.stack([x[1], -self.stiffness * x[0] - self.damping * x[1] - self.cubic * x[0] ** 3 + u[0]])


class Outputs(eqx.Module):
    """C (x, u)."""

    matrix: Any

    def __call__(self, x, u, t):
        return self.matrix @ jnp.concatenate([x, u])


class Kicked(lfm.Matern):
    """At each time in ``kicks`` the force keeps ``share`` of itself and draws the rest anew."""

    share: Any = 0.3
    kicks: tuple = eqx.field(static=True, default=())

    def __init__(self, share, kicks, *args):
        super().__init__(*args)
        self.share, self.kicks = share, kicks

    @property
    def jump_times(self):
        return self.kicks

    def jump(self, index):
        return self.share * jnp.eye(self.state_dim), (1 - self.share**2) * self.initial_covariance()


def whole_state(x, u, t):
    return x


def first_state(x, u, t):
    return x[:1]


def identity(value):
    return value


def softplus(value):
    return jax.nn.softplus(value)


def double_well(mean=0.5, variance=0.2, dispersion=0.7, noise=0.05, a=-1.0, b=1.0) -> lfm.LatentForceModel:
    return lfm.LatentForceModel(
        DoubleWell(a, b), {}, lfm.GaussianObservation(whole_state, jnp.array([noise])),
        lfm.Gaussian(jnp.array([mean]), jnp.array([variance])), process_noise=jnp.array([[dispersion]]),
        initial_time=0.0)


def motif(link=softplus, decay=0.8, lengthscale=1.3, noise_sd=0.1, variance=0.0, order=1, genes=2,
          initial_time=0.0, scale=1.0) -> lfm.LatentForceModel:
    """Genes with one force; all arguments but ``link``, ``order`` and ``genes`` may be traced."""
    decay = decay * jnp.linspace(1.0, 1.5, genes)
    return lfm.LatentForceModel(
        Motif(decay, jnp.linspace(1.0, 0.6, genes), 0.3, link), {"u": lfm.Matern(scale, lengthscale, order)},
        lfm.GaussianObservation(whole_state, noise_sd**2 * jnp.ones(genes)),
        lfm.Gaussian(0.3 / decay, variance * jnp.eye(genes)), initial_time=initial_time)


def padded(count: int, end: float, rows: int) -> np.ndarray:
    """Times of ``count`` equal steps from 0 to ``end``, after rows of no length: one shape for every count."""
    return np.concatenate([np.zeros(rows - count), np.linspace(0.0, end, count + 1)[1:]])
