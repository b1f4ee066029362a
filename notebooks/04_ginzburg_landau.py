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
# # What does the Gaussian approximation cost? The Ginzburg-Landau double well
#
# $$dx = -(\alpha x + \beta x^3)\,dt + \sigma\,dB, \qquad y_k = x(t_k) + e_k, \quad e_k \sim N(0, 0.1^2),$$
#
# with $(\alpha, \beta, \sigma) = (-1, 0.1, 2)$: a diffusion that jumps between two wells, at $\pm\sqrt{10}$, observed
# every 2 units of time. Between two observations the state may change wells, so that its density has two modes and no
# Gaussian describes it. In one dimension the exact answer can be computed, by solving the Fokker-Planck equation on a
# grid. This notebook compares with it
#
# - the extended, the cubature and the Gauss-Hermite Kalman filter (EKF, CKF, GHKF with 7 points),
# - the bootstrap particle filter (40,000 particles),
#
# first with the parameters known, then in what they say about the parameters, and last when both are unknown. The
# example is that of J. Hartikainen, *Sequential Inference for Latent Temporal Gaussian Process Models* (2013), section
# 2.7.1; the paths are our own.
#
# The same comparison runs from the command line, where it can be stopped and resumed:
#
#     lfm-ppl compare ginzburg-landau

# %%
import os
from pathlib import Path

import numpyro

numpyro.enable_x64()

import pandas as pd

from lfm_ppl.studies import scores
from lfm_ppl.studies.ginzburg_landau import figures, problem, study

quick = bool(os.environ.get("LFM_QUICK"))
settings = study.GinzburgLandauSettings()
if quick:
    settings = settings.quick(realisations=1, conditional=2)
# The folder of an earlier run of `lfm-ppl compare ginzburg-landau`; without one everything is computed here.
folder = Path(os.environ.get("LFM_COMPARE", "double-well"))
result = study.STUDY.run(settings, folder)
truth = problem.realisation(settings.figure, settings.seed)
states, chains = (result.data[kind].isel(dataset=settings.figure) for kind in ("state", "mcmc"))
pd.set_option("display.width", 160, "display.max_columns", 30)

# %% [markdown]
# ## States, with the parameters known
#
# The EKF linearises at the mean. In a well it believes that the state stays there, and its band between two
# observations is too narrow, until the state turns up in the other well; on the ridge between the wells its variance
# explodes. The CKF averages over the whole density: its band holds both wells. The exact band is not symmetric about
# the mean.

# %%
figures.plot_states(truth, states)

# %% [markdown]
# The densities behind the bands, at the two times of the source's figure, and at the time elsewhere at which the exact
# filtering density of this path is most bimodal. *Its best Gaussian* has the mean and the variance of the exact
# density; a Gaussian filter can at best be that. The smoother, which knows the next observation too, has little left to
# be unsure about.

# %%
figures.plot_marginals(truth, states)

# %% [markdown]
# ## Parameters, one at a time
#
# The posterior of each parameter under a flat prior, with the other two at their true values. With everything else
# known the truth should be well inside. For the EKF it is not.

# %%
figures.plot_conditional(result.data, settings.figure)

# %% [markdown]
# One path proves little. Over many paths: how often does the truth lie outside the central 99% interval? The nominal
# rate is 1%.

# %%
figures.plot_rates(result.data)

# %%
scores.readable(result.tables["rates"])

# %% [markdown]
# `cut` is the share of posteriors that reach an end of the interval on which the prior is flat, `differs` the share of
# intervals that hold the truth where the exact one does not, or the other way round.
#
# ## Parameters and states, by MCMC
#
# Robust adaptive Metropolis (RAM) with the likelihood of either filter, NUTS with that of the CKF, and
# particle-marginal RAM, whose likelihood is estimated by particles and whose posterior is the exact one. The smoothed
# states have the parameters integrated out: means and variances by the law of total variance over posterior draws.

# %%
figures.plot_integrated(truth, chains)

# %%
scores.readable(result.tables["parameters"])

# %% [markdown]
# ## Everything in one table
#
# Means over the realisations with standard errors. `coverage` is the share of times at which the 95% band holds the
# path, `coverage parameters` that of 95% intervals that hold the true parameter. `ESS/CPU s` is the smallest bulk
# effective sample size of the three parameters for a second of CPU time of warm-up and draws, four chains. The source
# gives 0.895 (EKF) and 0.935 (CKF) as root mean squared errors of its one path with the parameters integrated out.

# %%
scores.readable(result.tables["comparison"])

# %% [markdown]
# **Answer.** A filter that takes tangents (EKF) is not usable here: its 99% intervals miss a true parameter in 84% of
# the cases, where all others are known. Those of the CKF miss it in 16%, of the Gauss-Hermite filter in 27%, and of
# the exact posterior in 3%, where 1% is nominal. With all parameters unknown the posteriors are wide, and 95%
# intervals of the CKF cover as often as those of particle-marginal RAM (0.967 both), with a hundred times as many
# effective draws per second.
