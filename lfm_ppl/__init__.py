"""Bayesian inference in latent force models, on NumPyro.

A name is imported when it is asked for, so that ``import lfm_ppl`` costs next to nothing. What reads the source instead
of running it, such as a type checker, finds the names among the imports; `_NAMES` says the same to Python.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lfm_ppl import forces as forces
    from lfm_ppl import orbits as orbits
    from lfm_ppl.backtesting import Backtest as Backtest
    from lfm_ppl.backtesting import backtest as backtest
    from lfm_ppl.compilation import fast_loops as fast_loops
    from lfm_ppl.constrained.full_information import full_information as full_information
    from lfm_ppl.constrained.moving_horizon import MovingHorizon as MovingHorizon
    from lfm_ppl.constrained.moving_horizon import moving_horizon as moving_horizon
    from lfm_ppl.constrained.posterior import constrained_posterior as constrained_posterior
    from lfm_ppl.conversion import to_arviz as to_arviz
    from lfm_ppl.data import Data as Data
    from lfm_ppl.data import read_csv as read_csv
    from lfm_ppl.data import read_table as read_table
    from lfm_ppl.filtering.breakdown import FilterWarning as FilterWarning
    from lfm_ppl.filtering.ep.settings import SiteSettings as SiteSettings
    from lfm_ppl.filtering.filter import FilterState as FilterState
    from lfm_ppl.filtering.filter import filter as filter
    from lfm_ppl.filtering.smoother import smooth as smooth
    from lfm_ppl.fit_results import ConvergenceWarning as ConvergenceWarning
    from lfm_ppl.fitting import fit as fit
    from lfm_ppl.fitting_many import fit_many as fit_many
    from lfm_ppl.fokker_planck_grid.fokker_planck import fokker_planck as fokker_planck
    from lfm_ppl.forces import ApproximationWarning as ApproximationWarning
    from lfm_ppl.forces import Constant as Constant
    from lfm_ppl.forces import Force as Force
    from lfm_ppl.forces import Matern as Matern
    from lfm_ppl.forces import Periodic as Periodic
    from lfm_ppl.forces import QuasiPeriodic as QuasiPeriodic
    from lfm_ppl.forces import Resonator as Resonator
    from lfm_ppl.forces import SquaredExponential as SquaredExponential
    from lfm_ppl.forces import WienerVelocity as WienerVelocity
    from lfm_ppl.forecasting import forecast as forecast
    from lfm_ppl.inference.bound_model import BoundModel as BoundModel
    from lfm_ppl.inference.bound_model import bind as bind
    from lfm_ppl.inference.handlers.fixing import fix as fix
    from lfm_ppl.inference.handlers.on_latent_grid import on_latent_grid as on_latent_grid
    from lfm_ppl.inference.kernels.elliptical_slice import EllipticalSlice as EllipticalSlice
    from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalRAM as ParticleMarginalRAM
    from lfm_ppl.inference.kernels.ram import RAM as RAM
    from lfm_ppl.inference.map import map_estimate as map_estimate
    from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood as MarginalLikelihood
    from lfm_ppl.inference.marginal_likelihood import panel as panel
    from lfm_ppl.latent_grid.laplace import laplace as laplace
    from lfm_ppl.latent_grid.latent_grid import LatentGrid as LatentGrid
    from lfm_ppl.linearisation.rule import Rule as Rule
    from lfm_ppl.linearisation.sigma_points import CentralDifference as CentralDifference
    from lfm_ppl.linearisation.sigma_points import Cubature as Cubature
    from lfm_ppl.linearisation.sigma_points import GaussHermite as GaussHermite
    from lfm_ppl.linearisation.sigma_points import MonteCarlo as MonteCarlo
    from lfm_ppl.linearisation.sigma_points import Unscented as Unscented
    from lfm_ppl.linearisation.taylor import Taylor as Taylor
    from lfm_ppl.model.gaussian import Gaussian as Gaussian
    from lfm_ppl.model.inputs import Input as Input
    from lfm_ppl.model.latent_force_model import LatentForceModel as LatentForceModel
    from lfm_ppl.model.observation import GaussianObservation as GaussianObservation
    from lfm_ppl.model.observations.bernoulli import BernoulliObservation as BernoulliObservation
    from lfm_ppl.model.observations.binomial import BinomialObservation as BinomialObservation
    from lfm_ppl.model.observations.censored import CensoredObservation as CensoredObservation
    from lfm_ppl.model.observations.family import ObservationFamily as ObservationFamily
    from lfm_ppl.model.observations.generic import Observation as Observation
    from lfm_ppl.model.observations.negative_binomial import NegativeBinomialObservation as NegativeBinomialObservation
    from lfm_ppl.model.observations.poisson import PoissonObservation as PoissonObservation
    from lfm_ppl.model.observations.side_by_side import Observations as Observations
    from lfm_ppl.model.observations.student_t import StudentTObservation as StudentTObservation
    from lfm_ppl.model.simulate import Simulation as Simulation
    from lfm_ppl.model.simulate import simulate as simulate
    from lfm_ppl.model.state_space import state_space as state_space
    from lfm_ppl.particles.particle_filter import particle_filter as particle_filter
    from lfm_ppl.particles.particle_smoother import particle_smoother as particle_smoother
    from lfm_ppl.results.accuracy import check_accuracy as check_accuracy
    from lfm_ppl.results.arviz_data import load as load
    from lfm_ppl.results.arviz_data import save as save
    from lfm_ppl.results.correction import correct_posterior as correct_posterior
    from lfm_ppl.results.html_report import save_report as save_report
    from lfm_ppl.results.plots import plot_accuracy as plot_accuracy
    from lfm_ppl.results.plots import plot_calibration as plot_calibration
    from lfm_ppl.results.plots import plot_deterministics as plot_deterministics
    from lfm_ppl.results.plots import plot_fit as plot_fit
    from lfm_ppl.results.plots import plot_forces as plot_forces
    from lfm_ppl.results.plots import plot_inputs as plot_inputs
    from lfm_ppl.results.plots import plot_pairs as plot_pairs
    from lfm_ppl.results.plots import plot_residuals as plot_residuals
    from lfm_ppl.results.plots import plot_states as plot_states
    from lfm_ppl.results.plots import plot_trace as plot_trace
    from lfm_ppl.results.scoring import score as score
    from lfm_ppl.switching.rao_blackwellised import rao_blackwellised as rao_blackwellised
    from lfm_ppl.switching.rule import SwitchingRule as SwitchingRule
    from lfm_ppl.switching.rule import Thermostat as Thermostat
    from lfm_ppl.switching.switched_simulation import simulate_switched as simulate_switched

__version__ = "0.2.0"

_PACKAGES = ("forces", "orbits")
"""Specialised forces and their kernels; satellites."""

_OTHER_PACKAGES = (
    "data", "filtering", "fokker_planck_grid", "inference", "latent_grid", "linearisation", "model", "particles",
    "results", "switching",
)
"""What `lfm_ppl.filtering.filter.FilterResult` and the like are found by, without an import of their own."""

_NAMES = {
    "results.accuracy": ("check_accuracy",),
    "results.arviz_data": ("load", "save"),
    "results.correction": ("correct_posterior",),
    "results.html_report": ("save_report",),
    "results.plots": (
        "plot_accuracy", "plot_calibration", "plot_deterministics", "plot_fit", "plot_forces", "plot_inputs",
        "plot_pairs", "plot_residuals", "plot_states", "plot_trace",
    ),
    "results.scoring": ("score",),
    "inference.kernels.elliptical_slice": ("EllipticalSlice",),
    "fokker_planck_grid.fokker_planck": ("fokker_planck",),
    "latent_grid.laplace": ("laplace",),
    "latent_grid.latent_grid": ("LatentGrid",),
    "particles.particle_filter": ("particle_filter",),
    "particles.particle_smoother": ("particle_smoother",),
    "switching.rao_blackwellised": ("rao_blackwellised",),
    "switching.switched_simulation": ("simulate_switched",),
    "compilation": ("fast_loops",),
    "conversion": ("to_arviz",),
    "data": ("Data", "read_csv", "read_table"),
    "filtering.breakdown": ("FilterWarning",),
    "filtering.filter": ("FilterState", "filter"),
    "filtering.ep.settings": ("SiteSettings",),
    "filtering.smoother": ("smooth",),
    "forces": (
        "ApproximationWarning", "Constant", "Force", "Matern", "Periodic", "QuasiPeriodic", "Resonator",
        "SquaredExponential", "WienerVelocity",
    ),
    "constrained.full_information": ("full_information",),
    "constrained.moving_horizon": ("MovingHorizon", "moving_horizon"),
    "constrained.posterior": ("constrained_posterior",),
    "inference.bound_model": ("BoundModel", "bind"),
    "backtesting": ("Backtest", "backtest"),
    "fit_results": ("ConvergenceWarning",),
    "fitting": ("fit",),
    "fitting_many": ("fit_many",),
    "forecasting": ("forecast",),
    "inference.handlers.fixing": ("fix",),
    "inference.map": ("map_estimate",),
    "inference.marginal_likelihood": ("MarginalLikelihood", "panel"),
    "inference.handlers.on_latent_grid": ("on_latent_grid",),
    "inference.kernels.particle_marginal": ("ParticleMarginalRAM",),
    "inference.kernels.ram": ("RAM",),
    "linearisation.rule": ("Rule",),
    "linearisation.sigma_points": ("CentralDifference", "Cubature", "GaussHermite", "MonteCarlo", "Unscented"),
    "linearisation.taylor": ("Taylor",),
    "model.state_space": ("state_space",),
    "model.inputs": ("Input",),
    "model.latent_force_model": ("LatentForceModel",),
    "model.gaussian": ("Gaussian",),
    "model.observation": ("GaussianObservation",),
    "model.observations.bernoulli": ("BernoulliObservation",),
    "model.observations.binomial": ("BinomialObservation",),
    "model.observations.censored": ("CensoredObservation",),
    "model.observations.family": ("ObservationFamily",),
    "model.observations.generic": ("Observation",),
    "model.observations.negative_binomial": ("NegativeBinomialObservation",),
    "model.observations.poisson": ("PoissonObservation",),
    "model.observations.side_by_side": ("Observations",),
    "model.observations.student_t": ("StudentTObservation",),
    "model.simulate": ("Simulation", "simulate"),
    "switching.rule": ("SwitchingRule", "Thermostat"),
}
"""Module -> the public names in it."""

_MODULES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = sorted((*_MODULES, *_PACKAGES))


if not TYPE_CHECKING:  # a type checker would take it as a promise of any name at all

    def __getattr__(name: str) -> Any:
        """Import a public name; Python asks here for what is not imported yet."""
        if name in (*_PACKAGES, *_OTHER_PACKAGES):
            return importlib.import_module(f"{__name__}.{name}")
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Return the names that tab completion shows, imported or not."""
    return sorted({*globals(), *__all__})
