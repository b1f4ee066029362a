"""Two experiments with a shared rate: other lengths, other outputs, one linear and one non-linear observation."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

TIMES = {"y": np.arange(8.0), "y2": np.arange(0, 5, 0.5)}
Y = {"y": np.exp(-0.4 * TIMES["y"])[:, None],
     "y2": np.column_stack([2 * np.exp(-0.4 * TIMES["y2"]), 4 * np.exp(-0.8 * TIMES["y2"])])}
START = {"y": 1.0, "y2": 2.0}


def outputs_of(name):
    return {"y": lambda x, u, t: x, "y2": lambda x, u, t: jnp.stack([x[0], x[0] ** 2])}[name]


def system(name, rate):
    return lfm.LatentForceModel(
        lambda x, u, t: -rate * x + u, {"f": lfm.Matern(0.1, 2.0)},
        lfm.GaussianObservation(outputs_of(name), 0.01 * jnp.ones(Y[name].shape[1])),
        lfm.Gaussian(jnp.array([START[name]]), 0.01 * jnp.eye(1)))


def joint_model(times, y):
    """Both experiments, with times and data by name."""
    rate = numpyro.sample("a", dist.LogNormal(-1.0, 0.5))
    for name in ("y", "y2"):
        numpyro.sample(name, lfm.MarginalLikelihood(system(name, rate), times[name]), obs=y[name])


def alone(name):
    """Return the model of one experiment."""
    def model(times, y=None):
        rate = numpyro.sample("a", dist.LogNormal(-1.0, 0.5))
        numpyro.sample(name, lfm.MarginalLikelihood(system(name, rate), times), obs=y)

    return model
