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
# # A call centre: queues tracked through days whose arrivals nearly repeat
#
# **Question.** How well is a queue predicted between few readings, if the arrivals repeat from day to day, nearly?
#
# $$\frac{dL}{dt} = -\Omega(t)\,\frac{L}{1 + L} + \zeta(t), \qquad y_k = L(t_k) + e_k.$$
#
# $L$ is the mean number of customers in the queue, $\Omega$ the known service rate, and $\zeta$ the unknown rate of
# arrivals, which nearly repeats from day to day. The source is S. Reece and others, *Efficient state-space inference of
# periodic latent force models* (JMLR 2014), section 8. Its calls are not public; these are the calls of a bank, every
# five minutes from 7:00 to 21:00 (J. Weinberg, L. Brown and J. Stroud, JASA 2007), or simulated ones where those are
# not there. They are some 38 a minute, and are scaled, all days alike, to 0.7 of $\Omega = 10$ on average, at which the
# queue of a middling Thursday reaches some 25 customers, as in the source. Opening hours are joined day to day, so that
# a cycle has 14 hours.
#
# The queue is computed from the counts. It is read every 40 minutes, with an error of 0.5 customers, on three
# Thursdays, from which a method learns its parameters (maximum likelihood, the best of three searches), and every three
# hours on the fourth, which it tracks: at every five minutes the estimate is that of the filter, given the readings up
# to then. The test day has the service rate of training, or 15 in its first half and 5 in its second.
#
# The same study runs from the command line, where it can be stopped and resumed:
#
#     lfm-ppl compare call-centre --data FOLDER

# %%
import os
import warnings
from pathlib import Path

import numpyro

numpyro.enable_x64()

import pandas as pd

from lfm_ppl.studies import scores
from lfm_ppl.studies.call_centre import counts, figures, problem, study

quick = bool(os.environ.get("LFM_QUICK"))
pd.set_option("display.width", 160, "display.max_columns", 30)
shared = Path(os.environ.get("LFM_DATA", "../shared/data")) / "calls"
data = str(shared) if shared.is_dir() and not quick else None
settings = study.CallCentreSettings.quick(days=1) if quick else study.CallCentreSettings(data=data)
# The folder of an earlier run of `lfm-ppl compare call-centre`; without one everything is computed here.
folder = Path(os.environ.get("LFM_COMPARE", "lfm-results/compare/call-centre"))
with warnings.catch_warnings():
    warnings.simplefilter("ignore", counts.OverloadWarning)
    result = study.STUDY.run(settings, folder)
first = problem.build_window(settings.data, settings.weekday, 0, settings.seed)
print("real calls" if data else "simulated calls")

# %% [markdown]
# ## The service rate of training
#
# Three days of training, then the test day. A force without a period (Matern) knows nothing of the next three hours.

# %%
figures.plot_queues(first, result.data, "constant")

# %% [markdown]
# A model whose days are all alike (periodic) is far too sure of itself. RMSE over the day's 168 five minutes, and the
# log density of the true queue at these times, summed (ELL); the source does not say at how many times its own is
# taken, so that only the order can be compared.

# %%
scores.readable(result.tables["constant"])

# %% [markdown]
# ## A changed service rate
#
# At $\Omega = 5$ in the afternoon the bank's calls exceed what is served for hours, and the queue grows to hundreds.

# %%
figures.plot_queues(first, result.data, "changed")

# %%
scores.readable(result.tables["changed"])

# %% [markdown]
# ## Arrivals

# %%
figures.plot_arrivals(first, result.data)

# %%
figures.plot_cycles(first, result.data)

# %% [markdown]
# ## All test days

# %%
figures.plot_errors(result.data)

# %% [markdown]
# ## Parameters integrated out
#
# Three days say little about how alike days are, and the most likely value is taken for certain: the bands above are
# too narrow. Integrating the parameters out, over their posterior given the training, makes them honest, and the
# estimates a little better. The gain is in the log density of a day's queue.

# %%
scores.readable(result.tables["gain"])

# %% [markdown]
# These are weighted draws about every mode of the posterior that searches from three starts find: `several modes` is
# the share of days on which there is more than one, `beyond` the largest share of a posterior that is not about its
# highest mode. NUTS, which shares the density with them and the mode about which it starts, finds the same posterior,
# here for the first day: how far apart the means are at most, in posterior standard deviations, and both gains on that
# day.

# %%
scores.readable(result.tables["agreement"])

# %%
scores.readable(result.tables["learnt"])

# %% [markdown]
# **Answer.** A quasi-periodic force has a quarter of the error of a force that knows nothing of days, and a half of
# that of one whose days are all alike. Its bands hold 86% at the most likely parameters, and 95% with the parameters
# integrated out.
