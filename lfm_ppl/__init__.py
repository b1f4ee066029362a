"""Bayesian inference in latent force models, on NumPyro."""

from lfm_ppl import orbits
from lfm_ppl.analysis.accuracy import check_accuracy
from lfm_ppl.analysis.correction import correct as correct_posterior
from lfm_ppl.analysis.report import AccuracyReport
from lfm_ppl.comparators.elliptical_slice import EllipticalSlice
from lfm_ppl.comparators.fokker_planck import FokkerPlanckResult, fokker_planck
from lfm_ppl.comparators.laplace import LaplaceResult, laplace
from lfm_ppl.comparators.latent_grid import LatentGrid
from lfm_ppl.comparators.particle_filter import ParticleFilterResult, particle_filter
from lfm_ppl.comparators.particle_smoother import ParticleSmootherResult, particle_smoother
from lfm_ppl.comparators.rao_blackwellised import RaoBlackwellisedResult, rao_blackwellised
from lfm_ppl.comparators.switched_simulation import SwitchedSimulation, simulate_switched
from lfm_ppl.compilation import fast_loops
from lfm_ppl.data import Data, read_csv
from lfm_ppl.filtering.breakdown import FilterWarning
from lfm_ppl.filtering.filter import FilterResult, FilterState, filter
from lfm_ppl.filtering.smoother import SmootherResult, smooth
from lfm_ppl.forces import (
    CQM,
    SQM,
    WQM,
    Constant,
    Force,
    Kernel,
    Matern,
    ModeratedPeriodicMatern,
    Periodic,
    PeriodicKernel,
    PeriodicMatern,
    PeriodicSquaredExponential,
    QuasiPeriodic,
    RandomWalk,
    Resonator,
    SparseSpectrum,
    SquaredExponential,
    WienerVelocity,
    change_points,
    random_frequencies,
    resonators,
    significant_functions,
)
from lfm_ppl.inference.fit import ConvergenceWarning, fit
from lfm_ppl.inference.fixing import fix
from lfm_ppl.inference.map import MAPResult, map_estimate
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood, panel
from lfm_ppl.inference.on_latent_grid import on_latent_grid
from lfm_ppl.inference.particle_marginal import ParticleMarginalRAM
from lfm_ppl.inference.ram import RAM
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import (
    CentralDifference,
    Cubature,
    GaussHermite,
    MonteCarlo,
    Unscented,
)
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.augment import StateSpaceModel, state_space
from lfm_ppl.model.known_input import Input
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import Gaussian, GaussianObservation
from lfm_ppl.model.resolution import ApproximationWarning
from lfm_ppl.model.simulate import Simulation, simulate
from lfm_ppl.model.switching import SwitchingRule, Thermostat

__version__ = "0.1.0"

__all__ = [
    "AccuracyReport",
    "ApproximationWarning",
    "CQM",
    "CentralDifference",
    "Constant",
    "ConvergenceWarning",
    "Cubature",
    "Data",
    "EllipticalSlice",
    "FilterResult",
    "FilterState",
    "FilterWarning",
    "FokkerPlanckResult",
    "Force",
    "GaussHermite",
    "Gaussian",
    "GaussianObservation",
    "Input",
    "Kernel",
    "LaplaceResult",
    "LatentForceModel",
    "LatentGrid",
    "MAPResult",
    "MarginalLikelihood",
    "Matern",
    "ModeratedPeriodicMatern",
    "MonteCarlo",
    "ParticleFilterResult",
    "ParticleMarginalRAM",
    "ParticleSmootherResult",
    "Periodic",
    "PeriodicKernel",
    "PeriodicMatern",
    "PeriodicSquaredExponential",
    "QuasiPeriodic",
    "RAM",
    "RandomWalk",
    "RaoBlackwellisedResult",
    "Resonator",
    "Rule",
    "SQM",
    "Simulation",
    "SmootherResult",
    "SparseSpectrum",
    "SquaredExponential",
    "StateSpaceModel",
    "SwitchedSimulation",
    "SwitchingRule",
    "Taylor",
    "Thermostat",
    "Unscented",
    "WQM",
    "WienerVelocity",
    "change_points",
    "check_accuracy",
    "correct_posterior",
    "fast_loops",
    "filter",
    "fit",
    "fix",
    "fokker_planck",
    "laplace",
    "map_estimate",
    "on_latent_grid",
    "orbits",
    "panel",
    "particle_filter",
    "particle_smoother",
    "random_frequencies",
    "rao_blackwellised",
    "read_csv",
    "resonators",
    "significant_functions",
    "simulate",
    "simulate_switched",
    "smooth",
    "state_space",
]
