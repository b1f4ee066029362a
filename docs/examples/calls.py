"""Calls to a bank, a week ahead: python calls.py bank_calls.csv.gz (columns: DateTime, Calls; see the guide)."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd

import lfm_ppl as lfm

jax.config.update("jax_enable_x64", True)
DAYS = ("monday", "tuesday", "wednesday", "thursday")  # beside Friday


def model(times, y=None, inputs=None):
    """Log counts: the rhythm of a day, a level and a slope for each weekday, and a level x that wanders."""
    size, memory, rhythm, noise_sd = (numpyro.sample(name, dist.LogNormal(jnp.log(typical), 1.0)) for name, typical in (
        ("size", 0.1), ("memory", 48.0), ("rhythm", 1.0), ("noise_sd", 0.05)))  # memory in hours
    kernel = lfm.forces.PeriodicMatern(rhythm, 0.5, period=24.0, order=1)
    forces = {"rhythm": lfm.Periodic(kernel, functions=13, explained_variance=0.0)}
    forces |= {f"{what} of {day}": lfm.Constant(0.15) for what in ("level", "slope") for day in DAYS}
    observation = lfm.GaussianObservation(lambda x, u, t: 7.5 + x + u[0] + sum(
        inputs[day](t) * (u[1 + k] + u[5 + k] * inputs["hour"](t)) for k, day in enumerate(DAYS)), sd=noise_sd)
    centre = lfm.LatentForceModel(lambda x, u, t: -x / memory, forces, observation, lfm.Gaussian([0.0], [1.0]),
                                  process_noise=size * jnp.sqrt(2.0 / memory) * jnp.ones((1, 1)))
    numpyro.sample("y", lfm.MarginalLikelihood(centre, times), obs=y)


if __name__ == "__main__":
    calls = pd.read_csv(sys.argv[1], parse_dates=["DateTime"], index_col="DateTime")["Calls"]
    calls = calls[calls.index.hour < 21].resample("1h").sum(min_count=12).dropna()[-630:]  # 45 days of 14 hours
    table = pd.DataFrame({"log_calls": np.log(calls), "hour": (calls.index.hour - 13.5) / 6.5})
    table = table.assign(**{day: (calls.index.day_name() == day.title()).astype(float) for day in DAYS})
    data = lfm.read_table(table, outputs=["log_calls"], inputs=["hour", *DAYS], time_unit="h")
    found = lfm.backtest(model, data, horizon=70, every=14, first=434, season=70, draws=100)
    print(found.table.round(3), found.wins(), sep="\n\n")
