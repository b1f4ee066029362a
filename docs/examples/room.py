"""A heated room, and heat that nobody measured.

    dx/dt = loss (outside(t) - x) + gain heater(t) + heat(t),        y_k = x(t_k) + e_k,    e_k ~ N(0, noise_sd^2)

x is the temperature of the room, `outside` and `heater` are measured, and `heat` is the rest: sun, people, cooking.
"""

import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("temperature",)
INPUTS = {"heater": "previous", "outside": "linear"}
UNITS = {"time": "h", "temperature": "degC", "x": "degC", "heat": "K/h", "heater": "kW", "outside": "degC"}
PARAMETERS = {
    "loss": "rate at which the room cools (1/h)",
    "gain": "warming by one kilowatt (K/h/kW)",
    "scale": "size of the unmeasured heat (K/h)",
    "lengthscale": "how long it stays as it is (h)",
    "noise_sd": "standard deviation of the measurement noise (K)",
}


def build(inputs, loss, gain, scale, lengthscale, noise_sd):
    """Return the room with these parameters."""

    def dynamics(x, u, t):
        return loss * (inputs["outside"](t) - x) + gain * inputs["heater"](t) + u[0]

    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={"heat": lfm.Matern(scale=scale, lengthscale=lengthscale, order=1)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, sd=noise_sd),
        initial_state=lfm.Gaussian(jnp.array([18.0]), 9.0 * jnp.eye(1)),
        state_names=("x",),
        output_names=OUTPUTS,
        units=UNITS,
    )


def model(times, y=None, inputs=None):
    """Sample the parameters from their priors, and score the observations y (T, 1); NaN is missing."""
    loss = numpyro.sample("loss", dist.LogNormal(jnp.log(0.2), 0.5))
    gain = numpyro.sample("gain", dist.LogNormal(jnp.log(1.5), 0.5))
    scale = numpyro.sample("scale", dist.LogNormal(jnp.log(0.5), 0.5))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(3.0), 0.5))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(jnp.log(0.1), 0.5))
    system = build(inputs, loss, gain, scale, lengthscale, noise_sd)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
