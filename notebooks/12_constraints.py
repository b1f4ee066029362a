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
# # Forces that cannot be negative: full information, a moving horizon, and bands
#
# **Question.** Which of the known ways to estimate a force that cannot be negative has the smallest error, and can it
# have honest bands?
#
# A concentration cannot be negative, but a Gaussian process can. Those who build moving horizon estimators respect such
# bounds and have no posterior; those who have posteriors rarely respect them. Here are both:
# `lfm.full_information`, `lfm.MovingHorizon` and `lfm.constrained_posterior`, in time linear in the record.
#
# The source is T. M. Wolff, V. G. Lopez, M. A. Müller and T. Beckers, *Inference in latent force models using optimal
# state estimation*. The same study runs from the command line, where it can be stopped and resumed:
#
#     lfm-ppl compare constrained

# %%
import os
from pathlib import Path

import numpyro

numpyro.enable_x64()

import jax
import numpy as np
import pandas as pd
from matplotlib import pyplot as plt

import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.studies import scores
from lfm_ppl.studies.constrained import estimators, figures, problem, study

quick = bool(os.environ.get("LFM_QUICK"))
pd.set_option("display.width", 160, "display.max_columns", 30)

# %% [markdown]
# ## A bound is one argument
#
# $\dot x = 0.25\,\ell - 0.6\,x + w$: a protein $\ell$, of which only the product $x$ is measured, pushes. Every tenth
# sample of a record, and the estimate without and with the bound $\ell \ge 0$.

# %%
record = problem.record("half sines", 0)
few = slice(0, 1501, 10)
model = problem.transcription(scale=1.0, lengthscale=1.0)
times, y, truth = problem.TIMES[few], record.y[few], record.force[few]
smoothed = lfm.smooth(model, times, y).force("factor").mean
computed = lfm.full_information(model, times, y, lower={"factor": 0.0}, grid=times)
pd.DataFrame({"least": [smoothed.min(), computed.force("factor").mean.min()],
              "MSE": [np.mean((a - truth) ** 2) for a in (smoothed, computed.force("factor").mean)]},
             ["smoother", "full information"]).astype(float).round(4)

# %% [markdown]
# Full information gives the most probable trajectory. Of bands that respect the bound, and of draws that do, it says
# nothing; these come from expectation propagation on the same rows. Each draw is feasible, to the last bit.

# %%
posterior = lfm.constrained_posterior(model, times, y, lower={"factor": 0.0}, grid=times)
low, high = posterior.interval("factor")
draws = posterior.sample(jax.random.key(0), 5).forces["factor"]
figure, axes = plt.subplots(figsize=(7, 2.4), layout="constrained")
axes.fill_between(posterior.times, low, high, color="#B3D5E9", lw=0, label="95% band")
axes.plot(posterior.times, draws.T, color="#0072B2", lw=0.5, label=["draws", *[None] * 4])
axes.plot(times, truth, color="black", lw=0.8, ls="--", label="truth")
axes.set(xlabel="time (s)", ylabel="force", xlim=(0, 15), ylim=(0, 2))
axes.legend(frameon=False, ncols=3)
print(f"least value of the draws: {draws.min():.1e}")

# %% [markdown]
# ## Hyperparameters
#
# The source takes the rate $\lambda = \sqrt 3 / \text{lengthscale}$ as one more state, which does not change, and lets
# the cost decide on it. With `learnt=True` the model below has the states $(x, \ell, \dot\ell, \lambda)$; it is not
# linear any more, and `lfm.full_information` takes Gauss-Newton steps. With the weight $Q$ of the disturbance
# $w = \ddot\ell + 2 \lambda \dot\ell + \lambda^2 \ell$ a constant, as in the source, the cost of a path is, but for
# what happens at its ends,
#
# $$\int Q\,w^2\,dt = Q \int \ddot\ell^2 + 2 \lambda^2 \dot\ell^2 + \lambda^4 \ell^2\,dt,$$
#
# which is least at $\lambda = 0$ for every force: the lengthscale goes to infinity. With the weight that belongs to
# $\lambda$, $Q = 1 / 4 \lambda^3$, there is a minimum, but at lengthscales that are too short, since nothing stands
# against large disturbances: the density of a path has the factor $Q^{1/2}$ for each sample, which the cost has not.
# With that factor the density of a path without disturbances is infinite at $\lambda = 0$. The marginal likelihood
# integrates the path out, and has neither fault.

# %%
states = lfm.full_information(problem.companion(1.0, np.zeros(3), learnt=True), times, y,
                              lower={"factor": 0.0, "rate": 0.0}, grid=times, tolerance=1e-8)
learning = problem.learning("all")
likeliest = estimators.posterior_mode(learning, record.y)
pd.Series({"a state, Q constant": float(np.sqrt(3.0) / states.state("rate").mean[0]),
           "a state, Q with it": estimators.learn_rate_as_state("weight", record.y[None])[0, 0],
           "marginal likelihood": np.exp(likeliest[0])}, name="lengthscale (s)").round(2)

# %% [markdown]
# ## Many records
#
# The source has one record, does not say what its force is, and learns the lengthscale from the first 60 of 1,500
# samples. Here are four shapes of force. *smoother, 60 samples* and *delayed MHE, 60 samples* have the lengthscale that
# maximises the likelihood of these samples; in *delayed MHE, rate a state* the first window's cost decides, as in the
# source. A window starts from the earlier estimate, as printed. *rate a state* and *rate in Q* are the two ways above,
# with the whole record. All others have the scale and the lengthscale that maximise the posterior density given the
# whole record.
#
# What makes most of the difference is to learn from the whole record and to estimate with all of it; the bound adds to
# it. With the rate as a state the lengthscale has next to nothing to do with the force, and the error is what the
# weights make of it: twice that of the marginal likelihood with weights that were guessed well, five times with those
# of the rate. The bands of expectation propagation respect the bound. They are the shortest 95% intervals: a central
# one would leave out a force that is exactly zero.

# %%
settings = study.ConstrainedSettings()
# The folder of an earlier run of `lfm-ppl compare constrained`; without one everything is computed here.
folder = Path(os.environ.get("LFM_COMPARE", "lfm-results/compare/constrained"))
# Quick mode leaves the study out, which compiles for minutes; `lfm-ppl compare constrained --quick` is a little of it.
result = None if quick else study.STUDY.run(settings, folder)
quick or scores.readable(result.tables["transcription"])

# %%
quick or figures.plot_forces(result.data)

# %%
quick or figures.plot_errors(result.data)

# %%
quick or scores.readable(result.tables["shapes"]).T

# %% [markdown]
# ## A target on reentry
#
# The source's target: it is at 65 km and falls at 3 km/s, and the estimator starts at 55 km and 2 km/s, with next to no
# weight. Only distances are measured; dynamics and measurement are not linear.

# %%
quick or figures.plot_target(result.data)

# %% [markdown]
# ## Pituitary and thyroid
#
# TRH, a hormone of the hypothalamus, cannot be measured in blood. What it drives can: TSH, FT3 and FT4, once an hour
# over a day. The model `thyroid` is that of the source, whose published steady state it has in all printed digits; the
# patients are simulated, with TRH that follows the time of day and comes in pulses. Level, scale and lengthscale of TRH
# and the error of the assays are learnt from each patient's own day.

# %%
thyroid = loading.load("thyroid")
print(thyroid.summary)
pd.Series(thyroid.parameters)

# %%
quick or figures.plot_patient(result.data)

# %%
quick or figures.plot_peaks(result.data)

# %%
quick or scores.readable(result.tables["others"])

# %% [markdown]
# **Answer.** Full information with parameters from the whole record: its median squared error is 0.0009, that of the
# smoother without bounds 0.0013, and that of a moving horizon as published 0.0054. Expectation propagation has honest
# bands that respect the bounds: they hold 97% of the truth. In thyroid patients those of TRH, learnt from each
# patient's own day, hold 93% of the truth, and the daily wave of TRH is found within an hour in every patient.
