"""Heat in a rod: many draws of the prior, names of columns, and coverage of the truth over data sets."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from numpyro.infer import Predictive

import lfm_ppl as lfm
from lfm_ppl.io import loading

FILE = loading.load("heat")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::lfm_ppl.ApproximationWarning")
def test_no_draw_of_the_prior_fails():
    data = FILE.simulate()
    times, keywords = data.times[:8], FILE.keywords(data, {})
    draws = Predictive(FILE.model, num_samples=10_000, parallel=True)(jax.random.key(0), times, **keywords)
    assert draws["y"].shape == (10_000, 8, 8) and np.isfinite(draws["y"]).all()


def test_columns_are_named_by_places():
    assert FILE.definitions["positions"](("r=0.25", "0.5")).tolist() == [0.25, 0.5]
    with pytest.raises(ValueError, match="r=0.25"):
        FILE.definitions["positions"](("inside",))
    with pytest.raises(ValueError, match="domain"):
        numpyro.handlers.seed(FILE.model, 0)(np.arange(3.0), np.zeros((3, 1)), outputs=("r=1.5",))


@pytest.mark.slow
def test_the_truth_has_uniform_ranks():
    """Diffusivity, scale of the source and the source itself, over 100 data sets from the prior.

    Three parameters are known. The posterior of the others is computed by importance sampling: draws of the
    prior are weighted by the likelihood.
    """
    outputs, times = ("r=0.1", "r=0.4", "r=0.8"), np.linspace(0.0, 12.0, 13)
    build, truth = FILE.definitions["build"], FILE.definitions["TRUTH"]

    def rod(diffusivity, scale):
        return build(**{**truth, "diffusivity": diffusivity, "scale": scale}, outputs=outputs, modes=4)

    def prior(key):
        z = jax.random.normal(key, (2,))
        return jnp.exp(jnp.array([-4.6, 0.0]) + 0.7 * z)

    @jax.jit
    def rank(key):
        """Ranks of the two parameters and of the source at a place and a time, within their posteriors."""
        keys = jax.random.split(key, 4)
        true = prior(keys[0])
        simulation = lfm.simulate(keys[1], rod(*true), times)
        candidates = jax.vmap(prior)(jax.random.split(keys[2], 400))

        def posterior(parameters):
            model = rod(*parameters)
            smoothed = lfm.smooth(model, times, simulation.y)
            weights = FILE.definitions["source"]({**truth, "scale": parameters[1]}, modes=4).weights(np.array([0.6]))[0]
            mean = weights @ smoothed.input_mean[6, 4:]
            sd = jnp.sqrt((weights @ smoothed.input_covariance[6, 4:, 4:] @ weights.T)[0, 0])
            return smoothed.log_likelihood.sum(), mean[0], sd

        log_likelihood, mean, sd = jax.lax.map(posterior, candidates, batch_size=50)
        weight = jax.nn.softmax(log_likelihood)
        forces = jnp.stack([simulation.forces[f"source {index}"][6] for index in range(4)])
        true_field = FILE.definitions["source"]({**truth, "scale": true[1]}, modes=4)
        source = true_field.weights(np.array([0.6]))[0][0] @ forces
        below = jnp.stack([*(candidates < true).T, jax.scipy.stats.norm.cdf((source - mean) / sd)])
        return below @ weight, 1.0 / (weight**2).sum()

    results = [rank(key) for key in jax.random.split(jax.random.key(0), 100)]
    ranks, sizes = np.array([ranks for ranks, _ in results]), np.array([size for _, size in results])
    assert np.median(sizes) > 20
    covered = (np.abs(ranks - 0.5) < 0.45).sum(axis=0)  # 90% intervals; binomial, 3 standard deviations
    assert (np.abs(covered - 90) <= 9).all(), covered
    assert (np.abs(ranks.mean(axis=0) - 0.5) < 3 * np.sqrt(1 / 1200)).all(), ranks.mean(axis=0)
