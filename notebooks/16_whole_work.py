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
# # The whole work: a room, from data to a forecast
#
# **Question.** Heater and weather of a room are measured, and so is its temperature. How much heat do people, sun and
# cooking add, which nobody measured? And does a model that knows of this heat forecast the temperature better than one
# that takes it as constant?
#
# The notebook goes through every step: data, prior, fit, residuals, accuracy, a second model, comparison, forecast,
# score, rolling origins, files, and the same model in plain NumPyro.

# %%
import os
import tempfile
from dataclasses import replace
from pathlib import Path

import numpyro

numpyro.enable_x64()
numpyro.set_host_device_count(2)

import arviz as az
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import numpyro.distributions as dist
from numpyro.infer import MCMC, NUTS, Predictive

import lfm_ppl as lfm

quick = bool(os.environ.get("LFM_QUICK"))
size = {"chains": 2, "warmup": 30, "samples": 30} if quick else {"chains": 2, "warmup": 300, "samples": 500}

# %% [markdown]
# ## Data
#
# `lfm.datasets.load` returns observations with their known inputs and units. For data of your own this is
# `lfm.read_csv("room.csv", outputs=["temperature"], inputs={"heater": "previous", "outside": "linear"})`. The room is
# simulated, so that its true heat is known. The last twelve hours are held out.

# %%
data = lfm.datasets.load("room")
fitted = replace(data, times=data.times[:37], y=data.y[:37])
later = replace(data, times=data.times[37:], y=data.y[37:], truth=None)
print(f"{len(fitted.times)} hours of {', '.join(data.outputs)} with the inputs {', '.join(data.inputs)}; "
      f"{len(later.times)} hours held out")

# %% [markdown]
# ## The model
#
# $$\dot x = \mathrm{loss}\,(\mathrm{outside} - x) + \mathrm{gain}\,\mathrm{heater} + u(t), \qquad
#   y_k = x(t_k) + e_k.$$
#
# The heat $u$ is a Matern-3/2 process. With `varying=False` it is an unknown constant: the second model.

# %%
def room(times, y=None, inputs=None, varying=True):
    loss = numpyro.sample("loss", dist.LogNormal(jnp.log(0.2), 0.5))
    gain = numpyro.sample("gain", dist.LogNormal(jnp.log(1.5), 0.5))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(jnp.log(0.1), 0.5))
    if varying:
        scale = numpyro.sample("scale", dist.LogNormal(jnp.log(0.5), 0.5))
        lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(3.0), 0.5))
        heat = lfm.Matern(scale, lengthscale, order=1)
    else:
        heat = lfm.Constant(1.0)
    system = lfm.LatentForceModel(
        dynamics=lambda x, u, t: loss * (inputs["outside"](t) - x) + gain * inputs["heater"](t) + u,
        forces={"heat": heat},
        observation=lfm.GaussianObservation(lambda x, u, t: x, sd=noise_sd),
        initial_state=lfm.Gaussian(jnp.array([18.0]), 9.0 * jnp.eye(1)),
        output_names=("temperature",), state_names=("x",), units=data.units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


# %% [markdown]
# ## Prior predictive check
#
# Temperatures that the priors allow, before the model sees any. They must contain what a room may do, and little that
# it cannot do.

# %%
prior = Predictive(room, num_samples=50)(jax.random.key(0), fitted.times, inputs=data.known_inputs())
figure, axis = plt.subplots(figsize=(7, 2.4), layout="constrained")
axis.plot(fitted.times, prior["y"][..., 0].T, color="#0072B2", lw=0.5, alpha=0.5)
axis.plot(fitted.times, fitted.y[:, 0], "k.", ms=3)
axis.set(xlabel="time (h)", ylabel="temperature (degC)")
plt.show()
print(f"central 90% of the prior: {np.quantile(prior['y'], 0.05):.0f} to {np.quantile(prior['y'], 0.95):.0f} degC")

# %% [markdown]
# A room near the frost and one at 20 degC are both usual under the prior, as for a bad and a good insulation, and no
# temperature is absurd. The warmest hours of the measured room are above the central 90%.
#
# ## Fit

# %%
result = lfm.fit(room, fitted, seed=1, progress=False, **size)
lfm.summary(result)

# %%
lfm.plot_fit(result, width="full")

# %% [markdown]
# The heat that nobody measured, with the true one. It is found to a few tenths of a degree per hour.

# %%
lfm.plot_forces(result, width="full")

# %% [markdown]
# ## Residuals
#
# Each temperature, predicted from those before it. Independent standard normal numbers show no pattern.

# %%
lfm.plot_residuals(result, width="full")

# %% [markdown]
# ## Accuracy
#
# The model is linear with Gaussian noise, so that the likelihood has no error. The check says so. Of a nonlinear model
# it measures the error with particles.

# %%
print(lfm.check_accuracy(result, room, progress=False))

# %% [markdown]
# ## A second model
#
# The same room with heat that is an unknown constant, and both models compared by how well they predict each
# temperature from all others (expected log predictive density, leave-one-out).

# %%
constant = lfm.fit(room, replace(fitted, truth=None), seed=2, progress=False, model_kwargs={"varying": False}, **size)
print(az.compare({"varying heat": result, "constant heat": constant}).to_string())
lfm.summary(constant)

# %% [markdown]
# ## Forecast and score
#
# The twelve hours that were held out (crosses), with their heater and weather. The score is out of sample: CRPS in
# degC, and the log density of a measurement.

# %%
forecasts = {
    name: lfm.forecast(fit, room, later.times, inputs=later, seed=3, progress=False, model_kwargs=keywords)
    for name, fit, keywords in (("varying heat", result, {}), ("constant heat", constant, {"varying": False}))}
def with_held_out(figure):
    figure.axes[0].plot(later.times, later.y[:, 0], "x", color="#D55E00", ms=4)
    return figure


with_held_out(lfm.plot_fit(forecasts["varying heat"], width="full"))

# %%
scores = {name: lfm.score(forecast, later) for name, forecast in forecasts.items()}
for name, table in scores.items():
    print(f"{name}\n{table.round(3).to_string()}\n")

# %% [markdown]
# ## Rolling origins
#
# One night is one case. `lfm.backtest` fits to the data up to an origin, forecasts six hours, moves the origin on by
# six, and stands beside persistence, the last value with the spread of its changes.

# %%
rolling = lfm.backtest(room, data, horizon=6, every=6, first=25, draws=50 if quick else 200, seed=4,
                       progress=False)
rolling.table.round(3)

# %% [markdown]
# ## Save and load

# %%
with tempfile.TemporaryDirectory() as folder:
    lfm.save(result, Path(folder) / "room.nc")
    loaded = lfm.load(Path(folder) / "room.nc")
print("equal:", loaded["posterior"]["loss"].equals(result["posterior"]["loss"]))

# %% [markdown]
# ## The same model in plain NumPyro
#
# `room` is an ordinary NumPyro model: NumPyro's own NUTS samples it, and `lfm.to_arviz` gives its draws the groups of
# `lfm.fit`. The moments agree within the Monte Carlo error.

# %%
mcmc = MCMC(NUTS(room), num_warmup=size["warmup"], num_samples=size["samples"], num_chains=2,
            chain_method="vectorized", progress_bar=False)
mcmc.run(jax.random.key(5), fitted.times, fitted.y, inputs=data.known_inputs())
plain = lfm.to_arviz(mcmc, room, fitted.times, fitted.y, model_kwargs={"inputs": data.known_inputs()})
lfm.summary(plain)[["mean", "sd", "r_hat"]].join(lfm.summary(result)[["mean", "sd"]].add_suffix(" of lfm.fit"))

# %%
true_heat = np.interp(fitted.times, data.truth["times"], np.asarray(data.truth["forces"]["heat"]))
band = result["trajectories"]["forces"].sel(force="heat").interp(time=fitted.times)
low, high = band.quantile(0.025, ("chain", "draw")).values, band.quantile(0.975, ("chain", "draw")).values
error = float(np.sqrt(np.mean((band.mean(("chain", "draw")).values - true_heat) ** 2)))
coverage = np.mean((low < true_heat) & (true_heat < high))
print(f"heat: root mean squared error {error:.2f} K/h; {coverage:.0%} of the true values in the 95% band")
print("CRPS of the last twelve hours: " + ", ".join(
    f"{table.loc['all', 'crps']:.2f} degC ({name})" for name, table in scores.items()))

# %% [markdown]
# **Answer.** The heat of people, sun and cooking is between -0.6 and 1.9 K/h, and is found to 0.3 K/h; all true values
# lie in the 95% band. It must be allowed to vary: with constant heat the noise is estimated at 1.2 K in place of 0.1 K,
# the expected log predictive density is lower by 72 (standard error 10, with warnings of Pareto k), and the forecast of
# twelve hours has a CRPS of 1.71 degC in place of 0.61. Over four origins the varying heat has 0.67 degC, persistence
# 1.77.
