"""What holds for every model, asked of models drawn at random.

A structure is compiled once and asked about several series at a time. A long gap in coarse steps may send a non-linear
model to infinity: its log likelihood is then -inf, with a gradient of zero, and nothing else is asked.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_models import AHEAD, ROWS, Series, Structure, batch, build, structure

import lfm_ppl as lfm

CUT = 4
FEW, MANY = 4, 12

UNDIVIDED = 1e6
"""Longest step that divides no interval."""

RESOLVED = 1e6
"""Standard deviation above which a periodic function of a state is chance, and so is its derivative."""


def options_of(spec: Structure, known_times) -> dict:
    """Return the settings of all passes; by default known times divide long intervals, and traced times do not."""
    return {"rule": spec.rule, "steps": spec.steps, "max_step": None if known_times is None else UNDIVIDED}


def log_likelihood(spec: Structure, known_times, parameters, times, y):
    times = times if known_times is None else known_times
    return lfm.MarginalLikelihood(build(spec, parameters), times, **options_of(spec, known_times)).log_prob(y)


def results(spec: Structure, known_times, parameters, times, y):
    """Filter and smoother in one pass, in two, and beyond the data."""
    times = times if known_times is None else known_times
    join = jnp.concatenate if known_times is None else np.concatenate
    model, options = build(spec, parameters), options_of(spec, known_times)
    nothing = jnp.full((len(AHEAD), spec.outputs), jnp.nan)
    later = times[-1] + AHEAD
    passed = lfm.filter(model, times, y, **options)
    first = lfm.filter(model, times[:CUT], y[:CUT], **options)
    second = lfm.filter(model, times[CUT:], y[CUT:], **options, start=first.state)
    forecast = lfm.filter(model, later, nothing, **options, start=passed.state)
    smoothed = lfm.smooth(model, join([times, later]), jnp.concatenate([y, nothing]), **options, iterations=0)
    return {
        "log likelihood": passed.log_likelihood,
        "iterated log likelihood": lfm.smooth(model, times, y, **options).log_likelihood,
        "predicted": passed.predicted_covariance, "filtered": passed.filtered_covariance,
        "smoothed": smoothed.covariance[:ROWS],
        "in two windows": jnp.concatenate([first.log_likelihood, second.log_likelihood]),
        "last means": jnp.stack([passed.filtered_mean[-1], second.filtered_mean[-1]]),
        "forecast means": jnp.stack([forecast.predicted_mean, smoothed.mean[ROWS:]]),
        "forecast covariances": jnp.stack([forecast.predicted_covariance, smoothed.covariance[ROWS:]]),
    }


def central_differences(function, parameters, direction, step):
    upper, lower = ({name: value + sign * step * direction[name] for name, value in parameters.items()}
                    for sign in (1, -1))
    with np.errstate(invalid="ignore"):  # -inf less -inf
        return (np.asarray(function(upper)[0]) - np.asarray(function(lower)[0])) / (2 * step)


def variances(covariance):
    return np.diagonal(covariance, axis1=-2, axis2=-1)


def complaints(seed: int, count: int) -> list[str]:
    """Return what does not hold for a structure, one line a complaint."""
    spec = structure(seed)
    data = batch(spec, count)
    known_times = data.times[0] if spec.jumps else None
    value_and_gradient = jax.jit(jax.vmap(jax.value_and_grad(partial(log_likelihood, spec, known_times))))

    def with_data(parameters):
        return value_and_gradient(parameters, data.times, data.y)

    values, gradient = with_data(data.parameters)

    generator = np.random.default_rng(5)
    direction = {name: generator.normal(size=v.shape) * np.abs(v) for name, v in data.parameters.items()}
    along = sum((np.asarray(gradient[name]) * direction[name]).reshape(count, -1).sum(1) for name in direction)
    coarse, fine = (central_differences(with_data, data.parameters, direction, step) for step in (1e-6, 2.5e-7))
    result = jax.jit(jax.vmap(partial(results, spec, known_times)))(*data)

    failures = []
    for index in range(count):
        single = jax.tree_util.tree_map(lambda a: np.asarray(a)[index], result)  # noqa: B023
        slopes = along[index], coarse[index], fine[index]
        gradients = np.concatenate([np.asarray(g)[index].ravel() for g in gradient.values()])
        lines = _of_series(spec, float(values[index]), gradients, slopes, single)
        failures += [f"structure {seed}, series {index}: {line}" for line in lines]
    return failures + [f"structure {seed}: {line}" for line in _of_known_numbers(spec, data, result)]


def _of_series(spec: Structure, value: float, gradient: np.ndarray, slopes: tuple, result: dict) -> list[str]:
    if not np.isfinite(gradient).all():
        return ["the gradient is not finite"]
    if value == -np.inf:
        return ["the log likelihood is -inf, but its gradient is not zero"] if gradient.any() else []
    if not np.isfinite(value):
        return [f"the log likelihood is {value}"]
    failures = []

    def expect(small: float, most: float, quantity: str) -> None:
        if not small <= most:
            failures.append(f"{quantity}: {small:.1e}")

    total = float(result["log likelihood"].sum())
    iterated = float(result["iterated log likelihood"].sum())
    # Iterations that have not settled amplify rounding errors.
    rounding = 1e-6 if spec.linear else 1e-5
    expect(abs(value - iterated), rounding * max(1.0, abs(iterated)), "distribution and smoother")
    if total == -np.inf:  # in a single pass; iterations start from the moments before it breaks down
        return failures
    expect(abs(result["in two windows"].sum() - total), 1e-6 * max(1.0, abs(total)), "in two windows and in one")
    full_means, windows = result["last means"]
    expect(np.max(np.abs(full_means - windows) / np.maximum(1.0, np.abs(full_means))), 1e-5, "last means")

    slope, coarse, fine = slopes
    scale = max(1.0, abs(slope))
    # Of a chaotic path no two steps give the same difference.
    has_difference = abs(coarse - fine) < 0.1 * max(1.0, abs(fine))
    if spec.linear or has_difference and np.sqrt(variances(result["predicted"]).max()) < RESOLVED:
        expect(abs(slope - fine) / scale, max(1e-3, 30 * abs(coarse - fine) / scale), "gradient and differences")

    largest = variances(result["predicted"]).max(0)
    for name in ("predicted", "filtered", "smoothed"):
        expect(np.max(-variances(result[name]) - 1e-12 * largest), 0.0, f"negative variance, {name}")
    if spec.linear:
        filtered = variances(result["filtered"])
        floor = np.maximum(1e-9 * variances(result["predicted"]), 1e-12)
        excess = (variances(result["smoothed"]) - filtered) / np.maximum(filtered, floor)
        expect(excess.max(), 1e-6, "smoother above filter")

    means, covariances = result["forecast means"], result["forecast covariances"]
    sd = np.sqrt(np.maximum(variances(covariances[0]), 1e-16))
    expect(np.max(np.abs(means[0] - means[1]) / np.maximum(sd, 1e-6 * np.abs(means[0]))), 1e-4, "forecast means")
    expect(np.max(np.abs(covariances[0] - covariances[1]) / (sd[:, :, None] * sd[:, None, :])), 1e-4,
           "forecast covariances")
    return failures


def _of_known_numbers(spec: Structure, data: Series, result: dict) -> list[str]:
    """The same outside of compiled code, where structure and time grid are read off the numbers."""
    finite = np.flatnonzero(np.isfinite(np.asarray(result["log likelihood"])).all(1))
    if not finite.size:
        return []
    parameters, times, y = jax.tree_util.tree_map(lambda a: a[finite[0]], data)
    eager = lfm.filter(build(spec, parameters), times, y, **options_of(spec, times)).log_likelihood.sum()
    difference = abs(float(eager) - float(result["log likelihood"][finite[0]].sum()))
    return [] if difference <= 1e-6 * max(1.0, abs(float(eager))) else [f"known numbers and traced: {difference:.1e}"]


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [pytest.param(285, marks=pytest.mark.slow), 16])
def test_a_few_structures(seed):
    """One with a force that jumps and a curved output, and one that is linear."""
    assert not complaints(seed, FEW)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(0, 300, 30))
def test_many_structures(seed, release_programs_of_test):
    failures = complaints(seed, MANY)
    assert not failures, "\n".join(failures)
