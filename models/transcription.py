"""Gene expression driven by an unobserved transcription factor.

The expression x_j of each target gene j follows

    dx_j/dt = basal_j + sensitivity_j g(u(t)) - decay_j x_j,
    y_jk = x_j(t_k) + e_jk,    e_jk ~ N(0, noise_sd_j^2),

where g(u) is the activity of the transcription factor and u a Gaussian process with a Matern-3/2
covariance. The option `link` chooses g:

    linear       u                         repression   1 / (gamma + exp(u))
    softplus     log(1 + exp(u))           exponential  exp(u)
    saturation   exp(u) / (gamma + exp(u))

Expression starts near the resting level, x_j(0) ~ N(basal_j / decay_j, 0.1^2).

If the link is not linear, a single pass of the filter biases the posterior, on the p53 data by up to half a posterior
standard deviation. The likelihood therefore uses three iterations of posterior linearisation, whose log evidence is
exact to 0.03 there. `--iterations 0` is the single pass: four times as fast, for a first look.

With the option `df` the errors e_jk are noise_sd_j times Student's t with that many degrees of freedom, which makes
the rates robust against a few outliers; the noise_sd of their gene grows. For example:

    lfm-ppl fit transcription --data p53.csv --option df=4

The genes are the columns of the data file, any number of them. Two conventions make one set of
priors serve all files. Each gene of a data file is divided by its own largest value, so that
expression is of order one; decays, the factor's amplitude and all other numbers are relative to
that, and `basal` and `sensitivity` return to the units of the file when multiplied by it. Rates
have priors around 10 / duration of the experiment, so that hours, minutes and seconds all work.

The amplitude of u and all sensitivities trade off. One known sensitivity removes the ambiguity:
a file in hours with the gene CDKN1A (p21), a target of p53, has its sensitivity fixed at 1 and its
decay at the measured 0.8 per hour unless these are set otherwise or freed.

Sources: J. Hartikainen, M. Seppanen and S. Sarkka, State-space inference for non-linear latent
force models (ICML 2012), section 5.1; J. Hartikainen (2013), equations 3.42 to 3.46; M. Barenco et
al., Genome Biology 7:R25 (2006).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

LINKS = ("softplus", "linear", "saturation", "repression", "exponential")
OUTPUTS = None
UNITS: dict[str, str] = {}
OPTIONS = {
    "link": ("softplus", LINKS, "the activity g(u) of the transcription factor"),
    "gamma": (0.5, float, "saturation constant of the links saturation and repression"),
    "df": (0.0, float, "degrees of freedom of Student's t errors, 4 for example; 0: Gaussian errors"),
}
PARAMETERS = {
    "basal": "rate of production without the factor (expression/time)",
    "sensitivity": "response to the activity of the factor (expression/time)",
    "decay": "rate of decay (1/time)",
    "scale": "standard deviation of the Gaussian process u (1)",
    "lengthscale": "lengthscale of u (time)",
    "noise_sd": "standard deviation of the observation noise, or scale of Student's t (expression)",
}
FACTOR = "transcription factor"
START_SD = 0.1
STEPS = 6  # log likelihood within 0.02 of its limit over the posterior of the p53 data


def activity(u: jax.Array, link: str, gamma: float) -> jax.Array:
    """Return g(u), the activity of the factor.

    Raises:
        ValueError: the link is unknown, or the saturation constant is not positive.
    """
    is_concrete = not isinstance(gamma, jax.core.Tracer)
    if link in ("saturation", "repression") and is_concrete and not np.all(np.asarray(gamma) > 0):
        raise ValueError(f"gamma, the saturation constant, must be positive, got {gamma}.")
    if link == "linear":
        return u
    if link == "softplus":
        return jax.nn.softplus(u)
    if link == "exponential":
        return jnp.exp(u)
    if link == "saturation":
        return jax.nn.sigmoid(u - jnp.log(gamma))
    if link == "repression":
        return jax.nn.sigmoid(-u + jnp.log(gamma)) / gamma
    raise ValueError(f"link must be one of {', '.join(LINKS)}, got {link!r}.")


def build(
    basal,
    sensitivity,
    decay,
    scale,
    lengthscale,
    noise_sd,
    outputs,
    link="softplus",
    gamma=0.5,
    units=None,
    start=None,
    df=0.0,
) -> lfm.LatentForceModel:
    """Return the model of the genes `outputs`.

    Args:
        basal: see PARAMETERS, shape (N,), like sensitivity, decay and noise_sd.
        sensitivity: see PARAMETERS.
        decay: see PARAMETERS.
        scale: standard deviation of the force.
        lengthscale: lengthscale of the force.
        noise_sd: see PARAMETERS.
        outputs: names of the N genes.
        link: the activity of the factor.
        gamma: saturation constant.
        units: name -> unit.
        start: initial expression (N,) if it is known; None: near the resting level.
        df: degrees of freedom of Student's t errors; 0: Gaussian errors.
    """
    size = len(outputs)
    noise_sd = jnp.broadcast_to(jnp.asarray(noise_sd), (size,))
    resting_state = lfm.Gaussian(basal / decay, START_SD**2 * jnp.eye(size))
    return lfm.LatentForceModel(
        dynamics=lambda x, u, t: basal + sensitivity * activity(u[0], link, gamma) - decay * x,
        forces={FACTOR: lfm.Matern(scale=scale, lengthscale=lengthscale, order=1)},
        observation=(lfm.StudentTObservation(lambda x, u, t: x, df, noise_sd) if df
                     else lfm.GaussianObservation(lambda x, u, t: x, sd=noise_sd)),
        initial_state=resting_state if start is None else lfm.Gaussian(start, jnp.zeros((size, size))),
        state_names=outputs,
        output_names=outputs,
        units=units,
        deterministics={} if link == "linear" else {"activity": lambda x, u, t: activity(u[0], link, gamma)},
    )


def model(times, y=None, outputs=None, units=None, link="softplus", gamma=0.5, df=0.0) -> None:
    """Sample the rates of all genes, the force's parameters and the noise, and score expression.

    Args:
        times: observation times, shape (T,).
        y: expression, shape (T, N), of order one; NaN is missing, None draws from the prior.
        outputs: the names of the N genes; needed where y is None.
        units: name -> unit, for plots.
        link: the activity of the factor, see the module.
        gamma: saturation constant.
        df: degrees of freedom of Student's t errors; 0: Gaussian errors.
    """
    if outputs is None:
        if y is None:
            raise ValueError("give the names of the genes, outputs=(...), where there is no y.")
        outputs = tuple(f"gene {j + 1}" for j in range(y.shape[1]))
    outputs = tuple(outputs)
    duration = jnp.ptp(jnp.asarray(times, dtype=float))
    rate = jnp.where(duration > 0, 10.0 / jnp.where(duration > 0, duration, 1.0), 1.0)

    def per_gene(name, median, spread):
        prior = dist.LogNormal(jnp.log(median), spread).expand([len(outputs)]).to_event(1)
        return numpyro.sample(name, prior, infer={"event_dims": ["output"]})

    basal = per_gene("basal", 0.05 * rate, 1.0)
    sensitivity = per_gene("sensitivity", 0.5 * rate, 0.8)
    decay = per_gene("decay", rate, 0.8)
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.5))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(2.0 / rate), 0.5))
    noise_sd = per_gene("noise_sd", 0.1, 0.7)
    system = build(basal, sensitivity, decay, scale, lengthscale, noise_sd, outputs, link, gamma, units, df=df)
    # Full steps of the iterations converge fastest, because the density of the force has one mode.
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=STEPS, damping=1.0), obs=y)


def simulate(seed: int = 0, link: str = "softplus", gamma: float = 0.5, df: float = 0.0) -> lfm.Data:
    """Simulate three genes on t in [0, 15] with random rates, observed 13 times, noise 0.1.

    The rates are drawn as in the source: basal ~ U(0, 0.1), decay ~ U(0, 2), sensitivity ~ U(0, 1),
    and the expression starts U(-0.1, 0.1) away from rest.
    """
    random = np.random.default_rng(seed)
    outputs = ("gene 1", "gene 2", "gene 3")
    truth: dict[str, Any] = {
        "basal": random.uniform(0.0, 0.1, 3),
        "decay": random.uniform(0.0, 2.0, 3),
        "sensitivity": random.uniform(0.0, 1.0, 3),
        "scale": 1.0,
        "lengthscale": 2.0,
        "noise_sd": np.full(3, 0.1),
    }
    start = truth["basal"] / truth["decay"] + random.uniform(-0.1, 0.1, 3)
    system = build(**truth, outputs=outputs, link=link, gamma=gamma, start=start, df=df)
    grid = np.linspace(0.0, 15.0, 361)
    observed = np.arange(0, 361, 30)
    simulation = lfm.simulate(jax.random.key(seed), system, grid)
    return lfm.Data(
        times=grid[observed],
        y=np.asarray(simulation.y)[observed],
        outputs=outputs,
        units=UNITS,
        truth={"times": grid, "forces": simulation.forces, "state": simulation.state, "parameters": truth},
    )


def prepare(data: lfm.Data) -> lfm.Data:
    """Divide each gene, and its true values if they are known, by its largest value.

    Raises:
        ValueError: a gene has no positive value.
    """
    largest = np.max(np.where(np.isnan(data.y), -np.inf, data.y), axis=0)
    for gene, value in zip(data.outputs, largest, strict=True):
        if not value > 0:
            raise ValueError(
                f"gene {gene!r} has no positive value to be scaled by; leave the column out, or "
                "give expression on its natural scale, not as logarithms."
            )
    factors = ", ".join(f"{g} {f:.6g}" for g, f in zip(data.outputs, largest, strict=True))
    note = (
        f"Each gene is divided by its largest value ({factors}); basal, sensitivity and noise_sd "
        "are relative to it, decay is not affected."
    )
    truth = None if data.truth is None else _scaled(data.truth, largest)
    return dataclasses.replace(data, y=data.y / largest, truth=truth, note=note)


def _scaled(truth, largest):
    truth = dict(truth)
    if "state" in truth:
        truth["state"] = truth["state"] / largest
    if "parameters" in truth:
        scaled = ("basal", "sensitivity", "noise_sd")
        parameters = truth["parameters"].items()
        truth["parameters"] = {k: v / largest if k in scaled else v for k, v in parameters}
    return truth


def anchors(data: lfm.Data) -> dict[str, float]:
    """Return the decay of CDKN1A per hour from the literature, and its sensitivity as the unit."""
    hours = data.units.get("time") in ("h", "hr", "hour", "hours")
    if "CDKN1A" in data.outputs and hours:
        return {"sensitivity[CDKN1A]": 1.0, "decay[CDKN1A]": 0.8}
    return {}
