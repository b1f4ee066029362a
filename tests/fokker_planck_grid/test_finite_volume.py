"""The birth-death process on the cells: conservation, positivity, and the exponential against an independent one."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import expm

from lfm_ppl.fokker_planck_grid.finite_volume import (
    BirthDeathProcess,
    Grid,
    bernoulli,
    birth_death_process,
    gaussian_masses,
    propagate,
    transition,
)

GRID = Grid(-3.0, 3.0, 60)
FACES = GRID.edges[1:-1]


def well(diffusion=0.3) -> BirthDeathProcess:
    return birth_death_process(jnp.asarray(FACES - FACES**3), jnp.full(len(FACES), diffusion), GRID.width)


def matrix(process: BirthDeathProcess) -> np.ndarray:
    up, down = np.asarray(process.up), np.asarray(process.down)
    return np.diag(up[:-1], -1) + np.diag(down[1:], 1) - np.diag(up + down)


@pytest.mark.parametrize("diffusion", [0.3, 1e-4, 0.0])
def test_generator_keeps_mass_and_sign(diffusion):
    process = well(diffusion)
    generator = matrix(process)
    assert np.all(generator - np.diag(np.diag(generator)) >= 0.0)
    np.testing.assert_allclose(generator.sum(0), 0.0, atol=4e-16 * np.abs(generator).max())
    assert process.up[-1] == 0.0 and process.down[0] == 0.0



@pytest.mark.parametrize("length", [0.0, 1e-3, 0.7, 400.0, 1e7])
def test_transition_is_stochastic_and_exponential(length):
    process = well()
    matrix_exponential = np.asarray(transition(process, jnp.asarray(length)))
    assert matrix_exponential.min() >= 0.0
    np.testing.assert_allclose(matrix_exponential.sum(0), 1.0, atol=1e-12)
    if length < 100:
        np.testing.assert_allclose(matrix_exponential, expm(matrix(process) * length), atol=1e-12)
    masses = gaussian_masses(GRID, jnp.asarray(0.4), jnp.asarray(0.02))
    moved = np.asarray(propagate(process, jnp.asarray(length), masses))
    assert moved.min() >= 0.0 and abs(moved.sum() - masses.sum()) < 1e-12
    np.testing.assert_allclose(moved, matrix_exponential @ masses, atol=1e-12)
    expected_centres = propagate(process, jnp.asarray(length), jnp.asarray(GRID.centres), adjoint=True)
    np.testing.assert_allclose(expected_centres, GRID.centres @ matrix_exponential, atol=1e-11)


def test_stationary_masses_of_exponentially_fitted_fluxes():
    # With a constant velocity v and diffusion D the masses are exactly proportional to exp(v x / D).
    process = birth_death_process(jnp.full(len(FACES), -0.7), jnp.full(len(FACES), 0.2), GRID.width)
    masses = jnp.exp(-0.7 / 0.2 * jnp.asarray(GRID.centres))
    scale = float(jnp.max((process.up + process.down) * masses))
    np.testing.assert_allclose(matrix(process) @ masses, 0.0, atol=1e-13 * scale)


def test_bernoulli():
    z = np.array([-1e30, -800.0, -30.0, -1.0, -1.1e-3, -0.9e-3, -1e-9, 0.0, 1e-9, 0.9e-3, 1.1e-3, 1.0, 30.0, 800.0])
    safe = np.where(z == 0, 1.0, np.clip(z, -700.0, 700.0))
    expected = np.where(z == 0, 1.0, np.where(z < -700, -z, np.where(z > 700, 0.0, safe / np.expm1(safe))))
    np.testing.assert_allclose(bernoulli(jnp.asarray(z)), expected, rtol=1e-13, atol=1e-280)
    assert np.isfinite(jax.vmap(jax.grad(bernoulli))(jnp.asarray(z))).all()


def test_gaussian_masses():
    masses = gaussian_masses(GRID, jnp.asarray(0.33), jnp.asarray(0.09))
    assert abs(float(masses.sum()) - 1.0) < 1e-14
    assert abs(float(masses @ GRID.centres) - 0.33) < 1e-9
    tail = gaussian_masses(Grid(6.0, 12.0, 60), jnp.asarray(0.0), jnp.asarray(1.0))
    np.testing.assert_allclose(tail.sum(), 9.865876450376981e-10, rtol=1e-6)
    point_masses = gaussian_masses(GRID, jnp.asarray(0.33), jnp.asarray(0.0))
    assert int((point_masses > 0).sum()) == 2
    assert abs(float(point_masses.sum()) - 1.0) < 1e-12 and abs(float(point_masses @ GRID.centres) - 0.33) < 1e-12
