"""Linear models against dense Gaussian process algebra."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import LinearLFM, Regression, added, complex_step, matern
from systems import Linear, Outputs

import lfm_ppl as lfm
from lfm_ppl.model.state_space import state_space

NAN = np.nan


@dataclasses.dataclass
class Case:
    model: lfm.LatentForceModel
    reference: Regression
    times: np.ndarray
    y: np.ndarray
    steps: int = 3


def smooth_wave(t):
    return 0.5 * jnp.sin(1.1 * t) + 0.2


def wave_numpy(t):
    return 0.5 * np.sin(1.1 * t) + 0.2


# Gaps, replicates, observations at and after the initial time.
TIMES = np.array([0.5, 0.5, 0.9, 1.0, 2.2, 2.2, 2.2, 3.0, 6.5, 6.6])


def data(outputs: int, seed: int = 0) -> np.ndarray:
    y = np.random.default_rng(seed).normal(size=(len(TIMES), outputs))
    y[3, 0] = y[6] = y[8, -1] = NAN
    return y


def linear_case(j, b, forces, kernels, *, output, start=0.0, variance=None, noise=0.04, constant=0.0, additive=None,
                means=None, reference_additive=None, dispersion=None, steps=3, mean=None, breaks=()) -> Case:
    j, b, output = (np.atleast_2d(np.asarray(a, float)) for a in (j, b, output))
    size, count = b.shape
    mean = 0.3 * np.arange(1, size + 1) if mean is None else mean
    covariance = np.zeros((size, size)) if variance is None else np.asarray(variance, float)
    outputs = output.shape[0]
    constant = np.broadcast_to(constant, (size,))
    model = lfm.LatentForceModel(
        Linear(jnp.asarray(j), jnp.asarray(b), jnp.asarray(constant), additive), forces,
        lfm.GaussianObservation(Outputs(jnp.asarray(output)), noise * jnp.ones(outputs)),
        lfm.Gaussian(jnp.asarray(mean), jnp.asarray(covariance)), initial_time=start,
        process_noise=None if dispersion is None else jnp.asarray(dispersion))

    def add(t):
        return constant + (0.0 if reference_additive is None else reference_additive(t))

    process = LinearLFM(j, b, kernels, start, mean, covariance, means, add, dispersion, breaks=breaks)
    return Case(model, Regression(process, output, noise * np.ones(outputs)), TIMES, data(outputs), steps)


def regression(order: int) -> Case:
    kernel = matern(1.2, 0.8, order)
    empty = np.zeros((0, 0))
    model = lfm.LatentForceModel(
        Linear(jnp.zeros((0, 0)), jnp.zeros((0, 1)), jnp.zeros(0)), {"u": lfm.Matern(1.2, 0.8, order)},
        lfm.GaussianObservation(Outputs(jnp.ones((1, 1))), jnp.array([0.04])), lfm.Gaussian(jnp.zeros(0), empty),
        initial_time=0.5)
    process = LinearLFM(empty, np.zeros((0, 1)), [kernel], 0.5, np.zeros(0), empty)
    y = data(1)
    y[3] = 0.4
    return Case(model, Regression(process, np.ones((1, 1)), np.array([0.04])), TIMES, y)


def heater() -> lfm.Input:
    return lfm.Input([0.5, 1.0, 3.0, 6.5], [0.0, 2.0, -1.0, 0.5], "linear")


class Heated(eqx.Module):
    signal: Any

    def __call__(self, t):
        return jnp.array([1.0, 0.0]) * self.signal(t)


GENES = np.diag([-0.7, -1.1])
SENSITIVITY = np.array([[1.0], [0.5]])
SPRING = np.array([[0, 1, 0, 0], [-2.0, -0.4, 0, 0], [0, 0, 0, 1], [0, 0, -0.6, -1.0]])
SPRING_INPUT = np.array([[0.0], [1.0], [0.0], [0.5]])
STATES = np.eye(2, 3)


def _cases() -> dict[str, Any]:
    m = lfm.Matern
    genes = {"j": GENES, "b": SENSITIVITY, "output": STATES}
    single = {"forces": {"u": m(1.0, 1.3, 1)}, "kernels": [matern(1.0, 1.3, 1)]}
    positions = np.array([[1.0, 0, 0, 0, 0], [0, 0, 1, 0, 0]])
    heated = {"constant": 0.2, "additive": Heated(heater()), "breaks": (0.5, 1.0, 3.0, 6.5),
              "reference_additive": lambda t: np.array([np.interp(t, [0.5, 1.0, 3.0, 6.5], [0.0, 2.0, -1.0, 0.5]), 0])}
    return {
        **{f"matern {p}": lambda p=p: regression(p) for p in (2, 5)},
        "motif, known start": lambda: linear_case(**genes, **single, constant=0.3),
        "motif, uncertain start": lambda: linear_case(**genes, **single, variance=[[0.5, 0.2], [0.2, 0.3]], start=-1.0),
        "motif, rough force and process noise": lambda: linear_case(
            **genes, forces={"u": m(1.0, 1.3, 0)}, kernels=[matern(1.0, 1.3, 0)],
            dispersion=np.array([[0.3, 0.0], [0.1, 0.2]]), variance=np.eye(2)),
        "spring": lambda: linear_case(SPRING, SPRING_INPUT, {"u": m(1.0, 2.0, 2)}, [matern(1.0, 2.0, 2)],
                                      output=positions, variance=np.eye(4)),
        "two forces, one a sum": lambda: linear_case(
            GENES, [[1.0, 0.3], [0.5, -0.4]], {"a": m(1.0, 1.3, 1), "b": m(0.7, 0.6, 2) + m(0.5, 3.0, 0)},
            [matern(1.0, 1.3, 1), added(matern(0.7, 0.6, 2), matern(0.5, 3.0, 0))],
            output=[[1.0, 0, 0, 0], [0, 1.0, 0, 0.5]]),
        "mean function": lambda: linear_case(
            **genes, forces={"u": m(1.0, 1.3, 1, mean=smooth_wave)}, kernels=single["kernels"], means=[wave_numpy],
            steps=100),
        # The filter's rows end at the kinks of the input.
        "known input": lambda: linear_case(**genes, **single, **heated, steps=100),
    }


CASES = _cases()
# One of each kind; the others with -m slow.
QUICK = {"matern 5", "motif, rough force and process noise", "two forces, one a sum", "known input"}


@pytest.fixture(scope="module", params=[
    pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in CASES])
def case(request):
    return CASES[request.param]()


AT = np.array([7.4, 0.5, 1.6, 2.2, 3.0, 9.0])  # between, on and after the observations, in any order


@pytest.fixture(scope="module")
def smoothed(case):
    return lfm.smooth(case.model, case.times, case.y, steps=case.steps, at=AT)


def close(result, expected, tolerance=1e-8):
    """Relative to the largest entry."""
    result, expected = np.asarray(result), np.asarray(expected)
    assert result.shape == expected.shape
    assert np.abs(result - expected).max() <= tolerance * np.abs(expected).max()


def test_log_likelihood(case, smoothed):
    close(smoothed.log_likelihood.sum(), case.reference.log_likelihood(case.times, case.y))
    missing = np.isnan(case.y).all(axis=1)
    assert missing.any() and not np.asarray(smoothed.log_likelihood)[missing].any()


def test_smoother_and_forecast(case, smoothed):
    mean, covariance = case.reference.posterior(case.times, case.y, AT)
    close(smoothed.input_mean, mean)
    close(smoothed.input_covariance, covariance[np.arange(len(AT)), np.arange(len(AT))])


def test_leave_one_out(case, smoothed):
    close(smoothed.leave_one_out, case.reference.leave_one_out(case.times, case.y))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["motif, known start", "mean function"])
def test_filter(name):
    case = CASES[name]()
    result = lfm.filter(case.model, case.times, case.y, steps=case.steps)
    mean, covariance = case.reference.filtered(case.times, case.y)
    ssm = state_space(case.model)
    matrix, offset = jax.vmap(ssm.input_map)(jnp.asarray(case.times))
    close(jnp.einsum("kwn,kn->kw", matrix, result.filtered_mean) + offset, mean)
    close(jnp.einsum("kwn,knm,kvm->kwv", matrix, result.filtered_covariance, matrix), covariance)
    close(result.log_likelihood.sum(), case.reference.log_likelihood(case.times, case.y))
    present = np.isfinite(case.y)
    # Whitened residuals are another way to write the same quadratic form.
    assert np.array_equal(np.isfinite(result.whitened_innovation), present)
    joint = case.reference.joint(case.times, case.y)
    residual, k = joint[1][present.ravel()], joint[2][np.ix_(present.ravel(), present.ravel())]
    close(np.nansum(np.asarray(result.whitened_innovation) ** 2), residual @ np.linalg.solve(k, residual))


@pytest.mark.slow
def test_initial_time_defaults_to_the_first_observation():
    times = TIMES
    system = CASES["motif, uncertain start"]().model
    model = lfm.LatentForceModel(system.dynamics, system.forces, system.observation, system.initial_state)
    moved = CASES["motif, uncertain start"]().reference
    moved.process.start = times[0]
    y = data(2)
    close(lfm.filter(model, times, y).log_likelihood.sum(), moved.log_likelihood(times, y))


def build_motif(theta):
    return lfm.LatentForceModel(
        Linear(-jnp.diag(theta[:2]), theta[2:4, None], theta[4:6]), {"u": lfm.Matern(theta[6], theta[7], 1)},
        lfm.GaussianObservation(Outputs(jnp.asarray(STATES)), theta[8] * jnp.ones(2)),
        lfm.Gaussian(theta[9] * jnp.ones(2), theta[10] * jnp.eye(2)), initial_time=0.0)


def dense_motif(theta):
    process = LinearLFM(-np.diag(theta[:2]), theta[2:4, None], [matern(theta[6], theta[7], 1)], 0.0,
                        theta[9] * np.ones(2), theta[10] * np.eye(2), None, lambda t: theta[4:6])
    return Regression(process, STATES, theta[8] * np.ones(2))


def build_spring(theta):
    system = jnp.asarray(SPRING).at[1, 0].set(-theta[0]).at[1, 1].set(-theta[1])
    return lfm.LatentForceModel(
        Linear(system, theta[2] * jnp.asarray(SPRING_INPUT)), {"u": lfm.Matern(1.0, theta[3], 2)},
        lfm.GaussianObservation(lambda x, u, t: x[::2], theta[4] * jnp.ones(2)),
        lfm.Gaussian(jnp.zeros(4), jnp.zeros((4, 4))), initial_time=0.0)


def dense_spring(theta):
    system = SPRING.astype(complex)
    system[1, :2] = -theta[:2]
    process = LinearLFM(system, theta[2] * SPRING_INPUT, [matern(1.0, theta[3], 2)], 0.0, np.zeros(4),
                        np.zeros((4, 4)))
    return Regression(process, np.array([[1.0, 0, 0, 0, 0], [0, 0, 1, 0, 0]]), theta[4] * np.ones(2))


GRADIENTS = {
    "motif": (build_motif, dense_motif, [0.7, 1.1, 1.0, 0.5, 0.3, 0.2, 1.2, 1.3, 0.04, 0.4, 0.2]),
    # A decay that equals the force's rate: repeated roots.
    "motif, repeated roots": (build_motif, dense_motif,
                              [np.sqrt(3) / 1.3, 1.1, 1.0, 0.5, 0.3, 0.2, 1.2, 1.3, 0.04, 0.4, 0.2]),
    # Critical damping, of an oscillator as fast as the force; then none.
    "spring, critical": (build_spring, dense_spring, [1.25, 2 * np.sqrt(1.25), 1.0, 2.0, 0.04]),
}


@pytest.fixture(scope="module")
def derivatives():
    """Value, reverse-mode and forward-mode gradient of each builder, compiled once."""
    y = jnp.asarray(data(2))
    compiled = {}

    def derivative(build):
        if build not in compiled:
            def value(theta):
                return lfm.MarginalLikelihood(build(theta), TIMES, steps=2).log_prob(y)

            compiled[build] = jax.jit(lambda theta: (value(theta), jax.grad(value)(theta), jax.jacfwd(value)(theta)))
        return compiled[build]

    return derivative


@pytest.mark.thorough
@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.slow if name.startswith("spring") else ()) for name in GRADIENTS])
def test_gradient(derivatives, name):
    build, dense, theta = GRADIENTS[name]
    value, reverse, forward = derivatives(build)(jnp.asarray(theta))
    y = data(2)
    close(value, dense(np.asarray(theta)).log_likelihood(TIMES, y))
    expected = complex_step(lambda p: dense(p).log_likelihood(TIMES, y), theta)
    close(reverse, expected)
    close(forward, expected)
