"""Every wrong argument is named before anything is compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl import forces
from lfm_ppl.forces import Constant, Matern, SquaredExponential, Sum, WienerVelocity
from lfm_ppl.studies.periodic_kernels.resonators import resonators
from lfm_ppl.studies.periodic_kernels.sparse_spectrum import SparseSpectrum

KERNEL = forces.PeriodicSquaredExponential(1.0, 1.0, 10.0)
VALUES = [
    *((lambda make=make, name=name, value=value: make(**{"scale": 1.0, "lengthscale": 1.0, name: value}), name)
      for make in (Matern, SquaredExponential) for name in ("scale", "lengthscale")
      for value in (0.0, -1.0, np.nan, np.inf)),
    (lambda: WienerVelocity(-1.0), "scale"),
    (lambda: Constant(np.nan), "scale"),
    (lambda: Matern(jnp.ones(2), 1.0), "scale"),
    (lambda: jax.jit(lambda ell: Matern(1.0, ell).feedback())(jnp.ones(3)), "lengthscale"),
    (lambda: Matern(1.0, 1.0, order=6), "order"),
    (lambda: SquaredExponential(1.0, 1.0, order=3), "order"),
    (lambda: WienerVelocity(1.0, initial_sd=-1.0), "initial_sd"),
    (lambda: WienerVelocity(1.0, initial_velocity_sd=np.nan), "initial_velocity_sd"),
    (lambda: Constant(1.0, mean=np.nan), "mean"),
    (lambda: Matern(1.0, 1.0, mean=[1.0, 2.0]), "mean"),
    (lambda: Sum(()), "force"),
    (lambda: forces.PeriodicMatern(1.0, 1.0, 0.0), "period"),
    (lambda: forces.PeriodicSquaredExponential(1.0, 0.0, 3.0), "lengthscale"),
    (lambda: forces.SQM(1.0, (1.0, 3.0, 2.0)), "change_points"),
    (lambda: forces.WQM(-0.1, ()), "growth"),
    (lambda: forces.CQM(0.0), "lengthscale"),
    (lambda: forces.change_points(24.0, 0.0, 20.0), "period"),
    (lambda: lfm.Periodic(KERNEL, functions=4), "odd"),
    (lambda: lfm.Periodic(KERNEL, gamma=2.0), "gamma"),
    (lambda: lfm.Periodic(KERNEL, functions=7, explained_variance=99), "explained_variance"),
    (lambda: lfm.QuasiPeriodic(KERNEL, Matern(1.0, 1.0, mean=2.0)), "evolution"),
    (lambda: resonators(forces.ModeratedPeriodicMatern(1.0, 1.0, 5.0)), "'ModeratedPeriodicMatern'"),
    (lambda: forces.PeriodicKernel(lambda t, s: t - s, 5.0), "symmetric"),
    (lambda: forces.PeriodicKernel(lambda t, s: jnp.exp(-((t - s) ** 2)), 5.0, stationary=True), "stationary"),
    (lambda: forces.PeriodicKernel(lambda t, s: 1.0, 5.0), "elementwise"),
    (lambda: SparseSpectrum(1.0, np.ones((2, 2))), "frequencies"),
    (lambda: jax.jit(lambda p: lfm.Periodic(forces.PeriodicMatern(1.0, 1.0, p)).eigenvalues())(24.0), "functions"),
]
TYPES = [
    (lambda: Matern(1.0, "long"), "lengthscale"),
    (lambda: Matern(1.0, None), "lengthscale"),
    *((lambda make=make, order=order: make(1.0, 1.0, order=order), "order")
      for make in (Matern, SquaredExponential) for order in (2.0, "2", True, None)),
    (lambda: jax.jit(lambda order: Matern(1.0, 1.0, order=order).feedback())(2), "order"),
    (lambda: Constant(1.0, mean="zero"), "mean"),
    (lambda: Sum((Matern(1.0, 1.0), 2.0)), "2.0"),
    (lambda: Matern(1.0, 1.0) + 2.0, "operand"),
    (lambda: lfm.Periodic(Matern(1.0, 1.0)), "kernel"),
    (lambda: lfm.QuasiPeriodic(KERNEL, 3.0), "evolution"),
    (lambda: jax.jit(lambda p: forces.change_points(p, 0.0, 50.0))(24.0), "compilation"),
]


@pytest.mark.thorough
def test_wrong_arguments_are_named():
    for error, cases in ((ValueError, VALUES), (TypeError, TYPES)):
        for make, name in cases:
            with pytest.raises(error, match=name):
                make()
