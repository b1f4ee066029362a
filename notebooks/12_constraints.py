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
# A concentration cannot be negative, but a Gaussian process can. Those who build moving horizon estimators respect such
# bounds and have no posterior; those who have posteriors rarely respect them. Here are both:
# `lfm.full_information`, `lfm.moving_horizon` and `lfm.constrained_posterior`, in time linear in the record.
#
# The source is T. M. Wolff, V. G. Lopez, M. A. Müller and T. Beckers, *Inference in latent force models using optimal
# state estimation*. The same experiment runs from the command line, where it can be stopped and resumed:
#
#     lfm-ppl compare constrained

# %%
import os
from pathlib import Path

import numpyro

numpyro.enable_x64()

import numpy as np
import pandas as pd

import lfm_ppl as lfm
from lfm_ppl import loading
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.constrained import experiment, figures, problem

quick = bool(os.environ.get("LFM_QUICK"))
pd.set_option("display.width", 160, "display.max_columns", 30)

# %% [markdown]
# ## A bound is one argument
#
# $\dot x = 0.25\,\ell - 0.6\,x + w$: a protein, of which only the product $x$ is measured, pushes. A tenth of a record
# of the source's, and the estimate without and with the bound $\ell \ge 0$.

# %%
record = problem.record("half sines", 0)
few = slice(0, 1501, 10)
model = problem.transcription(scale=1.0, lengthscale=1.0)
times, y = problem.TIMES[few], record.y[few]
smoothed = lfm.smooth(model, times, y).force("factor").mean
found = lfm.full_information(model, times, y, lower={"factor": 0.0}, grid=times)
pd.DataFrame(
    {"least": [smoothed.min(), found.force("factor").min()],
     "MSE": [np.mean((a - record.force[few]) ** 2) for a in (smoothed, found.force("factor"))]},
    ["smoother", "full information"])

# %% [markdown]
# ## Many records
#
# The source has one record, does not say what its force is, and learns the lengthscale from the first 60 of 1,500
# samples. Here are four shapes of force. *smoother, 60 samples* and *delayed MHE, 60 samples* are the source's two
# estimators, with that lengthscale; a window of the latter starts from the earlier estimate, as printed. All others
# have the scale and the lengthscale that maximise the posterior density given the whole record.
#
# What makes most of the difference is to learn from the whole record and to estimate with all of it; the bound adds to
# it. The bands of expectation propagation respect the bound. They are the shortest 95% intervals: a central one would
# leave out a force that is exactly zero.

# %%
settings = experiment.quick() if quick else experiment.Settings()
# The folder of an earlier run of `lfm-ppl compare constrained`; without one everything is computed here.
folder = Path(os.environ.get("LFM_COMPARE", "lfm-results/compare/constrained"))
result = experiment.run(settings, folder)
scores.readable(result.transcription)

# %%
figures.plot_forces(settings, result.results)

# %%
figures.plot_errors(settings, result.results)

# %%
scores.readable(result.shapes)

# %% [markdown]
# ## A target on reentry
#
# The source's target: it is at 65 km and falls at 3 km/s, and the estimator is told 55 km and 2 km/s, with next to no
# weight. Only distances are measured; dynamics and measurement are not linear.

# %%
figures.plot_target(settings, result.results)

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
figures.plot_patient(settings, result.results)

# %%
figures.plot_peaks(settings, result.results)

# %%
scores.readable(result.others)
