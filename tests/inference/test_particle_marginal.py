"""Particle-marginal RAM: exact whatever the noise of the estimate, and whatever the surrogate."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import MCMC

import lfm_ppl as lfm
from lfm_ppl.inference import particle_potential
from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalState, particle_marginal
from lfm_ppl.inference.kernels.robust_metropolis import Adaptation, initial_state
from lfm_ppl.inference.particle_potential import ParticlePotential
from lfm_ppl.inference.trajectories import trajectories
from lfm_ppl.particles.particle_filter import ParticleSettings
from lfm_ppl.results.arviz_data import summary
from lfm_ppl.results.result_view import ResultView

TIMES = np.array([0.0, 0.6, 1.5, 1.5, 2.7, 4.0])
Y = np.array([[1.2], [0.7], [np.nan], [0.5], [-0.2], [0.4]])


def build(rate, noise=0.1):
    return lfm.LatentForceModel(
        lambda x, u, t: -rate * x, {}, lfm.GaussianObservation(lambda x, u, t: x, noise * jnp.ones(1)),
        lfm.Gaussian(jnp.array([1.0]), jnp.array([0.2])), process_noise=jnp.array([[0.5]]))


def relaxing(times, y=None):
    """Linear, so that the Kalman filter is exact."""
    rate = numpyro.sample("rate", dist.LogNormal(-0.5, 0.7))
    numpyro.sample("y", lfm.MarginalLikelihood(build(rate), times), obs=y)


def exact_posterior(y=Y):
    """Mean and standard deviation of log rate, by quadrature over the Kalman filter's likelihood."""
    grid = np.linspace(-4.0, 3.0, 400)
    density = jax.jit(jax.vmap(lambda v: lfm.MarginalLikelihood(build(jnp.exp(v)), TIMES).log_prob(y)))
    log_weights = np.asarray(density(jnp.asarray(grid))) - 0.5 * ((grid + 0.5) / 0.7) ** 2
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    mean = (weights * grid).sum()
    return mean, np.sqrt((weights * (grid - mean) ** 2).sum())


def effective(draws):
    """Effective sample size of draws (chains, n)."""
    import arviz

    return float(arviz.ess(np.asarray(draws)))


def assert_posterior(log_rate, mean, sd):
    """Mean and spread within four Monte Carlo standard errors, which must be small for the test to have power."""
    error = sd / np.sqrt(effective(log_rate))
    assert error < 0.1 * sd
    assert abs(log_rate.mean() - mean) < 4.0 * error
    spread_error = 1.5 * sd / np.sqrt(2.0 * effective((log_rate - mean) ** 2))
    assert abs(log_rate.std() - sd) < 4.0 * spread_error


@pytest.mark.slow
def test_the_estimate_is_carried_along_and_delayed_acceptance_spares_estimates():
    """Twenty particles give a noisy likelihood; the posterior is the Kalman filter's all the same."""
    kernel = lfm.ParticleMarginalRAM(relaxing, particles=20, delayed=True)
    mcmc = MCMC(kernel, num_warmup=500, num_samples=4000, num_chains=8, chain_method="vectorized", progress_bar=False)
    mcmc.run(jax.random.key(0), TIMES, Y, extra_fields=("potential_energy", "accepted", "estimated"))
    assert_posterior(np.log(mcmc.get_samples(group_by_chain=True)["rate"]), *exact_posterior())
    extra = mcmc.get_extra_fields(group_by_chain=True)
    # The estimate changes exactly where a proposal is accepted.
    changed = np.diff(extra["potential_energy"], axis=1) != 0
    assert np.array_equal(changed, np.asarray(extra["accepted"])[:, 1:])
    assert 0.2 < np.asarray(extra["estimated"]).mean() < 0.8


@pytest.mark.parametrize("surrogate", [None, lambda z: 0.5 * ((z - 0.8) / 1.5) ** 2], ids=["plain", "delayed"])
def test_noise_and_a_wrong_surrogate_leave_the_target_alone(surrogate):
    """Standard normal target, log-normal noise of sd 1.2 without bias on the density's scale."""
    sd = 1.2

    def estimate(z, key):
        return 0.5 * z**2 - sd * jax.random.normal(key) + 0.5 * sd**2

    def chain(key):
        zero = jnp.zeros(())
        start = ParticleMarginalState(initial_state(zero, zero, key, 2.4 * jnp.eye(1), 0),
                                      zero if surrogate is None else surrogate(zero), jnp.array(False), key)
        surrogate_at = None if surrogate is None else lambda data: surrogate
        algorithm = particle_marginal(lambda data: estimate, surrogate_at, Adaptation(None, 2 / 3, False), 0)
        return jax.lax.scan(lambda s, _: ((new := algorithm.step(s, None)), new.z), start, length=20_000)[1]

    draws = np.asarray(jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(1), 16)))[:, 500:]
    for power, moment in ((1, 0.0), (2, 1.0), (4, 3.0)):
        values = draws**power
        assert abs(values.mean() - moment) < 4.5 * values.std() / np.sqrt(effective(values))


@pytest.mark.thorough
def test_the_number_of_particles_is_chosen_for_an_sd_of_one():
    y = np.tile(Y, (4, 1))
    times = np.arange(24.0) / 4
    potential = ParticlePotential(bind(relaxing, times, y), ParticleSettings(1))
    z = jnp.array([-0.5])
    tuned = potential.tune(z, jax.random.key(1))
    run = jax.jit(jax.vmap(lambda key: potential(z, key, tuned.particles)))
    sd = float(run(jax.random.split(jax.random.key(2), 1000)).std())
    assert 0.6 < sd < 1.5 and abs(tuned.sd - sd) < 0.4


def test_precise_observations_that_no_particle_meets_are_an_error(monkeypatch):
    monkeypatch.setattr(particle_potential, "_MOST", 200)

    def impossible(times, y=None):
        rate = numpyro.sample("rate", dist.LogNormal(-0.5, 0.7))
        numpyro.sample("y", lfm.MarginalLikelihood(build(rate, noise=1e-20), times), obs=y)

    potential = ParticlePotential(bind(impossible, TIMES, Y), ParticleSettings(1))
    with pytest.raises(ValueError, match="particle"):
        potential.tune(jnp.array([-0.5]), jax.random.key(1))


@pytest.mark.thorough
def test_a_panel():
    """Two series share a rate: the estimate is the product of theirs, with independent particles."""

    def panel(times, y=None):
        rate = numpyro.sample("rate", dist.LogNormal(-0.5, 0.7))
        with numpyro.plate("series", 2):
            numpyro.sample("y", lfm.panel(build, rate * jnp.ones(2), times), obs=y)

    y = np.stack([Y, np.full_like(Y, np.nan)])
    settings = ParticleSettings(500)
    z = jnp.array([-0.3])
    panel_potential = ParticlePotential(bind(panel, TIMES, y), settings)
    single_potential = ParticlePotential(bind(relaxing, TIMES, Y), settings)

    def run(potential):
        return jax.jit(jax.vmap(lambda key: potential(z, key)))(
            jax.random.split(jax.random.key(3), 200))

    # A series that is all missing adds nothing.
    mine, single = np.asarray(run(panel_potential)), np.asarray(run(single_potential))
    assert abs(mine.mean() - single.mean()) < 5.0 * np.hypot(mine.std(), single.std()) / np.sqrt(200)


@pytest.mark.slow
def test_fit_samples_and_reports_the_particles():
    result = lfm.fit(relaxing, TIMES, Y, sampler="pmmh", chains=2, warmup=100, samples=200, thin=5, progress=False,
                     trajectory_draws=20, chain_method="vectorized")
    log_rate = np.log(ResultView.of(result).posterior["rate"].values)
    mean, sd = exact_posterior()
    assert abs(log_rate.mean() - mean) < 5.0 * sd / np.sqrt(summary(result)["ess_bulk"].iloc[0])
    assert result.attrs["sampler"] == "pmmh" and result.attrs["particles"] >= 50
    assert 0.0 < result.attrs["log_likelihood_sd"] < 1.6
    assert set(ResultView.of(result).group("sample_stats")) == {"acceptance_rate", "accepted", "lp", "estimated"}


@pytest.mark.slow
def test_trajectories_agree_with_the_exact_smoother_wherever_they_are_wanted():
    """Paths at single parameter values; a crowd of forecast times changes nothing elsewhere."""
    requested_times = np.array([0.3, 1.0, 3.5])
    draws = {"rate": np.full(600, 0.6)}
    exact = lfm.smooth(build(0.6), TIMES, Y, at=requested_times)
    for times in (requested_times, np.concatenate([requested_times, np.linspace(4.0, 8.0, 9)])):
        result = trajectories(jax.random.key(1), bind(relaxing, TIMES, Y), draws, times,
                             ParticleSettings(200, scheme="srk"), 10)["state"][:, :3, 0]
        sd = np.sqrt(np.asarray(exact.covariance)[:, 0, 0])
        assert np.all(np.abs(result.mean(axis=0) - exact.mean[:, 0]) < 5.0 * sd / np.sqrt(600) + 0.02 * sd)
        assert np.allclose(result.std(axis=0), sd, rtol=0.15)


@pytest.mark.thorough
@pytest.mark.parametrize("wrap", [lambda d: d.mask(jnp.array(True)), lambda d: d.expand((1,)).to_event(1)],
                         ids=["mask", "expand"])
def test_a_likelihood_that_cannot_be_replaced_is_an_error(wrap):
    def wrapped(times, y=None):
        rate = numpyro.sample("rate", dist.LogNormal(-0.5, 0.7))
        numpyro.sample("y", wrap(lfm.MarginalLikelihood(build(rate), times)), obs=y)

    y = Y if wrap(dist.Normal(0.0, 1.0)).event_shape == () else Y[None]
    with pytest.raises(ValueError, match="lfm.MarginalLikelihood"):
        lfm.ParticleMarginalRAM(wrapped, particles=5).init(jax.random.key(0), 10, None, (TIMES, y), {})


def plain(times, y=None):
    numpyro.sample("y", dist.Normal(numpyro.sample("level", dist.Normal()), 1.0), obs=y)


def observed_exactly(times, y=None):
    rate = numpyro.sample("rate", dist.LogNormal(-0.5, 0.7))
    numpyro.sample("y", lfm.MarginalLikelihood(build(rate, noise=0.0), times), obs=y)


@pytest.mark.parametrize(("model", "options", "error", "name"), [
    (relaxing, {"delayed": "no"}, TypeError, "delayed"), (relaxing, {"particles": 0}, ValueError, "particles"),
    (relaxing, {"particle_steps": 0}, ValueError, "particle_steps"),
    (relaxing, {"scheme": "milstien"}, ValueError, "'milstien'"), (plain, {}, ValueError, "site"),
    (observed_exactly, {}, ValueError, "'y0'"),
])
def test_wrong_options_and_models_are_named(model, options, error, name):
    with pytest.raises(error, match=name):
        kernel = lfm.ParticleMarginalRAM(model, **{"particles": 5, **options})
        kernel.init(jax.random.key(0), 10, None, (TIMES, Y if model is not plain else np.zeros(6)), {})
