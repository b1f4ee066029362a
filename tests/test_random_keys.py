"""No random key is used twice: the keys that reach the samplers of JAX in whole computations, and what they give."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.forces import SQM
from lfm_ppl.inference.trajectories import trajectories
from tests.random_key_recorder import recorded_keys

TIMES = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
Y = np.array([[1.0], [0.0], [2.0], [1.0], [3.0]])


def with_jumps(observation=None):
    """A force that jumps at 1 and 2, and process noise."""
    observation = observation or lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1]))
    return lfm.LatentForceModel(lambda x, u, t: -0.5 * x + 0.0 * u, {"u": SQM(1.0, (1.0, 2.0))}, observation,
                                lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1), initial_time=0.0)


def counts(times, y=None):
    """Counts of a non-linear state, whose forecasts are simulated."""
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.sin(x) - 2.0 * x + u, {"u": lfm.Matern(1.0, 1.0)},
        lfm.PoissonObservation(lambda x, u, t: x + level), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)),
        process_noise=jnp.eye(1), deterministics={"rate": lambda x, u, t: jnp.exp(x[0])})
    numpyro.sample("y", lfm.MarginalLikelihood(model, times, steps=1), obs=y)


def decays(times, y=None):
    """Two regimes, whose scores draw a path."""
    rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.3))
    models = {name: lfm.LatentForceModel(
        lambda x, u, t, factor=factor: -factor * rate * x, {},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.ones(1), jnp.eye(1)),
        process_noise=jnp.eye(1)) for name, factor in (("slow", 0.3), ("fast", 1.0))}
    numpyro.sample("y", lfm.Switching(models, [[0.0, 0.3], [0.5, 0.0]], times), obs=y)


def fit_and_forecast(model, **options):
    chain = {} if options.get("sampler") == "map" else {"chains": 1, "warmup": 2}
    result = lfm.fit(model, TIMES, Y, samples=3, trajectory_draws=2, progress=False, **chain, **options)
    if model is counts:
        # A fit and a forecast with one seed split it alike, and use different keys of it.
        lfm.forecast(result, model, [2.5, 3.0], draws=2, progress=False, seed=options["seed"] + 1)


def particles(function, **options):
    return function(jax.random.key(3), with_jumps(lfm.PoissonObservation(lambda x, u, t: x)), TIMES, Y, particles=8,
                    **options)


COMPUTATIONS = {
    "simulation": lambda: lfm.simulate(jax.random.key(3), with_jumps(), TIMES, steps=2),
    "draws of the smoother": lambda: lfm.smooth(with_jumps(), TIMES, Y).sample(jax.random.key(3), 2),
    "particle filter": lambda: particles(lfm.particle_filter),
}
SLOW_COMPUTATIONS = {
    "particle smoother": lambda: particles(lfm.particle_smoother, draws=2),
    "fit": lambda: fit_and_forecast(counts, seed=3),
    "particle-marginal": lambda: fit_and_forecast(counts, seed=3, sampler="pmmh", sampler_options={"particles": 8}),
    "regimes": lambda: fit_and_forecast(decays, seed=3, sampler="map"),
}


def check_keys(monkeypatch, compute):
    with recorded_keys(monkeypatch) as record:
        compute()
        assert record.reused() == {}
    assert len(record.consumers) > 2


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", COMPUTATIONS)
def test_no_key_is_used_twice(name, monkeypatch):
    check_keys(monkeypatch, COMPUTATIONS[name])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", SLOW_COMPUTATIONS)
def test_no_key_is_used_twice_in_long_computations(name, monkeypatch):
    check_keys(monkeypatch, SLOW_COMPUTATIONS[name])


def in_every_step(key):
    """The same key in every step of a loop."""
    return jax.lax.scan(lambda x, _: (x + jax.random.normal(key), None), 0.0, length=2)


REUSES = {
    "sampled twice": lambda key: (jax.random.normal(key), jax.random.uniform(key)),
    "split and sampled": lambda key: (jax.random.split(key), jax.random.normal(key)),
    "split twice": lambda key: (jax.random.split(key), jax.random.split(key, 3)),
    "an integer beside a split": lambda key: (jax.random.normal(jax.random.split(key)[1]),
                                              jax.random.normal(jax.random.fold_in(key, 1))),
    "in every step": in_every_step,
}


@pytest.mark.parametrize("name", REUSES)
def test_the_record_shows_what_is_used_twice(name, monkeypatch):
    with recorded_keys(monkeypatch) as record:
        jax.block_until_ready(jax.jit(REUSES[name])(jax.random.key(3)))
        assert record.reused()


@pytest.mark.thorough
@pytest.mark.parametrize("steps", [1, 3])
def test_a_jump_of_a_force_does_not_depend_on_the_process_noise(steps):
    """The first jump, at 1, and the second, at 2, against the increments of the state before them."""
    times = np.array([0.9, 1.0, 1.9, 2.0])
    keys = jax.random.split(jax.random.key(3), 4_000)
    paths = jax.jit(jax.vmap(lambda key: lfm.simulate(key, with_jumps(), times, steps=steps)))(keys)
    x, u = np.asarray(paths.state[..., 0]), np.asarray(paths.forces["u"])
    for row in (0, 2):
        increment, jump = x[:, row + 1] - np.exp(-0.05) * x[:, row], u[:, row + 1] - u[:, row]
        assert abs(np.corrcoef(increment, jump)[0, 1]) < 5 / np.sqrt(len(keys))


@pytest.mark.thorough
def test_predictions_of_counts_are_independent():
    def model(times, y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        constant = lfm.LatentForceModel(
            lambda x, u, t: -x, {}, lfm.PoissonObservation(lambda x, u, t: level + 0.0 * x),
            lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))
        numpyro.sample("y", lfm.MarginalLikelihood(constant, times), obs=y)

    draws = trajectories(jax.random.key(3), lfm.bind(model, TIMES, Y), {"level": np.full(4_000, 1.0)}, TIMES + 0.2)
    draws_of_y = draws["prediction"][..., 0]
    correlation = np.corrcoef(draws_of_y.T) - np.eye(len(TIMES))
    assert np.abs(correlation).max() < 5 / np.sqrt(len(draws_of_y))
