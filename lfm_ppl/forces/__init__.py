"""Forces: Gaussian process priors in state-space form."""

from lfm_ppl.forces.constant import Constant
from lfm_ppl.forces.matern import Matern
from lfm_ppl.forces.random_walk import RandomWalk
from lfm_ppl.forces.resonator import Resonator
from lfm_ppl.forces.sde import Force
from lfm_ppl.forces.squared_exponential import SquaredExponential
from lfm_ppl.forces.sum import Stack, Sum
from lfm_ppl.forces.wiener_velocity import WienerVelocity

__all__ = [
    "Constant",
    "Force",
    "Matern",
    "RandomWalk",
    "Resonator",
    "SquaredExponential",
    "Stack",
    "Sum",
    "WienerVelocity",
]
