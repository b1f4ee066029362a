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
# # The activity of p53 from its targets
#
# After irradiation the tumour suppressor p53 is activated and switches on its target genes.
# Barenco et al. (2006) measured the expression of five targets in human leukaemia cells, at seven
# times in three replicates. The activity of p53 itself was not measured. The model:
#
# $$\frac{dx_j}{dt} = B_j + S_j\, g(u(t)) - D_j\, x_j, \qquad j = 1, \dots, 5,$$
#
# with a basal rate, a sensitivity and a decay for each gene, and one common activity
# $g(u) = \log(1 + e^u)$ of a Gaussian process $u$. We infer all of it.

# %%
import os
from pathlib import Path

import numpyro

numpyro.set_host_device_count(4)
numpyro.enable_x64()

import arviz as az
import jax
import matplotlib.pyplot as plt
import numpy as np

import lfm_ppl as lfm
from lfm_ppl import loading
from lfm_ppl.analysis import plots, tables
from lfm_ppl.analysis.arviz_data import convergence_warnings, group, summary

quick = bool(os.environ.get("LFM_QUICK"))
size = dict(chains=2, warmup=50, samples=50) if quick else dict(chains=4, warmup=1000, samples=1000)

# %% [markdown]
# ## Data
#
# The arrays are read in place; `LFM_DATA` says where. Without them the notebook takes the simulated
# genes of the model file, and says so.

# %%
transcription = loading.load("transcription")
folder = Path(os.environ.get("LFM_DATA", "../shared/data"))
path = folder / "p53" / "p53_targets.csv"
if path.is_file():
    data = transcription.prepare(lfm.read_csv(path))
    print(f"{path.name}: {len(data.times)} rows of {', '.join(data.outputs)}")
else:
    data = transcription.simulate()
    print(f"{path} is not there: this run shows the model's simulated genes instead.")
print(data.note)

# %% [markdown]
# Scaling all sensitivities up and the activity down changes nothing, so one of them has to be given.
# The literature fixes the gene CDKN1A (p21): sensitivity 1, and the decay that was measured in a
# separate experiment, 0.8 per hour. On the command line this is
# `lfm-ppl fit transcription --data p53_targets.csv`, where these two are the default, or
# `--set 'decay[CDKN1A]=0.8'` in so many words.

# %%
fixed = transcription.anchors(data)
print(fixed)

# %% [markdown]
# ## Posterior

# %%
result = lfm.fit(
    transcription.model,
    data.times,
    data.y,
    model_kwargs=transcription.keywords(data, {}),
    fixed=fixed,
    progress=False,
    **size,
)
print(tables.text_table(summary(result)))
print("\n".join(convergence_warnings(result)) or "No complaint about convergence.")
print(f"{result.attrs['wall_time_s']:.0f} s")

# %%
plots.plot_fit(result, width="full")

# %% [markdown]
# ## The activity of p53
#
# Every draw of $u$ gives one draw of the activity $g(u)$. It rises to a peak about four hours after
# irradiation and falls.

# %%
trajectories = group(result, "trajectories")
force = trajectories["forces"].isel(force=0).stack(sample=("chain", "draw"))
activity = np.asarray(jax.nn.softplus(force.transpose("at", "sample").values))
hours = trajectories["at"].values
figure, axes = plt.subplots(figsize=(7.0, 2.6), layout="constrained")
low, middle, high = np.quantile(activity, [0.025, 0.5, 0.975], axis=1)
axes.fill_between(hours, low, high, alpha=0.3, linewidth=0, label="95%")
axes.plot(hours, middle, label="median")
axes.set(xlabel="time (h)", ylabel="activity", ylim=(0, None))
axes.legend(frameon=False)
plt.show()

peak = hours[activity.argmax(axis=0)]
early = np.mean(peak < hours[-1] / 2)
print(f"peak at {np.median(peak):.1f} h, 95%: {np.quantile(peak, 0.025):.1f} to {np.quantile(peak, 0.975):.1f} h")
print(f"probability that it lies in the first half of the experiment: {early:.3f}")

# %% [markdown]
# ## Another shape of response
#
# Does a saturating response describe the data better? The leave-one-out conditionals in the result
# answer through ArviZ: `az.compare` ranks models by how well each observation is predicted from all
# the others. A difference (`elpd_diff`) that is small against its standard error (`dse`) decides nothing, and seven
# times in three replicates leave room for both shapes.

# %%
saturation = lfm.fit(
    transcription.model,
    data.times,
    data.y,
    model_kwargs=transcription.keywords(data, {"link": "saturation"}),
    fixed=fixed,
    progress=False,
    **size,
)
print(az.compare({"softplus": result, "saturation": saturation}).to_string())
