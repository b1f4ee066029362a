"""Ballistic target on reentry, decelerated by drag and driven by an unknown force.

A target falls towards the ground. Its altitude r (m) and its speed downwards v (m/s) follow

    dr = -v dt + q_r dB_1,
    dv = (-alpha exp(-gamma r) v^2 + g + u(t)) dt + q_v dB_2,
    y_k = sqrt(s_x^2 + (s_y - r(t_k))^2) + e_k,    e_k ~ N(0, noise_sd^2),

where the drag grows with the density of the air, gamma = 1.49e-4 per metre, g = 9.8 m/s^2, and u is an
unknown acceleration, a Gaussian process with a Matern-5/2 covariance. A radar at (s_x, s_y), at a horizontal
distance of 30 km and 30 m above the ground, measures the distance only. Dynamics and measurement are non-linear.

Unknown are the drag alpha and the force's scale and lengthscale. The levels of the noise, q_r, q_v and
noise_sd, are known in the source and fixed at its values unless they are freed, for example by

    lfm-ppl fit ballistic --set noise_sd=free

The target is at about 65 km at the first time and falls at about 3 km/s: r ~ N(65000, 500^2),
v ~ N(3000, 100^2). With the option `df` the errors e_k are noise_sd times Student's t with that many degrees of
freedom, which makes the estimates robust against outliers. The default data start at the means: 120 distances in 30 s.

Sources: J. Hartikainen, M. Seppanen and S. Sarkka, State-space inference for non-linear latent force
models (ICML 2012), section 5.2; X. R. Li and V. P. Jilkov, Survey of maneuvering target tracking: II.
Ballistic target models, Proc. SPIE 4473 (2001).
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

OUTPUTS = ("distance",)
UNITS = {
    "time": "s",
    "distance": "m",
    "altitude": "m",
    "speed": "m/s",
    "u": "m/s^2",
}
OPTIONS = {
    "aside": (30_000.0, float, "horizontal distance of the radar from the target's path (m)"),
    "height": (30.0, float, "height of the radar above the ground (m)"),
    "df": (0.0, float, "degrees of freedom of Student's t errors, 4 for example; 0: Gaussian errors"),
}
PARAMETERS = {
    "alpha": "drag where the density of the air is that of the ground (1/m)",
    "scale": "standard deviation of the unknown acceleration (m/s^2)",
    "lengthscale": "lengthscale of the unknown acceleration (s)",
    "q_r": "dispersion of the altitude (m/sqrt(s))",
    "q_v": "dispersion of the speed (m/s/sqrt(s))",
    "noise_sd": "standard deviation of the radar's noise, or scale of Student's t (m)",
}
KNOWN = {"q_r": 50.0, "q_v": 10.0, "noise_sd": 30.0}
TRUTH = {"alpha": 4.49e-4, "scale": 50.0, "lengthscale": 5.0, **KNOWN}
AIR, GRAVITY = 1.49e-4, 9.8
START = (65_000.0, 3_000.0)
START_SD = (500.0, 100.0)
GRID = np.linspace(0.0, 30.0, 1191)  # ten intervals between neighbours of 120 measurements
LONGEST_STEP = 0.26  # seconds: one step between neighbours of 120 measurements; likelihoods are exact to 0.1%


def build(
    alpha, scale, lengthscale, q_r, q_v, noise_sd, aside=30_000.0, height=30.0, units=None, start_sd=START_SD,
    df=0.0,
) -> lfm.LatentForceModel:
    """Return the target with these parameters.

    Args:
        alpha: see PARAMETERS.
        scale: see PARAMETERS.
        lengthscale: see PARAMETERS.
        q_r: see PARAMETERS.
        q_v: see PARAMETERS.
        noise_sd: see PARAMETERS.
        aside: horizontal distance of the radar (m).
        height: of the radar (m).
        units: name -> unit.
        start_sd: standard deviations of altitude and speed at the first time.
        df: degrees of freedom of Student's t errors; 0: Gaussian errors.
    """

    def dynamics(x, u, t):
        altitude, speed = x
        return jnp.stack([-speed, -alpha * jnp.exp(-AIR * altitude) * speed**2 + GRAVITY + u[0]])

    def distance(x, u, t):
        return jnp.sqrt(aside**2 + (height - x[:1]) ** 2)

    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={"u": lfm.Matern(scale=scale, lengthscale=lengthscale, order=2)},
        process_noise=jnp.diag(jnp.array([q_r, q_v], dtype=float)),
        observation=(lfm.StudentTObservation(distance, df, noise_sd) if df
                     else lfm.GaussianObservation(distance, sd=noise_sd)),
        initial_state=lfm.Gaussian(jnp.array(START), jnp.diag(jnp.array(start_sd) ** 2)),
        state_names=("altitude", "speed"),
        output_names=OUTPUTS,
        units=units,
    )


def model(times, y=None, aside: float = 30_000.0, height: float = 30.0, df: float = 0.0, units=None) -> None:
    """Sample the drag, the force's parameters and the noise, and score the distances.

    Args:
        times: of the measurements (s), shape (T,).
        y: distances (m), shape (T, 1); NaN is missing, None draws from the prior predictive.
        aside: horizontal distance of the radar from the target's path (m).
        height: of the radar (m).
        df: degrees of freedom of Student's t errors; 0: Gaussian errors.
        units: name -> unit, for plots.
    """
    alpha = numpyro.sample("alpha", dist.LogNormal(jnp.log(5e-4), 1.0))
    scale = numpyro.sample("scale", dist.LogNormal(jnp.log(30.0), 1.0))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(5.0), 0.7))
    q_r, q_v, noise_sd = (numpyro.sample(name, dist.LogNormal(jnp.log(value), 0.7)) for name, value in KNOWN.items())
    system = build(alpha, scale, lengthscale, q_r, q_v, noise_sd, aside, height, units, df=df)
    # Three iterations change the log likelihood by 0.02 (sd over the posterior), less than its error with or without
    # them, and cost four times as much.
    numpyro.sample(
        "y", lfm.MarginalLikelihood(system, times, steps=1, max_step=LONGEST_STEP, iterations=0), obs=y
    )


def anchors(data: lfm.Data) -> dict[str, float]:
    """Return the levels of the noise, which are fixed at known values unless they are freed."""
    return dict(KNOWN)


def simulate(seed: int = 0, aside: float = 30_000.0, height: float = 30.0, df: float = 0.0) -> lfm.Data:
    """Simulate 30 s of the source's target, measured 120 times.

    Args:
        seed: random seed of force, path and noise.
        aside: horizontal distance of the radar (m).
        height: of the radar (m).
        df: degrees of freedom of Student's t errors; 0: Gaussian errors.
    """
    simulation = _simulator(float(aside), float(height), float(df))(jax.random.key(seed))
    observed = np.arange(0, len(GRID), 10)
    return lfm.Data(
        times=GRID[observed],
        y=np.asarray(simulation.y)[observed],
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": GRID, "forces": simulation.forces, "state": simulation.state, "parameters": TRUTH},
    )


@functools.cache
def _simulator(aside: float, height: float, df: float) -> Callable[[jax.Array], lfm.Simulation]:
    """Return the simulator, compiled once for all seeds."""
    system = build(**TRUTH, aside=aside, height=height, start_sd=(0.0, 0.0), df=df)
    return jax.jit(lambda key: lfm.simulate(key, system, GRID, steps=5))
