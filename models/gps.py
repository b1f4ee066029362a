"""Orbit of a GPS satellite, driven by small unmeasured forces.

Position r and velocity v follow

    dr = v dt,    dv = (a(r, t) + u_solar(t) a_solar(r, t) + R u(t)) dt + white dB,
    y_k = r(t_k) + e_k,    e_k ~ N(0, noise_sd^2 I),

where a(r, t) is the pull of the Earth (to degree and order 8), the Moon, the Sun and the solid tide, a_solar
the pressure of sunlight with the Earth's shadow, and the small forces u are quasi-periodic, on each axis

    u(t) = b(t) + sum_n c_n(t),    db = drift dbeta,    c_n'' = -(2 pi n f)^2 c_n + white noise.

The option `axes` chooses their axes. DYB: along the direction to the Sun (D, together with the sunlight), the
axis of the solar panels (Y) and the third axis (B), in sunlight only, f that of the orbit. RTN: radial, tangential
and normal as in the source, f half of that. All are in nm/s^2, distances in km, times in hours.

Positions are in axes that do not turn (GCRS). A data file has the columns time_h, x, y and z, the time in hours
after the option `epoch`, which is in seconds of GPS time; `lfm_ppl.orbits.read_sp3` and `Environment.celestial`
make them from SP3 files, and `lfm-ppl compare gps --data FOLDER` runs the whole study on such files.

Published positions are smoothed by another model, so that their scatter carries no information on the forces:
noise_sd is fixed at 5 cm unless it is freed.

Sources: J. Hartikainen, M. Seppanen and S. Sarkka, State-space inference for non-linear latent force
models (ICML 2012), section 6; G. Beutler and others, Extended orbit modeling techniques at the CODE
processing center, Manuscripta Geodaetica 19 (1994).
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

OUTPUTS = ("x", "y", "z")
UNITS = {
    "time": "h",
    **dict.fromkeys(["x", "y", "z"], "km"),
    **dict.fromkeys(["vx", "vy", "vz"], "km/h"),
    **dict.fromkeys(["solar", "panel", "remaining", "radial", "tangential", "normal"], "nm/s^2"),
}
EPOCH = lfm.orbits.gps_seconds(2019, 4, 7)
OPTIONS = {
    "axes": ("DYB", ("DYB", "RTN"), "axes of the small forces"),
    "epoch": (EPOCH, float, "seconds of GPS time at time zero"),
}
PARAMETERS = {
    "amplitude": "standard deviation of the oscillation at the base frequency (nm/s^2)",
    "wander": "dispersion of that oscillation (nm/s^2/sqrt(h))",
    "drift": "dispersion of the levels of the forces (nm/s^2/sqrt(h))",
    "white": "dispersion of white noise on the acceleration (nm/s^2 sqrt(h))",
    "noise_sd": "standard deviation of a coordinate's error (km)",
}
KNOWN = {"noise_sd": 5e-5}
TRUTH = {"amplitude": 1.0, "wander": 0.03, "drift": 0.01, "white": 0.03, **KNOWN}
START = (26_560.0, 0.0, 0.0, 0.0, 8_000.0, 11_425.0)  # an orbit of half a day, inclined by 55 degrees
GRID = 0.25 * np.arange(193)
STEPS = 30


def build(
    amplitude, wander, drift, white, noise_sd, environment, start, axes="DYB", units=None
) -> lfm.LatentForceModel:
    """Return the satellite with these parameters.

    Args:
        amplitude: see PARAMETERS.
        wander: see PARAMETERS.
        drift: see PARAMETERS.
        white: see PARAMETERS.
        noise_sd: see PARAMETERS.
        environment: Earth, Moon and Sun, a `lfm.orbits.Environment`.
        start: position and velocity at the first time, a `lfm.Gaussian`.
        axes: axes of the small forces.
        units: name -> unit.
    """
    period = lfm.orbits.period_of(start.mean[None])
    forces = lfm.orbits.small_forces(axes, amplitude, wander, drift, period=period)
    return lfm.orbits.satellite(environment, start, forces, axes, white, noise_sd, units)


def model(times, y=None, axes: str = "DYB", epoch: float = EPOCH, units=None) -> None:
    """Sample the magnitudes of the small forces, and score the positions.

    Args:
        times: hours after the epoch, shape (T,).
        y: positions in axes that do not turn (km), shape (T, 3); NaN is missing, None draws from the prior predictive.
        axes: axes of the small forces, DYB or RTN.
        epoch: seconds of GPS time at time zero.
        units: name -> unit, for plots.
    """
    amplitude = numpyro.sample("amplitude", dist.LogNormal(jnp.log(1.0), 1.0))
    wander = numpyro.sample("wander", dist.LogNormal(jnp.log(0.02), 1.0))
    drift = numpyro.sample("drift", dist.LogNormal(jnp.log(0.005), 1.0))
    white = numpyro.sample("white", dist.LogNormal(jnp.log(0.03), 1.0))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(jnp.log(KNOWN["noise_sd"]), 0.5))
    start = lfm.orbits.wide_start(jnp.array(START)) if y is None else lfm.orbits.start_near(times, y)
    system = build(amplitude, wander, drift, white, noise_sd, _environment(epoch, times), start, axes, units)
    # Three iterations change the log likelihood by 0.005 (sd over five points of the prior), and cost four times as
    # much.
    numpyro.sample(
        "y", lfm.MarginalLikelihood(system, times, rule=lfm.Taylor(), steps=STEPS, iterations=0), obs=y
    )


def anchors(data: lfm.Data) -> dict[str, float]:
    """Return the error of published positions, which is fixed unless it is freed."""
    return dict(KNOWN)


def simulate(seed: int = 0, axes: str = "DYB", epoch: float = EPOCH) -> lfm.Data:
    """Simulate two days of a satellite with quasi-periodic forces, with a position every quarter of an hour.

    Args:
        seed: random seed of forces and errors.
        axes: axes of the small forces, DYB or RTN.
        epoch: seconds of GPS time at time zero.
    """
    simulation = _simulator(axes, float(epoch))(jax.random.key(seed))
    return lfm.Data(
        times=GRID,
        y=np.asarray(simulation.y),
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": GRID, "forces": simulation.forces, "state": simulation.state, "parameters": TRUTH},
    )


@functools.cache
def _simulator(axes: str, epoch: float) -> Callable[[jax.Array], lfm.Simulation]:
    """Return the simulator, compiled once for all seeds."""
    start = lfm.Gaussian(jnp.array(START), jnp.zeros((6, 6)))
    system = build(**TRUTH, environment=_environment(epoch, GRID), start=start, axes=axes)
    return jax.jit(lambda key: lfm.simulate(key, system, GRID, steps=STEPS))


def _environment(epoch: float, times) -> lfm.orbits.Environment:
    """Return Earth, Moon and Sun for the satellite, tabulated once for whole days."""
    return _tabulated(float(epoch), float(24 * np.ceil((np.max(np.asarray(times)) + 1e-9) / 24)))


@functools.lru_cache(maxsize=4)
def _tabulated(epoch: float, hours: float) -> lfm.orbits.Environment:
    with jax.ensure_compile_time_eval():
        return lfm.orbits.Environment.over(epoch, hours)
