"""Ballistic target on reentry in three dimensions, seen by a radar in range, azimuth and elevation.

With position p = (east, north, up) in metres, the radar at the origin, and velocity v (m/s),

    dp = v dt + q_r dB_1,
    dv = (-alpha exp(-gamma up) |v| v - (0, 0, g) + u(t)) dt + q_v dB_2,
    y_k = (|p|, atan2(north, east) - bearing, atan2(up, |(east, north)|)) + e_k,    e_k ~ N(0, R),
    R = diag(range_sd^2, angle_sd^2, angle_sd^2),

where gamma = 1.49e-4 per metre, g = 9.8 m/s^2, and u is an unknown acceleration: in each direction a Gaussian
process with a Matern-5/2 covariance, the three with one scale and one lengthscale. The ground is flat. Azimuth
counts from the radar's axis, which is turned from east towards north by `bearing`, and lies in [-pi, pi): the
default target crosses the direction where it jumps by 2 pi, so that residuals are reduced to [-pi, pi].

Unknown are the drag alpha and the force's scale and lengthscale. The levels of the noise are known unless they are
freed, for example by

    lfm-ppl fit ballistic-3d --set angle_sd=free

At the first time the target is at about (-50, -15, 65) km and moves at about (0.6, 1, -2.7) km/s, each with a standard
deviation of 500 m and 100 m/s. The default data start at the means, and have 60 measurements in 30 s.

Sources: X. R. Li and V. P. Jilkov, Survey of maneuvering target tracking: II. Ballistic target models, Proc. SPIE 4473
(2001), for the motion, and III. Measurement models, Proc. SPIE 4473 (2001), for the radar; J. Hartikainen, M. Seppanen
and S. Sarkka, State-space inference for non-linear latent force models (ICML 2012), section 5.2, which names the
three-dimensional case and gives the constants.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("range", "azimuth", "elevation")
AXES = ("east", "north", "up")
UNITS = {
    "time": "s",
    "range": "m",
    "azimuth": "rad",
    "elevation": "rad",
    **{axis: "m" for axis in AXES},
    **{f"speed_{axis}": "m/s" for axis in AXES},
    **{f"u_{axis}": "m/s^2" for axis in AXES},
}
OPTIONS = {
    "bearing": (0.0, float, "direction of the radar's axis, from east towards north (rad)"),
}
PARAMETERS = {
    "alpha": "drag where the density of the air is that of the ground (1/m)",
    "scale": "standard deviation of the unknown acceleration in each direction (m/s^2)",
    "lengthscale": "lengthscale of the unknown acceleration (s)",
    "q_r": "dispersion of the position in each direction (m/sqrt(s))",
    "q_v": "dispersion of the velocity in each direction (m/s/sqrt(s))",
    "range_sd": "standard deviation of the radar's noise in range (m)",
    "angle_sd": "standard deviation of the radar's noise in azimuth and elevation (rad)",
}
KNOWN = {"q_r": 50.0, "q_v": 10.0, "range_sd": 30.0, "angle_sd": 1e-3}
TRUTH = {"alpha": 4.49e-4, "scale": 50.0, "lengthscale": 5.0, **KNOWN}
AIR, GRAVITY = 1.49e-4, 9.8
START = (-50_000.0, -15_000.0, 65_000.0, 600.0, 1_000.0, -2_700.0)
START_SD = (500.0,) * 3 + (100.0,) * 3
GRID = np.linspace(0.0, 30.0, 591)  # ten intervals between neighbours of 60 measurements
LONGEST_STEP = 0.26  # seconds


def build(
    alpha, scale, lengthscale, q_r, q_v, range_sd, angle_sd, bearing=0.0, units=None, start_sd=START_SD
) -> lfm.LatentForceModel:
    """Return the target with these parameters.

    Args:
        alpha: see PARAMETERS.
        scale: see PARAMETERS.
        lengthscale: see PARAMETERS.
        q_r: see PARAMETERS.
        q_v: see PARAMETERS.
        range_sd: see PARAMETERS.
        angle_sd: see PARAMETERS.
        bearing: direction of the radar's axis (rad).
        units: name -> unit.
        start_sd: standard deviations of position and velocity at the first time, (6,).
    """

    def dynamics(x, u, t):
        speed = jnp.sqrt((x[3:] ** 2).sum())
        drag = -alpha * jnp.exp(-AIR * x[2]) * speed * x[3:]
        return jnp.concatenate([x[3:], drag + u - jnp.array([0.0, 0.0, GRAVITY])])

    def radar(x, u, t):
        east, north, up = x[:3]
        ground_distance = jnp.sqrt(east**2 + north**2)
        azimuth = _on_circle(jnp.arctan2(north, east) - bearing)
        return jnp.stack([jnp.sqrt(ground_distance**2 + up**2), azimuth, jnp.arctan2(up, ground_distance)])

    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={f"u_{axis}": lfm.Matern(scale=scale, lengthscale=lengthscale, order=2) for axis in AXES},
        process_noise=jnp.diag(jnp.concatenate([q_r * jnp.ones(3), q_v * jnp.ones(3)])),
        observation=lfm.GaussianObservation(
            radar, sd=jnp.stack([jnp.asarray(sd, float) for sd in (range_sd, angle_sd, angle_sd)]), angular=(1,)
        ),
        initial_state=lfm.Gaussian(jnp.array(START), jnp.diag(jnp.array(start_sd) ** 2)),
        state_names=(*AXES, *(f"speed_{axis}" for axis in AXES)),
        output_names=OUTPUTS,
        units=units,
    )


def model(times, y=None, bearing: float = 0.0, units=None) -> None:
    """Sample the drag, the force's parameters and the noise, and score the radar's measurements.

    Args:
        times: of the measurements (s), shape (T,).
        y: range (m), azimuth and elevation (rad), shape (T, 3); NaN is missing, None draws from the prior predictive.
        bearing: direction of the radar's axis (rad).
        units: name -> unit, for plots.
    """
    alpha = numpyro.sample("alpha", dist.LogNormal(jnp.log(5e-4), 1.0))
    scale = numpyro.sample("scale", dist.LogNormal(jnp.log(30.0), 1.0))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(5.0), 0.7))
    noise = {name: numpyro.sample(name, dist.LogNormal(jnp.log(value), 0.7)) for name, value in KNOWN.items()}
    system = build(alpha, scale, lengthscale, **noise, bearing=bearing, units=units)
    # Three iterations change the log likelihood by 0.02 (sd over the posterior), less than its error with or without
    # them, and cost four times as much.
    numpyro.sample(
        "y", lfm.MarginalLikelihood(system, times, steps=1, max_step=LONGEST_STEP, iterations=0), obs=y
    )


def anchors(data: lfm.Data) -> dict[str, float]:
    """Return the levels of the noise, which are fixed at known values unless they are freed."""
    return dict(KNOWN)


def simulate(seed: int = 0, bearing: float = 0.0) -> lfm.Data:
    """Simulate 30 s of a target, measured 60 times.

    Args:
        seed: random seed of forces, path and noise.
        bearing: direction of the radar's axis (rad).
    """
    simulation = _simulator(float(bearing))(jax.random.key(seed))
    observed = np.arange(0, len(GRID), 10)
    y = np.array(simulation.y)[observed]
    y[:, 1] = _on_circle(y[:, 1])  # a radar reports angles in [-pi, pi), also with noise
    return lfm.Data(
        times=GRID[observed],
        y=y,
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": GRID, "forces": simulation.forces, "state": simulation.state, "parameters": TRUTH},
    )


def _on_circle(angle):
    """Return the angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


@functools.cache
def _simulator(bearing: float) -> Callable[[jax.Array], lfm.Simulation]:
    """Return the simulator, compiled once for all seeds."""
    system = build(**TRUTH, bearing=bearing, start_sd=(0.0,) * 6)
    return jax.jit(lambda key: lfm.simulate(key, system, GRID, steps=5))
