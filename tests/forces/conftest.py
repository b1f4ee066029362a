"""The list of forces that the contract tests run over, and an exact reference."""

from __future__ import annotations

from decimal import Decimal, localcontext
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lfm_ppl.forces import (  # isort: skip
    CQM, SQM, WQM, Constant, Force, Matern, ModeratedPeriodicMatern, Periodic, PeriodicMatern,
    PeriodicSquaredExponential, QuasiPeriodic, RandomWalk, Resonator, SquaredExponential, WienerVelocity)
from lfm_ppl.forces.shared_state import in_state_of
from lfm_ppl.studies.periodic_kernels.sparse_spectrum import SparseSpectrum

# Functions of (scale, lengthscale). A new force is covered by a line here.
FORCES = {
    **{f"matern_{p}": lambda s, ell, p=p: Matern(s, ell, order=p) for p in range(6)},
    **{f"squared_exponential_{n}": lambda s, ell, n=n: SquaredExponential(s, ell, order=n) for n in (2, 4, 6, 7, 8)},
    "wiener_velocity": lambda s, ell: WienerVelocity(s, 0.5 * s, 2.0 * s / ell, mean=0.5),
    "random_walk": lambda s, ell: RandomWalk(s / jnp.sqrt(ell), 0.5 * s),
    "resonator": lambda s, ell: Resonator(10.0 * ell, s, s / jnp.sqrt(ell)),
    "damped_resonator": lambda s, ell: Resonator(12.0 * ell, s, s / jnp.sqrt(ell), 0.7 / ell),
    "sparse_spectrum": lambda s, ell: SparseSpectrum(s, jnp.array([1.0, 2.3]) / ell),
    "constant": lambda s, ell: Constant(s),
    "sum": lambda s, ell: Matern(s, ell, order=1, mean=1.0) + Constant(2.0 * s),
    "nested_sum": lambda s, ell: Matern(s, ell, order=2) + (Matern(s, ell, 0) + Matern(s, ell, 0)),
    "cqm": lambda s, ell: CQM(ell),
    "sqm": lambda s, ell: SQM(ell, (1.0, 3.0)),
    "wqm": lambda s, ell: WQM(s, (1.0, 3.0)),
    "periodic": lambda s, ell: Periodic(PeriodicMatern(s, 1.2, 9.0 * ell, 2), functions=5),
    "periodic_exact": lambda s, ell: Periodic(PeriodicSquaredExponential(s, 4.0, 9.0 * ell), functions=11),
    "periodic_moderated": lambda s, ell: Periodic(ModeratedPeriodicMatern(s, 1.2, 9.0 * ell, 0.1 / ell), functions=3,
                                                explained_variance=0.0),
    "quasi_periodic": lambda s, ell: QuasiPeriodic(
        PeriodicMatern(s, 1.2, 9.0 * ell), Matern(1.0, 5.0 * ell), functions=3, explained_variance=0.0),
    "quasi_periodic_steps": lambda s, ell: QuasiPeriodic(
        PeriodicSquaredExponential(s, 1.2, 9.0 * ell), SQM(2.0, (1.0, 3.0)), functions=3, explained_variance=0.0),
    "oscillator": lambda s, ell: MinimalOscillator(s, ell),
    "jumping_sum": lambda s, ell: MinimalOscillator(s, ell, (1.0, 3.0)) + Matern(s, ell),
    "shared_matern": lambda s, ell: in_state_of(Matern(s, ell, 2), Matern(1.0, 0.3 * ell, 2)),
    "shared_squared_exponential": lambda s, ell: in_state_of(
        SquaredExponential(s, ell, order=4), SquaredExponential(1.0, 2.0 * ell, order=4)),
}
# Forces whose state-space form has exactly the covariance that they state in closed form.
EXACT = [name for name in FORCES if not name.startswith(
    ("squared", "oscillator", "jumping", "quasi", "shared_squared")) and name not in ("periodic", "periodic_moderated")]
# Compiled by default, at least one of each kind; the others with -m slow.
QUICK = ("matern_1", "matern_5", "squared_exponential_6", "wiener_velocity", "random_walk", "damped_resonator",
         "sparse_spectrum", "constant", "sum", "cqm", "sqm", "wqm", "periodic", "quasi_periodic_steps", "jumping_sum",
         "shared_matern")
QUICK_DERIVATIVES = ("matern_1", "oscillator")


def params(quick):
    return [pytest.param(name, marks=() if name in quick else pytest.mark.slow) for name in FORCES]


class MinimalOscillator(Force):
    """A critically damped oscillator that says the least possible, so that the defaults are used.

    The state (u, u'/w) has the stationary covariance scale^2 I. At each jump the velocity turns
    round and gains variance.
    """

    scale: jax.Array
    lengthscale: jax.Array
    jumps: tuple[float, ...] = eqx.field(static=True, default=())
    mean: Any = 0.0

    state_dim = 2
    noise_dim = 1

    @property
    def stationary(self):
        return not self.jumps

    def initial_covariance(self):
        return self.scale**2 * jnp.eye(2)

    def feedback(self):
        return jnp.array([[0.0, 1.0], [-1.0, -2.0]]) / self.lengthscale

    def dispersion(self):
        return jnp.array([[0.0], [1.0]]) * self.scale * 2.0 / jnp.sqrt(self.lengthscale)

    @property
    def jump_times(self):
        return self.jumps

    def jump(self, index):
        if index >= len(self.jumps):
            return super().jump(index)
        return jnp.diag(jnp.array([1.0, -1.0])), jnp.diag(jnp.array([0.0, 0.1 * (index + 1.0)]))


@pytest.fixture
def every_force():
    return FORCES


@pytest.fixture(params=params(QUICK))
def name(request):
    return request.param


@pytest.fixture
def build(name):
    """Each force in turn, as a function of (scale, lengthscale)."""
    return FORCES[name]


@pytest.fixture
def has_exact_covariance(name):
    return name in EXACT


@pytest.fixture(params=params(QUICK_DERIVATIVES))
def build_to_differentiate(request):
    return FORCES[request.param]


@pytest.fixture
def oscillator():
    return MinimalOscillator


@pytest.fixture
def exact_step():
    return _exact_step


def _exact_step(feedback, dispersion, dt, digits=80):
    """Return exp(F dt) and the process noise from their Taylor series in 80-digit arithmetic.

    Q' = F Q + Q F' + L L', so that Q = sum_k M_k dt^(k+1) / (k+1)!, M_0 = L L', M_(k+1) = F M_k + M_k F'. Meant for
    |F dt| up to about 20.
    """
    exact = np.vectorize(lambda value: Decimal(float(value)), otypes=[object])
    with localcontext() as context:
        context.prec = digits
        n, dt = len(feedback), Decimal(float(dt))
        step, zero = exact(feedback) * dt, exact(np.zeros((n, n)))
        column = exact(dispersion) if np.size(dispersion) else exact(np.zeros((n, 1)))
        term, transition, moment, noise = exact(np.eye(n)), zero, column.dot(column.T) * dt, zero
        for k in range(1, 1000):
            transition, noise = transition + term, noise + moment
            term = step.dot(term) / k
            moment = (step.dot(moment) + moment.dot(step.T)) / (k + 1)
            size = max(abs(x) for x in [*term.ravel(), *moment.ravel()])
            if k > 3 * n and size < Decimal(10) ** (20 - digits):
                return transition.astype(float), noise.astype(float)
    raise AssertionError("the Taylor series did not converge")
