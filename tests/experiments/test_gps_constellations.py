"""Satellites of other constellations: the light pushes a box with panels, as no force of the library does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lfm_ppl import orbits
from lfm_ppl.experiments.gps import experiment, problem

PRESSURE = 6.5
"""Of sunlight on a square metre of a satellite of 700 kg (nm/s^2)."""
DAYS, STEPS, NOISE = 10, 30, 5e-5
RUNGE_KUTTA = jnp.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]])


def face(sun, normal, area, specular, diffuse):
    """Acceleration by the light on a face: absorbed, reflected and scattered."""
    cosine = jnp.maximum(normal @ sun, 0.0)
    return -PRESSURE * area * cosine * ((1 - specular) * sun + 2 * (diffuse / 3 + specular * cosine) * normal)


def push(environment, r, t, body):
    """Acceleration (km/h^2) by light, on a body and on panels that nearly point to the Sun, and by a thrust."""
    # Areas resemble a Galileo satellite, whose body is longer than wide.
    light = jnp.linalg.norm(environment.solar_pressure(r, t))  # of one nm/s^2, zero in the shadow
    sun = environment.sun(t) - r
    sun = sun / jnp.linalg.norm(sun)
    down = -r / jnp.linalg.norm(r)
    y = jnp.cross(down, sun)
    y = y / jnp.linalg.norm(y)
    x = jnp.cross(y, down)
    panel = sun + body["tilt"] * y + body["lag"] * x
    total = face(sun, panel / jnp.linalg.norm(panel), 10.8, 0.2, 0.05)
    for normal, area, specular in ((down, 3.0, 0.2), (-down, 3.0, 0.25), (x, 1.3, 0.3), (-x, 1.3, 0.3)):
        total = total + face(sun, normal, area * body["body"], specular, 0.3)
    return light * body["scale"] * total - orbits.NANO * body["thrust"] * down


def constellation(letter, count, radius, inclination, seed=0):
    """Satellites on circular orbits in three planes, followed by Runge-Kutta steps of 30 s."""
    environment = orbits.Environment.over(orbits.gps_seconds(2019, 4, 7), 24.0 * DAYS)
    times, random = 0.25 * np.arange(96 * DAYS), np.random.default_rng(seed)
    h = 0.25 / STEPS

    @jax.jit
    def path(start, body):
        def slope(x, t):
            return jnp.concatenate([x[3:], environment.acceleration(x[:3], t) + push(environment, x[:3], t, body)])

        def step(x, t):
            def stage(carry, row):
                last, total = carry
                last = slope(x + row[0] * h * last, t + row[0] * h)
                return (last, total + row[1] * last), None

            (_, total), _ = jax.lax.scan(stage, (jnp.zeros(6), jnp.zeros(6)), RUNGE_KUTTA)
            return x + h * total, None

        return jax.lax.scan(lambda x, t: (jax.lax.scan(step, x, t + h * jnp.arange(STEPS))[0], x[:3]), start,
                            jnp.asarray(times))[1]

    positions = {}
    for number in range(count):
        node, along = 2 * np.pi * (number % 3) / 3 + random.uniform(0, 0.1), random.uniform(0, 2 * np.pi)
        start = problem.circular(node, along, radius, inclination)
        body = {"tilt": random.normal(0, 0.01), "lag": random.normal(0, 0.01), "body": random.uniform(0.8, 1.2),
                "scale": random.uniform(0.95, 1.05), "thrust": random.uniform(0.8, 1.5)}
        positions[f"{letter}{number + 1:02d}"] = (np.asarray(path(jnp.asarray(start), body))
                                                  + NOISE * random.normal(size=(len(times), 3)))
    return problem.Arcs(environment, times, positions, None)


def compute(task):
    return experiment.STUDY.kinds[experiment.STUDY.task_kind(task)].compute(task)


@pytest.mark.slow
@pytest.mark.parametrize(("letter", "radius", "inclination", "period"), [("E", 29_600.0, 56.0, 14.08),
                                                                         ("R", 25_510.0, 64.8, 11.26)])
def test_days_of_other_constellations_are_predicted_within_a_tenth_of_the_deterministic_error(
        letter, radius, inclination, period, monkeypatch):
    data = constellation(letter, 6, radius, inclination)
    monkeypatch.setattr(problem, "arcs", lambda folder, seed=0: data)
    settings = experiment.GpsSettings(alternatives=0)
    results = {task.name: compute(task) for task in experiment.learning_tasks(settings)}
    for task in experiment.prediction_tasks(settings, results):
        results[task.name] = compute(task)
        orbit = orbits.Orbit(0.0, np.array(task.settings["orbit"][:6]), *task.settings["orbit"][6:])
        neighbourhood = orbits.Neighbourhood.of(data.environment, orbit, data.times[:96])
        assert float(neighbourhood.period) == pytest.approx(period, abs=0.01)
    data_sets = experiment.STUDY.collect(settings, results)
    table = experiment.satellite_table(data_sets)
    assert list(table.index) == list(data.positions) and "left out" not in data_sets
    assert (table["ratio"] < 0.1).all(), table[["deterministic", "LFM", "ratio"]].to_string()
