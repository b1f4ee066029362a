"""Forces as latent sites: the posterior that the marginal likelihood has, in many dimensions."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from numpyro.infer import MCMC, Predictive

import lfm_ppl as lfm

TIMES = np.linspace(0.0, 5.0, 6)
Y = np.array([[0.1], [0.6], [np.nan], [1.3], [0.7], [0.2]])


def linear(times, y=None, variance=0.1):
    """A linear model, whose marginal likelihood is exact."""
    decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.5))
    system = lfm.LatentForceModel(
        lambda x, u, t: u - decay * x, {"u": lfm.Matern(1.0, 2.0, order=1)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.04])),
        lfm.Gaussian(jnp.zeros(1), variance * jnp.eye(1)))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


@pytest.mark.slow
def test_a_known_start_is_known_in_compiled_code_too():
    """Numbers that the model makes are tracers there, so that no site may depend on their values."""
    latent = lfm.on_latent_grid(linear, points=11)
    mcmc = MCMC(lfm.RAM(latent), num_warmup=5, num_samples=5, num_chains=2, chain_method="vectorized",
                progress_bar=False)
    mcmc.run(jax.random.key(0), TIMES, Y, variance=0.0)
    assert np.isfinite(mcmc.get_samples()["y_forces"]).all()


@pytest.mark.thorough
def test_predictions_follow_the_forces():
    """Given forces and start the observations scatter about their state with the noise, and nothing else."""
    latent_values = {"decay": jnp.array(0.8), "y_white": 0.3 * jnp.ones((1, 41)), "y_start": jnp.array([0.5])}
    latent = handlers.condition(lfm.on_latent_grid(linear, points=41), latent_values)
    predictions = np.asarray(Predictive(latent, num_samples=4000)(jax.random.key(0), TIMES)["y"])
    site = handlers.trace(handlers.seed(latent, 0)).get_trace(TIMES)["y"]["fn"]
    state = np.asarray(site.latent.state(site.u, site.start))
    assert np.all(np.abs(predictions.mean(axis=0) - state) < 4.5 * 0.2 / np.sqrt(4000))
    assert np.all(np.abs(predictions.std(axis=0) / 0.2 - 1) < 4.5 / np.sqrt(8000))
    assert site.sample(jax.random.key(1), (2, 3)).shape == (2, 3, 6, 1)


@pytest.mark.slow
def test_elliptical_slice_sampling_where_the_parameters_are_fixed():
    """Against the exact smoother, force by force."""
    fixed = handlers.substitute(linear, {"decay": 0.8})
    latent = lfm.on_latent_grid(handlers.block(fixed, hide=["decay"]), points=61)
    mcmc = MCMC(lfm.EllipticalSlice(latent), num_warmup=500, num_samples=4000, num_chains=4,
                chain_method="vectorized", progress_bar=False)
    mcmc.run(jax.random.key(1), TIMES, Y)
    forces = np.asarray(mcmc.get_samples(group_by_chain=True)["y_forces"])[:, :, 0, ::12]
    result = numpyro.diagnostics.summary({"u": forces})["u"]
    model = handlers.trace(handlers.seed(fixed, 0)).get_trace(TIMES, Y)["y"]["fn"].model
    exact = lfm.smooth(model, TIMES, Y, at=np.linspace(0.0, 5.0, 6))
    assert result["n_eff"].min() > 100
    mean, sd = (np.asarray(part)[:6] for part in (exact.force("u").mean, exact.force("u").sd))
    assert np.all(np.abs(result["mean"] - mean) < 4.5 * sd / np.sqrt(result["n_eff"]) + 5e-3)
    assert np.all(np.abs(result["std"] / sd - 1) < 4.5 / np.sqrt(2 * result["n_eff"]) + 0.02)


def test_wrong_arguments_are_named():
    def without(times, y=None):
        numpyro.sample("y", dist.Normal(0.0, 1.0), obs=y)

    for compute, name in ((lambda: handlers.seed(lfm.on_latent_grid(without), 0)(TIMES, 0.3), "site"),
                          (lambda: lfm.on_latent_grid(linear, quadrature="exact"), "quadrature"),
                          (lambda: handlers.seed(lfm.on_latent_grid(linear, points=11), 0)(TIMES, Y[1:]), r"\(6, 1\)"),
                          (lambda: jax.jit(lambda t: handlers.seed(lfm.on_latent_grid(linear), 0)(t, Y))(TIMES),
                           "traced")):
        with pytest.raises(ValueError, match=name):
            compute()
