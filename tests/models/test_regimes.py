"""The climate with two regimes: a finite density all over the prior, and the panel of its probabilities."""

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure
from numpyro import handlers
from numpyro.infer import Predictive

import lfm_ppl as lfm
from lfm_ppl.io import loading


@pytest.fixture(scope="module")
def file():
    return loading.load("regimes")


@pytest.mark.thorough
@pytest.mark.parametrize("count", [200, pytest.param(2_000, marks=pytest.mark.slow)])
def test_no_draw_of_the_prior_has_a_density_or_gradient_that_is_nan(file, count):
    data = file.simulate()
    bound = lfm.bind(file.model, data.times, data.y)
    prior = Predictive(handlers.block(file.model, hide=["y"]), num_samples=count)(jax.random.key(0), data.times, data.y)
    z = jax.vmap(bound.unconstrain)({name: prior[name] for name in file.parameters})
    values, gradients = jax.jit(lambda z: jax.lax.map(jax.value_and_grad(bound.log_density), z, batch_size=200))(z)
    assert np.shape(gradients) == (count, bound.size) and np.all(np.isfinite(gradients))
    assert np.all(np.isfinite(values))


@pytest.mark.thorough
def test_a_figure_has_one_panel_for_all_regimes_also_of_a_forecast_and_of_a_choice(file, tmp_path):
    data = file.simulate()
    result = lfm.fit(file.model, data.times[-60:], data.y[-60:], sampler="map", samples=40, trajectory_draws=40,
                     truth={"times": data.times, "state": data.truth["state"]}, progress=False)
    lfm.save(result, tmp_path / "posterior.nc")
    result = lfm.load(tmp_path / "posterior.nc")
    states = result["trajectories"]["states"].sel(state=["cold", "warm"])
    np.testing.assert_allclose(states.sum("state"), 1.0)
    forecast = lfm.forecast(result, file.model, np.array([0.5, 1.0]), progress=False)
    for source, count in ((result, 2), (forecast, 2)):
        figure = lfm.plot_states(source)
        assert isinstance(figure, Figure)
        assert [axes.get_ylabel() for axes in figure.axes][1:] == ["probability"] and len(figure.axes) == count
        labels = [text.get_text() for text in figure.axes[1].get_yticklabels()]
        assert labels == ["0", "0.5", "1", "truth"]
    assert [axes.get_ylabel() for axes in lfm.plot_states(result, ["warm"]).axes] == ["probability"]
    assert len(lfm.plot_states(result, ["isotopes"]).axes) == 1
