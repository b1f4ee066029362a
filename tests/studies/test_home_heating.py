"""Home heating study: data, small runs of every part, tables and figures."""

import jax
import numpy as np
import pytest

from lfm_ppl.studies.home_heating import prediction, problem
from lfm_ppl.studies.home_heating.problem import Model

REAL = problem.data_folder()


@pytest.fixture(scope="module")
def window():
    """A simulated home."""
    return problem.home(0, "one store")


@pytest.mark.skipif(REAL is None, reason="needs ../shared/data/house")
def test_the_real_house_has_29_windows():
    windows = problem.house(str(REAL))
    assert len(windows) == 29
    np.testing.assert_array_equal(windows[0].y[24:], windows[1].y[:96])
    assert all(np.isfinite(window.y).all() and window.set_points is None for window in windows)
    assert 0.5 < max(window.y[:, 2].max() for window in windows) < 2.0


@pytest.mark.parametrize(("text", "message"), [
    (",Ti,Ta\n2020-01-01 00:00,1,1\n", "'Ph'"),
    (",Ti,Ta,Ph\n2020-01-01 00:00,1,1,1\n2020-01-01 02:00,1,1,1\n", "a row an hour"),
    (",Ti,Ta,Ph\n2020-01-01 00:00,1,1,1\n2020-01-01 01:00,1,1,1\n", "five whole days")])
def test_invalid_files(tmp_path, text, message):
    (tmp_path / problem.FILE).write_text(text)
    with pytest.raises(ValueError, match=message):
        problem.house(str(tmp_path))


@pytest.mark.slow
def test_nuts_and_ram_have_the_same_posterior(window):
    model = Model("none", "one store", 3)
    z, _ = prediction.find_mode(model, window)
    nuts = prediction.posterior("NUTS", model, window, z, jax.random.key(0), (2, 300, 700))
    ram = prediction.posterior("RAM", model, window, z, jax.random.key(1), (4, 1000, 4000))
    assert nuts["divergences"] == 0 and max(nuts["r_hat"].max(), ram["r_hat"].max()) < 1.03
    error = np.sqrt(1 / nuts["ess"] + 1 / ram["ess"])
    assert (np.abs(nuts["mean"] - ram["mean"]) < 4 * error * nuts["sd"]).all()
    np.testing.assert_allclose(nuts["sd"], ram["sd"], rtol=4 * error.max())
