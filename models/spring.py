"""Two masses on springs, driven by one unobserved force: a linear latent force model.

Each output d = 1, 2 is the position of a damped oscillator of unit mass,

    x_d'' + damping_d x_d' + stiffness_d x_d = sensitivity_d u(t),
    y_dk = x_d(t_k) + e_dk,    e_dk ~ N(0, noise_sd^2),

and u is a Gaussian process with a Matern-5/2 covariance of unit scale (the sensitivities carry the
scale; they are positive, which fixes the sign of u). The state is (x_1, x_1', x_2, x_2'). The model
is linear and Gaussian, so that filter, smoother and likelihood are exact.

Sources: J. Hartikainen, Sequential Inference for Latent Temporal Gaussian Process Models (2013),
section 3.4.1, equations 3.32 to 3.35 and figure 3.8; M. Alvarez, D. Luengo and N. Lawrence, Latent
force models (2009).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("x1", "x2")
UNITS: dict[str, str] = {}
OPTIONS: dict[str, Any] = {}
PARAMETERS = {
    "damping": "friction of each oscillator, per unit mass (1/time)",
    "stiffness": "spring constant of each oscillator, per unit mass (1/time^2)",
    "sensitivity": "response of each oscillator to the force, per unit mass (x/time^2)",
    "lengthscale": "lengthscale of the force (time)",
    "noise_sd": "standard deviation of the observation noise (x)",
}
TRUTH = {
    "damping": np.array([0.4, 1.0]),
    "stiffness": np.array([2.0, 0.6]),
    "sensitivity": np.array([1.0, 0.5]),
    "lengthscale": 2.0,
    "noise_sd": 0.05,
}


def build(damping, stiffness, sensitivity, lengthscale, noise_sd, units=None) -> lfm.LatentForceModel:
    """Return the two oscillators with these parameters."""

    def dynamics(x, u, t):
        position, velocity = x[0::2], x[1::2]
        acceleration = sensitivity * u[0] - damping * velocity - stiffness * position
        return jnp.stack([velocity, acceleration], axis=1).ravel()

    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={"u": lfm.Matern(scale=1.0, lengthscale=lengthscale, order=2)},
        observation=lfm.GaussianObservation(lambda x, u, t: x[0::2], sd=noise_sd),
        initial_state=lfm.Gaussian(jnp.zeros(4), jnp.eye(4)),
        state_names=("position 1", "velocity 1", "position 2", "velocity 2"),
        output_names=OUTPUTS,
        units=units,
    )


def model(times, y=None, units=None) -> None:
    """Sample the parameters of the oscillators and of the force, and score the observations.

    Args:
        times: observation times, shape (T,).
        y: the two positions, shape (T, 2); NaN is missing, None draws from the prior predictive.
        units: name -> unit, for plots.
    """
    pair, of_outputs = dist.LogNormal(jnp.zeros(2), 1.0).to_event(1), {"event_dims": ["output"]}
    damping = numpyro.sample("damping", pair, infer=of_outputs)
    stiffness = numpyro.sample("stiffness", pair, infer=of_outputs)
    sensitivity = numpyro.sample("sensitivity", pair, infer=of_outputs)
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.5, 0.7))
    noise_sd = numpyro.sample("noise_sd", dist.HalfNormal(0.2))
    system = build(damping, stiffness, sensitivity, lengthscale, noise_sd, units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def simulate(seed: int = 0) -> lfm.Data:
    """Simulate t in [0, 20], observed every half unit of time."""
    grid = np.linspace(0.0, 20.0, 401)
    observed = np.arange(0, 401, 10)
    simulation = lfm.simulate(jax.random.key(seed), build(**TRUTH), grid)
    return lfm.Data(
        times=grid[observed],
        y=np.asarray(simulation.y)[observed],
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": grid, "forces": simulation.forces, "state": simulation.state, "parameters": TRUTH},
    )
