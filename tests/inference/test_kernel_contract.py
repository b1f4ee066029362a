"""What every sampler owes as a NumPyro kernel: its law, its chains, new data, pickling, and errors that say a name."""

import functools
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC
from processes import on_two_devices

import lfm_ppl as lfm

TIMES = np.array([0.0, 0.6, 1.5, 1.5, 2.7, 4.0])
Y = np.array([[1.2], [0.7], [np.nan], [0.5], [-0.2], [0.4]])
KERNELS = {"RAM": lfm.RAM, "particle-marginal RAM": functools.partial(lfm.ParticleMarginalRAM, particles=20),
           "delayed acceptance": functools.partial(lfm.ParticleMarginalRAM, particles=20, delayed=True),
           "elliptical slice": lfm.EllipticalSlice}
CHAINS, WARMUP, SAMPLES = 4, 300, 800


def build(level):
    return lfm.LatentForceModel(
        lambda x, u, t: level - x, {}, lfm.GaussianObservation(lambda x, u, t: x, 0.3 * jnp.ones(1)),
        lfm.Gaussian(jnp.array([1.0]), jnp.array([0.2])), process_noise=jnp.array([[0.5]]))


def model(times, y=None):
    """Linear in its parameter, whose posterior is therefore normal."""
    level = numpyro.sample("level", dist.Normal(0.5, 1.0))
    numpyro.deterministic("twice", 2.0 * level)
    numpyro.sample("y", lfm.MarginalLikelihood(build(level), times, steps=4), obs=y)


def chains(kernel, samples=SAMPLES, **options):
    return MCMC(KERNELS[kernel](model), num_warmup=WARMUP, num_samples=samples, num_chains=CHAINS, progress_bar=False,
                **{"chain_method": "vectorized", "jit_model_args": True, **options})


@jax.jit
def log_likelihoods(y):
    """At the levels -1, 0 and 1."""
    return jax.vmap(lambda level: lfm.MarginalLikelihood(build(level), TIMES).log_prob(y))(jnp.array([-1.0, 0.0, 1.0]))


@pytest.fixture(scope="module", params=[
    pytest.param(name, marks=pytest.mark.slow if isinstance(kernel, functools.partial) else ())
    for name, kernel in KERNELS.items()])
def sampled(request):
    """Name of the kernel, its MCMC, and draws (chain, draw)."""
    mcmc = chains(request.param)
    mcmc.run(jax.random.key(0), TIMES, Y, extra_fields=("i",))
    return request.param, mcmc, np.asarray(mcmc.get_samples(group_by_chain=True)["level"])


def assert_posterior(mcmc, y):
    """Within 4.5 Monte Carlo errors of the normal posterior, which three values of the likelihood determine."""
    low, middle, high = log_likelihoods(y).tolist()
    precision = 1.0 + 2.0 * middle - low - high
    mean, sd = (0.5 + 0.5 * (high - low)) / precision, precision**-0.5
    draws = mcmc.get_samples(group_by_chain=True)
    level = np.asarray(draws["level"])
    np.testing.assert_allclose(draws["twice"], 2.0 * level)
    squares = (level - mean) ** 2
    size, size_of_squares = effective_sample_size(level), effective_sample_size(squares)
    assert size > 100
    assert abs(level.mean() - mean) < 4.5 * sd / np.sqrt(size)
    assert abs(squares.mean() / sd**2 - 1) < 4.5 * np.sqrt(2 / size_of_squares)
    return mean


@pytest.mark.thorough
def test_draws_have_the_posterior_of_each_data_set_and_depend_on_the_key(sampled):
    _, mcmc, draws = sampled
    mean = assert_posterior(mcmc, Y)
    mcmc.run(jax.random.key(1), TIMES, Y + 1.0, extra_fields=("i",))
    assert assert_posterior(mcmc, Y + 1.0) > mean + 0.3
    mcmc.run(jax.random.key(0), TIMES, Y, extra_fields=("i",))
    np.testing.assert_array_equal(mcmc.get_samples(group_by_chain=True)["level"], draws)
    np.testing.assert_array_equal(mcmc.get_extra_fields(group_by_chain=True)["i"],
                                  [WARMUP + np.arange(1, SAMPLES + 1)] * CHAINS)


@pytest.mark.thorough
def test_thinned_chains_in_sequence_that_go_on_after_pickling_are_those_of_one_run(sampled):
    name, _, draws = sampled
    mcmc = chains(name, samples=SAMPLES // 2, chain_method="sequential", thinning=5)
    mcmc.run(jax.random.key(0), TIMES, Y)
    first = mcmc.get_samples(group_by_chain=True)["level"]
    if name in ("RAM", "elliptical slice"):  # others hold a bound model, whose programs cannot be pickled
        mcmc = pickle.loads(pickle.dumps(mcmc))
    mcmc.post_warmup_state = mcmc.last_state
    mcmc.run(mcmc.post_warmup_state.rng_key, TIMES, Y)
    second = mcmc.get_samples(group_by_chain=True)["level"]
    np.testing.assert_allclose(np.concatenate([first, second], axis=1), draws[:, 4::5], rtol=1e-8)


def test_the_progress_bar_shows_the_diagnostics(capsys):
    kernel = lfm.RAM(model)
    mcmc = MCMC(kernel, num_warmup=20, num_samples=20)
    mcmc.progress_bar = True
    mcmc.run(jax.random.key(0), TIMES, Y)
    assert kernel.get_diagnostics_str(mcmc.last_state) in capsys.readouterr().err


def without_parameters():
    numpyro.sample("y", dist.Normal(), obs=0.0)


def discrete():
    numpyro.sample("mean", dist.Normal())
    numpyro.sample("class", dist.Bernoulli(0.3))


@pytest.mark.parametrize("kernel", [lfm.RAM, lfm.ParticleMarginalRAM, lfm.EllipticalSlice])
def test_models_that_cannot_be_sampled_are_refused(kernel):
    with pytest.raises(ValueError, match="no latent site"):
        kernel(without_parameters).init(jax.random.key(0), 10, None)
    with pytest.raises(ValueError, match="'class'"):
        kernel(discrete).init(jax.random.key(0), 10, None)


ON_TWO_DEVICES = """
import sys
sys.path += ["tests", "tests/inference", "."]
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import test_kernel_contract as contract

assert jax.local_device_count() == 2
for name in contract.KERNELS:
    draws = []
    for method in ("parallel", "vectorized"):
        mcmc = contract.MCMC(contract.KERNELS[name](contract.model), num_warmup=50, num_samples=50, num_chains=2,
                             chain_method=method, progress_bar=False)
        mcmc.run(jax.random.key(3), contract.TIMES, contract.Y)
        draws.append(mcmc.get_samples(group_by_chain=True)["level"])
    assert np.std(draws[0], axis=1).min() > 0
    np.testing.assert_allclose(*draws, rtol=1e-8, err_msg=name)
print("same")
"""


@pytest.mark.slow
def test_parallel_chains_are_those_side_by_side():
    result = on_two_devices(ON_TWO_DEVICES)
    assert result.stdout.strip() == "same", result.stderr
