"""The home: its equations against an ODE solver, its residuals, and what it says about a mistake."""

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.likelihoods.likelihood_site import likelihood_site

FILE = loading.load("home-heating")
TIMES = np.arange(0.0, 13.0)
HEATER = np.array([0, 1, 1, 0, 0.5, 0, 0, 1, 1, 1, 0, 0, 0.0])
RATES = {"alpha": 0.3, "beta": 2.0, "noise_sd": 0.1, "outdoor_mean": 4.0, "outdoor_scale": 2.0,
         "outdoor_lengthscale": 5.0}
HYPER = {"scale": 0.2, "lengthscale": 0.5, "memory": 3.0, "period": 24.0, "noise": 0.05, "damping": 0.02,
         "gamma": 0.1, "psi": 0.07}


def system(times=TIMES, heater=HEATER, **options):
    """Return the model with known parameters."""
    inputs = {"heater": lfm.Input(times, np.resize(heater, len(times)))}
    return likelihood_site(FILE.model, (times, np.full((len(times), 2), np.nan)), {**options, "inputs": inputs},
                           jax.random.key(0), RATES | HYPER).example.model


@pytest.mark.parametrize("envelope", [False, True], ids=["one store", "envelope"])
def test_the_expected_temperatures_solve_the_equations(envelope):
    """Without residual, and the temperature outside at its mean, equations 73, or 74 and 75 of the source."""
    model = system(residual="none", envelope=envelope)
    y = np.full((13, 2), np.nan)
    y[0] = [18.0, 4.0]  # what is expected at the start
    result = np.asarray(lfm.filter(model, TIMES, y, steps=5).predicted_mean)

    def slope(t, x):
        heater = HEATER[min(int(t), 12)]
        if not envelope:
            return [0.3 * (4.0 - x[0]) + 2.0 * heater]
        return [0.3 * (x[1] - x[0]) + 2.0 * heater, 0.1 * (x[0] - x[1]) + 0.07 * (4.0 - x[1])]

    size = 2 if envelope else 1
    state = np.array([18.0, 15.0][:size])
    for hour in range(12):
        state = solve_ivp(slope, (hour, hour + 1 - 1e-9), state, rtol=1e-10, atol=1e-10).y[:, -1]
        np.testing.assert_allclose(result[hour + 1, :size], state, rtol=1e-6)


@pytest.mark.parametrize(("residual", "states", "jumps"), [
    ("SQM", 5, (24.0, 48.0, 72.0, 96.0)), ("WQM", 5, (24.0, 48.0, 72.0, 96.0)), ("CQM", 5, ()), ("periodic", 5, ()),
    ("matern", 1, ()), ("resonator", 9, ()), ("none", 0, ())])
def test_residuals_are_what_they_are_called(residual, states, jumps):
    """Over two days; the midnights of two more days belong to a forecast."""
    model = system(np.arange(49.0), residual=residual)
    assert model.force_names == (("weather", "residual") if states else ("weather",))
    if not states:
        return
    force = model.forces["residual"]
    assert (force.state_dim, force.jump_times) == (states, jumps)
    if residual in ("periodic", "CQM"):
        fade = 1.0 if residual == "periodic" else np.exp(-1.0 / 3.0)
        assert float(force.covariance(30.0, 6.0)) == pytest.approx(0.04 * fade)  # exactly one day later


def test_the_outdoor_process_is_read_off_its_measurements():
    """A long path of a Matern-3/2 process, drawn with its dense covariance."""
    times = 0.5 * np.arange(1200)
    lag = np.sqrt(3.0) * np.abs(times[:, None] - times) / 10.0
    root = np.linalg.cholesky(9.0 * (1.0 + lag) * np.exp(-lag) + 1e-10 * np.eye(len(times)))
    outdoor = 6.0 + root @ np.random.default_rng(0).normal(size=len(times))
    outdoor[100:110] = np.nan
    data = lfm.Data(times, np.column_stack([outdoor, outdoor]), FILE.outputs)
    result = FILE.anchors(data)
    # 600 hours hold some 30 independent values.
    assert result["outdoor_mean"] == pytest.approx(6.0, abs=4 * 3.0 / np.sqrt(30))
    assert result["outdoor_scale"] == pytest.approx(3.0, rel=4 / np.sqrt(60))
    assert result["outdoor_lengthscale"] == pytest.approx(10.0, rel=0.3)


@pytest.mark.slow
def test_the_default_home_keeps_to_its_set_points():
    data = FILE.simulate()
    hour = data.times % 24
    day, night = (hour >= 12) & (hour < 22), (hour >= 3) & (hour < 6)
    assert abs(np.nanmean(data.y[day, 0]) - 20.0) < 0.5 and abs(np.nanmean(data.y[night, 0]) - 16.0) < 0.5
    assert set(np.round(6 * data.inputs["heater"].values, 6)) <= set(range(7))


def test_homes_without_a_heater_or_with_an_unknown_residual_are_refused():
    times = np.arange(3.0)
    data = lfm.Data(times, np.ones((3, 2)), FILE.outputs, inputs={"heater": (times, 0.5 * np.ones(3))})
    with pytest.raises(ValueError, match="0.5 all the time"):
        FILE.prepare(data)
    with pytest.raises(ValueError, match="'heater'"):
        FILE.keywords(lfm.Data(times, np.ones((3, 2)), FILE.outputs), {})
    with pytest.raises(ValueError, match="residual"):
        system(residual="monthly")
