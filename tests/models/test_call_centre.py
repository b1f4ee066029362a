"""The call centre: its queue against the fluid equation, its options, and what it refuses."""

import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.likelihoods.likelihood_site import likelihood_site


def model_module():
    """Return the module of the model file."""
    return sys.modules[loading.load("call-centre").model.__module__]


@pytest.mark.parametrize("link", ["linear", "softplus"])
def test_the_drift_is_that_of_the_fluid_equation(link):
    """In customers: dL/dt = (1 + L) dx/dt, without the bound on settling."""
    service = lfm.Input([0.0, 100.0], [10.0, 5.0])
    system = model_module().build(6.0, 2.0, 0.5, 200.0, 10.0, link=link, service=service, fastest=0.0)
    for customers, u, t, omega in ((0.2, 4.0, 10.0, 10.0), (30.0, 9.0, 150.0, 5.0), (2.0, -1.0, 100.0, 5.0)):
        slope = system.dynamics(jnp.log1p(jnp.array([customers])), jnp.array([u]), t)
        rate = np.log1p(np.exp(u)) if link == "softplus" else u
        assert (1 + customers) * slope[0] == pytest.approx(rate - omega * customers / (1 + customers))


def test_a_known_rate_gives_a_known_queue():
    """A force without variance: the mean is the solution, through overload and a change of the service rate."""
    m = model_module()
    service = lfm.Input([0.0, 300.0], [10.0, 5.0])
    system = m.build(7.0, 1e-6, 0.5, 200.0, force="matern", service=service, fastest=0.0)
    system = lfm.LatentForceModel(system.dynamics, system.forces, system.observation,
                                  lfm.Gaussian(jnp.log1p(jnp.ones(1)), jnp.zeros(1)))
    times = np.arange(0.0, 601.0, 20.0)
    result = lfm.filter(system, times, np.where(times[:, None] == 0.0, np.log(2.0), np.nan), steps=100)
    path = [1.0]
    for begin in times[:-1]:
        omega = 10.0 if begin < 300.0 else 5.0
        solution = integrate.solve_ivp(lambda t, x: 7.0 - omega * x / (1 + x), (0, 20.0), path[-1:],  # noqa: B023
                                       rtol=1e-10, atol=1e-10)
        path.append(solution.y[0, -1])
    np.testing.assert_allclose(np.expm1(result.predicted_mean[:, 0]), path, rtol=1e-4)


@pytest.mark.parametrize(("force", "variance"), [("cqm", 1.0), ("wqm", 1.2), ("periodic", 1.0), ("matern", 1.0),
                                                 ("resonator", 2.1)])
def test_every_force_has_the_covariance_that_is_said(force, variance):
    """At a distance of two cycles, and at one time: as shares of scale^2; eigenfunctions left out may miss a little."""
    m = model_module()
    values = {"mean": 6.0, "scale": 2.0, "lengthscale": 400.0, "memory": 10.0}
    values |= dict.fromkeys(set(values) - set(m.names(force)))
    result = m.arrivals(force, **values, period=840.0, functions=41 if force != "resonator" else 3, cycles=4)
    assert result.mean_at(0.0) == 6.0
    late, early = 1800.0, 120.0
    expected = {"cqm": np.exp(-0.2), "wqm": 1.0, "periodic": 1.0, "matern": np.exp(-4.2), "resonator": 2.0}[force]
    spread = {"resonator": 2.0 + late / 8400.0 / 2.0}.get(force, variance)
    assert result.covariance(late, late) / 4.0 == pytest.approx(spread, abs=0.05)
    assert result.covariance(late, early) / 4.0 == pytest.approx(expected, abs=0.05)
    assert len(result.jump_times) == (3 if force == "wqm" else 0)


@pytest.mark.slow
def test_steps_of_two_minutes_are_short_enough():
    m, data = model_module(), loading.load("call-centre").simulate()
    values = {name: m.TRUTH[name] for name in m.names("matern")}
    system = m.build(**values, force="matern")
    coarse, fine = (float(lfm.MarginalLikelihood(system, data.times, steps=steps).log_prob(data.y))
                    for steps in (m.STEPS, 5 * m.STEPS))
    assert coarse == pytest.approx(fine, abs=0.02)


def test_readings_become_logarithms():
    file = loading.load("call-centre")
    data = lfm.Data([0.0, 1.0, 2.0], [[3.0], [-0.4], [np.nan]], ("queue",))
    prepared = file.prepare(data)
    np.testing.assert_allclose(prepared.y[:, 0], [np.log(4.0), 0.0, np.nan])
    assert prepared.outputs == ("log queue",) and "log(1 + queue)" in prepared.note
    with pytest.raises(ValueError, match="queue"):
        file.prepare(lfm.Data([0.0], [[3.0]], ("length",)))


def test_impossible_rates_and_periods_are_refused_and_overloads_warned_of():
    m, file = model_module(), loading.load("call-centre")
    values = dict(mean=6.0, scale=2.0, noise_sd=0.5, lengthscale=100.0, memory=10.0)
    for options, name in (({"service": -5.0}, "service rate"),
                          ({"service": lfm.Input([0.0, 1.0], [10.0, -1.0])}, "rate"),
                          ({"period": 0.0}, "period"), ({"force": "sqn"}, "force"), ({"link": "exp"}, "link")):
        with pytest.raises(ValueError, match=name):
            m.build(**values, **options)
    for end, options, name in ((2000.0, {"service": 0.0}, "zero"), (801.0, {}, "period"),
                               (801.0, {"period": -840.0}, "period")):
        with pytest.raises(ValueError, match=name):
            likelihood_site(file.model, (np.arange(0.0, end, 40.0),), options, jax.random.key(0))
    times = np.arange(0.0, 200.0, 4.0)
    with pytest.warns(UserWarning, match="96 min"):
        m._warn_overload(times, np.where(times < 98.0, 11.0, 5.0), 10.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        m._warn_overload(times, np.where(times < 50.0, 11.0, 5.0), 10.0)
