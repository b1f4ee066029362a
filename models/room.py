"""A heated room, and the heat of people, sun and cooking, which nobody measured.

The temperature x of the room (degC) follows

    dx/dt = loss (outside(t) - x) + gain heater(t) + heat(t),
    y_k = x(t_k) + e_k,    e_k ~ N(0, noise_sd^2),

where the temperature outside and the power of the heater are measured, and the heat is a Gaussian process with a
Matern-3/2 covariance. The model is linear and Gaussian, so that filter, smoother and likelihood are exact.

A data file has a time column (dates, or time_h), the output temperature, and the known inputs heater (its power from
that time to the next) and outside. The default data are simulated: two days, measured every hour.

Source: P. Bacher and H. Madsen, Identifying suitable models for the heat dynamics of buildings, Energy and Buildings
43 (2011), the model with one state, with a latent force in place of the sun.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("temperature",)
INPUTS = {"heater": "previous", "outside": "linear"}
UNITS = {"time": "h", "temperature": "degC", "x": "degC", "heat": "K/h", "heater": "kW", "outside": "degC"}
OPTIONS: dict[str, Any] = {}
PARAMETERS = {
    "loss": "rate at which the room cools (1/h)",
    "gain": "warming by one kilowatt (K/h/kW)",
    "scale": "standard deviation of the heat (K/h)",
    "lengthscale": "lengthscale of the heat (h)",
    "noise_sd": "standard deviation of a measurement (K)",
}
TRUTH = {"loss": 0.15, "gain": 1.8, "scale": 0.8, "lengthscale": 3.0, "noise_sd": 0.1}
DAY, STEP = 24.0, 1.0  # of the default data (h)


def build(inputs, loss, gain, scale, lengthscale, noise_sd, units=None) -> lfm.LatentForceModel:
    """Return the room with these parameters and these known inputs."""

    def dynamics(x, u, t):
        return loss * (inputs["outside"](t) - x) + gain * inputs["heater"](t) + u[0]

    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={"heat": lfm.Matern(scale=scale, lengthscale=lengthscale, order=1)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, sd=noise_sd),
        initial_state=lfm.Gaussian(jnp.array([18.0]), 9.0 * jnp.eye(1)),
        state_names=("x",),
        output_names=OUTPUTS,
        units=units,
    )


def model(times, y=None, inputs=None, units=None) -> None:
    """Sample the parameters of room and heat, and score the temperatures.

    Args:
        times: hours, shape (T,).
        y: temperatures, shape (T, 1); NaN is missing, None draws from the prior predictive.
        inputs: ``{"heater": function of time, "outside": function of time}``; None: the inputs of the default data.
        units: name -> unit, for plots.
    """
    loss = numpyro.sample("loss", dist.LogNormal(jnp.log(0.2), 0.5))
    gain = numpyro.sample("gain", dist.LogNormal(jnp.log(1.5), 0.5))
    scale = numpyro.sample("scale", dist.LogNormal(jnp.log(0.5), 0.5))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(3.0), 0.5))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(jnp.log(0.1), 0.5))
    tables = as_functions(known_inputs()) if inputs is None else inputs
    system = build(tables, loss, gain, scale, lengthscale, noise_sd, units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def known_inputs(days: int = 2) -> dict[str, tuple[np.ndarray, np.ndarray, str]]:
    """Return heater and outside of the default data: name -> (times, values, interpolation)."""
    times = np.arange(0.0, days * DAY + STEP / 2, STEP)
    clock = times % DAY
    heater = np.where((clock >= 6.0) & (clock < 9.0) | (clock >= 16.0) & (clock < 22.0), 1.5, 0.3)
    outside = 4.0 - 4.0 * np.cos(2.0 * np.pi * (clock - 3.0) / DAY)
    return {"heater": (times, heater, INPUTS["heater"]), "outside": (times, outside, INPUTS["outside"])}


def as_functions(tables) -> dict[str, lfm.Input]:
    """Return known inputs as functions of time."""
    return {name: lfm.Input(*table) for name, table in tables.items()}


def simulate(seed: int = 8) -> lfm.Data:
    """Simulate two days of the room, measured every hour.

    Args:
        seed: random seed of heat and errors.
    """
    tables = known_inputs()
    times = tables["heater"][0]
    grid = np.linspace(times[0], times[-1], 10 * (len(times) - 1) + 1)
    simulation = lfm.simulate(jax.random.key(seed), build(as_functions(tables), **TRUTH), grid)
    return lfm.Data(
        times=grid[::10],
        y=np.asarray(simulation.y)[::10],
        outputs=OUTPUTS,
        inputs=tables,
        units=UNITS,
        truth={"times": grid, "forces": simulation.forces, "state": simulation.state, "parameters": TRUTH},
    )
