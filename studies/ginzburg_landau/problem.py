"""Realisations of the double well, its true parameters, and the methods of the study."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.likelihoods.likelihood_site import likelihood_site

NAMES = ("alpha", "beta", "sigma")
TRUTH = (-1.0, 0.1, 2.0)
GAUSSIAN: dict[str, lfm.Rule] = {"EKF": lfm.Taylor(), "CKF": lfm.Cubature(), "GHKF(7)": lfm.GaussHermite(7)}
PARTICLES, GRID = "particle filter", "grid"
METHODS = (*GAUSSIAN, PARTICLES, GRID)
STEPS = 60
"""Integration steps of the Gaussian filters between two observations, as in the model file."""

DEFAULT = 2
"""Index of the realisation that the model file simulates by default, for seed 0."""

MAX_REALISATIONS = 10_000
"""Largest number of realisations for one seed of the study."""


@dataclass(frozen=True)
class Realisation:
    """A simulated path and its observations.

    Attributes:
        times: (T,) observation times.
        y: (T, 1) observations.
        fine: (K,) times of the path, including the observation times.
        path: (K,) states.
    """

    times: np.ndarray
    y: np.ndarray
    fine: np.ndarray
    path: np.ndarray

    @property
    def sparse(self) -> np.ndarray:
        """The observations on the fine times (K, 1), NaN between them."""
        values = np.full((len(self.fine), 1), np.nan)
        values[np.searchsorted(self.fine, self.times - 1e-9)] = self.y
        return values


@functools.cache
def model_file() -> loading.ModelFile:
    """Return the shipped model."""
    return loading.load("ginzburg-landau")


@functools.lru_cache(maxsize=256)
def realisation(index: int, seed: int = 0) -> Realisation:
    """Return realisation ``index`` of the study with this seed.

    ``lfm-ppl simulate ginzburg-landau --seed N`` writes the same data for N = 10000 seed + index. The path starts in
    the right well, at sqrt(10); the filters' prior is N(0, 10). With seed 0, number 2 is the model's default data.
    """
    data = model_file().simulate(seed=MAX_REALISATIONS * seed + index)
    truth: Any = data.truth
    return Realisation(data.times, data.y, np.asarray(truth["times"]), np.asarray(truth["state"])[:, 0])


def system(theta: Any) -> lfm.LatentForceModel:
    """Return the double well with parameters (alpha, beta, sigma); they may be traced."""
    alpha, beta, sigma = theta
    sites = {"sigma": sigma, "linear": alpha / sigma**2, "cubic": beta / sigma**2}
    site = likelihood_site(model_file().model, (np.arange(0.0, 51.0, 2.0),), {}, jax.random.key(0), sites)
    return site.distribution.model


@functools.cache
def true_system() -> lfm.LatentForceModel:
    """Return the double well at the true parameters; one object, so that all realisations share compiled programs."""
    return system(jnp.asarray(TRUTH))
