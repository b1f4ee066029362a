"""The particle filter: unbiased where the likelihood is known, and right where it is not linear."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from systems import Kicked, Outputs, double_well, first_state, motif, softplus

import lfm_ppl as lfm
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.model.state_space import state_space
from lfm_ppl.particles.normals import normals
from lfm_ppl.particles.particle_filter import ParticleSettings, check_settings, log_likelihood
from lfm_ppl.particles.resampling import RESAMPLING, effective_sample_size, resample

TIMES = np.array([0.0, 0.7, 0.7, 2.0, 3.1])
Y = np.array([[0.3], [0.5], [0.1], [np.nan], [-0.4]])


def relaxing(decay=0.8, noise=0.09, dispersion=0.6):
    """An Ornstein-Uhlenbeck process."""
    return lfm.LatentForceModel(
        lambda x, u, t: 0.2 - decay * x, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([noise])),
        lfm.Gaussian(jnp.array([0.4]), jnp.array([0.5])), process_noise=jnp.array([[dispersion]]), initial_time=-0.5)


def decay(x, u, t):
    return u - 0.8 * x


def driven(noise=0.09, order=1):
    """A decay driven by a force, without noise of its own."""
    return lfm.LatentForceModel(
        decay, {"u": lfm.Matern(1.0, 1.3, order)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([noise])), lfm.Gaussian(jnp.zeros(1), jnp.array([0.3])))


def estimates(model, times, y, runs, steps=1, key=0, **settings):
    """(runs,) log likelihood estimates from one compiled program."""
    ssm = state_space(model)
    grid = build_time_grid(ssm, times, steps)
    checked_settings = check_settings(ssm, ParticleSettings(**settings))
    keys = jax.random.split(jax.random.key(key), runs)
    run = jax.jit(jax.vmap(lambda k: log_likelihood(ssm, grid, y, k, checked_settings)))
    return np.asarray(run(keys))


def assert_unbiased(estimated, exact):
    """The mean of the likelihood ratios is one, within four standard errors; and the test has some power."""
    ratio = np.exp(estimated - exact)
    error = ratio.std(ddof=1) / np.sqrt(len(ratio))
    assert error < 0.05
    assert abs(ratio.mean() - 1.0) < 4.0 * error


@pytest.mark.parametrize("resampling, threshold", [
    ("systematic", 0.5), pytest.param("stratified", 1.0, marks=pytest.mark.slow)])
def test_the_likelihood_is_unbiased(resampling, threshold):
    """Over 1,000 runs against the Kalman filter, which is exact; a start before the data, a replicate, a gap."""
    model = relaxing()
    exact = float(lfm.filter(model, TIMES, Y).log_likelihood.sum())
    estimated = estimates(model, TIMES, Y, 1000, particles=60, resampling=resampling, threshold=threshold)
    assert_unbiased(estimated, exact)


@pytest.mark.thorough
@pytest.mark.parametrize("model, scheme, steps", [
    (driven(), "exact", 1), pytest.param(driven(order=0), "srk", 40, marks=pytest.mark.slow),
], ids=["exact", "rough force"])
def test_the_likelihood_is_unbiased_with_forces_and_steps(model, scheme, steps):
    """The bias of the steps is below 0.1% here: it is of order h^2, and halving h does not show it."""
    exact = float(lfm.filter(model, TIMES, Y).log_likelihood.sum())
    assert_unbiased(estimates(model, TIMES, Y, 1000, steps, particles=100, scheme=scheme), exact)


@pytest.mark.slow
def test_several_outputs_with_missing_entries_and_correlated_noise():
    noise = jnp.array([[0.2, 0.05], [0.05, 0.1]])
    model = lfm.LatentForceModel(
        lambda x, u, t: -0.5 * x, {"u": lfm.Matern(1.0, 1.0, 1)},
        lfm.GaussianObservation(Outputs(jnp.array([[1.0, 0.5], [0.0, 1.0]])), noise),
        lfm.Gaussian(jnp.zeros(1), jnp.array([0.5])), process_noise=jnp.array([[0.4]]))
    y = np.array([[0.1, 0.2], [np.nan, 0.4], [0.5, np.nan], [np.nan, np.nan], [0.3, -0.2]])
    exact = float(lfm.filter(model, TIMES, y).log_likelihood.sum())
    assert_unbiased(estimates(model, TIMES, y, 1000, particles=150), exact)


def test_filtering_moments_agree_with_the_kalman_filter():
    model = driven()
    exact = lfm.filter(model, TIMES, Y)
    result = lfm.particle_filter(jax.random.key(1), model, TIMES, Y, particles=50_000)
    sd = np.sqrt(np.asarray(exact.filtered_covariance)[:, [0, 1, 2], [0, 1, 2]])
    error = sd / np.sqrt(np.asarray(result.ess))[:, None]
    assert np.all(np.abs(result.mean - exact.filtered_mean) < 5.0 * error)
    variance = np.einsum("ki,kj->kij", sd, sd) ** 2 + np.asarray(exact.filtered_covariance) ** 2
    error = np.sqrt(variance / np.asarray(result.ess)[:, None, None])
    assert np.all(np.abs(result.covariance - exact.filtered_covariance) < 5.0 * error)


@pytest.mark.slow
def test_the_double_well_agrees_with_the_grid():
    """Non-linear dynamics, bimodal filtering densities: the Fokker-Planck grid is the reference."""
    from lfm_ppl.fokker_planck_grid.fokker_planck import fokker_planck

    model = double_well(mean=0.0)
    times, y = np.array([0.5, 2.0, 3.0]), np.array([[0.2], [-0.9], [1.1]])
    exact = fokker_planck(model, times, y, cells=300, bounds=(-3.2, 3.2))
    estimated = estimates(model, times, y, 400, 40, particles=300)
    assert_unbiased(estimated, float(exact.log_likelihood.sum()))
    result = lfm.particle_filter(jax.random.key(0), model, times, y, particles=50_000, steps=40)
    error = np.asarray(exact.sd) / np.sqrt(np.asarray(result.ess))
    assert np.all(np.abs(result.mean[:, 0] - exact.mean) < 4.0 * error)


@pytest.mark.slow
def test_a_nonlinear_link_agrees_with_importance_sampling_from_the_prior():
    """Plain simulation of the model, weighted by all observations at once: no resampling, other integration."""
    model = motif(softplus, genes=1, noise_sd=0.3)
    times, y = np.array([0.5, 1.0, 2.0]), np.array([[0.6], [0.8], [0.7]])
    states = jax.jit(jax.vmap(lambda key: lfm.simulate(key, model, times, steps=20).state))(
        jax.random.split(jax.random.key(3), 20_000))
    ratio = stats.norm.logpdf(y, states, 0.3).sum(axis=(1, 2))
    exact = np.log(np.exp(ratio).mean())
    error = np.exp(ratio - exact).std() / np.sqrt(len(ratio))
    ratios = np.exp(estimates(model, times, y, 200, 40, particles=300) - exact)
    assert abs(ratios.mean() - 1.0) < 4.0 * np.hypot(error, ratios.std() / np.sqrt(200))


@pytest.mark.slow
def test_jumps_of_a_force():
    force = Kicked(0.3, (0.6, 1.0), 1.0, 1.3, 1)
    model = eqx.tree_at(lambda m: m.forces["u"], driven(), force)
    exact = float(lfm.filter(model, TIMES, Y).log_likelihood.sum())
    assert_unbiased(estimates(model, TIMES, Y, 1000, 20, particles=100, scheme="srk"), exact)


@pytest.mark.slow
def test_angles_are_compared_on_the_circle():
    def build(angular):
        return lfm.LatentForceModel(
            lambda x, u, t: -0.1 * x, {}, lfm.GaussianObservation(first_state, jnp.array([0.1]), angular),
            lfm.Gaussian(jnp.array([3.0]), jnp.array([0.1])), process_noise=jnp.array([[0.1]]))

    times, key = np.array([0.0, 1.0]), jax.random.key(0)
    y = np.array([[3.1], [2.9]])
    wrapped = lfm.particle_filter(key, build((0,)), times, y - 2 * np.pi, particles=500)
    plain = lfm.particle_filter(key, build(()), times, y, particles=500)
    assert np.allclose(wrapped.log_likelihood, plain.log_likelihood, atol=1e-9)


@pytest.mark.slow
def test_batches_bound_the_memory_and_nothing_else():
    """In batches, the last of which is not full, the estimate is as unbiased."""
    model = relaxing()
    exact = float(lfm.filter(model, TIMES, Y).log_likelihood.sum())
    assert_unbiased(estimates(model, TIMES, Y, 1000, particles=100, batch=30), exact)

    def temporaries(batch):
        ssm = state_space(motif())
        grid, settings = build_time_grid(ssm, TIMES, 2), ParticleSettings(200_000, scheme="srk", batch=batch)
        run = jax.jit(lambda key: log_likelihood(ssm, grid, np.ones((5, 2)), key, settings))
        return run.lower(jax.random.key(0)).compile().memory_analysis().temp_size_in_bytes

    assert temporaries(2_000) < 0.8 * temporaries(None)


def test_failure_is_minus_infinity():
    """No particle is near the observation."""
    far = np.array([[0.1], [1e200]])
    result = lfm.particle_filter(jax.random.key(0), relaxing(), [0.0, 1.0], far, particles=50)
    assert result.log_likelihood[1] == -np.inf and np.isfinite(result.log_likelihood[0])


@pytest.mark.slow
def test_some_exploding_particles_leave_the_others_alone():
    model = double_well(mean=0.0, variance=400.0)
    result = lfm.particle_filter(jax.random.key(0), model, [0.0, 4.0], [[np.nan], [0.9]], particles=4000, steps=20)
    assert np.all(np.isfinite(result.log_likelihood)) and np.all(np.isfinite(result.mean))


@pytest.mark.slow
def test_lost_particles_count_wherever_they_are_lost():
    """A drift that explodes from some starts: rows within an interval do not forgive what one row would not."""
    model = lfm.LatentForceModel(lambda x, u, t: x**2, {}, lfm.GaussianObservation(first_state, jnp.array([1.0])),
                                 lfm.Gaussian(jnp.array([0.0]), jnp.array([0.3])), process_noise=jnp.array([[0.01]]))
    arguments = (jax.random.key(0), model, [0.0, 4.0], [[np.nan], [0.0]])
    one_row = lfm.particle_filter(*arguments, particles=20_000, steps=400, scheme="srk")
    rows = lfm.particle_filter(*arguments, particles=20_000, steps=1, max_step=0.01, scheme="srk")
    lost = 1.0 - np.exp(float(one_row.log_likelihood.sum()) + 0.5 * np.log(2 * np.pi))
    assert lost > 0.3  # the test has something to see
    assert np.isclose(one_row.log_likelihood.sum(), rows.log_likelihood.sum(), atol=0.03)


def test_degeneracy_is_reported():
    """A precise observation after vague ones leaves few effective particles, and the result says where."""
    model = relaxing(noise=1e-4)
    y = np.array([[np.nan], [np.nan], [np.nan], [0.2], [np.nan]])
    result = lfm.particle_filter(jax.random.key(0), model, TIMES, y, particles=1000)
    assert result.ess.argmin() == 3 and result.ess.min() < 50.0
    assert result.resampled.tolist() == [False, False, False, True, False]


def test_parameters_do_not_recompile():
    first = state_space(double_well())
    ssm = [first, jax.tree.map(lambda leaf: 0.9 * leaf if eqx.is_inexact_array(leaf) else leaf, first)]
    grid = build_time_grid(first, TIMES, 5)
    count = []

    @eqx.filter_jit
    def run(ssm, key):
        count.append(1)
        return log_likelihood(ssm, grid, Y, key, ParticleSettings(50, scheme="srk"))

    values = [float(run(model_ssm, jax.random.key(0))) for model_ssm in ssm]
    assert len(count) == 1 and values[0] != values[1]


def test_normal_numbers():
    """Mean zero, variance one, the right distribution to its tails, rows and squares uncorrelated."""
    sample = np.asarray(normals(jax.random.key(5), 5, 50_001))
    assert sample.shape == (5, 50_001)
    assert stats.kstest(sample.ravel(), "norm").pvalue > 1e-3
    for power, moment in ((1, 0.0), (2, 1.0), (3, 0.0), (4, 3.0), (6, 15.0)):
        values = sample.ravel() ** power
        assert abs(values.mean() - moment) < 4.5 * values.std() / np.sqrt(values.size)
    for values in (sample, sample**2):
        assert np.abs(np.corrcoef(values) - np.eye(5)).max() < 4.5 / np.sqrt(50_001)
    assert np.isclose(stats.norm.sf(3.5), (sample > 3.5).mean(), rtol=0.5)
    # The polynomials against the functions that they stand for: the two numbers of a pair lie on a circle.
    bits = np.asarray(jax.random.bits(jax.random.key(5), (5, 25_001), jnp.uint64))
    radius = np.sqrt(-2 * np.log(((bits >> 32) | 1).astype(float) * 2.0**-32))
    turn = 2 * np.pi * ((bits & 0xFFFFFFFF).astype(float) + 0.5) * 2.0**-32
    quarter = np.pi / 4  # angles are counted from the middle of a quadrant
    assert np.allclose(sample[:, :25_001], radius * np.cos(turn - quarter), atol=1e-9)
    assert np.allclose(sample[:, 25_001:], (radius * np.sin(turn - quarter))[:, :-1], atol=1e-9)
    assert normals(jax.random.key(5), 4, 101).shape == (4, 101)


@pytest.mark.parametrize("count", [200_001, pytest.param(20_000_000, marks=pytest.mark.slow)])
def test_normal_numbers_of_single_precision(count):
    """The logarithm of the largest words, one in many million, is rounded below zero."""
    with jax.enable_x64(False):
        assert not np.isnan(np.asarray(normals(jax.random.key(3), 2, count))).any()


@pytest.mark.parametrize("scheme", RESAMPLING)
def test_resampling_is_unbiased(scheme):
    weights = np.array([0.0, 0.37, 0.001, 0.0, 0.129, 0.4, 0.1, 0.0])
    keys = jax.random.split(jax.random.key(0), 5_000)
    ancestors = np.asarray(jax.jit(jax.vmap(lambda k: resample(k, jnp.asarray(3.0 * weights), scheme)))(keys))
    counts = (ancestors[:, :, None] == np.arange(8)).sum(axis=1)
    error = np.maximum(counts.std(axis=0), 1e-9) / np.sqrt(len(keys))
    assert np.all(np.abs(counts.mean(axis=0) - 8 * weights) < 4.5 * error + 1e-12)
    assert counts[:, weights == 0].max() == 0
    if scheme == "systematic":
        assert np.all((counts >= np.floor(8 * weights)) & (counts <= np.ceil(8 * weights)))
    if scheme == "multinomial":
        assert np.allclose(counts.var(axis=0), 8 * weights * (1 - weights), rtol=0.1, atol=1e-3)


def test_effective_sample_size():
    assert effective_sample_size(jnp.full(10, 0.1)) == pytest.approx(10.0)
    assert effective_sample_size(jnp.array([1.0, 0.0])) == pytest.approx(1.0)


def test_errors():
    for change, error, name in (
            ({"particles": 0}, ValueError, "particles"), ({"particles": 10.5}, TypeError, "particles"),
            ({"resampling": "systemic"}, ValueError, "'systematic'"), ({"threshold": 1.5}, ValueError, "threshold"),
            ({"scheme": "runge"}, ValueError, "runge"), ({"batch": 0}, ValueError, "batch"),
            ({"steps": 0}, ValueError, "steps"), ({"y": np.full((5, 1), np.nan)}, ValueError, "y"),
            ({"y": np.zeros((4, 1))}, ValueError, r"\(4, 1\)"), ({"times": TIMES[::-1]}, ValueError, "times"),
            ({"key": 0}, TypeError, "key"), ({"model": relaxing(noise=0.0)}, ValueError, "'y0'")):
        with pytest.raises(error, match=name):
            lfm.particle_filter(**{"key": jax.random.key(0), "model": relaxing(), "times": TIMES, "y": Y, **change})
