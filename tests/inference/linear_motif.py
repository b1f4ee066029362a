"""Two linear motifs driven by one force, and their exact covariance by quadrature of the kernel.

    dx_j/dt = sensitivity_j u(t) - decay_j x_j,    x_j(0) ~ N(0, START_VARIANCE),    y_jk = x_j(t_k) + e_jk

and u has a Matern-3/2 covariance. The reference below knows no state space: the covariance of x is the double
integral of the kernel against exp(-decay (t - a)), by Gauss-Legendre quadrature on pieces where the kernel is smooth.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import systems

import lfm_ppl as lfm

THETA = {"decay": np.array([0.5, 1.2]), "lengthscale": 1.5, "noise_sd": 0.2}
SENSITIVITY = np.array([1.0, 0.7])
START_VARIANCE = 0.3
TIMES = np.array([0.0, 0.4, 1.0, 1.0, 1.7, 2.5, 4.0, 4.6])
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


def build(decay, lengthscale, noise_sd) -> lfm.LatentForceModel:
    """Return the model of as many outputs as there are decays."""
    size = np.shape(decay)[0]
    sensitivity = SENSITIVITY[:size]
    return lfm.LatentForceModel(
        dynamics=systems.Motif(decay, sensitivity, 0.0, systems.identity),
        forces={"drive": lfm.Matern(scale=1.0, lengthscale=lengthscale, order=1)},
        observation=lfm.GaussianObservation(systems.whole_state, noise_sd**2 * jnp.ones(size)),
        initial_state=lfm.Gaussian(jnp.zeros(size), START_VARIANCE * jnp.eye(size)),
        output_names=("a", "b")[:size],
        units={"time": "h", "a": "nM", "b": "nM", "drive": "1/h", "rate": "1/h"},
        deterministics={"rate": lambda x, u, t: jnp.exp(u[0])},
    )


def model(times, y=None, spread=0.4) -> None:
    """The NumPyro model; ``spread`` is the width of the priors around THETA."""
    decay = numpyro.sample("decay", dist.LogNormal(jnp.log(THETA["decay"]), spread).to_event(1),
                           infer={"event_dims": ["output"]})
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(THETA["lengthscale"]), spread))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(jnp.log(THETA["noise_sd"]), spread))
    numpyro.sample("y", lfm.MarginalLikelihood(build(decay, lengthscale, noise_sd), times), obs=y)


def data(seed: int = 0, missing: bool = True) -> np.ndarray:
    """Draw (T, 2) from the exact distribution at TIMES and THETA."""
    covariance = observation_covariance(TIMES, **THETA)
    y = np.random.default_rng(seed).multivariate_normal(np.zeros(len(covariance)), covariance).reshape(-1, 2)
    if missing:
        y[2, 0] = y[4, 1] = y[6, 0] = np.nan
    return y


def kernel(lag, lengthscale):
    """Matern-3/2 of unit scale."""
    r = np.sqrt(3.0) * np.abs(lag) / lengthscale
    return (1.0 + r) * np.exp(-r)


def _integral(function, end, split):
    """Integrate over [0, end], in two pieces at ``split``; both arrays of one shape."""
    split = np.clip(split, 0.0, end)
    total = 0.0
    for low, high in ((np.zeros_like(end), split), (split, end)):
        half = 0.5 * (high - low)[..., None]
        total = total + (half * _WEIGHTS * function(low[..., None] + half * (1.0 + _NODES))).sum(-1)
    return total


def state_force(t, s, decay, lengthscale):
    """Covariance of x(t), unit sensitivity and x(0) = 0, with u(s)."""
    t, s = np.broadcast_arrays(np.asarray(t, float), np.asarray(s, float))
    return _integral(lambda a: np.exp(-decay * (t[..., None] - a)) * kernel(a - s[..., None], lengthscale), t, s)


def state_state(t, s, decay_t, decay_s, lengthscale):
    """Covariance of x(t) and x(s), of unit sensitivity and x(0) = 0, with their decays."""
    t, s = np.broadcast_arrays(np.asarray(t, float), np.asarray(s, float))
    return _integral(lambda b: np.exp(-decay_s * (s[..., None] - b)) * state_force(t[..., None], b, decay_t,
                                                                                  lengthscale), s, t)


def joint_covariance(times, grid, decay, lengthscale):
    """Covariance of x(times) (T, M), u(grid) (K,) and x(grid) (K, M), flattened; times and grid from zero."""
    size = len(decay)
    everywhere = np.concatenate([times, grid])
    labels = [("x", t, j) for t in times for j in range(size)] + [("u", t, 0) for t in grid]
    labels += [("x", t, j) for t in grid for j in range(size)]
    xx = np.array([[SENSITIVITY[i] * SENSITIVITY[j] * state_state(everywhere[:, None], everywhere, decay[i], decay[j],
                                                                  lengthscale) for j in range(size)]
                   for i in range(size)])
    for j in range(size):
        xx[j, j] += START_VARIANCE * np.exp(-decay[j] * (everywhere[:, None] + everywhere))
    xu = np.array([SENSITIVITY[j] * state_force(everywhere[:, None], grid, decay[j], lengthscale) for j in range(size)])
    index = np.concatenate([np.repeat(np.arange(len(times)), size), np.arange(len(grid)),
                            np.repeat(len(times) + np.arange(len(grid)), size)])
    covariance = np.empty((len(labels), len(labels)))
    for row, (kind, t, i) in enumerate(labels):
        for column, (other_kind, s, j) in enumerate(labels):
            if kind == "x" and other_kind == "x":
                value = xx[i, j, index[row], index[column]]
            elif kind == "u" and other_kind == "u":
                value = kernel(t - s, lengthscale)
            elif kind == "x":
                value = xu[i, index[row], index[column]]
            else:
                value = xu[j, index[column], index[row]]
            covariance[row, column] = value
    return covariance


def observation_covariance(times, decay, lengthscale, noise_sd):
    """Covariance of y (T, M) flattened."""
    size = len(times) * len(decay)
    return joint_covariance(times, np.zeros(0), decay, lengthscale) + noise_sd**2 * np.eye(size)


def log_density(y, decay, lengthscale, noise_sd, times=TIMES) -> float:
    """Exact log density of the present entries of ``y``."""
    present = np.isfinite(y).ravel()
    if not present.any():
        return 0.0
    covariance = observation_covariance(times, decay, lengthscale, noise_sd)[np.ix_(present, present)]
    white = np.linalg.solve(np.linalg.cholesky(covariance), y.ravel()[present])
    return -0.5 * (white @ white + np.linalg.slogdet(covariance)[1] + present.sum() * np.log(2 * np.pi))


def posterior(y, grid, decay, lengthscale, noise_sd, times=TIMES):
    """Exact mean and covariance of (x(times) flattened, u(grid), x(grid) flattened) given ``y``."""
    joint = joint_covariance(times, grid, decay, lengthscale)
    present = np.flatnonzero(np.isfinite(y).ravel())
    observed = joint[np.ix_(present, present)] + noise_sd**2 * np.eye(len(present))
    gain = np.linalg.solve(observed, joint[present]).T
    return gain @ y.ravel()[present], joint - gain @ joint[present]
