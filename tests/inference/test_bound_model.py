"""The bound model: NumPyro's own densities and transforms, data as an argument, one compilation for all data sets."""

import contextlib
import logging
import os
import subprocess
import sys
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import systems
from numpyro.infer import NUTS
from numpyro.infer.util import ParamInfo, potential_energy

import lfm_ppl as lfm
from lfm_ppl.inference import sampling, traced_model
from lfm_ppl.inference.bind import bind_arguments
from lfm_ppl.inference.bound_samplers import nuts_sampler, ram_sampler
from lfm_ppl.inference.laplace_start import Laplace
from lfm_ppl.inference.model_digest import model_digest
from lfm_ppl.inference.schedule import Schedule
from lfm_ppl.results.arviz_data import group

TIMES = np.array([0.0, 0.7, 1.1, 2.0, 3.0])
Y = np.array([[0.4, 0.3], [0.8, np.nan], [0.9, 0.5], [1.0, 0.4], [0.7, 0.2]])
OTHER = np.array([[0.1, 0.5], [0.3, 0.2], [np.nan, np.nan], [0.6, 0.1], [0.9, 0.4]])


def model(times, y=None, order=1):
    """Non-linear, with a scalar and a vector site, a bounded one and a deterministic one."""
    decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(-2.0, 0.3).expand([2]).to_event(1))
    lengthscale = numpyro.sample("lengthscale", dist.Uniform(0.5, 3.0))
    numpyro.deterministic("half_life", jnp.log(2.0) / decay)
    system = systems.motif(decay=decay, lengthscale=lengthscale, noise_sd=noise_sd, order=order)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=2), obs=y)


def small(times, y=None):
    """Linear, with one parameter: little to compile."""
    decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(systems.motif(systems.identity, decay=decay), times, steps=2), obs=y)


@pytest.fixture(scope="module")
def bound():
    return lfm.bind(model, TIMES, Y)


VALUES = {"decay": 0.8, "noise_sd": np.array([0.1, 0.2]), "lengthscale": 1.3}


@contextlib.contextmanager
def compilations():
    """Collect the names of the functions that XLA compiles."""
    seen = []

    class Handler(logging.Handler):
        def emit(self, record):
            # "stage" brings an array to the device.
            if record.getMessage().startswith("Compiling") and "jit(stage)" not in record.getMessage():
                seen.append(record.getMessage()[:120])

    logger, handler = logging.getLogger("jax"), Handler()
    propagate, before = logger.propagate, jax.config.jax_log_compiles
    logger.addHandler(handler)
    logger.propagate = False
    jax.config.update("jax_log_compiles", True)
    try:
        yield seen
    finally:
        jax.config.update("jax_log_compiles", before)
        logger.removeHandler(handler)
        logger.propagate = propagate


def test_coordinates_are_named_and_values_come_back(bound):
    assert bound.names == ("decay", "lengthscale", "noise_sd[0]", "noise_sd[1]")
    assert bound.size == 4 and bound.sites and "decay" in repr(bound)
    z = bound.unconstrain(VALUES)
    back = bound.constrain(z)
    assert float(back["half_life"]) == pytest.approx(np.log(2.0) / 0.8)
    for name, value in VALUES.items():
        np.testing.assert_allclose(back[name], value, rtol=1e-12)
    several = bound.constrain_draws(np.stack([z, z + 0.1])[None])
    assert several["noise_sd"].shape == (1, 2, 2) and several["half_life"].shape == (1, 2)
    np.testing.assert_allclose(several["noise_sd"][0, 0], VALUES["noise_sd"], rtol=1e-12)


@pytest.mark.parametrize("y", [Y, OTHER], ids=["its own data", "other data"])
def test_the_density_is_numpyros_and_its_gradient_agrees_with_differences(bound, y):
    z = np.array([-0.2, 0.3, -2.1, -1.8])
    expected = -float(potential_energy(model, (TIMES, y), {}, bound.unravel(z)))
    assert float(bound.log_density(z, y)) == pytest.approx(expected, rel=1e-12)
    value, gradient = bound.log_density_gradient(z, y)
    assert float(value) == pytest.approx(expected, rel=1e-12)
    step = 1e-5
    differences = [(float(bound.log_density(z + step * unit, y)) - float(bound.log_density(z - step * unit, y)))
                   / (2 * step) for unit in np.eye(4)]
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-6)
    prior = bound.log_prior(z, y)
    assert float(bound.log_likelihood(z, y)) == pytest.approx(expected - float(prior), rel=1e-10)


def test_many_data_sets_are_a_vmap(bound):
    z = bound.unconstrain(VALUES)
    both = jax.vmap(bound.log_density, in_axes=(None, 0))(z, jnp.stack([jnp.asarray(Y), jnp.asarray(OTHER)]))
    np.testing.assert_allclose(both, [bound.log_density(z), bound.log_density(z, OTHER)], rtol=1e-12)


@pytest.mark.slow
def test_filter_and_smoother_at_a_draw_are_the_librarys(bound):
    system = systems.motif(decay=0.8, lengthscale=1.3, noise_sd=VALUES["noise_sd"])
    z = bound.unconstrain(VALUES)
    expected = lfm.filter(system, TIMES, Y, steps=2)
    for result in (bound.filter(z), bound.filter(VALUES)):
        np.testing.assert_allclose(result.log_likelihood, expected.log_likelihood, rtol=1e-10)
        np.testing.assert_allclose(result.filtered_mean, expected.filtered_mean, atol=1e-10)
    assert float(result.log_likelihood.sum()) == pytest.approx(float(bound.log_likelihood(z)), rel=1e-10)
    at = np.array([0.2, 3.5])
    smoothed = lfm.smooth(system, TIMES, OTHER, steps=2, at=at)
    again = bound.smooth(z, at, OTHER)
    np.testing.assert_allclose(again.force("u").mean, smoothed.force("u").mean, atol=1e-10)
    np.testing.assert_allclose(again.force("u").sd, smoothed.force("u").sd, atol=1e-10)


def test_a_model_is_traced_once_whatever_the_data():
    run = Mock(side_effect=model)

    def counted(times, y=None):
        run(times, y)

    first = lfm.bind(counted, TIMES, Y)
    z = first.unconstrain(VALUES)
    first.log_density_gradient(z)
    first.log_density(z)
    count = run.call_count
    with compilations() as compiled:
        second = lfm.bind(counted, TIMES.copy(), OTHER)
        second.log_density_gradient(z)
        second.log_density(z)
        first.with_data(OTHER).log_density(z)
    assert compiled == [] and run.call_count == count
    assert float(second.log_density(z)) != float(first.log_density(z))


@pytest.mark.parametrize("change", [
    {"times": TIMES + 1.0},
    *(pytest.param(change, marks=pytest.mark.slow) for change in ({"y": Y[:, :1]}, {"order": 2}))], ids=str)
def test_what_decides_the_program_is_never_mixed_up(bound, change):
    def sized(times, y=None, order=1):
        count = 2 if y is None else y.shape[1]
        rate = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        system = systems.motif(systems.identity, decay=rate, order=order, genes=count)
        numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=2), obs=y)

    given = {"times": TIMES, "y": Y, **change}
    times, y = given.pop("times"), given.pop("y")
    lfm.bind(sized, TIMES, Y)
    result = lfm.bind(sized, times, y, **given)
    expected = -potential_energy(sized, (times, y), given, result.unravel(np.zeros(1)))
    assert float(result.log_density(np.zeros(1))) == pytest.approx(float(expected), rel=1e-12)


@pytest.mark.parametrize("sampler, model, fixed", [
    pytest.param("nuts", small, {}, id="nuts, one parameter", marks=pytest.mark.slow),
    pytest.param("nuts", model, {"lengthscale": 1.3}, id="nuts", marks=pytest.mark.slow),
    pytest.param("ram", model, {"lengthscale": 1.3}, id="ram", marks=pytest.mark.slow),
    pytest.param("map", model, {"lengthscale": 1.3}, id="map")])
def test_a_second_data_set_compiles_nothing_in_fit(sampler, model, fixed):
    settings = {"sampler": sampler, "chains": 2, "warmup": 20, "samples": 20, "trajectory_draws": 8, "progress": False,
                "chain_method": "vectorized", "fixed": fixed}
    with pytest.warns() if sampler != "map" else contextlib.nullcontext():
        lfm.fit(model, TIMES, Y, **settings)
    with compilations() as compiled, pytest.warns() if sampler != "map" else contextlib.nullcontext():
        result = lfm.fit(model, TIMES, OTHER, **settings)
    assert compiled == []
    np.testing.assert_array_equal(group(result, "observed_data")["y"].values, OTHER)


def test_a_second_data_set_compiles_nothing_in_map_and_check():
    settings = {"sampler": "map", "samples": 20, "trajectory_draws": 0, "progress": False}
    checked = {"draws": 8, "particles": 20, "replicates": 2, "progress": False}
    results = [lfm.fit(model, TIMES, y, **settings) for y in (Y, OTHER)]
    lfm.map_estimate(model, TIMES, Y, restarts=1, hessian="finite-differences")
    lfm.check_accuracy(results[0], model, **checked)
    with compilations() as compiled:
        lfm.map_estimate(model, TIMES, OTHER, restarts=1, hessian="finite-differences")
        lfm.check_accuracy(results[1], model, **checked)
    assert compiled == []


@pytest.mark.parametrize("model", [small, pytest.param(model, marks=pytest.mark.slow)], ids=["small", "non-linear"])
def test_a_step_is_that_of_numpyros_nuts(model):
    bound = lfm.bind(model, TIMES, Y)
    z = bound.unconstrain({"decay": VALUES["decay"]} if model is small else VALUES)
    value, gradient = bound.log_density_gradient(z)
    point = ParamInfo(bound.unravel(z), -value, bound.unravel(-gradient))
    algorithm = nuts_sampler(bound, 30, {}).algorithm
    state = algorithm.init(jax.random.key(5), point, bound.y, None)
    kernel = NUTS(model, forward_mode_differentiation=True, dense_mass=True)
    kernel.init(jax.random.key(5), 30, point.z, (TIMES, Y), {})
    step, expected = jax.jit(algorithm.step), jax.jit(lambda state: kernel.sample(state, (TIMES, Y), {}))
    moved = 0
    for _ in range(32):  # the whole warm-up, in which the mass matrix is learnt, and two steps more
        mine, theirs = step(state, bound.y), expected(state.hmc)
        assert int(mine.hmc.num_steps) == int(theirs.num_steps)
        moved += int(mine.hmc.num_steps) > 1 and not np.array_equal(mine.z["decay"], state.z["decay"])
        for name in mine.z:
            np.testing.assert_allclose(mine.z[name], theirs.z[name], rtol=1e-6)
        for one, other in zip(jax.tree.leaves(mine.hmc.adapt_state.inverse_mass_matrix),
                              jax.tree.leaves(theirs.adapt_state.inverse_mass_matrix), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6)
        np.testing.assert_allclose(mine.hmc.adapt_state.step_size, theirs.adapt_state.step_size, rtol=1e-6)
        state = mine
    assert moved >= 3


def test_chains_from_the_mode_begin_with_the_covariance_there(monkeypatch):
    tuning = []

    def run_chains(key, sampler, *arguments):
        tuning.append(sampler.tuning)
        return run(key, sampler, *arguments)

    run = sampling.run_chains
    monkeypatch.setattr(sampling, "run_chains", run_chains)
    lfm.fit(small, TIMES, Y, chains=1, warmup=2, samples=2, trajectory_draws=0, progress=False)
    bound = lfm.bind(small, TIMES, Y)
    mode = lfm.map_estimate(small, TIMES, Y)
    np.testing.assert_allclose(tuning[0].covariance, mode.covariance, rtol=1e-4)
    value, gradient = bound.log_density_gradient(mode.mode)
    point = ParamInfo(bound.unravel(mode.mode), -value, bound.unravel(-gradient))
    sampler = nuts_sampler(bound, 30, {"dense_mass": True}, Laplace(mode.mode, mode.covariance))
    state = sampler.algorithm.init(jax.random.key(5), point, bound.y, sampler.tuning)
    (inverse_mass_matrix,) = state.hmc.adapt_state.inverse_mass_matrix.values()
    np.testing.assert_allclose(inverse_mass_matrix, mode.covariance)


def test_thinning_and_blocks_keep_the_last_step_of_each_draw(capfd, monkeypatch):
    monkeypatch.setattr("lfm_ppl.utils.progress.EVERY_S", 0.0)
    bound = lfm.bind(small, TIMES, Y)
    kernel = lfm.RAM(small, initial_scale=0.1)
    starts = np.stack([bound.unconstrain({"decay": 0.8})] * 2)

    def run(samples, thin=1, chain_method="sequential", show_progress=False):
        schedule = Schedule(7, samples, thin, chain_method)
        sampler = ram_sampler(bound, 7, kernel)
        return sampling.run_chains(jax.random.key(0), sampler, starts, schedule, show_progress=show_progress).z

    unthinned = run(30)
    np.testing.assert_allclose(run(10, thin=3), unthinned[:, 2::3], rtol=1e-12)
    np.testing.assert_allclose(run(30, chain_method="vectorized"), unthinned, rtol=1e-8)
    np.testing.assert_array_equal(run(30, show_progress=True), unthinned)
    assert "acceptance" in capfd.readouterr().err


def test_fixed_parameters_and_settings(bound):
    fixed = bound.fix({"decay": 0.8, "noise_sd[1]": 0.2})
    assert fixed.names == ("lengthscale", "noise_sd[0]")
    assert float(fixed.constrain(np.zeros(2))["noise_sd"][1]) == pytest.approx(0.2)
    finer = bound.approximate(steps=9)
    assert finer.site.example.steps == 9 and bound.site.example.steps == 2
    assert bound.approximate(steps=9).traced is finer.traced


@pytest.mark.slow
def test_a_model_that_asks_its_data_for_values():
    def looks(times, y=None):
        shift = float(np.nanmean(y))
        rate = numpyro.sample("decay", dist.LogNormal(shift, 0.3))
        numpyro.sample("y", lfm.MarginalLikelihood(systems.motif(systems.identity, decay=rate), times, steps=2), obs=y)

    computed = lfm.bind(looks, TIMES, Y)
    expected = -float(potential_energy(looks, (TIMES, Y), {}, {"decay": jnp.array(0.1)}))
    assert float(computed.log_density(np.array([0.1]))) == pytest.approx(expected, rel=1e-12)
    with pytest.raises(ValueError, match="needs the values of its data.*with_data"):
        computed.log_density(np.array([0.1]), OTHER)
    result = lfm.fit(looks, TIMES, Y, sampler="map", samples=5, trajectory_draws=2, progress=False)
    assert group(result, "log_likelihood")["y"].shape == (1, 5, 5) and "forces" in group(result, "trajectories")
    other = computed.with_data(OTHER)
    expected = -float(potential_energy(looks, (TIMES, OTHER), {}, {"decay": jnp.array(0.1)}))
    assert float(other.log_density(np.array([0.1]))) == pytest.approx(expected, rel=1e-12)


def test_times_that_a_model_computes_with_stay_known():
    def hours(times, y=None):
        rate = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        system = systems.motif(systems.identity, decay=rate)
        numpyro.sample("y", lfm.MarginalLikelihood(system, jnp.asarray(times) * 2.0, steps=2), obs=y)

    result = lfm.bind(hours, TIMES, Y).smooth({"decay": 1.2}, at=[0.5, 7.0])  # requested times need known ones
    expected = lfm.smooth(systems.motif(systems.identity, decay=1.2), TIMES * 2.0, Y, steps=2, at=[0.5, 7.0])
    np.testing.assert_allclose(result.force("u").mean, expected.force("u").mean, atol=1e-10)


def test_a_panel():
    def several(times, y=None):
        decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        with numpyro.plate("series", 2):
            numpyro.sample("y", lfm.panel(lambda p: systems.motif(decay=p), decay * jnp.ones(2), times, steps=2), obs=y)

    both = np.stack([Y, OTHER])
    result = lfm.bind(several, TIMES, both)
    z = np.array([0.1])
    parts = [lfm.MarginalLikelihood(systems.motif(decay=np.exp(0.1)), TIMES, steps=2).log_prob(y) for y in both]
    assert float(result.log_likelihood(z)) == pytest.approx(float(sum(parts)), rel=1e-10)
    with pytest.raises(ValueError, match="smooth takes one series"):
        result.smooth(z)


def _bound_before_and_after(change):
    """Return bound model, log density and digest of a model function before and after a closure variable changes."""
    state = {"power": 1.0, "prior": 0.3, "table": np.array([1.0, 2.0])}

    def reads(times, y=None):
        decay = numpyro.sample("decay", dist.LogNormal(0.0, state["prior"]))
        system = lfm.LatentForceModel(
            lambda x, u, t: jax.nn.softplus(u) * jnp.asarray(state["table"]) - decay * x ** state["power"],
            {"u": lfm.Matern(1.0, 1.0)}, lfm.GaussianObservation(lambda x, u, t: x, 0.1 * jnp.ones(2)),
            lfm.Gaussian(jnp.ones(2), 0.1 * jnp.eye(2)))
        numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=2, iterations=0), obs=y)

    results = []
    for update in ({}, change):
        state.update(update)
        bound = lfm.bind(reads, TIMES, Y)
        results.append((bound, float(bound.log_density(np.array([0.1]))), model_digest(bound)))
        expected = -float(potential_energy(reads, (TIMES, Y), {}, {"decay": 0.1}))
        assert results[-1][1] == pytest.approx(expected, rel=1e-12)
    return results


@pytest.mark.parametrize("change", [{"power": 2.0}, {"prior": 0.5}, {"table": np.array([1.0, 2.1])}], ids=str)
def test_a_model_with_changed_variables_is_another_model(change):
    before, after = _bound_before_and_after(change)
    assert before[0].traced is not after[0].traced
    assert before[1] != after[1] and before[2] != after[2]


def test_a_model_with_equal_variables_is_traced_once():
    before, after = _bound_before_and_after({"table": np.array([1.0, 2.0])})
    assert before[0].traced is after[0].traced and before[1:] == after[1:]


POWER = 1.0


def test_global_variables_of_nested_functions_are_compared(monkeypatch):
    def driven(times, y=None):
        decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        system = lfm.LatentForceModel(
            lambda x, u, t: POWER * u - decay * x, {"u": lfm.Matern(1.0, 1.0)},
            lfm.GaussianObservation(lambda x, u, t: x, 0.1 * jnp.ones(1)), lfm.Gaussian(jnp.ones(1), 0.1 * jnp.eye(1)))
        numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)

    first = lfm.bind(driven, TIMES, Y[:, :1]).log_density(np.array([0.1]))
    monkeypatch.setitem(driven.__globals__, "POWER", 2.0)
    assert float(lfm.bind(driven, TIMES, Y[:, :1]).log_density(np.array([0.1]))) != float(first)


def test_times_may_follow_from_parameters_or_data():
    def warped(times, y=None):
        speed = numpyro.sample("speed", dist.LogNormal(0.0, 0.5))
        system = systems.motif(systems.identity)
        numpyro.sample("y", lfm.MarginalLikelihood(system, jnp.asarray(times) * speed, steps=2), obs=y)

    bound = lfm.bind(warped, TIMES, Y)
    for z in (0.0, 0.7):
        expected = -potential_energy(warped, (TIMES, Y), {}, {"speed": z})
        assert float(bound.log_density(np.array([z]))) == pytest.approx(float(expected), rel=1e-12)

    def packed(data):
        decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        system = systems.motif(systems.identity, decay=decay)
        numpyro.sample("y", lfm.MarginalLikelihood(system, data["times"], steps=2), obs=data["y"])

    for times in (TIMES, 2.0 * TIMES):
        data = {"times": jnp.asarray(times), "y": jnp.asarray(Y)}
        result = bind_arguments(packed, (data,), {}).log_density(np.array([0.1]))
        expected = -potential_energy(packed, (data,), {}, {"decay": 0.1})
        assert float(result) == pytest.approx(float(expected), rel=1e-12)


def test_binding_runs_a_model_with_numbers_and_with_tracers():
    run = Mock()

    def counted(times, y=None):
        run()
        decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        numpyro.sample("y", lfm.MarginalLikelihood(systems.motif(decay=decay), times, steps=2), obs=y)

    first = lfm.bind(counted, TIMES, Y)
    assert first.site.name == "y" and run.call_count == 2
    assert lfm.bind(counted, TIMES, OTHER).traced is first.traced and run.call_count == 2


def test_a_model_may_be_bound_first_in_compiled_code():
    def prior(times, y=None):
        model(times, y, order=0)

    z = np.zeros(4)
    inside = jax.jit(lambda z: lfm.bind(prior, TIMES, Y).log_prior(z))(z)
    with_data = jax.jit(lambda z, y: lfm.bind(prior, TIMES, y).log_prior(z))(z, Y)
    outside = lfm.bind(prior, TIMES, Y).log_prior(z)
    np.testing.assert_allclose([inside, with_data], outside, rtol=1e-12)


def test_the_latest_models_are_kept(monkeypatch):
    monkeypatch.setattr(traced_model, "_CACHED_MODELS", 2)
    traced_model._models.clear()
    for order in (0, 1, 2):
        lfm.bind(model, TIMES, Y, order=order)
    assert len(traced_model._models) == 2


def no_site(times, y=None):
    numpyro.sample("decay", dist.LogNormal(0.0, 0.3))


def discrete(times, y=None):
    numpyro.sample("count", dist.Poisson(3.0))


@pytest.mark.parametrize("arguments, error, message", [
    ((model, TIMES, Y[:3]), ValueError, r"one column for each of the 2 outputs, shape \(5, 2\); got \(3, 2\)"),
    ((3, TIMES, Y), TypeError, "model must be a NumPyro model"),
    ((no_site, TIMES, Y), ValueError, "exactly one site"),
    ((discrete, TIMES, Y), ValueError, "discrete latent sites: 'count'"),
])
def test_wrong_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        lfm.bind(*arguments)


def test_traced_times_are_named():
    with pytest.raises(TypeError, match="times decide what is compiled.*outside of jit"):
        jax.jit(lambda t: lfm.bind(model, t, Y).log_density(np.zeros(4)))(TIMES)


@pytest.mark.parametrize("values, message", [
    ({"decay": 1.0}, "no value of 'noise_sd'"),
    ({**VALUES, "delay": 1.0}, "unknown site in values 'delay'. Did you mean 'decay'"),
    ({**VALUES, "decay": -1.0}, "outside of the support of the prior.*'decay'"),
    ({**VALUES, "decay": np.ones(2)}, r"value of 'decay' must have shape \(\)"),
])
def test_wrong_values_are_named(bound, values, message):
    with pytest.raises(ValueError, match=message):
        bound.unconstrain(values)


def test_observations_of_one_output_may_be_a_vector():
    def single(times, y=None):
        decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        numpyro.sample("y", lfm.MarginalLikelihood(systems.motif(decay=decay, genes=1), times, steps=2), obs=y)

    z = np.array([0.1])
    expected = lfm.bind(single, TIMES, Y[:, :1]).log_density(z)
    assert float(lfm.bind(single, TIMES, Y[:, 0]).log_density(z)) == float(expected)


def test_fixing_in_compiled_code_leaves_nothing_behind(bound):
    values, z = {"decay": 0.8, "noise_sd": 0.1}, np.array([0.2])
    inside = jax.jit(lambda z: bound.fix(values).log_prior(z))(z)
    assert float(bound.fix(values).log_prior(z)) == pytest.approx(float(inside), rel=1e-12)
    at = lambda decay: bound.fix({**values, "decay": decay}).log_prior(z)  # noqa: E731
    assert np.isfinite(jax.jit(at)(0.8)) and np.isfinite(jax.grad(at)(0.8))


@pytest.mark.parametrize("z, y, message", [
    (np.zeros(3), Y, r"z must have shape \(4,\), one entry for each of decay, lengthscale"),
    (np.zeros(4), Y[:4], "shape that was bound"),
    (np.zeros(4), np.full((5, 2), np.inf), "y has infinite entries"),
])
def test_wrong_positions_and_data_are_named(bound, z, y, message):
    with pytest.raises(ValueError, match=message):
        bound.log_density(z, y)


def test_data_of_another_type_are_taken(bound):
    assert np.isfinite(bound.log_prior(np.zeros(4), np.ones((5, 2), int)))


def test_other_data_must_have_the_same_shape(bound):
    with pytest.raises(ValueError, match=r"shape that was bound, \(5, 2\), got \(3, 2\)"):
        bound.with_data(Y[:3])


@pytest.mark.slow
def test_a_digest_is_equal_in_processes_that_hash_differently():
    code = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.inference.model_digest import model_digest
file = loading.load("spring")
data = file.simulate(seed=0)
print(model_digest(lfm.bind(file.model, data.times, data.y, **file.keywords(data, {}))))
"""
    digests = {subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONHASHSEED": seed}, check=True,
                              capture_output=True, text=True).stdout for seed in ("0", "2")}
    assert len(digests) == 1 and len(digests.pop().strip()) == 64
