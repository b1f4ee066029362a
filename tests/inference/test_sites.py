"""Models with several likelihood sites, bound to times and data by name."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from two_experiments import TIMES, Y, alone, joint_model, system

import lfm_ppl as lfm

Z = jnp.array([-0.7])


@pytest.mark.thorough
def test_the_log_density_is_the_sum_of_the_sites():
    bound = lfm.bind(joint_model, TIMES, Y)
    singles = {name: lfm.bind(alone(name), TIMES[name], Y[name]) for name in Y}
    log_likelihoods = {name: float(single.log_likelihood(Z)) for name, single in singles.items()}
    expected = float(bound.log_prior(Z)) + sum(log_likelihoods.values())
    assert float(bound.log_density(Z)) == pytest.approx(expected, abs=1e-12)
    assert float(bound.log_likelihood(Z)) == pytest.approx(sum(log_likelihoods.values()), abs=1e-12)
    step = 1e-5
    slope = (bound.log_density(Z + step) - bound.log_density(Z - step)) / (2 * step)
    np.testing.assert_allclose(bound.log_density_gradient(Z)[1], [slope], rtol=1e-6)
    for name, single in singles.items():
        selected = bound.site_models[name]
        assert float(selected.log_likelihood(Z)) == pytest.approx(log_likelihoods[name], abs=1e-12)
        np.testing.assert_allclose(selected.smooth(Z).mean, single.smooth(Z).mean, atol=1e-12)
        np.testing.assert_allclose(selected.filter(Z).log_likelihood, single.filter(Z).log_likelihood, atol=1e-12)
        np.testing.assert_array_equal(selected.times, TIMES[name])


@pytest.mark.thorough
def test_other_data_of_one_site_or_of_all():
    bound = lfm.bind(joint_model, TIMES, Y)
    other_data = {**Y, "y2": 1.1 * Y["y2"]}
    expected = lfm.bind(joint_model, TIMES, other_data)
    assert float(bound.log_density(Z, other_data)) == pytest.approx(float(expected.log_density(Z)), abs=1e-12)
    assert float(bound.site_models["y2"].log_density(Z, other_data["y2"])) == pytest.approx(
        float(expected.log_density(Z)), abs=1e-12)
    assert float(jax.jit(lambda y: lfm.bind(joint_model, TIMES, y).log_density(Z))(other_data)) == pytest.approx(
        float(expected.log_density(Z)), abs=1e-12)
    assert float(bound.site_models["y2"].with_data(other_data["y2"]).log_likelihood(Z)) == pytest.approx(
        float(lfm.bind(alone("y2"), TIMES["y2"], other_data["y2"]).log_likelihood(Z)), abs=1e-12)


@pytest.mark.thorough
def test_sites_of_a_model_that_asks_its_data_for_values():
    def looks(times, y):
        rate = numpyro.sample("a", dist.LogNormal(float(np.nanmean(y["y"])), 0.5))
        for name in times:
            numpyro.sample(name, lfm.MarginalLikelihood(system(name, rate), times[name]), obs=y[name])

    def constant_model(times, y):
        rate = numpyro.sample("a", dist.LogNormal(float(np.nanmean(Y["y"])), 0.5))
        for name in times:
            numpyro.sample(name, lfm.MarginalLikelihood(system(name, rate), times[name]), obs=y[name])

    bound, expected = lfm.bind(looks, TIMES, Y), lfm.bind(constant_model, TIMES, Y)
    assert bound.problem.data is None
    minus, gradient = bound.objective().value_and_gradient(Z)
    np.testing.assert_allclose(-gradient, expected.log_density_gradient(Z)[1], rtol=1e-9)
    assert -minus == pytest.approx(float(expected.log_density(Z)), abs=1e-10)


def closed(times, y):
    """A model whose second site closes over its data."""
    rate = numpyro.sample("a", dist.LogNormal(-1.0, 0.5))
    numpyro.sample("y", lfm.MarginalLikelihood(system("y", rate), times["y"]), obs=y["y"])
    numpyro.sample("y2", lfm.MarginalLikelihood(system("y2", rate), TIMES["y2"]), obs=Y["y2"])


def arrays(times, y=None):
    """A model whose first site takes times and data as they are."""
    rate = numpyro.sample("a", dist.LogNormal(-1.0, 0.5))
    numpyro.sample("y", lfm.MarginalLikelihood(system("y", rate), times), obs=y)
    numpyro.sample("y2", lfm.MarginalLikelihood(system("y2", rate), TIMES["y2"]), obs=Y["y2"])


FIRST = {"y": TIMES["y"]}, {"y": Y["y"]}


@pytest.mark.parametrize(("model", "times", "y", "part"), [
    (arrays, TIMES["y"], Y["y"], "{'y': (times, y), 'y2': (times, y)}"),
    (joint_model, TIMES["y"], Y["y"], "by site"),
    (joint_model, *FIRST, "'y2': (times, y)"),
    (closed, *FIRST, "are y, y2, and there are data of y: "),
    (closed, TIMES, Y, "obs=y['y2']"),
    (arrays, TIMES, Y, "times['y']"),
    (joint_model, TIMES, {"y": Y["y"]}, "times has y, y2, and y has y."),
    (joint_model, TIMES, Y["y"], "no dict"),
    (joint_model, {**TIMES, "y3": TIMES["y"]}, {**Y, "y3": Y["y"]}, "are y, y2, and there are data of y, y2, y3: "),
    (joint_model, TIMES, {**Y, "y2": Y["y"]}, "site 'y2': "),
    (joint_model, TIMES, {**Y, "y2": None}, "y['y2']"),
])
def test_errors_say_what_to_pass(model, times, y, part):
    with pytest.raises((ValueError, TypeError)) as caught:
        lfm.bind(model, times, y)
    assert part in str(caught.value) and "\n" not in str(caught.value)


def test_a_function_of_one_site_names_the_sites():
    with pytest.raises(ValueError, match=r"y, y2.*site_models"):
        lfm.bind(joint_model, TIMES, Y).smooth(Z)
