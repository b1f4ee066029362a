"""Forces: Gaussian process priors in state-space form, one per module; `sde` defines the protocol.

The public names are exported here as `lfm_ppl.forces.NAME`; the most common ones are also `lfm_ppl.NAME`.
"""

from lfm_ppl.forces import priors as priors
from lfm_ppl.forces.constant import Constant
from lfm_ppl.forces.matern import Matern
from lfm_ppl.forces.periodic_kernels import (
    ModeratedPeriodicMatern,
    PeriodicCovariance,
    PeriodicKernel,
    PeriodicMatern,
    PeriodicSquaredExponential,
)
from lfm_ppl.forces.quasi_periodic import Periodic, QuasiPeriodic
from lfm_ppl.forces.random_walk import RandomWalk
from lfm_ppl.forces.resonator import Resonator
from lfm_ppl.forces.sde import ApproximationWarning, Force, Sum
from lfm_ppl.forces.squared_exponential import SquaredExponential
from lfm_ppl.forces.weights import CQM, SQM, WQM, change_points
from lfm_ppl.forces.wiener_velocity import WienerVelocity

__all__ = [
    "ApproximationWarning",
    "CQM",
    "Constant",
    "Force",
    "Matern",
    "ModeratedPeriodicMatern",
    "Periodic",
    "PeriodicCovariance",
    "PeriodicKernel",
    "PeriodicMatern",
    "PeriodicSquaredExponential",
    "QuasiPeriodic",
    "RandomWalk",
    "Resonator",
    "SQM",
    "SquaredExponential",
    "Sum",
    "WQM",
    "WienerVelocity",
    "change_points",
]
