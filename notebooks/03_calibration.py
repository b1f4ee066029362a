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
# # Are the posteriors right? Simulation-based calibration
#
# **Question.** Do intervals of the filter's posterior hold the truth as often as they say, with an exact and with an
# approximate likelihood?
#
# Draw parameters $\theta^*$ from the prior and data from the model at $\theta^*$. Then $\theta^*$ is itself one draw
# from the posterior given these data, so among $L$ independent posterior draws its rank is uniform on $0, \dots, L$.
# Repeated over many data sets, the histogram of the ranks must be level. A posterior that is too narrow shows as a
# valley, one too wide as a hill, a shifted one as a slope (Talts et al., 2018).
#
# This tests everything at once: the discretised force, the filter's likelihood, and the sampler.

# %%
import os
import time

import numpyro

numpyro.enable_x64()

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pandas as pd
from numpyro.infer import NUTS

import lfm_ppl as lfm
from lfm_ppl.accuracy.calibration import p_values

quick = bool(os.environ.get("LFM_QUICK"))
data_sets = 8 if quick else 240
times = np.linspace(0.0, 6.0, 10)

# %% [markdown]
# ## The model
#
# One gene, driven by one force, from a known start:
#
# $$\frac{dx}{dt} = s\,g(u(t)) - d\,x, \qquad x(0) = 0.$$
#
# With $g(u) = u$ the filter's likelihood is exact, and the ranks must be uniform. With $g(u) = \log(1 + e^u)$ it is an
# approximation: the study says whether that can be seen in the posteriors. Ten observations leave them wide.


# %%
def motif(times, y=None, link=lambda u: u, steps=10):
    decay = numpyro.sample("decay", dist.LogNormal(-0.3, 0.4))
    sensitivity = numpyro.sample("sensitivity", dist.LogNormal(0.0, 0.4))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.5, 0.3))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(-1.2, 0.3))
    model = lfm.LatentForceModel(
        dynamics=lambda x, u, t: sensitivity * link(u) - decay * x,
        forces={"u": lfm.Matern(scale=1.0, lengthscale=lengthscale, order=1)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, sd=noise_sd),
        initial_state=lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))),
    )
    numpyro.sample("y", lfm.MarginalLikelihood(model, times, steps=steps, iterations=0), obs=y)


def softplus(times, y=None):
    motif(times, y, jax.nn.softplus, steps=4)


# %% [markdown]
# ## The study
#
# `calibrate` runs all data sets in one compiled program. The draws are thinned until they are nearly independent.

# %%
samplers = {
    "NUTS": dict(kernel=lambda m: NUTS(m, forward_mode_differentiation=True), thin=3, warmup=300, batch=20),
    "RAM": dict(kernel=lfm.RAM, thin=60, warmup=2000),
}
if quick:
    samplers = {name: {**settings, "thin": 1, "warmup": 50, "batch": 8} for name, settings in samplers.items()}
computed, seconds = {}, {}
for label, model in (("linear", motif), ("softplus", softplus)):
    for sampler, settings in samplers.items():
        started = time.perf_counter()
        key = jax.random.key(12)
        computed[label, sampler] = lfm.calibrate(key, model, times, data_sets=data_sets, **settings)
        seconds[label, sampler] = time.perf_counter() - started

# %% [markdown]
# ### Linear, NUTS

# %%
lfm.plot_calibration(computed["linear", "NUTS"], width="full")

# %% [markdown]
# ### Linear, RAM

# %%
lfm.plot_calibration(computed["linear", "RAM"], width="full")

# %% [markdown]
# ### Softplus, NUTS

# %%
lfm.plot_calibration(computed["softplus", "NUTS"], width="full")

# %% [markdown]
# ### Softplus, RAM

# %%
lfm.plot_calibration(computed["softplus", "RAM"], width="full")

# %% [markdown]
# ## In numbers
#
# Two tests of uniformity for every scalar, with p-values by simulation: Pearson's statistic in 16 bins, and the
# largest distance between the distribution function of the ranks and the uniform one. Forty p-values of a sampler
# that is right are themselves uniform; the smallest of forty is below 0.025 in two studies of three.

# %%
rows = []
for (label, sampler), result in computed.items():
    for scalar, rank in result.ranks.items():
        p = p_values(rank, result.draws)
        rows.append({"model": label, "sampler": sampler, "scalar": scalar, **p})
table = pd.DataFrame(rows).set_index(["model", "sampler", "scalar"])
print(table.round(3).to_string())
print(f"\nsmallest of {table.size} p-values: {table.to_numpy().min():.3f}")
for (label, sampler), value in seconds.items():
    print(f"{label}, {sampler}: {data_sets} data sets in {value:.0f} s")

# %% [markdown]
# **Answer.** Yes. With 240 data sets of each kind the smallest of 40 p-values is 0.098. The error of the
# approximation, for the softplus, cannot be seen in the ranks.
