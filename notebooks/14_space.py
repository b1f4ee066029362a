# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Fields in space and time: heat in a rod, events on a map
#
# **Question.** Where and when was the source, as seen by few sensors?
#
# A latent force may depend on the place. This notebook estimates
#
# - a heat source that nobody measured, from thermometers along a rod. Temperature $x$ and source $s$ are fields,
#   $x_t = D\,x_{rr} - \gamma\,x + s(r, t)$,
#   and both are expanded in eigenfunctions of the Laplacian (`lfm.heat`);
# - the rate of events in a square that changes in time, a log-Gaussian Cox process whose covariance is the product of
#   one in space and one in time (`lfm.SeparableField`).
#
# Sources: S. Särkkä, M. Álvarez and N. Lawrence, *IEEE Trans. Automatic Control* 64 (2019), section V; J. Hartikainen,
# doctoral thesis, Aalto University (2013), section 3.3.

# %%
import os

import numpyro

numpyro.enable_x64()
numpyro.set_host_device_count(2)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import numpyro.distributions as dist

import lfm_ppl as lfm

quick = bool(os.environ.get("LFM_QUICK"))

# %% [markdown]
# ## A flame that moves along a rod
#
# The rod is one metre long and its ends are insulated. For 20 minutes a flame moves from left to right. Its heat is
# computed with 60 eigenfunctions; the data are eight thermometers, read twice a minute.

# %%
FINE = lfm.LaplaceBasis((0.0, 1.0), 60, "neumann")
DIFFUSIVITY, DECAY, NOISE_SD = 0.01, 0.1, 0.1
sensors = (np.arange(8) + 0.5) / 8
times = 0.5 * np.arange(41)


def flame(r, t):
    """Heat of the flame (K/min)."""
    return 3.0 * np.exp(-0.5 * ((r - 0.1 - 0.04 * t) / 0.12)**2)


rate, step = DIFFUSIVITY * FINE.wavenumbers**2 + DECAY, 0.05
coefficients, history = np.zeros(60), [np.zeros(60)]
for k in range(400):
    source = np.asarray(FINE.coefficients(lambda r, t=step * (k + 0.5): flame(r, t)))
    coefficients = np.exp(-rate * step) * coefficients + (1.0 - np.exp(-rate * step)) / rate * source
    history.append(coefficients)
temperature = np.array(history)[::10] @ FINE.functions(sensors).T
y = temperature + NOISE_SD * np.random.default_rng(0).normal(size=temperature.shape)

# %% [markdown]
# The model knows the material, but nothing of a flame. Its source is a Gaussian process with a Matérn covariance in
# space and one in time; scale, lengthscales and noise are unknown. (`lfm-ppl fit heat` estimates diffusivity and decay,
# too.)

# %%
BASIS = lfm.LaplaceBasis((0.0, 1.0), 10, "neumann")
UNITS = {"time": "min"} | {f"r={position:.2f}": "K" for position in sensors}


def heat_source(p):
    return lfm.SpectralField(BASIS, lfm.Matern(p["scale"], p["space_lengthscale"], order=1),
                             lfm.Matern(1.0, p["time_lengthscale"], order=0))


def rod(times, y=None):
    p = {"scale": numpyro.sample("scale", dist.LogNormal(0.0, 0.7)),
         "space_lengthscale": numpyro.sample("space_lengthscale", dist.LogNormal(-1.2, 0.4)),
         "time_lengthscale": numpyro.sample("time_lengthscale", dist.LogNormal(1.2, 0.7))}
    noise_sd = numpyro.sample("noise_sd", dist.HalfNormal(0.5))
    model = lfm.heat(heat_source(p), DIFFUSIVITY, DECAY, sensors=sensors, sd=noise_sd,
                     output_names=list(UNITS)[1:], units=UNITS)
    numpyro.sample("y", lfm.MarginalLikelihood(model, times), obs=y)


draws = {"chains": 2, "warmup": 20, "samples": 20} if quick else {"chains": 2, "warmup": 150, "samples": 300}
result = lfm.fit(rod, times, y, progress=False, seed=1, **draws)
lfm.summary(result)

# %% [markdown]
# `lfm.plot_field` draws the posterior of a field: mean and standard deviation against place and time, and three
# snapshots with 95% bands. The source depends on parameters; a function of the parameters makes it for each draw.

# %%
lfm.plot_field(result, BASIS, sensors=sensors, name="temperature", unit="K", length_unit="m", width="full")

# %%
lfm.plot_field(result, heat_source, sensors=sensors, name="source", unit="K/min", length_unit="m", width="full")

# %% [markdown]
# The flame itself, and the estimate of it: `lfm.evaluate_field` returns draws, mean and standard deviation as xarray.

# %%
positions = np.linspace(0.0, 1.0, 81)
estimate = lfm.evaluate_field(result, heat_source, positions)
figure, axes = plt.subplots(1, 3, figsize=(7, 2.4), sharey=True, layout="constrained")
for axis, k in zip(axes, (8, 20, 32), strict=True):
    mean, sd = (estimate[name].sel(time=times[k], method="nearest").values for name in ("mean", "sd"))
    axis.fill_between(positions, mean - 1.96 * sd, mean + 1.96 * sd, color="#8FBFDE", lw=0, label="95%")
    axis.plot(positions, mean, color="#0072B2", label="posterior mean")
    axis.plot(positions, flame(positions, times[k]), color="black", ls="--", lw=0.9, label="flame")
    axis.set(xlabel="place (m)", ylabel="source (K/min)" if k == 8 else "", title=f"t = {times[k]:g} min")
_ = axes[0].legend(frameon=False, fontsize=7)

# %% [markdown]
# ## Events on a map
#
# Events fall into the 16 cells of a square in 12 periods. The logarithm of their rate is a level plus a field that is
# smooth in space and time, the true one of which is simulated here. Ten copies of the temporal force carry
# nearly all of its variance.

# %%
side = (np.arange(4) + 0.5) / 4
cells = np.stack([grid.ravel() for grid in np.meshgrid(side, side, indexing="ij")], axis=1)
periods = np.arange(12.0)
AREA, LEVEL = 1.0 / 16, 4.5


def rate_field(p):
    return lfm.SeparableField(cells, lfm.SquaredExponential(p["scale"], p["space_lengthscale"]),
                              lfm.Matern(1.0, p["time_lengthscale"], order=1), rank=10, name="rate")


truth = {"scale": 1.0, "space_lengthscale": 0.5, "time_lengthscale": 5.0}
print(f"share of the variance that is left out: {float(rate_field(truth).lost_variance):.3f}")


def events(times, y=None):
    p = {"scale": numpyro.sample("scale", dist.LogNormal(0.0, 0.5)),
         "space_lengthscale": numpyro.sample("space_lengthscale", dist.LogNormal(-0.7, 0.4)),
         "time_lengthscale": numpyro.sample("time_lengthscale", dist.LogNormal(1.6, 0.5))}
    level = numpyro.sample("level", dist.Normal(4.0, 1.0))
    field = rate_field(p)
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.zeros(0), field.forces,
        lfm.PoissonObservation(lambda x, u, t: level + field(u), exposure=AREA),
        lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))), units={"time": "month"})
    numpyro.sample("y", lfm.MarginalLikelihood(model, times), obs=y)


space = rate_field(truth).spatial_kernel.covariance(np.linalg.norm(cells[:, None] - cells, axis=-1))
in_time = rate_field(truth).temporal_force.covariance(periods[:, None] - periods)
rng = np.random.default_rng(5)
log_rate = (np.linalg.cholesky(in_time) @ rng.normal(size=(12, 16))
            @ np.linalg.cholesky(space + 1e-9 * np.eye(16)).T)
counts = rng.poisson(AREA * np.exp(LEVEL + log_rate)).astype(float)
print(f"{int(counts.sum())} events")

# %% [markdown]
# The posterior of the four parameters is nearly normal: a Laplace approximation at its mode takes a few seconds. The
# field follows for each draw of it, also between the cells.

# %%
intensity = lfm.fit(events, periods, counts, sampler="map", seed=2, progress=False,
                    **({"samples": 20} if quick else {"samples": 100}))
lfm.summary(intensity).filter(items=["mean", "sd"])

# %%
lfm.plot_field(intensity, rate_field, sensors=cells, name="log rate", width="full")

# %% [markdown]
# Estimate and truth in the cells, for all periods:

# %%
estimate = lfm.evaluate_field(intensity, rate_field, cells)
mean, sd = (estimate[name].sel(time=periods, method="nearest").values for name in ("mean", "sd"))
figure, axis = plt.subplots(figsize=(3.4, 2.8), layout="constrained")
axis.errorbar(log_rate.ravel(), mean.ravel(), 1.96 * sd.ravel(), fmt="o", ms=2, lw=0.4, color="#0072B2")
limits = [log_rate.min(), log_rate.max()]
axis.plot(limits, limits, color="black", ls="--", lw=0.9)
axis.set(xlabel="true field, log rate less its level", ylabel="posterior mean, 95%")
print(f"{100 * np.mean(np.abs(log_rate - mean) < 1.96 * sd):.0f}% of the true values lie in their 95% intervals")

# %% [markdown]
# **Answer.** Eight thermometers show a source that moves along the rod, with a lengthscale of 0.11 m (95%: 0.07 to
# 0.15). Of the map, all true log rates lie in their 95% intervals, from 832 events in 16 cells and 12 periods.
