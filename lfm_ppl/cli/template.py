"""A room with an unmeasured heat source: change this file into your own model.

    dx/dt = heat(t) - loss (x - outside),        y_k = x(t_k) + e_k,    e_k ~ N(0, noise_sd^2)

x is the temperature of a room, `loss` its rate of cooling, and `heat` an unmeasured force with a Gaussian process
prior. Its posterior is computed together with the posterior of the parameters. `lfm-ppl models` shows the first line.
"""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

# What is measured: one column of the data file for each name, beside a column `time` (or `time_h`, with its unit).
OUTPUTS = ("temperature",)

# What is known at all times, as columns of the data file: name -> "previous" (a value holds to the next), "linear",
# "zero" ("previous", with blank cells read as zero), or "dose:STATE" (doses, which model(...) takes as `events`).
# Then `def model(times, y=None, inputs=None)`, and in the dynamics inputs["outside"](t) in place of OUTSIDE.
# INPUTS = {"outside": "linear"}

# Units of outputs, states, forces and time, for figures and tables; leave out what has none.
UNITS = {"time": "h", "temperature": "degC", "x": "degC", "heat": "K/h"}

# What each parameter means, for `lfm-ppl models`.
PARAMETERS = {
    "loss": "rate at which the room cools (1/h)",
    "scale": "size of the heat's fluctuations (K/h)",
    "lengthscale": "how long the heat stays as it is (h)",
    "noise_sd": "standard deviation of the measurement noise (K)",
}

OUTSIDE = 10.0  # degC, taken as known


def build(loss, scale, lengthscale, noise_sd):
    """Return the system with these parameters."""

    def dynamics(x, u, t):
        # dx/dt for the state x (one entry for each state), the forces u (in the order below) and the time t.
        # Write it with jax.numpy (jnp.exp, jax.nn.softplus, ...); it need not be linear.
        return u[0] - loss * (x - OUTSIDE)

    return lfm.LatentForceModel(
        dynamics=dynamics,
        # order 1 is a Matern-3/2: once differentiable. Others: lfm.SquaredExponential, lfm.Periodic, sums of them.
        # A mean that is not zero: mean=... (a number or a function of time).
        forces={"heat": lfm.Matern(scale=scale, lengthscale=lengthscale, order=1)},
        # What is measured of (x, u), and the standard deviation of its noise, for each output. Where it differs, it is
        # a function of x, u, t: sd=lambda x, u, t: 0.1 * x for an error of 10%.
        observation=lfm.GaussianObservation(lambda x, u, t: x, sd=noise_sd),
        # What is known of the state at the first time: mean (M,) and covariance (M, M).
        initial_state=lfm.Gaussian(jnp.array([15.0]), 25.0 * jnp.eye(1)),
        state_names=("x",),
        output_names=OUTPUTS,
        units=UNITS,
        # What follows from state and forces, drawn like them: a rate softplus(u) that the dynamics use, a flow, ...
        # deterministics={"net heat": lambda x, u, t: u[0] - loss * (x[0] - OUTSIDE)},
    )


def model(times, y=None):
    """Sample the parameters from their priors, and score the observations y (T, 1); NaN is missing."""
    # LogNormal(log(median), width): positive; with a width of 0.5, mostly within a factor of e of the median.
    loss = numpyro.sample("loss", dist.LogNormal(jnp.log(0.3), 0.5))
    scale = numpyro.sample("scale", dist.LogNormal(jnp.log(1.5), 0.5))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(4.0), 0.5))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(jnp.log(0.3), 0.5))
    # What follows from the parameters can be recorded, too.
    numpyro.deterministic("half_life", jnp.log(2.0) / loss)
    system = build(loss, scale, lengthscale, noise_sd)
    # The one likelihood of the model. For dynamics that are not linear, `steps`, `rule` and `iterations` set the
    # approximation, and `lfm-ppl check RESULT` measures it.
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def simulate(seed=0):
    """Simulate the data that are fitted without --data, with their truth; leave the function out if you have your own.

    Trying a model on data whose truth is known is the best test of it.
    """
    truth = {"loss": 0.3, "scale": 1.5, "lengthscale": 4.0, "noise_sd": 0.3}
    grid = np.linspace(0.0, 48.0, 385)
    observed = np.arange(0, 385, 8)  # once an hour
    simulation = lfm.simulate(jax.random.key(seed), build(**truth), grid)
    return lfm.Data(
        times=grid[observed],
        y=np.asarray(simulation.y)[observed],
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": grid, "forces": simulation.forces, "state": simulation.state, "parameters": truth},
    )
