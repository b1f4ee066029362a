"""Linearised models, in which `lfm_ppl.model.resolution` and `lfm_ppl.model.truncation` estimate errors of forces.

1. Linearise the model at its prior mean (`linearised_terms`).
2. On a time grid, over each step of which a force is taken as linear in time, compute the response of the outputs to
   the forces by one matrix exponential per distinct step (`output_responses`).
3. `error_bound` gives the error of the log likelihood from the eigenvalues of the approximate and exact covariances.

Source: Whittle (1953), Arkiv för Matematik 2, for the likelihood of an approximate covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

from lfm_ppl.forces.sde import Force, Sum
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.utils import checks

TOLERANCE = 0.1
"""Error of the log likelihood above which a warning is given."""

LEAST_NOISE = 1e-10
"""Lower bound on the observation noise, relative to the variance of the signal; it keeps K non-singular."""


class LinearModel(NamedTuple):
    """The linear model dx/dt = A x + B u, y = C x + D u + e, e ~ N(0, R), x(t0) ~ N(., P0)."""

    a: np.ndarray  # A (M, M)
    b: np.ndarray  # B (M, R)
    c: np.ndarray  # C (D, M)
    d: np.ndarray  # D (D, R)
    noise: np.ndarray  # R (D, D)
    initial: np.ndarray  # P0 (M, M)


class ForceTerm(NamedTuple):
    """A force that is not a sum, or a term of a sum: the name in the model, the column in the inputs u, the force."""

    name: str
    column: int
    force: Force


class LinearisedTerm(NamedTuple):
    """A force of a linearised model, its other forces, and the observed times (N,), N > 1."""

    term: ForceTerm
    other_terms: list[ForceTerm]
    linear: LinearModel
    times: np.ndarray


def linearised_terms(model: LatentForceModel, times: Any, y: Any,
                     is_checked: Callable[[Force], bool]) -> list[LinearisedTerm]:
    """Return the forces that ``is_checked`` selects, also in sums, with the model linearised at its prior mean.

    Args:
        model: the latent force model.
        times: (T,).
        y: (T, D), NaN where missing; None: all entries are observed.
        is_checked: selects forces.

    Returns:
        The list is empty if a value is traced, if fewer than two times are observed, for an observation family, and
        for a model with process noise, which the linearised model does not include.
    """
    pairs = zip(model.force_names, model.force_list, strict=True)
    terms = [ForceTerm(name, column, term) for column, (name, force) in enumerate(pairs)
             for term in (force.forces if isinstance(force, Sum) else (force,))]
    checked = [index for index, term in enumerate(terms) if is_checked(term.force)]
    observed = _observed_times(model, times, y) if checked else None
    linear = None if observed is None else _linearise(model, observed[0])
    if observed is None or linear is None:
        return []
    return [LinearisedTerm(terms[index], terms[:index] + terms[index + 1:], linear, observed) for index in checked]


def _observed_times(model: LatentForceModel, times: Any, y: Any) -> np.ndarray | None:
    """Return the times (N,) with observed entries, None where the linearised model does not give the likelihood."""
    if isinstance(model.observation, ObservationFamily) or model.process_noise is not None:
        return None
    # In compiled code every new array is traced.
    if checks.traced((model, times, y, jnp.zeros(()))):
        return None
    observed = np.asarray(times, float)
    if y is not None and observed.ndim == 1 and np.shape(y)[:1] == observed.shape:
        observed = observed[np.isfinite(np.asarray(checks.unmask(y), float)).reshape(observed.size, -1).any(axis=1)]
    return observed if observed.ndim == 1 and observed.size > 1 and np.all(np.isfinite(observed)) else None


def _linearise(model: LatentForceModel, time: float) -> LinearModel | None:
    """Return the model linearised at its prior mean; None if a coefficient is traced or not finite."""
    t = jnp.asarray(time, float)
    x = model.initial_state.mean
    u = jnp.asarray([force.mean_at(t) for force in model.force_list], float)
    slopes: list[Any] = []
    for function in (model.dynamics, model.observation.function):
        differentiate: Callable[..., Any] = jax.jacfwd(lambda x, u, f=function: jnp.asarray(f(x, u, t), float), (0, 1))
        slopes.extend(differentiate(x, u))
    covariance = model.observation.covariance
    noise = (jnp.median(jnp.asarray(covariance), axis=0) if np.ndim(covariance) == 3
             else model.observation.covariance_at(x, u, t, jnp.asarray(0)))
    coefficients = (*slopes, noise, model.initial_state.covariance)
    if checks.traced(coefficients):
        return None
    linear = LinearModel(*(np.asarray(coefficient, float) for coefficient in coefficients))
    return linear if all(np.all(np.isfinite(coefficient)) for coefficient in linear) else None


def output_responses(linear: LinearModel, grid: np.ndarray, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the linear maps from the forces on a grid (J,) and from a standard normal initial state to the outputs.

    Args:
        linear: the linearised model; its initial time is the first time of the grid.
        grid: non-decreasing times; the first and then every ``substeps``-th time is observed.
        substeps: steps between observations; forces are taken as linear in time over a step.

    Returns:
        Arrays (points D, J, R) and (points D, M).
    """
    size, sources = linear.b.shape
    steps, index_of_step = np.unique(np.diff(grid), return_inverse=True)
    if steps.size and np.ptp(steps) <= 1e-9 * steps.max():
        # Steps that differ by rounding only share one matrix exponential.
        steps, index_of_step = steps[-1:], np.zeros_like(index_of_step)
    block = np.zeros((steps.size, size + sources, size + sources))
    block[:, :size, :size] = linear.a * steps[:, None, None]
    block[:, :size, size:] = linear.b * steps[:, None, None]
    transitions = expm(block)
    values, vectors = np.linalg.eigh(linear.initial)
    start = vectors * np.sqrt(np.maximum(values, 0.0))
    state = np.zeros((size, grid.size, sources))
    response, initial = [], []
    for index in range(grid.size):
        if index:
            transition = transitions[index_of_step[index - 1]]
            # The mean of the values of u at both ends of a step drives the step.
            state = np.einsum("ij,jkr->ikr", transition[:size, :size], state)
            state[:, index - 1: index + 1] += 0.5 * transition[:size, None, size:]
            start = transition[:size, :size] @ start
        if index % substeps == 0:
            output = np.einsum("ij,jkr->ikr", linear.c, state)
            output[:, index] += linear.d
            response.append(output)
            initial.append(linear.c @ start)
    return np.concatenate(response), np.concatenate(initial)


def error_bound(eigenvalues: np.ndarray, pieces: float = 1.0) -> float:
    r"""Return |mean| + 2 standard deviations of the error of a log likelihood, over data sets from the exact process.

    For y ~ N(0, K), whose covariance is K_n under the approximation, and the eigenvalues e_i of K_n^-1 K, the error has

        mean = -sum_i (e_i - 1 - log e_i) / 2,    variance = sum_i (e_i - 1)^2 / 2.

    Args:
        eigenvalues: e_i.
        pieces: number of independent pieces of the data; the eigenvalues describe one piece.
    """
    mean = 0.5 * (eigenvalues - 1.0 - np.log(eigenvalues)).sum()
    variance = 0.5 * ((eigenvalues - 1.0) ** 2).sum()
    return float(pieces * mean + 2.0 * np.sqrt(pieces * variance))
