"""Learning how large the small forces are, and predicting with them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl import orbits
from lfm_ppl.orbits import learning, magnitudes, prediction, training
from lfm_ppl.orbits.arc import NOISE, Arc
from lfm_ppl.orbits.table import TimeTable
from lfm_ppl.studies.gps import problem


def test_common_magnitudes_are_the_mean_and_the_scatter_of_the_satellites():
    several = [np.full(21, value) for value in (-2.0, -1.0, 0.0, 1.0, 2.0)]
    mean, sd = magnitudes.common(several, "DYB")
    assert np.allclose(mean, 0.0) and np.allclose(sd, np.sqrt(2.0))
    assert np.allclose(magnitudes.common([np.zeros(21)] * 5, "DYB").sd, 0.5)
    assert magnitudes.common(several[:4], "DYB").mean is not mean and np.allclose(
        magnitudes.common(several[:4], "DYB").mean, magnitudes.wide("DYB").mean)


@pytest.mark.thorough
@pytest.mark.parametrize(("axes", "size", "states"), [("DYB", 21, 27), ("RTN", 34, 1 + 15 + 15 + 21)])
def test_magnitudes_become_forces(axes, size, states):
    names = magnitudes.names(axes)
    assert len(names) == size == len(set(names))
    vector = np.log(np.arange(1.0, size + 1))
    forces, white = magnitudes.forces(vector, axes, orbits.GPS_PERIOD)
    assert sum(force.state_dim for force in forces.values()) == states and float(white) == pytest.approx(size)
    force = forces["panel" if axes == "DYB" else "radial"]
    value = dict(zip(names, np.exp(vector), strict=True))
    name = "panel" if axes == "DYB" else "radial"
    level, first = force.forces[0], force.forces[1]
    assert float(level.initial_sd) == pytest.approx(value[f"level of {name}"])
    assert float(level.scale) == pytest.approx(value[f"drift of {name}"])
    assert float(first.scale) == pytest.approx(value[f"amplitude of {name} 1"])
    assert float(first.noise) == pytest.approx(value[f"amplitude of {name} 1"]
                                               * value[f"wander of {name} over amplitude"])


def test_target_of_a_normal_evidence_has_its_mode_and_its_covariance():
    centre, precision = np.array([1.0, -2.0]), np.array([[4.0, 1.0], [1.0, 3.0]])
    prior = magnitudes.Prior(np.array([0.5, 0.5]), np.array([2.0, 0.5]))

    def evidence(z):
        return -0.5 * (z - centre) @ precision @ (z - centre), -precision @ (z - centre)

    target = learning.Target(evidence, prior)
    total = precision + np.diag(prior.sd**-2)
    mode = np.linalg.solve(total, precision @ centre + prior.mean / prior.sd**2)
    assert target.mode() == pytest.approx(mode, abs=1e-5)
    draws = target.draws(mode, 20_000)
    covariance = np.linalg.inv(total)
    # The standard error of a variance is sqrt(2/N) of it.
    assert np.abs(np.cov(draws.T) - covariance).max() < 4 * np.sqrt(2 / 20_000) * covariance.max()
    assert np.abs(draws.mean(axis=0) - mode).max() < 4 * np.sqrt(covariance.max() / 20_000)


def test_where_positions_say_nothing_the_prior_is_left():
    prior = magnitudes.Prior(np.array([0.5, -1.0]), np.array([2.0, 0.5]))
    target = learning.Target(lambda z: (0.0, np.zeros(2)), prior)
    assert target.mode() == pytest.approx(prior.mean)
    assert np.cov(target.draws(prior.mean, 20_000).T) == pytest.approx(np.diag(prior.sd**2), abs=0.16)


@pytest.mark.thorough
def test_a_breakdown_turns_the_search_back():
    def evidence(z):
        value = -0.5 * float(z @ z) if z[0] > -1.0 else np.nan
        return value, -z
    target = learning.Target(evidence, magnitudes.Prior(np.array([4.0]), np.array([100.0])))
    assert target.mode() == pytest.approx([0.0], abs=1e-2)


def test_log_density_of_errors():
    random = np.random.default_rng(0)
    root = random.normal(size=(5, 3, 3))
    error, covariance = random.normal(size=(5, 3)), root @ root.transpose(0, 2, 1)
    expected = [stats.multivariate_normal.logpdf(e, cov=c + NOISE**2 * np.eye(3))
                for e, c in zip(error, covariance, strict=True)]
    assert np.asarray(training.log_density(error, covariance)) == pytest.approx(np.array(expected), rel=1e-10)


def test_a_search_that_starts_where_there_is_no_density_says_so():
    target = learning.Target(lambda z: (np.nan, np.zeros(2)), magnitudes.Prior(np.zeros(2), np.ones(2)))
    with pytest.raises(ValueError, match="magnitudes"):
        target.mode()
    with pytest.raises(ValueError, match="curvature"):
        learning.Target(lambda z: (0.0, np.full(2, np.nan)), target.prior).draws(np.zeros(2), 3)


@pytest.fixture(scope="module")
def satellite():
    """A day of a simulated satellite, learnt from its first eighteen hours."""
    pytest.importorskip("erfa", reason="needs the extra gps")
    data = problem.arcs(None)
    return Arc(data.environment, data.times[:96], data.positions[problem.SIMULATED[0]][:96], 72)


@pytest.mark.slow
def test_departures_are_predicted_as_the_satellite_itself(satellite):
    """The linear model of departures, in steps fifteen times as long, against the filter of the satellite."""
    arc, axes = satellite, "DYB"
    orbit = orbits.fit_orbit(arc.environment, arc.times[:arc.train], arc.positions[:arc.train])
    neighbourhood = prediction.surroundings(arc, orbit, axes)
    vector = magnitudes.wide(axes).mean
    mean, covariance = prediction.filter_positions(arc, orbit, vector, axes, arc.learnt())
    result = prediction.predict(arc, neighbourhood, vector[None])
    horizon = slice(arc.train, None)
    sd = np.sqrt(np.diagonal(covariance[horizon], axis1=1, axis2=2))
    assert np.abs(result.state[horizon, :3] - mean[horizon]).max() < 2e-2 * sd.min()
    assert np.abs(result.covariance[horizon] / covariance[horizon] - 1)[:, [0, 1, 2], [0, 1, 2]].max() < 1e-2


BEGIN, COUNT, GROWTH = 10.25, 11, 0.1


@pytest.fixture(scope="module")
def freely():
    """A training far from everything, its magnitudes and moments: forces push along axes that grow with time.

    One position is missing, and one coordinate of another.
    """
    axes, times, random = "DYB", BEGIN + 0.5 * np.arange(COUNT), np.random.default_rng(2)
    along = np.zeros((3, 9))
    along[:, 6:9] = orbits.NANO * np.linalg.qr(random.normal(size=(3, 3)))[0]
    table = TimeTable(BEGIN, 1.0, (1 + GROWTH * np.arange(8.0)[:, None]) * along.ravel())
    on_orbit = 90.0 * np.eye(along.shape[1] - 6)[0]
    neighbourhood = orbits.Neighbourhood(np.zeros((COUNT, 6)), table, on_orbit, axes, orbits.GPS_PERIOD)
    # Forces and noises that move a satellite by far more than its positions' noise within hours.
    larger = {"level": 100.0, "amplitude": 100.0, "drift": 1e4, "wander": 30.0, "white": 1e3}
    vector = (magnitudes.wide(axes).mean + 0.3 * random.normal(size=len(magnitudes.names(axes)))
              + np.log([larger[name.split()[0]] for name in magnitudes.names(axes)]))
    mean, covariance = moments(times - BEGIN, axes, along[:, 6:], on_orbit, vector)
    y = (mean + np.linalg.cholesky(covariance) @ random.normal(size=3 * COUNT)).reshape(-1, 3)
    y[4] = y[8, 1] = np.nan
    return training.Training.along(neighbourhood, times, y, axes), vector, mean, covariance


def moments(times, axes, along, on_orbit, vector):
    """Mean (3 T,) and covariance (3 T, 3 T) of free positions, by the textbook's covariances of the forces."""
    forces, white = magnitudes.forces(vector, axes, orbits.GPS_PERIOD)
    late, early = np.maximum.outer(times, times), np.minimum.outer(times, times)
    nodes, weights = np.polynomial.legendre.leggauss(12)

    def pushed(force):
        """Covariance of twice the integral of a force: its covariance function (a - v) (b - u) k(u, v), integrated."""
        a, b = late[..., None, None, None], early[..., None, None]
        u = 0.5 * b * (nodes[:, None] + 1)
        weight = 0.5 * b * weights[:, None] * (b - u) * (1 + GROWTH * u)
        # It has a kink where both times are the same; the square is cut there.
        bounds = np.stack([np.stack([0 * u, u], axis=-1), np.stack([u, a[..., 0] + 0 * u], axis=-1)])
        low, high = bounds[..., :1], bounds[..., 1:]
        v = low + 0.5 * (high - low) * (nodes + 1)
        inner = (0.5 * (high - low) * weights * (a - v) * (1 + GROWTH * v)
                 * np.asarray(force.covariance(u[..., None] + 0 * v, v)))
        return (weight[..., None] * inner).sum(axis=(0, 3, 4, 5))

    unit = np.multiply.outer
    covariance = np.einsum("ts,ij->tisj", orbits.START_SD[0] ** 2 + orbits.START_SD[1] ** 2 * unit(times, times),
                           np.eye(3))
    integral = late * early**2 / 2 - early**3 / 6
    covariance = covariance + np.einsum("ts,ij->tisj", (orbits.NANO * float(white)) ** 2 * integral, np.eye(3))
    mean = np.zeros((len(times), 3))
    for axis, force, already in zip(along.T, forces.values(), on_orbit, strict=True):
        covariance = covariance + np.einsum("ts,i,j->tisj", pushed(force), axis, axis)
        response = 0.5 * times**2 + GROWTH * times**3 / 6
        mean = mean + (float(force.mean_at(0.0)) - already) * response[:, None] * axis
    size = 3 * len(times)
    return mean.ravel(), covariance.reshape(size, size) + NOISE**2 * np.eye(size)


@pytest.mark.slow
def test_densities_of_positions_are_those_of_a_gaussian(freely):
    """Covariances by quadrature of the forces' covariance functions, densities by SciPy."""
    data, vector, mean, covariance = freely
    y = data.y.ravel()
    present = np.isfinite(y)
    expected = stats.multivariate_normal.logpdf(y[present], mean[present], covariance[np.ix_(present, present)])
    assert float(training.log_likelihood(vector, data.regression, data.axes)) == pytest.approx(expected, rel=1e-5)
    total = 0.0
    for seen in (3, 7):
        some = np.flatnonzero(present & (np.arange(len(y)) < 3 * seen))
        rows = []
        for row in (row for row in range(seen, COUNT) if np.isfinite(data.y[row]).all()):
            columns = np.arange(3 * row, 3 * row + 3)
            gain = np.linalg.solve(covariance[np.ix_(some, some)], covariance[np.ix_(some, columns)]).T
            rows.append(stats.multivariate_normal.logpdf(
                y[columns], mean[columns] + gain @ (y - mean)[some],
                covariance[np.ix_(columns, columns)] - gain @ covariance[np.ix_(some, columns)]))
        total += np.mean(rows)
    assert float(training.held_out(vector, data.regression, data.axes)) == pytest.approx(total, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("slope", [training.slope_of_log_likelihood, training.slope_of_held_out])
def test_magnitudes_beyond_numbers_have_minus_infinity_and_zero_slopes(freely, slope):
    """So has a matrix without a root."""
    data, vector, _, _ = freely
    wrong = data.regression._replace(noise=-data.noise)
    for point, regression in (*((np.full_like(vector, logarithm), data.regression) for logarithm in (
            400.0, np.inf, np.nan)), (vector, wrong)):
        value, result = slope(point, regression, data.axes)
        assert value == -np.inf and (np.asarray(result) == 0.0).all()
    value, result = slope(np.full_like(vector, -400.0), data.regression, data.axes)
    assert np.isfinite(value) and np.isfinite(result).all()


@pytest.fixture(scope="module")
def learning_from(satellite):
    """The training of the simulated satellite, one position missing, and magnitudes."""
    arc, axes = satellite, "DYB"
    positions = arc.positions.copy()
    positions[10] = np.nan
    arc = arc._replace(positions=positions)
    orbit = orbits.fit_orbit(arc.environment, arc.times[:arc.train], arc.positions[:arc.train])
    return training.Training.of(arc, orbit, axes), magnitudes.wide(axes).mean + 0.1


@pytest.mark.slow
def test_the_regression_has_the_densities_of_the_filter(learning_from):
    data, vector = learning_from
    assert np.isnan(data.y).any() and len(data.times) == 36
    settings = {"rule": lfm.Taylor(), "steps": training.steps_of(data.times)}
    system = training.departing(vector, data.neighbourhood, data.axes)
    result = lfm.filter(system, data.times, data.y, **settings)
    assert float(training.log_likelihood(vector, data.regression, data.axes)) == pytest.approx(
        float(result.log_likelihood.sum()), rel=1e-8)
    total = 0.0
    for seen in (12, 24):
        passed = lfm.filter(system, data.times, np.where(np.arange(36)[:, None] < seen, data.y, np.nan), **settings)
        density = training.log_density(data.y - passed.predicted_mean[:, :3], passed.predicted_covariance[:, :3, :3])
        total += np.nanmean(density[seen:])
    assert float(training.held_out(vector, data.regression, data.axes)) == pytest.approx(total, rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("target", [learning.held_out, learning.likelihood])
def test_slopes_of_the_targets_are_those_of_differences(learning_from, target):
    data, point = learning_from
    target = target(data, magnitudes.wide(data.axes))
    _, slope = target.evidence(point)
    for index in (0, 3, len(point) // 2, len(point) - 1):
        step = 1e-4 * np.eye(len(point))[index]
        difference = (target.evidence(point + step)[0] - target.evidence(point - step)[0]) / 2e-4
        assert slope[index] == pytest.approx(difference, rel=1e-4, abs=1e-5)
