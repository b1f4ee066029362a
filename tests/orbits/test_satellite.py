"""Orbits without unknown forces, and the satellite as a latent force model."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl import orbits
from lfm_ppl.model.state_space import state_space
from lfm_ppl.orbits import deviations, geopotential
from lfm_ppl.orbits.environment import PER_HOUR2

pytest.importorskip("erfa", reason="needs the extra gps")

EPOCH = orbits.gps_seconds(2019, 4, 7)
START = np.array([26_560.0, 0.0, 0.0, 0.0, 8_000.0, 11_425.0])
TIMES = 0.25 * np.arange(97)


@pytest.fixture(scope="session")
def around():
    return orbits.Environment.over(EPOCH, 48.0)


def kepler(state, hours, gm):
    """The two-body orbit after some hours, by Kepler's equation."""
    r, v = state[:3], state[3:]
    energy = v @ v / 2 - gm / np.linalg.norm(r)
    a = -gm / (2 * energy)
    n = np.sqrt(gm / a**3)
    e_cos, e_sin = 1 - np.linalg.norm(r) / a, r @ v / np.sqrt(gm * a)
    change = n * hours
    for _ in range(50):
        residual = change - e_cos * np.sin(change) + e_sin * (1 - np.cos(change)) - n * hours
        change -= residual / (1 - e_cos * np.cos(change) + e_sin * np.sin(change))
    f = 1 - a / np.linalg.norm(r) * (1 - np.cos(change))
    g = hours - (change - np.sin(change)) / n
    return f * r + g * v


def test_the_two_body_limit_is_an_ellipse():
    alone = orbits.Environment.over(EPOCH, 24.0, degree=0, bodies=False)
    path = orbits.propagate(alone, orbits.Orbit(0.0, START, 0.0, 0.0), TIMES)
    gm = geopotential.GM * PER_HOUR2
    for index in (40, 96):
        assert np.linalg.norm(path[index, :3] - kepler(START, TIMES[index], gm)) < 5e-6  # km
    energy = (path[:, 3:] ** 2).sum(1) / 2 - gm / np.linalg.norm(path[:, :3], axis=1)
    assert np.abs(energy / energy[0] - 1).max() < 1e-12


@pytest.mark.slow
def test_energy_in_the_turning_field_is_conserved():
    """Jacobi's integral v^2/2 - U - omega . (r x v), for a field that turns evenly about a fixed axis."""
    field = orbits.Environment.over(EPOCH, 24.0, bodies=False)
    path = orbits.propagate(field, orbits.Orbit(0.0, START, 0.0, 0.0), TIMES)
    turns = np.asarray(jax.vmap(lambda t: field.rotation(t))(TIMES))

    def work(r, degree):
        """U by integrating the pull from far away along the radius."""
        nodes, weights = np.polynomial.legendre.leggauss(40)
        s = 0.5 * (nodes + 1)  # r' = r / s, s from 0 to 1
        pull = jax.vmap(lambda q: geopotential.acceleration(q, degree))(jnp.asarray(r[None] / s[:, None]))
        return -(0.5 * weights * (np.asarray(pull) @ r) / s**2).sum()

    potential = PER_HOUR2 * np.array([work(turn @ r, 8) for turn, r in zip(turns, path[:, :3], strict=True)])
    axis = turns[48].T @ np.array([0.0, 0.0, 1.0])
    rate = 2 * np.pi * 1.00273781191135448 / 24.0
    jacobi = (path[:, 3:] ** 2).sum(1) / 2 - potential - rate * np.cross(path[:, :3], path[:, 3:]) @ axis
    point = (path[:, 3:] ** 2).sum(1) / 2 - PER_HOUR2 * geopotential.GM / np.linalg.norm(path[:, :3], axis=1)
    assert np.ptp(jacobi) < 1e-3 * np.ptp(point)


@pytest.mark.slow
def test_halved_steps_change_nothing(around, monkeypatch):
    orbit = orbits.Orbit(0.0, START, 100.0, 0.0)
    path = orbits.propagate(around, orbit, TIMES)
    monkeypatch.setattr("lfm_ppl.orbits.deterministic.STEP", 1 / 240)
    finer = orbits.propagate(around, orbit, TIMES)
    assert np.linalg.norm((path - finer)[-1, :3]) < 1e-5  # km, after a day


@pytest.mark.thorough
def test_an_orbit_is_found_again(around):
    """Noise of 1 cm, gaps, and an unknown amplitude of the sunlight."""
    orbit = orbits.Orbit(0.0, START, 93.0, 0.0)
    truth = orbits.propagate(around, orbit, TIMES)
    y = truth[:, :3] + 1e-5 * np.random.default_rng(0).normal(size=(97, 3))
    y[[12, 40, 41]] = np.nan
    result = orbits.fit_orbit(around, TIMES, y)
    assert abs(result.solar - 93.0) < 0.2 and np.abs(result.state - START)[:3].max() < 3e-5
    assert result.residual == pytest.approx(1e-5 * np.sqrt(3), rel=0.2)
    row = np.arange(97)[:, None]
    for times, positions in ((TIMES**2, y), (TIMES[:1], y[:1]), (TIMES, np.where(row < 5, y, np.nan)),
                             (TIMES, np.where(row > 60, y, np.nan))):
        with pytest.raises(ValueError):
            orbits.fit_orbit(around, times, positions)
    with pytest.raises(ValueError):
        orbits.propagate(around, orbit, TIMES + 1.0)


@pytest.mark.parametrize(("axes", "states"), [("DYB", 33), pytest.param("RTN", 58, marks=pytest.mark.slow)])
def test_points_are_placed_in_position_and_velocity_alone(around, axes, states):
    """At most twelve points, whatever the number of states."""
    start = lfm.Gaussian(jnp.asarray(START), 1e-2 * jnp.eye(6))
    ssm = state_space(orbits.satellite(around, start, orbits.small_forces(axes), axes, white=0.1))
    assert ssm.state_dim == states
    expected = (0, 1, 2) if axes == "DYB" else (0, 1, 2, 3, 4, 5)
    assert tuple(ssm.drift_structure.nonlinear) == expected


@pytest.mark.parametrize(("axes", "turns"), [("DYB", 1), ("RTN", 2)])
def test_resonators_have_multiples_of_the_frequency_of_the_orbit_or_of_half_of_it(axes, turns):
    for force, (name, multiples) in zip(orbits.small_forces(axes, period=14.08).values(),
                                        orbits.HARMONICS[axes].items() if axes == "DYB"
                                        else [("solar", ()), *orbits.HARMONICS[axes].items()], strict=True):
        periods = [float(part.period) for part in getattr(force, "forces", ()) if hasattr(part, "period")]
        np.testing.assert_allclose(periods, [turns * 14.08 / n for n in multiples], err_msg=name)


def test_the_period_of_an_orbit_is_that_of_kepler_along_an_ellipse_too():
    axis, eccentricity, gm = 29_600.0, 0.16, orbits.GM * 3600.0**2
    anomaly = np.linspace(0.0, 6.0, 50)
    rate = np.sqrt(gm / axis**3) / (1 - eccentricity * np.cos(anomaly))
    path = np.zeros((50, 6))
    path[:, 0], path[:, 3] = axis * (np.cos(anomaly) - eccentricity), -axis * np.sin(anomaly) * rate
    minor = axis * np.sqrt(1 - eccentricity**2)
    path[:, 1], path[:, 4] = minor * np.sin(anomaly), minor * np.cos(anomaly) * rate
    assert float(orbits.period_of(path)) == pytest.approx(2 * np.pi * np.sqrt(axis**3 / gm), rel=1e-12)
    assert float(orbits.period_of(path)) == pytest.approx(14.08, abs=0.01)  # as Galileo's
    for wrong in (path[0], 2.0 * path):
        with pytest.raises(ValueError):
            orbits.period_of(wrong)


@pytest.mark.thorough
def test_any_force_can_act_on_a_satellite(around):
    start = lfm.Gaussian(jnp.asarray(START), jnp.eye(6))
    with pytest.raises(ValueError, match="axes"):
        orbits.small_forces("XYZ")
    with pytest.raises(ValueError, match="3"):
        orbits.satellite(around, start, {"solar": lfm.Constant(1.0)})
    forces = dict.fromkeys(("solar", "panel", "remaining"), lfm.Matern(1.0, 3.0))
    assert orbits.satellite(around, start, forces).force_names == ("solar", "panel", "remaining")


def test_start_of_an_orbit_from_positions(around):
    truth = orbits.propagate(around, orbits.Orbit(0.0, START, 100.0, 0.0), TIMES)
    result = orbits.start_near(TIMES, truth[:, :3])
    assert np.abs(result.mean - START)[:3].max() < 1e-9 and np.abs(result.mean - START)[3:].max() < 1e-3
    holes = truth[:, :3].copy()
    holes[[2, 5]] = np.nan
    error = np.abs(orbits.start_near(TIMES, holes).mean - START)
    assert error[:3].max() < 1e-9 and error[3:].max() < 0.1 * orbits.START_SD[1]
    for missing in ([0], [2, 3, 4, 5, 6]):
        holes = truth[:, :3].copy()
        holes[missing] = np.nan
        with pytest.raises(ValueError):
            orbits.start_near(TIMES, holes)


@pytest.mark.slow
def test_departures_follow_two_orbits_that_differ_a_little(around):
    """The linear model against the difference of two paths, whose start and sunlight differ."""
    first = orbits.Orbit(0.0, START, 100.0, 0.0)
    change = np.array([2e-3, -1e-3, 3e-3, 1e-3, -2e-3, 1e-3])
    second = orbits.propagate(around, orbits.Orbit(0.0, START + change, 102.0, 0.0), TIMES)
    neighbourhood = orbits.Neighbourhood.of(around, first, TIMES, nodes=8)
    forces = {"solar": lfm.Constant(1e-9, mean=102.0), "panel": lfm.Constant(1e-9), "remaining": lfm.Constant(1e-9)}
    model = orbits.departure(neighbourhood, forces, start=lfm.Gaussian(jnp.asarray(change), jnp.zeros((6, 6))))
    nothing = np.full((len(TIMES), 3), np.nan)
    nothing[0] = change[:3]
    result = lfm.filter(model, TIMES, nothing, rule=lfm.Taylor(), steps=4).filtered_mean[:, :6]
    apart = second - np.asarray(neighbourhood.path)
    assert np.abs(result - apart).max() < 1e-4 * np.abs(apart).max()


def test_the_table_of_a_neighbourhood_holds_means():
    """Sums of samples through a jump are right, wherever it is, and polynomials of degree three are left alone."""
    finer, nodes = 8, 30
    t = np.arange(finer * nodes + 1) / finer
    smooth = np.stack([t**k for k in range(4)], axis=1) / 30.0 ** np.arange(4)
    np.testing.assert_allclose(deviations._means(smooth, finer), smooth[::finer], atol=1e-13)
    weights = np.where(np.arange(nodes + 1) % 2, 4.0, 2.0) / 3.0  # Simpson's rule: Runge-Kutta's for a pure integral
    weights[[0, -1]] = 1 / 3
    for edge in np.linspace(10.0, 12.0, 17):
        jump = (t[:, None] >= edge).astype(float)
        expected = 0.5 * (jump[1:] + jump[:-1]).sum() / finer
        assert weights @ deviations._means(jump, finer)[:, 0] == pytest.approx(expected, abs=1e-12)
    plain = [weights @ (t[::finer] >= edge) - (30.0 - edge) for edge in np.linspace(10.0, 12.0, 17)]
    assert np.abs(plain).max() > 0.6
    few = np.arange(3.0 * finer + 1)[:, None]  # nothing is averaged in a table as short as this
    np.testing.assert_array_equal(deviations._means(few, finer), few[::finer])


def test_small_forces_take_one_magnitude_for_each_oscillation():
    forces = orbits.small_forces("DYB", {name: [1.0, 2.0, 3.0, 4.0] for name in ("solar", "panel", "remaining")},
                                 {name: [0.1] * 4 for name in ("solar", "panel", "remaining")},
                                 {"solar": 0.1, "panel": 0.2, "remaining": 0.3},
                                 {"solar": 10.0, "panel": 1.0, "remaining": 2.0})
    assert [float(force.scale) for force in forces["panel"].forces] == pytest.approx([0.2, 1.0, 2.0, 3.0, 4.0])
    assert float(forces["remaining"].forces[0].initial_sd) == 2.0
