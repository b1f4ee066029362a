"""NumPyro models without data, as targets of searches and samplers."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

from lfm_ppl.inference.bind import bind_arguments

COVARIANCE = np.array([[1.0, 0.9], [0.9, 2.0]])
"""Of `gaussian`."""


def bound(model):
    return bind_arguments(model, (), {}, "test")


def gaussian():
    numpyro.sample("x", dist.MultivariateNormal(jnp.array([1.0, -2.0]), jnp.array(COVARIANCE)))
