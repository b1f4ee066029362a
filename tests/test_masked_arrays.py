"""Masked entries are missing data wherever observations enter, and never the numbers under the mask."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.utils import checks

TIMES = np.arange(12.0)
MODEL = lfm.LatentForceModel(
    lambda x, u, t: u - 0.3 * x, {"f": lfm.Matern(1.0, 3.0)},
    lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
CUBIC = lfm.LatentForceModel(
    lambda x, u, t: -x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
    lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.array([[0.5]]))


def masked(shape: tuple[int, ...] = (12, 1), dtype: type = float) -> np.ma.MaskedArray:
    """Return observations with -999 under the masked rows 3 to 5."""
    y = np.round(3 * np.sin(np.arange(np.prod(shape)).reshape(shape) / 5)).astype(dtype)
    y[..., 3:6, :] = -999
    return np.ma.masked_equal(y, -999)


def numpyro_model(times, y=None):
    rate = numpyro.sample("rate", dist.LogNormal(-1.0, 0.5))
    model = lfm.LatentForceModel(lambda x, u, t: u - rate * x, {"f": lfm.Matern(1.0, 3.0)},
                                 MODEL.observation, MODEL.initial_state)
    numpyro.sample("y", lfm.MarginalLikelihood(model, times), obs=y)


KEY = jax.random.key(0)
LIKELIHOOD = lfm.MarginalLikelihood(MODEL, TIMES)
USES = {
    "log_prob": LIKELIHOOD.log_prob,
    "filter": lambda y: lfm.filter(MODEL, TIMES, y).log_likelihood,
    "smooth": lambda y: lfm.smooth(MODEL, TIMES, y).mean,
    "bind": lambda y: lfm.bind(numpyro_model, TIMES, y).log_density(jnp.zeros(1)),
    "potential of NumPyro": lambda y: numpyro.infer.util.log_density(numpyro_model, (TIMES, y), {}, {"rate": 0.3})[0],
    "particle_filter": lambda y: lfm.particle_filter(KEY, CUBIC, TIMES, y, particles=50, steps=2).log_likelihood,
    "full_information": lambda y: lfm.full_information(MODEL, TIMES, y, lower={"f": -5.0}, grid=TIMES).force("f").mean,
    "Data": lambda y: lfm.Data(TIMES, y, ("x",)).y,
    "read_table": lambda y: lfm.read_table({"time": TIMES, "x": y[:, 0]}).y,
}


@pytest.mark.filterwarnings("ignore:.*-999, far from")
@pytest.mark.parametrize("use", USES.values(), ids=USES)
def test_a_masked_entry_is_nan(use):
    y = masked()
    np.testing.assert_array_equal(use(y), use(y.filled(np.nan)))


@pytest.mark.thorough
def test_whole_numbers_lists_and_panels_keep_their_mask():
    integers = masked(dtype=int)
    assert lfm.Data(TIMES, integers, ("x",)).y[2:7, 0].tolist()[1:4] == pytest.approx([np.nan] * 3, nan_ok=True)
    panel = lfm.panel(lambda level: lfm.LatentForceModel(
        lambda x, u, t: u - 0.3 * x, {"f": lfm.Matern(1.0, 3.0)}, MODEL.observation,
        lfm.Gaussian(level, jnp.eye(1))), jnp.zeros((2, 1)), TIMES)
    series = [masked(), masked()]
    expected = float(LIKELIHOOD.log_prob(masked().filled(np.nan)))
    np.testing.assert_allclose(panel.log_prob(np.ma.stack(series)), expected, rtol=1e-12)
    np.testing.assert_allclose(panel.log_prob(series), expected, rtol=1e-12)
    np.testing.assert_array_equal(checks.unmask([1.0, np.ma.masked]), [1.0, np.nan])
    np.testing.assert_array_equal(checks.unmask(np.ma.masked_array([1, 2], mask=False)), [1, 2])


def test_a_masked_time_is_refused():
    times = np.ma.masked_array([0.0, 1.0, 2.0], mask=[0, 1, 0])
    for use in (lambda: lfm.MarginalLikelihood(MODEL, times), lambda: lfm.Data(times, np.zeros((3, 1)), ("x",)),
                lambda: lfm.Input(times, np.zeros(3)), lambda: lfm.smooth(MODEL, TIMES, np.zeros((12, 1)), at=times)):
        with pytest.raises(ValueError, match=r"\[1\]"):
            use()
