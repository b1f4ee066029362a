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
# # Counts, gross errors, yes and no: how good are Gaussian factors?
#
# $$f(t) = \text{level} + u(t), \qquad y_k \sim p(\cdot \mid f(t_k)).$$
#
# Only `observation=` of a model says what its data are. A family beyond the Gaussian has no closed likelihood, and the
# filter takes a Gaussian factor in the place of each value. `factors=` says how factors are refined: expectation
# propagation (EP, the default), variational, or Laplace. Here each is held against exact sampling of the same
# posterior, with the parameters held fixed:
#
# - disasters in British coal mines, 1851 to 1962, in 333 bins of four months (Poisson);
# - 200 simulated answers of yes or no;
# - 200 simulated measurements with Student's t errors, of which every tenth is off by 20 scales.
#
# The reference takes the process as its values at the data, with a dense covariance and no filter: elliptical slices
# for means, standard deviations and predictions, importance sampling for the evidence. The same comparison, of these
# and of four models of a bank's calls, runs from the command line, where it can be stopped and resumed:
#
#     lfm-ppl compare counts --data FOLDER

# %%
import os
from pathlib import Path

import numpyro

numpyro.enable_x64()

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import lfm_ppl as lfm
from lfm_ppl.studies import scores
from lfm_ppl.studies.counts import figures, problem, study

quick = bool(os.environ.get("LFM_QUICK"))
pd.set_option("display.width", 160, "display.max_columns", 30)

# %% [markdown]
# ## A model of counts in five lines
#
# The process is the logarithm of a rate; `observation=` is all that differs from a Gaussian model. Counts that nobody
# made are NaN.

# %%
def build(observation):
    return lfm.LatentForceModel(lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(1.0, 3.0)}, observation,
                                lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))


times = np.arange(40.0)
counted = build(lfm.PoissonObservation(lambda x, u, t: 1.5 + u))
simulation = lfm.simulate(jax.random.key(2), counted, times)
y = np.where((times < 15)[:, None] | (times > 21)[:, None], simulation.y, np.nan)
likelihood = lfm.MarginalLikelihood(counted, times)
print(f"log Z by EP: {float(likelihood.log_prob(y)):.4f}")

# %% [markdown]
# ## The comparison

# %%
shared = Path(os.environ.get("LFM_DATA", "../shared/data"))
data = str(shared) if (shared / problem.DISASTERS).is_file() and not quick else None
settings = study.CountsSettings.quick() if quick else study.CountsSettings(
    data=data, problems=(problem.COAL, *problem.SIMULATED))
# The folder of an earlier run with these settings; without one everything is computed here.
folder = Path(os.environ.get("LFM_COMPARE", "lfm-results/compare/counts"))
result = study.STUDY.run(settings, folder)
print("real disasters" if data else "simulated disasters")

# %% [markdown]
# ## The rate of disasters
#
# The reference's median and 95% band are the dashed lines.

# %%
figures.plot_coal(settings, result.data)

# %% [markdown]
# ## The posterior of the predictor
#
# `less reference` is the error of log Z, `mean` the largest error of a posterior mean in posterior standard deviations,
# `sd` the largest relative error of a standard deviation, `covered` the share of the true predictor in 95% bands, and
# `seconds` the CPU time of one evidence with its gradient (of the reference: of all draws, with the compilation). The
# reference's own error is up to 0.03 in `mean` and `sd`, and 0.005 in log Z.

# %%
scores.readable(result.tables["accuracy"])

# %% [markdown]
# Dotted: 0.2 in log Z, 0.05 posterior standard deviations, 3%. Laplace's method takes the mode for the mean, which is
# not the same for skew posteriors, and its log Z is the furthest off for yes or no and for gross errors.
#
# A run of the reference with 160,000 draws, accurate to 0.005, gives the largest errors of EP: standard deviations of
# Student's t are within 0.021 of the exact ones, of yes or no within 0.040; means within 0.017 and 0.009 of one.

# %%
figures.plot_errors(settings, result.data)

# %% [markdown]
# ## Held-out data
#
# Negative log predictive density of each value given the other folds (smaller is better), and the share of values in
# their 95% predictive intervals. The methods cannot be told apart by what they predict. Gross errors are no part of the
# model of Student's t, which is why fewer than 95% of its data are covered.

# %%
scores.readable(result.tables["prediction"])

# %% [markdown]
# ## The parameters, and the reference itself
#
# `ess` and `r_hat` describe the elliptical slices: the worst of 40 entries of the predictor; `share` is the
# effective share of the draws of importance sampling.

# %%
result.data["parameters"].to_dataframe().round(3)

# %%
result.data["comparison"].sel({"method": "reference"}, drop=True)[["ess", "r_hat", "share"]].to_dataframe().round(3)

# %% [markdown]
# **Answer.** Good: means by expectation propagation are within 0.03 posterior standard deviations of exact sampling,
# standard deviations within 4%, in a thousandth of its time. Laplace's method is off by up to 0.4 standard deviations.
# Held-out data do not tell the methods apart.
