"""The bound model: NumPyro's own densities and transforms, data as an argument, one compilation for all data sets."""

import contextlib
import os
import subprocess
import sys
import types
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
from lfm_ppl.inference import sampling
from lfm_ppl.inference.bind import bind_arguments
from lfm_ppl.inference.bound_samplers import nuts_sampler, ram_sampler
from lfm_ppl.inference.laplace_start import Laplace
from lfm_ppl.inference.model_digest import model_digest
from lfm_ppl.inference.schedule import Schedule
from lfm_ppl.inference.symmetrising import SymmetrisingTransform
from lfm_ppl.inference.unbound_model import SharedModel
from lfm_ppl.results.result_view import ResultView
from tests.compiled_programs import compilations

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
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=1, iterations=0), obs=y)


def small(times, y=None, order=1):
    """Linear, with one parameter: little to compile."""
    decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
    system = systems.motif(systems.identity, decay=decay, order=order)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=2), obs=y)


@pytest.fixture(scope="module")
def bound():
    return lfm.bind(model, TIMES, Y)


def numpyro_density(model, arguments, z, **keywords):
    """Log density that NumPyro computes of unconstrained values by site, in one program."""
    return -float(jax.jit(lambda z: potential_energy(model, arguments, keywords, z))(z))


VALUES = {"decay": 0.8, "noise_sd": np.array([0.1, 0.2]), "lengthscale": 1.3}


@pytest.mark.thorough
def test_coordinates_are_named_and_values_come_back(bound):
    assert bound.names == ("decay", "lengthscale", "noise_sd[0]", "noise_sd[1]")
    assert bound.size == 4 and "decay" in repr(bound)
    z = bound.unconstrain(VALUES)
    parameters = bound.constrain(z)
    assert float(parameters["half_life"]) == pytest.approx(np.log(2.0) / 0.8)
    for name, value in VALUES.items():
        np.testing.assert_allclose(parameters[name], value, rtol=1e-12)
    several = bound.constrain_draws(np.stack([z, z + 0.1])[None])
    assert several["noise_sd"].shape == (1, 2, 2) and several["half_life"].shape == (1, 2)
    np.testing.assert_allclose(several["noise_sd"][0, 0], VALUES["noise_sd"], rtol=1e-12)


def test_the_density_is_numpyros_and_its_gradient_agrees_with_differences(bound):
    z, step = np.array([-0.2, 0.3, -2.1, -1.8]), 1e-5
    for y in (Y, OTHER):
        expected = numpyro_density(model, (TIMES, y), bound.unravel(z))
        assert float(bound.log_density(z, y)) == pytest.approx(expected, rel=1e-12)
        value, gradient = bound.log_density_gradient(z, y)
        assert float(value) == pytest.approx(expected, rel=1e-12)
        differences = [(float(bound.log_density(z + step * unit, y)) - float(bound.log_density(z - step * unit, y)))
                       / (2 * step) for unit in np.eye(4)]
        np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-6)
        prior = float(bound.log_prior(z, y))
        assert float(bound.log_likelihood(z, y)) == pytest.approx(expected - prior, rel=1e-10)
    assert np.isfinite(bound.log_prior(np.zeros(4), np.ones((5, 2), int)))  # data of another type


@pytest.mark.thorough
def test_many_data_sets_are_a_vmap():
    bound, z = lfm.bind(small, TIMES, Y), np.array([0.1])
    densities = jax.vmap(bound.log_density, in_axes=(None, 0))(z, jnp.stack([jnp.asarray(Y), jnp.asarray(OTHER)]))
    np.testing.assert_allclose(densities, [bound.log_density(z), bound.log_density(z, OTHER)], rtol=1e-12)


@pytest.mark.thorough
def test_filter_and_smoother_at_a_draw_are_the_librarys_at_times_that_the_model_computes():
    def hours(times, y=None):
        rate = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        system = systems.motif(systems.identity, decay=rate)
        numpyro.sample("y", lfm.MarginalLikelihood(system, jnp.asarray(times) * 2.0, steps=2), obs=y)

    bound, system, values = lfm.bind(hours, TIMES, Y), systems.motif(systems.identity, decay=1.2), {"decay": 1.2}
    z = bound.unconstrain(values)
    expected = lfm.filter(system, 2.0 * TIMES, Y, steps=2)
    for point in (z, values):
        np.testing.assert_allclose(bound.filter(point).filtered_mean, expected.filtered_mean, atol=1e-10)
    assert float(expected.log_likelihood.sum()) == pytest.approx(float(bound.log_likelihood(z)), rel=1e-10)
    requested_times = [0.5, 7.0]  # requested times need known ones
    smoothed = lfm.smooth(system, 2.0 * TIMES, OTHER, steps=2, at=requested_times)
    force = bound.smooth(z, requested_times, OTHER).force("u")
    np.testing.assert_allclose(force.mean, smoothed.force("u").mean, atol=1e-10)
    np.testing.assert_allclose(force.sd, smoothed.force("u").sd, atol=1e-10)


@pytest.mark.thorough
def test_the_methods_of_a_bound_model_read_the_model_once():
    run = Mock(side_effect=small)

    def counted(times, y=None):
        run(times, y)

    first, z = lfm.bind(counted, TIMES, Y), np.array([0.1])
    first.log_density_gradient(z)
    first.log_density(z)
    count = run.call_count
    with compilations() as compiled:
        with_other_data = first.with_data(OTHER)
        with_other_data.log_density_gradient(z)
        with_other_data.log_density(z)
        assert run.call_count == count
        second = lfm.bind(counted, TIMES.copy(), OTHER)
        assert float(second.log_density(z)) == float(with_other_data.log_density(z)) != float(first.log_density(z))
    assert compiled == []


@pytest.mark.thorough
def test_what_decides_the_program_is_never_mixed_up():
    lfm.bind(small, TIMES, Y)
    for times, order in ((TIMES + 1.0, 1), (TIMES, 2)):
        result = lfm.bind(small, times, Y, model_kwargs={"order": order})
        expected = numpyro_density(small, (times, Y), {"decay": 0.0}, order=order)
        assert float(result.log_density(np.zeros(1))) == pytest.approx(expected, rel=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize(("sampler", "model"), [
    ("map", small), pytest.param("nuts", model, marks=pytest.mark.slow),
    pytest.param("ram", small, marks=pytest.mark.slow)])
def test_a_second_data_set_compiles_nothing(sampler, model):
    settings = {"sampler": sampler, "chains": 2, "warmup": 20, "samples": 20, "trajectory_draws": 8, "progress": False,
                "chain_method": "vectorized"}
    checked = {"draws": 8, "particles": 20, "replicates": 2, "progress": False}

    def compute(y):
        with contextlib.nullcontext() if sampler == "map" else pytest.warns(lfm.ConvergenceWarning):
            result = lfm.fit(model, TIMES, y, **settings)
        if sampler == "map":
            lfm.map_estimate(model, TIMES, y, restarts=1, hessian="finite-differences")
            lfm.check_accuracy(result, model, **checked)
        return result

    compute(Y)
    with compilations() as compiled:
        result = compute(OTHER)
    assert compiled == []
    np.testing.assert_array_equal(ResultView.of(result).group("data")["y"].values, OTHER)


@pytest.mark.slow
@pytest.mark.parametrize("model", [small, model], ids=["small", "non-linear"])
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
        moved += int(mine.hmc.num_steps) > 1 and not np.array_equal(mine.hmc.z["decay"], state.hmc.z["decay"])
        for name in theirs.z:
            np.testing.assert_allclose(mine.hmc.z[name], theirs.z[name], rtol=1e-6)
        for matrix, expected_matrix in zip(jax.tree.leaves(mine.hmc.adapt_state.inverse_mass_matrix),
                                           jax.tree.leaves(theirs.adapt_state.inverse_mass_matrix), strict=True):
            np.testing.assert_allclose(matrix, expected_matrix, rtol=1e-6)
        np.testing.assert_allclose(mine.hmc.adapt_state.step_size, theirs.adapt_state.step_size, rtol=1e-6)
        state = mine
    assert moved >= 3


@pytest.mark.slow
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
    np.testing.assert_allclose(tuning[0].laplace.covariance, mode.covariance, rtol=1e-4)
    value, gradient = bound.log_density_gradient(mode.mode)
    point = ParamInfo(bound.unravel(mode.mode), -value, bound.unravel(-gradient))
    transform = SymmetrisingTransform(Laplace(mode.mode, mode.covariance), np.zeros(bound.size))
    sampler = nuts_sampler(bound, 30, {"dense_mass": True}, transform)
    state = sampler.algorithm.init(jax.random.key(5), point, bound.y, sampler.tuning)
    (inverse_mass_matrix,) = state.hmc.adapt_state.inverse_mass_matrix.values()
    np.testing.assert_allclose(inverse_mass_matrix, transform.correlation)


@pytest.mark.thorough
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
    assert finer.site.example.settings.steps == 9 and bound.site.example.settings.steps == 1


@pytest.mark.thorough
def test_a_model_that_asks_its_data_for_values():
    def looks(times, y=None):
        rate = numpyro.sample("decay", dist.LogNormal(float(np.nanmean(y)), 0.3))
        numpyro.sample("y", lfm.MarginalLikelihood(systems.motif(systems.identity, decay=rate), times, steps=2), obs=y)

    bound, z = lfm.bind(looks, TIMES, Y), np.array([0.1])
    with pytest.raises(ValueError, match="with_data"):
        bound.log_density(z, OTHER)
    for y, result in ((Y, bound), (OTHER, bound.with_data(OTHER))):
        expected = numpyro_density(looks, (TIMES, y), {"decay": 0.1})
        assert float(result.log_density(z)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.thorough
def test_models_that_share_programs_may_have_other_numbers_of_series():
    def several(times, y=None):
        with numpyro.plate("series", y.shape[0]):
            decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
            numpyro.sample("y", lfm.panel(lambda p: systems.motif(systems.identity, decay=p), decay, times, steps=2),
                           obs=y)

    shared = SharedModel(several)
    for count in (2, 3):
        y = np.stack([Y, OTHER, Y])[:count]
        z = 0.1 * np.arange(count)
        result, expected = (float(lfm.bind(model, TIMES, y).log_density(z)) for model in (shared, several))
        assert result == pytest.approx(expected, rel=1e-12)


@pytest.mark.thorough
def test_a_panel():
    def several(times, y=None):
        decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        with numpyro.plate("series", 2):
            numpyro.sample("y", lfm.panel(lambda p: systems.motif(systems.identity, decay=p), decay * jnp.ones(2),
                                          times, steps=2), obs=y)

    panel_data = np.stack([Y, OTHER])
    result = lfm.bind(several, TIMES, panel_data)
    z = np.array([0.1])
    system = systems.motif(systems.identity, decay=np.exp(0.1))
    parts = [lfm.MarginalLikelihood(system, TIMES, steps=2).log_prob(y) for y in panel_data]
    assert float(result.log_likelihood(z)) == pytest.approx(float(sum(parts)), rel=1e-10)
    with pytest.raises(ValueError, match="one series"):
        result.smooth(z)


SPREAD = 0.3


def spread():
    return SPREAD


def observe(times, y, spread, table=None):
    """A model of one parameter that reads what changes between two fits."""
    decay = numpyro.sample("decay", dist.LogNormal(0.0, spread))
    level = 0.0 if table is None else jnp.asarray(table)[-1]
    system = systems.motif(lambda u: u + level, decay=decay)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=2), obs=y)


def by_helper(times, y=None):
    observe(times, y, spread())


class Study:
    """A model as a method, and as a callable object that has no hash."""

    spread = 0.3
    __hash__ = None

    def __eq__(self, other):
        return isinstance(other, Study)

    def model(self, times, y=None):
        observe(times, y, self.spread)

    def __call__(self, times, y=None):
        observe(times, y, self.spread)


def changed(kind, monkeypatch):
    """Return a model, and the function that changes what it reads."""
    table = np.linspace(0.0, 1.0, 5000)
    study, state, module = Study(), {"spread": 0.3}, types.ModuleType("settings")
    module.spread = 0.3
    return {
        "helper": (by_helper, lambda: monkeypatch.setitem(by_helper.__globals__, "SPREAD", 0.5)),
        "table": (lambda times, y=None: observe(times, y, 0.3, table), lambda: table.__setitem__(-1, 2.0)),
        "method": (study.model, lambda: setattr(study, "spread", 0.5)),
        "callable": (study, lambda: setattr(study, "spread", 0.5)),
        "closure": (lambda times, y=None: observe(times, y, state["spread"]), lambda: state.update(spread=0.5)),
        "module": (lambda times, y=None: observe(times, y, module.spread), lambda: setattr(module, "spread", 0.5)),
    }[kind]


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["closure", *(pytest.param(kind, marks=pytest.mark.thorough) for kind in (
    "helper", "table", "method", "callable", "module"))])
def test_a_model_is_what_its_function_computes_now(kind, monkeypatch):
    current, change = changed(kind, monkeypatch)

    def compute():
        bound = lfm.bind(current, TIMES, Y)
        fitted = lfm.fit(current, TIMES, Y, sampler="map", samples=50, trajectory_draws=0, progress=False)
        return float(bound.log_density(np.array([0.1]))), model_digest(bound), float(fitted["posterior"]["decay"].std())

    initial_values = compute()
    with compilations() as compiled:
        assert compute() == initial_values
    assert compiled == []
    change()
    changed_values = compute()
    assert all(new != old for new, old in zip(changed_values, initial_values, strict=True))
    assert changed_values[0] == pytest.approx(numpyro_density(current, (TIMES, Y), {"decay": 0.1}), rel=1e-12)


@pytest.mark.thorough
def test_a_digest_tells_models_that_need_the_values_of_their_data_apart():
    def branching(spread):
        def model(times, y=None):
            numpyro.deterministic("is_high", float(np.asarray(y)[0, 0]) > 0.0)
            observe(times, y, spread)

        return model

    bound = [lfm.bind(branching(spread), TIMES, Y) for spread in (0.3, 0.3, 0.5)]
    assert all(model.problem.data is None for model in bound)
    digests = [model_digest(model) for model in bound]
    assert digests[0] == digests[1] != digests[2]


@pytest.mark.thorough
def test_times_may_follow_from_parameters_or_data():
    def warped(times, y=None):
        speed = numpyro.sample("speed", dist.LogNormal(0.0, 0.5))
        system = systems.motif(systems.identity)
        numpyro.sample("y", lfm.MarginalLikelihood(system, jnp.asarray(times) * speed, steps=2), obs=y)

    bound = lfm.bind(warped, TIMES, Y)
    expected = numpyro_density(warped, (TIMES, Y), {"speed": 0.7})
    assert float(bound.log_density(np.array([0.7]))) == pytest.approx(expected, rel=1e-12)

    def packed(data):
        decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        system = systems.motif(systems.identity, decay=decay)
        numpyro.sample("y", lfm.MarginalLikelihood(system, data["times"], steps=2), obs=data["y"])

    for times in (TIMES, 2.0 * TIMES):
        data = {"times": jnp.asarray(times), "y": jnp.asarray(Y)}
        result = bind_arguments(packed, (data,), {}).log_density(np.array([0.1]))
        expected = numpyro_density(packed, (data,), {"decay": 0.1})
        assert float(result) == pytest.approx(expected, rel=1e-12)


def test_a_model_may_be_bound_first_in_compiled_code():
    def prior(times, y=None):
        small(times, y, order=0)

    z = np.zeros(1)
    compiled_value = jax.jit(lambda z: lfm.bind(prior, TIMES, Y).log_prior(z))(z)
    with_data = jax.jit(lambda z, y: lfm.bind(prior, TIMES, y).log_prior(z))(z, Y)
    eager_value = lfm.bind(prior, TIMES, Y).log_prior(z)
    np.testing.assert_allclose([compiled_value, with_data], eager_value, rtol=1e-12)


def no_site(times, y=None):
    numpyro.sample("decay", dist.LogNormal(0.0, 0.3))


def discrete(times, y=None):
    numpyro.sample("count", dist.Poisson(3.0))


def test_what_cannot_be_bound_is_named():
    for model_function, y, error, name in ((small, Y[:3], ValueError, r"\(5, 2\)"), (3, Y, TypeError, "model"),
                                           (no_site, Y, ValueError, "site"), (discrete, Y, ValueError, "'count'")):
        with pytest.raises(error, match=name):
            lfm.bind(model_function, TIMES, y)
    with pytest.raises(TypeError, match="times"):
        jax.jit(lambda t: lfm.bind(small, t, Y).log_density(np.zeros(1)))(TIMES)


def test_wrong_values_positions_and_data_are_named(bound):
    for values, name in (({"decay": 1.0}, "'noise_sd'"), ({**VALUES, "delay": 1.0}, "'delay'"),
                         ({**VALUES, "decay": -1.0}, "'decay'"), ({**VALUES, "decay": np.ones(2)}, "'decay'")):
        with pytest.raises(ValueError, match=name):
            bound.unconstrain(values)
    for z, y, name in ((np.zeros(3), Y, "z must have shape"), (np.zeros(4), Y[:4], "shape"),
                       (np.zeros(4), np.full((5, 2), np.inf), "y has infinite")):
        with pytest.raises(ValueError, match=name):
            bound.log_density(z, y)


@pytest.mark.thorough
def test_observations_of_one_output_may_be_a_vector():
    def single(times, y=None):
        numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
        numpyro.sample("y", lfm.MarginalLikelihood(systems.motif(systems.identity, genes=1), times), obs=y)

    vector, column = (lfm.bind(single, TIMES, y).log_density(np.zeros(1)) for y in (Y[:, 0], Y[:, :1]))
    assert float(vector) == float(column)


@pytest.mark.thorough
def test_fixing_in_compiled_code_leaves_nothing_behind(bound):
    values, z = {"decay": 0.8, "noise_sd": 0.1}, np.array([0.2])
    compiled_value = jax.jit(lambda z: bound.fix(values).log_prior(z))(z)
    assert float(bound.fix(values).log_prior(z)) == pytest.approx(float(compiled_value), rel=1e-12)

    def prior_at(decay):
        return bound.fix({**values, "decay": decay}).log_prior(z)

    assert np.isfinite(jax.jit(prior_at)(0.8)) and np.isfinite(jax.grad(prior_at)(0.8))


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
print(model_digest(lfm.bind(file.model, data.times, data.y, model_kwargs=file.keywords(data, {}))))
"""
    digests = {subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONHASHSEED": seed}, check=True,
                              capture_output=True, text=True).stdout for seed in ("0", "2")}
    assert len(digests) == 1 and len(digests.pop().strip()) == 64


@pytest.mark.thorough
def test_gradients_of_a_model_with_a_loop_without_reverse_mode():
    """Four parameters, whose gradient is taken in reverse mode elsewhere."""

    def model(times, y=None):
        z = numpyro.sample("z", dist.Normal(0.0, 1.0).expand([4]))
        # The square root of 1 + z^2 by Newton's method.
        rate = jax.lax.while_loop(lambda v: v[1] < 6, lambda v: (0.5 * (v[0] + (1 + z[0]**2) / v[0]), v[1] + 1),
                                  (jnp.ones(()), 0))[0]
        system = lfm.LatentForceModel(
            lambda x, u, t: u - rate * x, {"u": lfm.Matern(jnp.exp(z[1]), 1.0)},
            lfm.GaussianObservation(lambda x, u, t: x, jnp.exp(z[2:3])), lfm.Gaussian(z[3:], jnp.eye(1)))
        numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)

    bound = lfm.bind(model, jnp.arange(4.0), jnp.array([[0.1], [0.4], [-0.3], [0.2]]))
    z, step = jnp.array([0.3, -0.2, 0.5, 1.0]), 1e-5
    value, gradient = bound.log_density_gradient(z)
    differences = [(bound.log_density(z.at[i].add(step)) - bound.log_density(z.at[i].add(-step))) / (2 * step)
                   for i in range(4)]
    np.testing.assert_allclose(value, bound.log_density(z))
    np.testing.assert_allclose(gradient, differences, rtol=1e-6)
