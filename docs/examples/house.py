"""A house a day ahead: python house.py house_hourly.csv (columns: time, Ph, Ti, Ta, Th; see the guide)."""

import sys

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
import pandas as pd

import lfm_ppl as lfm

jax.config.update("jax_enable_x64", True)


def model(times, y=None, inputs=None):
    """Air exchanges heat with walls and radiator, walls with the outside; the rest is an unseen force."""
    into_air, into_walls, out, radiator = (numpyro.sample(name, dist.LogNormal(jnp.log(rate), 1.0)) for name, rate in (
        ("into_air", 0.3), ("into_walls", 0.05), ("out", 0.02), ("radiator", 0.05)))  # 1/h
    scale = numpyro.sample("scale", dist.LogNormal(jnp.log(0.1), 1.0))  # K/h
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(3.0), 0.5))  # h
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(jnp.log(0.05), 0.5))  # K

    def dynamics(x, u, t):
        air, walls = x
        d_air = into_air * (walls - air) + radiator * (inputs["Th"](t) - air) + u[0]
        return jnp.stack([d_air, into_walls * (air - walls) + out * (inputs["Ta"](t) - walls)])

    house = lfm.LatentForceModel(dynamics, {"heat": lfm.Matern(scale, lengthscale, order=0)},
                                 lfm.GaussianObservation(lambda x, u, t: x[:1], sd=noise_sd),
                                 lfm.Gaussian(jnp.array([18.0, 17.0]), jnp.diag(jnp.array([1.0, 9.0]))))
    numpyro.sample("y", lfm.MarginalLikelihood(house, times), obs=y)


if __name__ == "__main__":
    table = pd.read_csv(sys.argv[1], index_col=0, parse_dates=True)
    data = lfm.read_table(table, outputs=["Ti"], inputs={"Ta": "linear", "Th": "linear"}, time_unit="h")
    found = lfm.backtest(model, data, horizon=24, every=24, first=len(data.times) - 240, draws=200)
    print(found.table.round(3), found.wins(), sep="\n\n")
