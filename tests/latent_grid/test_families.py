"""Expectation propagation against elliptical slices on a grid: an exact reference for any family."""

import importlib.util
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC

import lfm_ppl as lfm

ROOT = Path(__file__).resolve().parents[2]
COAL = Path(os.environ.get("LFM_DATA", ROOT.parent / "shared" / "data")) / "coal" / "coal.csv"
TIMES = np.linspace(0.0, 8.0, 20)


def force(x, u, t):
    return u


def process(observation):
    return lfm.LatentForceModel(lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(1.1, 1.4)}, observation,
                                lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))


FAMILIES = {
    "Poisson": lambda rng, f: (lfm.PoissonObservation(force), rng.poisson(np.exp(f))),
    "Student-t": lambda rng, f: (lfm.StudentTObservation(force, 4.0, 0.2), f + 0.2 * rng.standard_t(4, f.size) + 4.0 * (
        np.arange(f.size) % 7 == 3)),
    "Bernoulli": lambda rng, f: (lfm.BernoulliObservation(lambda x, u, t: 2.0 * u),
                                 rng.uniform(size=f.size) < 1 / (1 + np.exp(-2 * f))),
    "negative binomial": lambda rng, f: (lfm.NegativeBinomialObservation(force, 2.0),
                                         rng.poisson(np.exp(f) * rng.gamma(2.0, 0.5, f.size))),
}


def problem(name):
    """Model, times and data."""
    if name in FAMILIES:
        rng = np.random.default_rng(1)
        f = np.asarray(lfm.simulate(jax.random.key(1), process(lfm.GaussianObservation(force, jnp.ones(1))),
                                    TIMES).forces["u"])
        observation, y = FAMILIES[name](rng, f)
        return process(observation), TIMES, y.astype(float)[:, None]
    if not COAL.exists():
        pytest.skip(f"needs the dates of the disasters, {COAL}")
    spec = importlib.util.spec_from_file_location("coal", ROOT / "models" / "coal.py")
    coal = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(coal)
    bins = int(name.split()[1])
    times, y = coal.count(np.loadtxt(COAL, skiprows=1), 1851.0, 1963.0, bins)
    return coal.build(0.3, 0.8, 20.0, 112.0 / bins), times, y


def slices(model, times, y, chains=4, draws=1000, thin=100, warmup=5000):
    """Draws (chains, draws, T) of the force, whose grid are the observation times themselves."""

    def numpyro_model(times, y=None):
        numpyro.sample("y", lfm.MarginalLikelihood(model, times), obs=y)

    kernel = lfm.EllipticalSlice(lfm.on_latent_grid(numpyro_model, points=times))
    mcmc = MCMC(kernel, num_warmup=warmup, num_samples=draws * thin, thinning=thin, num_chains=chains,
                chain_method="vectorized", progress_bar=False)
    mcmc.run(jax.random.key(0), times, jnp.asarray(y))
    return np.asarray(mcmc.get_samples(group_by_chain=True)["y_forces"])[:, :, 0]


@pytest.mark.slow
@pytest.mark.parametrize("name", [
    "Bernoulli", "Student-t", "coal 111"])
def test_moments_are_those_of_elliptical_slices(name):
    """Means within 0.05 sd and sds within 3%, each beyond four of its own Monte Carlo errors.

    Beside gross errors the posterior has two modes, and a Gaussian is too wide: sds within 10%.
    """
    largest_of_sds = 0.1 if name == "Student-t" else 0.03
    model, times, y = problem(name)
    mean, sd = map(np.asarray, lfm.MarginalLikelihood(model, times).smooth(y).force(model.force_names[0]))
    samples = slices(model, times, y)
    exact, spread = samples.mean((0, 1)), samples.std((0, 1))
    of_mean = 1.0 / np.sqrt(effective_sample_size(samples))
    of_sd = 1.0 / np.sqrt(2.0 * effective_sample_size((samples - exact) ** 2))
    mean_error, wider = np.abs(mean - exact) / spread, np.abs(sd / spread - 1.0)
    print(f"{name}: means {mean_error.max():.3f} sd at most (rms {np.sqrt((mean_error**2).mean()):.3f}, Monte Carlo "
          f"{of_mean.max():.3f}), sds {wider.max():.3f} (rms {np.sqrt((wider**2).mean()):.3f}, {of_sd.max():.3f})")
    assert of_mean.max() < 0.05 and of_sd.max() < 0.05
    assert np.all(mean_error < 0.05 + 4 * of_mean) and np.all(wider < largest_of_sds + 4 * of_sd)


@pytest.mark.slow
def test_coal_has_the_evidence_of_bayesnewton():
    """The same counts and hyperparameters in BayesNewton 1.3.4, an implementation of its own (111 bins)."""
    model, times, y = problem("coal 111")
    theirs = {"ep": -175.2304464105596, lfm.FactorSettings(power=0.5): -175.2314237700023,
              "variational": -175.2324063924814}
    for factors, expected in theirs.items():
        value = float(jax.jit(lfm.MarginalLikelihood(model, times, factors=factors).log_prob)(jnp.asarray(y, float)))
        print(factors, value)
        assert value == pytest.approx(expected, abs=1e-7)
    gaussian = lfm.MarginalLikelihood(model, times)
    mean, sd = map(np.asarray, gaussian.smooth(y).force(model.force_names[0]))
    np.testing.assert_allclose(mean[[0, 50, 100]], [0.73549481, -0.3167189, -0.81036701], atol=5e-7)
    np.testing.assert_allclose(sd[[0, 50, 100]], [0.24480603, 0.22654376, 0.27578656], atol=5e-7)


@pytest.mark.thorough
def test_a_grid_without_states_is_the_process_itself():
    """Values on the grid have the prior's covariance, and the likelihood is the family's."""
    model, times, y = problem("Poisson")
    latent = lfm.LatentGrid(model, times, points=times)
    distance = np.sqrt(3) * np.abs(times[:, None] - times) / 1.4
    np.testing.assert_allclose(latent.root[0] @ latent.root[0].T, 1.21 * (1 + distance) * np.exp(-distance), atol=1e-8)
    u = jnp.asarray(np.random.default_rng(0).normal(size=(1, len(times))))
    expected = sum(float(model.observation.log_prob(u[:, k], jnp.asarray(y[k]))[0]) for k in range(len(times)))
    assert float(latent.log_likelihood(u, jnp.asarray(y))) == pytest.approx(expected, rel=1e-12)
