"""A drug in the body: absorption with a lag, one or two compartments, and an unexplained input.

Doses d_k, swallowed at times t_k, reach the gut after a lag. The drug is absorbed at a first-order rate, distributed
between the blood (the central compartment) and, with two compartments, a tissue, and eliminated from the blood:

    gut'    = -absorption gut,    gut <- gut + d_k at t_k + lag,
    blood'  = absorption gut - (clearance + exchange) / volume blood + exchange / tissue_volume tissue + u(t),
    tissue' = exchange / volume blood - exchange / tissue_volume tissue,
    y_k = blood(t_k) / volume + e_k,    e_k ~ N(0, noise_sd^2).

The unexplained input u is a Gaussian process with a Matern-3/2 covariance: absorption that is not of the first order,
or a recirculation of the drug. Clearance and volumes are relative to the share of the dose that is absorbed. An
absorption that is slower than the elimination explains the same data as a fast one with another volume ("flip-flop");
the priors prefer the fast one. The model is linear, so that filter, smoother and likelihood are exact.

A data file has a column with the doses, in rows of its own or beside a concentration: ``--events COLUMN:gut`` where the
column is not called ``dose``, ``--events AMT:gut,blood`` where a column CMT numbers gut and blood. A dose with a RATE
or DUR is an infusion.

Sources: M. Rowland and T. N. Tozer, Clinical Pharmacokinetics and Pharmacodynamics, 4th edition (2011), chapters 6, 11
and 19; the unexplained input follows S. Sarkka, M. Alvarez and N. Lawrence, Gaussian process latent force models for
learning and stochastic control of physical systems, IEEE Trans. Automatic Control 64 (2019).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("concentration",)
INPUTS = {"dose": "dose:gut"}
UNITS = {"time": "h", "concentration": "mg/L", "dose": "mg", "gut": "mg", "blood": "mg", "tissue": "mg", "u": "mg/h"}
OPTIONS: dict[str, Any] = {"compartments": (1, (1, 2), "compartments: the blood alone, or blood and tissue")}
PARAMETERS = {
    "absorption": "rate at which the drug leaves the gut (1/h)",
    "lag": "time from a dose to the beginning of its absorption (h)",
    "clearance": "volume of blood that is cleared of the drug in an hour (L/h)",
    "volume": "volume of the central compartment (L)",
    "exchange": "flow between blood and tissue, of two compartments (L/h)",
    "tissue_volume": "volume of the tissue, of two compartments (L)",
    "scale": "standard deviation of the unexplained input (mg/h)",
    "lengthscale": "lengthscale of the unexplained input (h)",
    "noise_sd": "standard deviation of the measurement noise (mg/L)",
}
TRUTH = {"absorption": 1.2, "lag": 0.4, "clearance": 3.0, "volume": 30.0, "scale": 1.0, "lengthscale": 4.0,
         "noise_sd": 0.1}
TRUTH_OF_TISSUE = {"exchange": 4.0, "tissue_volume": 40.0}


def build(absorption, lag, clearance, volume, scale, lengthscale, noise_sd, exchange=None, tissue_volume=None, *,
          events=(), units=None) -> lfm.LatentForceModel:
    """Return the body with these parameters; without an exchange it has one compartment."""

    def dynamics(x, u, t):
        gut, blood = x[0], x[1]
        absorbed = absorption * gut
        change = absorbed - clearance / volume * blood + u[0]
        if exchange is None:
            return jnp.stack([-absorbed, change])
        flow = exchange * (blood / volume - x[2] / tissue_volume)
        return jnp.stack([-absorbed, change - flow, flow])

    names = ("gut", "blood") if exchange is None else ("gut", "blood", "tissue")
    delayed = [event.delayed(lag) if event.state == "gut" else event for event in events]
    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={"u": lfm.Matern(scale=scale, lengthscale=lengthscale, order=1)},
        observation=lfm.GaussianObservation(lambda x, u, t: x[1:2] / volume, sd=noise_sd),
        initial_state=lfm.Gaussian(jnp.zeros(len(names)), jnp.zeros((len(names), len(names)))),
        state_names=names,
        output_names=OUTPUTS,
        units=units,
        events=delayed,
    )


def model(times, y=None, events=(), compartments: int = 1, units=None) -> None:
    """Sample the parameters of the body and of the unexplained input, and score the concentrations.

    Args:
        times: observation times, shape (T,); the first one is that of the first dose or earlier.
        y: concentrations, shape (T, 1); NaN is missing, None draws from the prior predictive.
        events: the doses, `lfm.Dose` and `lfm.Infusion`; those to the state "gut" begin to be absorbed after the lag.
        compartments: 1 or 2.
        units: name -> unit, for plots.
    """
    parameters = {
        "absorption": numpyro.sample("absorption", dist.LogNormal(0.3, 0.5)),
        "lag": numpyro.sample("lag", dist.LogNormal(-1.0, 0.5)),
        "clearance": numpyro.sample("clearance", dist.LogNormal(1.0, 0.8)),
        "volume": numpyro.sample("volume", dist.LogNormal(3.5, 0.6)),
    }
    if compartments == 2:
        parameters["exchange"] = numpyro.sample("exchange", dist.LogNormal(1.0, 0.8))
        parameters["tissue_volume"] = numpyro.sample("tissue_volume", dist.LogNormal(3.5, 0.6))
    scale = numpyro.sample("scale", dist.HalfNormal(2.0))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(1.2, 0.5))
    noise_sd = numpyro.sample("noise_sd", dist.HalfNormal(0.3))
    system = build(**parameters, scale=scale, lengthscale=lengthscale, noise_sd=noise_sd, events=events, units=units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def simulate(seed: int = 0, compartments: int = 1) -> lfm.Data:
    """Simulate four doses of 100 mg, one every twelve hours, with 24 measured concentrations."""
    doses = 12.0 * np.arange(4)
    after = np.array([0.5, 1.0, 2.0, 4.0, 7.0, 11.0])
    grid = np.linspace(0.0, 48.0, 481)
    truth = TRUTH | (TRUTH_OF_TISSUE if compartments == 2 else {})
    system = build(**truth, events=[lfm.Dose(doses, 100.0 * np.ones(4), "gut")])
    simulation = lfm.simulate(jax.random.key(seed), system, grid)
    measured = np.sort(np.concatenate([dose + after for dose in doses]))
    times = np.union1d(doses, measured)
    rows = np.round(10.0 * times).astype(int)
    y = np.where(np.isin(times, measured)[:, None], np.asarray(simulation.y)[rows], np.nan)
    return lfm.Data(
        times=times,
        y=y,
        outputs=OUTPUTS,
        units=UNITS,
        inputs={"dose": (doses, 100.0 * np.ones(4), "dose:gut")},
        truth={"times": grid, "forces": simulation.forces, "state": simulation.state, "parameters": truth},
    )
