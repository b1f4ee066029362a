"""Gravity, Sun, Moon, tide and shadow against potentials, quadrature and pyerfa."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import lpmv

from lfm_ppl import orbits
from lfm_ppl.orbits import bodies, earth, geopotential, times
from lfm_ppl.orbits.table import TimeTable

erfa = pytest.importorskip("erfa", reason="needs the extra gps")

EPOCH = orbits.gps_seconds(2019, 4, 7)
PLACES = np.array([[7000.0, 0.0, 100.0], [-15_000.0, 12_000.0, 18_000.0], [10.0, 20.0, 26_560.0]])
SUN, MOON = np.array([1.45e8, 3.1e7, 1.3e7]), np.array([2.1e5, 3.0e5, 1.1e5])


ACCELERATION = jax.jit(geopotential.acceleration, static_argnums=1)


def gradient(potential, r, h=1.0):
    """Central differences of order four."""
    total = np.zeros(3)
    for axis in range(3):
        unit = h * np.eye(3)[axis]
        inner_difference = potential(r + unit) - potential(r - unit)
        outer_difference = potential(r + 2 * unit) - potential(r - 2 * unit)
        total[axis] = (8 * inner_difference - outer_difference) / (12 * h)
    return total


def potential(r, degree):
    """The potential by Legendre functions in latitude and longitude."""
    c, s = geopotential.coefficients()
    radius, longitude = np.linalg.norm(r), np.arctan2(r[1], r[0])
    return geopotential.GM / radius * sum(
        (geopotential.RADIUS / radius) ** n * (-1) ** m * lpmv(m, n, r[2] / radius)
        * (c[n, m] * np.cos(m * longitude) + s[n, m] * np.sin(m * longitude))
        for n in range(degree + 1) for m in range(n + 1))


@pytest.mark.parametrize("degree", [0, 8])
def test_gravity_is_the_gradient_of_the_potential(degree):
    for r in PLACES:
        result = np.asarray(ACCELERATION(r, degree))
        expected = gradient(lambda p: potential(p, degree), r)
        assert np.abs(result - expected).max() < 1e-8 * np.linalg.norm(expected)
        if degree == 0:
            np.testing.assert_allclose(result, -geopotential.GM * r / np.linalg.norm(r) ** 3, rtol=1e-14)


def test_gravity_has_a_gradient_at_the_pole():
    jacobian = jax.jacfwd(geopotential.acceleration)(jnp.array([0.0, 0.0, 7000.0]))
    assert np.isfinite(jacobian).all() and abs(np.trace(jacobian)) < 1e-12  # Laplace's equation
    with pytest.raises(ValueError, match="degree"):
        geopotential.acceleration(jnp.ones(3), 9)


def test_a_body_pulls_the_satellite_more_than_the_earth():
    attraction = jax.jit(bodies.attraction)
    for r, body in itertools.product(PLACES, (SUN, MOON)):
        wide = [np.array(a, np.longdouble) for a in (r, body)]
        separation = wide[1] - wide[0]
        expected = separation / np.sqrt((separation**2).sum()) ** 3 - wide[1] / np.sqrt((wide[1] ** 2).sum()) ** 3
        np.testing.assert_allclose(attraction(r, body, 1.0), expected.astype(float), rtol=1e-11,
                                   atol=1e-14 * float(np.abs(expected).max()))


def test_the_tide_is_the_gradient_of_its_potential():
    """k2 GM/s^3 R^5/r^3 P2(cos theta)."""
    distance = np.linalg.norm(MOON)

    def raised(p):
        cosine = p @ MOON / np.linalg.norm(p) / distance
        return (bodies.LOVE_NUMBER * bodies.GM_MOON * geopotential.RADIUS**5 / distance**3
                / np.linalg.norm(p) ** 3 * (1.5 * cosine**2 - 0.5))

    tide = jax.jit(bodies.solid_tide)
    for r in PLACES:
        result = np.asarray(tide(r, MOON, bodies.GM_MOON))
        np.testing.assert_allclose(result, gradient(raised, r), rtol=1e-6, atol=1e-8 * np.abs(result).max())


def test_sunlight_is_the_visible_part_of_the_disc():
    """Counted on the sky: points of the Sun's disc outside the Earth's. The limb is not quite straight."""
    u, v = np.meshgrid(np.linspace(-1, 1, 401), np.linspace(-1, 1, 401))
    disc = np.hypot(u, v) < 1
    sun = np.array([1.496e8, 0.0, 0.0])
    # Behind the Earth, on a circle of 26,560 km, through the whole penumbra.
    angles = np.linspace(0.2355, 0.2495, 57)
    positions = 26_560.0 * np.stack([-np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    result, expected = np.asarray(jax.jit(jax.vmap(bodies.sunlight, (0, None)))(positions, sun)), []
    for r in positions:
        to_sun, to_earth = sun - r, -r
        between = np.arccos(to_sun @ to_earth / np.linalg.norm(to_sun) / np.linalg.norm(to_earth))
        a, b = np.arcsin(bodies.SUN_RADIUS / np.linalg.norm(to_sun)), np.arcsin(geopotential.RADIUS / 26_560.0)
        seen = np.hypot(between + a * u, a * v) > b
        expected.append((disc & seen).sum() / disc.sum())
    assert result[0] == 0.0 and result[-1] == 1.0 and np.all(np.diff(result) >= 0)
    assert np.abs(result - expected).max() < 0.01
    assert float(bodies.sunlight(jnp.array([26_560.0, 0.0, 0.0]), jnp.asarray(sun))) == 1.0
    slopes = jax.vmap(jax.grad(lambda a: bodies.sunlight(26_560.0 * jnp.array([-jnp.cos(a), jnp.sin(a), 0.0]), sun)))
    assert np.isfinite(jax.jit(slopes)(angles)).all()


def test_axes_are_orthogonal_and_right_handed():
    r, v = jnp.asarray(PLACES[1]), jnp.array([3.0, 8000.0, -2000.0])
    for axes in (orbits.rtn(r, v), orbits.dyb(r, jnp.asarray(SUN))):
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-14)
        assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(orbits.rtn(r, v)[:, 0], r / np.linalg.norm(r))
    # Sun, Earth and satellite in a line: nothing to turn about, and nothing that is not finite.
    aligned = jax.jacfwd(lambda p: orbits.dyb(p, jnp.asarray(SUN)))(-1e-4 * jnp.asarray(SUN))
    assert np.isfinite(aligned).all()


def test_earth_rotation_equals_pyerfa():
    rotation = earth.EarthRotation.over(EPOCH, 240.0)
    turn = jax.jit(lambda t: rotation(t))
    for hours in np.random.default_rng(0).uniform(0.0, 240.0, 20):
        seconds = np.array([EPOCH + 3600.0 * hours])
        orientation, tt = earth.orientation(seconds), times.terrestrial(seconds)
        x, y, s = erfa.xys06a(*tt)
        ut1 = erfa.utcut1(*times.utc(seconds), orientation.ut1_minus_utc)
        expected = erfa.c2tcio(erfa.c2ixys(x + orientation.dx, y + orientation.dy, s), erfa.era00(*ut1),
                               erfa.pom00(orientation.x, orientation.y, erfa.sp00(*tt)))[0]
        assert 26_560e3 * np.abs(turn(hours) - expected).max() < 1e-3  # metres; 5 cm are asked for


def test_earth_orientation_is_that_of_the_iers():
    """Bulletin values of 7 April 2019, 0 h UTC, which is 18 s of GPS time later."""
    result = earth.orientation(np.array([EPOCH + 18.0]))
    assert result.ut1_minus_utc[0] == pytest.approx(-0.1263186, abs=1e-6)
    arcsecond = np.pi / 180 / 3600
    assert result.x[0] / arcsecond == pytest.approx(0.051831, abs=1e-5)
    assert result.y[0] / arcsecond == pytest.approx(0.391315, abs=1e-5)
    with pytest.raises(ValueError, match="MJD"), pytest.warns(Warning, match="dubious"):
        earth.orientation(np.array([orbits.gps_seconds(2150, 1, 1)]))


def test_utc_jumps_and_ut1_does_not():
    """Through the leap second at the end of 2016, UT1 goes on smoothly in GPS time."""
    seconds = orbits.gps_seconds(2017, 1, 1) + np.array([-7200.0, 0.0, 17.0, 18.0, 7200.0])
    result = earth.orientation(seconds)
    first, second = times.utc(seconds)
    ut1 = sum(erfa.utcut1(first, second, result.ut1_minus_utc)) - times.GPS_START - 13_510.0
    offset = (ut1 - (seconds - orbits.gps_seconds(2017, 1, 1)) / 86_400.0) * 86_400.0
    assert np.ptp(offset) < 1e-3 and result.ut1_minus_utc[-1] - result.ut1_minus_utc[0] == pytest.approx(1.0, abs=1e-3)


def test_gps_time_is_not_utc():
    """Taken as UTC, the same clock reading turns the Earth 18 s further: 35 km at a GPS satellite."""
    right = earth.EarthRotation.over(EPOCH, 6.0)
    wrong = earth.EarthRotation.over(EPOCH + 18.0, 6.0)
    over_the_equator = np.asarray(right(1.0)).T @ np.array([26_560.0, 0.0, 0.0])
    moved = np.linalg.norm((np.asarray(right(1.0)) - np.asarray(wrong(1.0))) @ over_the_equator)
    assert moved == pytest.approx(26_560.0 * 18.0 * 2 * np.pi / 86_164.1, rel=1e-3)
    leap = times.TAI_MINUS_GPS - np.array(erfa.dat(2019, 4, 7, 0.0))
    assert leap == -18.0
    first, second = times.utc(np.array([EPOCH]))
    assert ((first - 2_458_580.5) + second)[0] * 86_400.0 == pytest.approx(-18.0, abs=1e-4)


def test_sun_and_moon_follow_their_tables():
    table = bodies.positions(EPOCH, 48.0)
    for hours in (0.3, 17.77, 47.9):
        tt = times.terrestrial(np.array([EPOCH + 3600.0 * hours]))
        sun, moon = np.split(np.asarray(table(hours)), 2)
        assert np.linalg.norm(sun + bodies.ASTRONOMICAL_UNIT * erfa.epv00(*tt)[0]["p"][0]) < 1e-3
        assert np.linalg.norm(moon - bodies.ASTRONOMICAL_UNIT * erfa.moon98(*tt)["p"][0]) < 1e-3


def test_a_table_is_exact_for_cubics_and_refuses_nonsense():
    nodes = np.arange(6.0)
    table = TimeTable(0.0, 1.0, np.stack([nodes**3, nodes], axis=1))
    for t in (0.0, 0.4, 2.5, 4.9, 5.0):
        np.testing.assert_allclose(table(t), [t**3, t], atol=1e-12)
    for values in (np.zeros((3, 1)), np.full((5, 1), np.nan)):
        with pytest.raises(ValueError, match="table"):
            TimeTable(0.0, 1.0, values)
