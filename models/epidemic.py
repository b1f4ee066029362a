"""An epidemic whose transmission rate nobody measured, seen through reports of new cases.

Susceptible and infectious shares S and I of a population of N follow the SIR model,

    dS/dt = -b(t) S I,    dI/dt = b(t) S I - recovery I,    b(t) = R0 recovery exp(u(t)),

with u a Gaussian process of mean zero, Matern-3/2 covariance, standard deviation `scale` and lengthscale `lengthscale`:
weather, holidays, what people do. The state is (log S, log I), in which both equations are sums of exponentials and
nothing becomes negative. Reports are overdispersed counts of the new infections a time step,

    y_k ~ NegativeBinomial(mean = reported N b S I step, concentration),

whose logarithm is linear in states and force. Recovery rate, population and the share of cases that are reported are
known: reports alone do not tell R0 from the recovery rate. At the first time nobody is immune, and the infectious share
is `seed`.

The default data are simulated: 60 days of daily reports among a hundred thousand people, R0 = 2, infectious for a week.

Source: W. O. Kermack and A. G. McKendrick, A contribution to the mathematical theory of epidemics, Proceedings of the
Royal Society A 115 (1927).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("reports",)
UNITS = {"time": "day"}
OPTIONS = {
    "population": (1e5, float, "number of people N"),
    "recovery": (1 / 7, float, "recovery rate (1/day)"),
    "reported": (0.5, float, "share of the new infections that is reported"),
}
PARAMETERS = {
    "R0": "infections by one infectious person among susceptible ones, at u = 0 (1)",
    "seed": "infectious share at the first time (1)",
    "scale": "standard deviation of the logarithm of the transmission rate about its mean (1)",
    "lengthscale": "lengthscale of the logarithm of the transmission rate (day)",
    "concentration": "concentration of the reports; large: as regular as a Poisson's (1)",
}
TRUTH = {"R0": 2.0, "seed": 1e-3, "scale": 0.3, "lengthscale": 15.0, "concentration": 10.0}
STEPS = 2  # of half a day
SEED_SD = 0.2  # of the logarithm of the infectious share: a first day differs from the model's


def build(R0, seed, scale, lengthscale, concentration, step=1.0, population=1e5, recovery=1 / 7,  # noqa: N803
          reported=0.5, units=None) -> lfm.LatentForceModel:
    """Return the epidemic with these parameters; a report counts the infections of a ``step`` of time."""
    level = jnp.log(R0 * recovery)

    def dynamics(x, u, t):
        susceptible, infectious = x
        transmission = level + u[0]
        return jnp.stack([-jnp.exp(transmission + infectious), jnp.exp(transmission + susceptible) - recovery])

    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={"log transmission": lfm.Matern(scale=scale, lengthscale=lengthscale, order=1)},
        observation=lfm.NegativeBinomialObservation(
            lambda x, u, t: level + u + x[:1] + x[1:], concentration, exposure=reported * population * step),
        initial_state=lfm.Gaussian(jnp.stack([jnp.log1p(-seed), jnp.log(seed)]), jnp.diag(jnp.array([0, SEED_SD**2]))),
        state_names=("log susceptible", "log infectious"),
        output_names=OUTPUTS,
        units=units,
    )


def model(times, y=None, population: float = 1e5, recovery: float = 1 / 7, reported: float = 0.5, units=None) -> None:
    """Sample the parameters of the epidemic, and score the reports.

    Args:
        times: of the reports, shape (T,).
        y: counts, shape (T, 1); NaN is missing, None draws from the prior predictive.
        population: number of people N.
        recovery: recovery rate.
        reported: share of the new infections that is reported.
        units: name -> unit, for plots.
    """
    ratio = numpyro.sample("R0", dist.LogNormal(0.7, 0.4))
    seed = numpyro.sample("seed", dist.LogNormal(jnp.log(1e-3), 1.0))
    scale = numpyro.sample("scale", dist.LogNormal(-1.2, 0.5))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(2.7, 0.4))
    concentration = numpyro.sample("concentration", dist.LogNormal(2.3, 1.0))
    step = float(np.median(np.diff(times)))
    system = build(ratio, seed, scale, lengthscale, concentration, step, population, recovery, reported, units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=STEPS), obs=y)


def simulate(seed: int = 0, population: float = 1e5, recovery: float = 1 / 7, reported: float = 0.5) -> lfm.Data:
    """Simulate daily reports for 60 days."""
    times = np.arange(60.0)
    system = build(**TRUTH, population=population, recovery=recovery, reported=reported)
    drawn = lfm.simulate(jax.random.key(seed), system, times)
    return lfm.Data(
        times=times,
        y=np.asarray(drawn.y),
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": times, "forces": drawn.forces, "state": drawn.state, "parameters": TRUTH},
    )
