"""Times, known inputs, events and keyword arrays as arguments of programs: equal numbers, nothing compiled again."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer.util import potential_energy

import lfm_ppl as lfm
from tests.compiled_programs import compilations

TIMES = np.array([0.0, 1.0, 2.0, 4.0, 5.0, 8.0])
Y = np.array([[0.1], [0.9], [0.7], [np.nan], [1.2], [0.4]])
Z = np.array([0.1, -0.2])


def system(dynamics, covariance, **settings):
    return lfm.LatentForceModel(dynamics, {"u": lfm.Matern(0.3, 1.0)}, lfm.GaussianObservation(
        lambda x, u, t: x, covariance), lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), initial_time=0.0, **settings)


def parameters():
    return (numpyro.sample("lag", dist.Uniform(0.1, 0.9)), numpyro.sample("rate", dist.LogNormal(-1.0, 0.5)))


def infusion(times, y=None, inputs=None, R=None, units=None):
    """Non-linear, with a known input, and errors that are known row by row."""
    lag, rate = parameters()
    built = system(lambda x, u, t: inputs["rate"](t) - rate * x / (lag + x**2) + u, R)
    numpyro.sample("y", lfm.MarginalLikelihood(built, times, steps=2, iterations=0), obs=y)


def lagged(times, y=None, inputs=None, R=None, units=None):
    lag, rate = parameters()
    built = system(lambda x, u, t: inputs["rate"](t - lag) - rate * x + u, R)
    numpyro.sample("y", lfm.MarginalLikelihood(built, times, steps=2), obs=y)


def doses(times, y=None, inputs=None, R=None, units=None):
    lag, rate = parameters()
    dose_times, amounts = inputs["rate"].times, inputs["rate"].values
    events = [lfm.Dose(dose_times, amounts, "x0"), lfm.Dose(dose_times, rate, "x0", lag=lag)]
    numpyro.sample("y", lfm.MarginalLikelihood(system(
        lambda x, u, t: u - rate * x, R, events=events, units=units), times), obs=y)


def patient(shift, amount, variance):
    """Times that are not regular, a table of three amounts, and a variance for each row."""
    table = lfm.Input(np.array([0.0, 2.5 + shift, 6.0]), np.array([amount, 0.3, 0.0]), outside="hold")
    return TIMES + shift * (TIMES == 4.0), {
        "inputs": {"rate": table}, "R": np.full((6, 1, 1), variance), "units": {"u": "1/h", "time": "h"}}


@pytest.mark.thorough
@pytest.mark.parametrize("model", [
    pytest.param(infusion, marks=pytest.mark.thorough), lagged, pytest.param(doses, marks=pytest.mark.thorough)])
def test_other_times_inputs_and_errors_compile_nothing_and_give_their_own_density(model):
    def evaluate(patient, y):
        times, keywords = patient
        return lfm.bind(model, times, y, model_kwargs=keywords).log_density_gradient(Z)

    evaluate(patient(0.0, 1.0, 0.1), Y)
    times, keywords = patient(0.2, 1.4, 0.2)
    with compilations() as compiled:
        value, gradient = evaluate((times, keywords), 1.1 * Y)
    assert compiled == []
    # NumPyro's own density of the model, whose times and inputs are constants of its program.
    expected, slope = jax.jit(jax.value_and_grad(lambda z: -potential_energy(
        model, (times, 1.1 * Y), keywords, {"lag": z[0], "rate": z[1]})))(Z)
    assert float(value) == pytest.approx(float(expected), rel=1e-12)
    np.testing.assert_allclose(gradient, slope, rtol=1e-9)


def branching(times, y=None, gain=None):
    """A model that needs the value of an argument, of which another is an entry of its structure."""
    lag, rate = parameters()
    sign = 1.0 if float(times[-1]) < 8.5 else -1.0
    numpyro.sample("y", lfm.MarginalLikelihood(
        system(lambda x, u, t: sign * u - rate * x + gain @ x**2, jnp.array([0.1 + lag])), times), obs=y)


def structured(times, y=None, gain=None):
    """Linear where the gain is zero."""
    lag, rate = parameters()
    numpyro.sample("y", lfm.MarginalLikelihood(
        system(lambda x, u, t: u - rate * x + gain @ x**2, jnp.array([0.1 + lag])), times, steps=2), obs=y)


def filtered(times, y=None, gain=None):
    """A model with a filter beside its likelihood, whose steps depend on the gaps between times."""
    lag, rate = parameters()
    built = system(lambda x, u, t: u - rate * x + gain @ x**2, jnp.array([0.1 + lag]))
    numpyro.factor("filtered", lfm.filter(built, times, Y, steps=2).log_likelihood.sum())
    numpyro.sample("y", lfm.MarginalLikelihood(built, times, steps=2, iterations=0), obs=y)


@pytest.mark.thorough
@pytest.mark.parametrize("model", [
    filtered, pytest.param(structured, marks=pytest.mark.slow)])
def test_a_model_that_needs_values_is_compiled_for_them(model):
    cases = [(TIMES, 0.1), (1.1 * TIMES + 20.0 * (TIMES == 8.0), 0.1), (TIMES, 0.0)]
    for times, gain in cases[:2] if model is filtered else cases:
        keywords = {"gain": np.full((1, 1), gain)}
        expected = -jax.jit(lambda z: potential_energy(model, (times, Y), keywords, z))(  # noqa: B023
            {"lag": Z[0], "rate": Z[1]})
        result = lfm.bind(model, times, Y, model_kwargs=keywords).log_density(Z)
        assert float(result) == pytest.approx(float(expected), rel=1e-12)


@pytest.mark.thorough
def test_a_second_subject_of_fit_many_compiles_nothing():
    def model(times, y=None, inputs=None):
        rate = numpyro.sample("rate", dist.LogNormal(-1.0, 0.5))
        built = lfm.LatentForceModel(lambda x, u, t: inputs["rate"](t) - rate * x, {}, lfm.GaussianObservation(
            lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), initial_time=0.0)
        numpyro.sample("y", lfm.MarginalLikelihood(built, times), obs=y)

    def subject(shift, amount):
        table = (np.array([0.0, 2.5 + shift, 6.0]), np.array([amount, 0.3, 0.0]))
        return lfm.Data(times=TIMES + shift * (TIMES == 4.0), y=Y, outputs=("x",), inputs={"rate": table})

    def fit(subjects):
        fits = lfm.fit_many(model, subjects, sampler="map", samples=20, trajectory_draws=10, progress=False).run()
        assert not fits.failed
        return fits.summary["mean"]

    fit({"first": subject(0.0, 1.0)})
    with compilations() as compiled:
        together = fit({"second": subject(0.2, 1.4), "third": subject(0.3, 0.8)})
    assert compiled == []
    assert together["second", "rate"] != together["third", "rate"]
