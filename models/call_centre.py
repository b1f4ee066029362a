"""Queue of a call centre, fed by an unseen rate of arrivals that nearly repeats from day to day.

The mean number L of customers in the queue follows the fluid approximation of a queue with one server,

    dL/dt = -Omega(t) L / (1 + L) + zeta(t),    y_k = L(t_k) + e_k,    e_k ~ N(0, noise_sd^2),

where Omega is the known service rate, a number or an `lfm.Input`, and zeta the unknown rate of arrivals. At
zeta = rho Omega < Omega it settles at L = rho / (1 - rho): a few more arrivals make a much longer queue. The state is
therefore x = log(1 + L), in which Gaussians do far better,

    dx/dt = (zeta - Omega (1 - exp(-x))) exp(-x),    log(1 + y_k) ~ N(x(t_k), noise_sd^2 exp(-2 x(t_k))),

with readings below zero as zero. The option `link` says what the force u does:

    linear       zeta = u, which may be negative: customers who hang up
    softplus     zeta = log(1 + exp(u)) customers per minute, never negative

and the option `force` what u is: its mean, plus

    sqm          a periodic Matern-1/2 process whose shape changes from one cycle to the next
    cqm          the same, changing all the time
    wqm          the same, its variance growing from cycle to cycle
    periodic     the same in all cycles
    matern       a Matern-1/2 process without any period
    resonator    sinusoids of the period and its fractions, each of which wanders

`memory` is the number of cycles over which cycles stay alike: correlations fall by e, or variances double.

Times are minutes of opening hours, joined day to day from the first opening on, so that cycles begin at the multiples
of the period. A data file has a column `queue` of customers, or a column `log queue` of log(1 + customers). A short
queue settles within seconds, which no reading shows and explicit integration has to follow; the rate
r = Omega exp(-2 x) at which it settles is therefore bounded, to r / (1 + FASTEST r). Below zero, where only the tails
of the filter's Gaussians lie, exp(-x) goes on as exp(-|x|), and L / (1 + L) = 1 - exp(-x) as an odd function.

The default data are three days of 14 hours at Omega = 10 per minute, the queue read every 40 minutes.

Sources: S. Reece and others, Efficient state-space inference of periodic latent force models, Journal of Machine
Learning Research 15 (2014), section 8; W.-P. Wang, D. Tipper and S. Banerjee, A simple approximation for modeling
nonstationary queues, IEEE INFOCOM (1996).
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

LINKS = ("linear", "softplus")
FORCES = ("sqm", "cqm", "wqm", "periodic", "matern", "resonator")
OUTPUTS = None
LOG_QUEUE, QUEUE = "log queue", "queue"
UNITS = {"time": "min", "arrivals": "customers/min"}
OPTIONS = {
    "link": ("linear", LINKS, "the rate of arrivals as a function of the force"),
    "force": ("sqm", str, f"what the force is: {', '.join(FORCES)}"),
    "service": (10.0, float, "service rate Omega (customers/min); a Python caller may give an lfm.Input"),
    "period": (840.0, float, "length of a cycle (min)"),
    "functions": (9, int, "functions of which a cycle is made"),
}
PARAMETERS = {
    "mean": "mean of the force (customers/min)",
    "scale": "standard deviation of the force about its mean (customers/min)",
    "lengthscale": "lengthscale of the force within a cycle; a resonator has none (min)",
    "memory": "cycles over which cycles stay alike; not of periodic and matern (1)",
    "noise_sd": "standard deviation of the error of a reading (customers)",
}
TRUTH = {"mean": 6.0, "scale": 1.8, "lengthscale": 200.0, "memory": 10.0, "noise_sd": 0.5}
FASTEST = 1.0  # minutes; on days of a bank 1 + L is off for it by 0.6% in the middle, and by 14% at most
STEPS = 20  # of two minutes between readings every 40
LONGEST_STEP = 2.0
WARNED = 60.0  # minutes for which arrivals may exceed the service rate
DAYS, INTERVAL = 3, 40.0


def names(force: str) -> tuple[str, ...]:
    """Return the names of the parameters that a model with this force has."""
    absent = {"periodic": ("memory",), "matern": ("memory",), "resonator": ("lengthscale",)}.get(force, ())
    return tuple(name for name in PARAMETERS if name not in absent)


def arrivals(force, mean, scale, lengthscale, memory, period, functions, cycles) -> lfm.Force:
    """Return the force.

    Args:
        force: one of FORCES.
        mean: see PARAMETERS; so are all before `period`.
        scale: see PARAMETERS.
        lengthscale: see PARAMETERS.
        memory: see PARAMETERS.
        period: length of a cycle (min).
        functions: of which a cycle is made.
        cycles: number of them, which have change points between them; those after the last time do nothing.

    Raises:
        ValueError: an unknown force, a period that is not positive.
    """
    if force not in FORCES:
        raise ValueError(f"force must be one of {', '.join(FORCES)}, got {force!r}.")
    _check_period(period)
    if force == "matern":
        return lfm.Matern(scale, lengthscale, order=0, mean=mean)
    if force == "resonator":
        waves: lfm.Force = lfm.Constant(scale, mean=mean)
        for k in range(1, functions // 2 + 1):
            waves = waves + lfm.Resonator(period / k, scale / k, scale / k / jnp.sqrt(memory * period))
        return waves
    # A short distance in time is pi / period times as long on the circle.
    kernel = lfm.forces.PeriodicMatern(scale, lengthscale * np.pi / period, period, order=0)
    if force == "periodic":
        return lfm.Periodic(kernel, functions=functions, mean=mean, explained_variance=0.0)
    changes = tuple(period * np.arange(1, cycles))
    evolution = {"cqm": lambda: lfm.forces.CQM(memory * period), "sqm": lambda: lfm.forces.SQM(memory, changes),
                 "wqm": lambda: lfm.forces.WQM(1.0 / memory, changes)}[force]()
    return lfm.QuasiPeriodic(kernel, evolution, functions=functions, mean=mean, explained_variance=0.0)


def build(mean, scale, noise_sd, lengthscale=None, memory=None, force="sqm", link="linear", service=10.0, period=840.0,
          functions=9, cycles=DAYS, units=None, fastest=FASTEST) -> lfm.LatentForceModel:
    """Return the queue with these parameters.

    Args:
        mean: see PARAMETERS; so are the next four.
        scale: see PARAMETERS.
        noise_sd: see PARAMETERS.
        lengthscale: see PARAMETERS; None for a resonator.
        memory: see PARAMETERS; None where the force has none.
        force: one of FORCES.
        link: one of LINKS.
        service: the rate Omega, a number or an `lfm.Input` (customers/min).
        period: length of a cycle (min).
        functions: of which a cycle is made.
        cycles: number of them.
        units: name -> unit.
        fastest: shortest time in which a queue settles (min); 0: as the equation has it.

    Raises:
        ValueError: an unknown force or link, a negative service rate, a period that is not positive.
    """
    if link not in LINKS:
        raise ValueError(f"link must be one of {', '.join(LINKS)}, got {link!r}.")
    omega = _service(service)
    _check_service(omega)

    def dynamics(x, u, t):
        free = jnp.exp(-jnp.abs(x))  # the share of time in which nobody waits
        rate = jax.nn.softplus(u) if link == "softplus" else u
        settling = omega(t) * free**2
        return (rate - omega(t) * jnp.sign(x) * (1.0 - free)) * free / (1.0 + fastest * settling)

    def variance(x, u, t):
        return (noise_sd * jnp.exp(-x)) ** 2

    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={"arrivals": arrivals(force, mean, scale, lengthscale, memory, period, functions, cycles)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, variance),
        initial_state=lfm.Gaussian(0.5 * jnp.ones(1), 0.25 * jnp.ones(1)),
        state_names=(LOG_QUEUE,),
        output_names=(LOG_QUEUE,),
        units=units,
    )


def model(times, y=None, link="linear", force="sqm", service=10.0, period=840.0, functions=9, units=None) -> None:
    """Sample the parameters of arrivals and readings, and score the readings.

    Args:
        times: of the readings, minutes of opening hours from the first opening on, shape (T,).
        y: log(1 + customers), shape (T, 1); NaN is missing, None draws from the prior predictive.
        link: one of LINKS.
        force: one of FORCES.
        service: the rate Omega, a number or an `lfm.Input` (customers/min).
        period: length of a cycle (min).
        functions: of which a cycle is made.
        units: name -> unit, for plots.

    Raises:
        ValueError: as `build`; a period that is longer than the data; nobody ever serves.
    """
    _check_period(period)
    last = float(np.max(times))
    if force != "matern" and period > last:
        raise ValueError(f"period is {period:g} min, but the data end after {last:g}: nothing repeats in them. Give "
                         "the length of a cycle in the unit of the times, or force=matern.")
    omega = _service(service)
    _check_service(omega)
    typical = jnp.mean(omega.values)
    if not isinstance(typical, jax.core.Tracer) and typical == 0:
        raise ValueError("the service rate is zero all the time; what arrives is compared with it, so that it must be "
                         "positive for some of the time.")
    priors = {"mean": dist.LogNormal(jnp.log(0.6 * typical), 0.5), "scale": dist.LogNormal(jnp.log(0.2 * typical), 0.7),
              "lengthscale": dist.LogNormal(jnp.log(period / 5), 0.7), "memory": dist.LogNormal(jnp.log(10.0), 1.0),
              "noise_sd": dist.LogNormal(jnp.log(0.5), 0.7)}
    parameters = {name: numpyro.sample(name, priors[name]) for name in names(force)}
    cycles = 2 * int(np.ceil(last / period))  # a forecast as long as the data has change points, too
    system = build(**parameters, force=force, link=link, service=omega, period=period, functions=functions,
                   cycles=cycles, units=units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=STEPS, max_step=LONGEST_STEP), obs=y)


def simulate(seed: int = 0, link: str = "linear", force: str = "sqm", service: float = 10.0, period: float = 840.0,
             functions: int = 9) -> lfm.Data:
    """Simulate three cycles, the queue read every 40 minutes.

    Args:
        seed: of arrivals and errors.
        link: one of LINKS.
        force: one of FORCES.
        service: the rate Omega (customers/min).
        period: length of a cycle (min).
        functions: of which a cycle is made.

    Warns:
        UserWarning: arrivals exceed the service rate for more than an hour at a time.
    """
    grid = np.arange(0.0, DAYS * period + 1e-9, INTERVAL / 10)
    drawn = _simulator(link, force, float(service), float(period), functions)(jax.random.key(seed))
    rates = np.asarray(drawn.forces["arrivals"])
    _warn_overload(grid, np.logaddexp(0.0, rates) if link == "softplus" else rates, service)
    truth: dict[str, Any] = {name: TRUTH[name] for name in names(force)}
    return lfm.Data(
        times=grid[::10],
        y=np.asarray(drawn.y)[::10],
        outputs=(LOG_QUEUE,),
        units=UNITS,
        truth={"times": grid, "forces": drawn.forces, "state": drawn.state, "parameters": truth},
    )


def prepare(data: lfm.Data) -> lfm.Data:
    """Take the logarithm log(1 + customers) of readings, readings below zero as zero.

    Raises:
        ValueError: there is neither a column `queue` nor a column `log queue`, or there are others.
    """
    if data.outputs == (LOG_QUEUE,):
        return data
    if data.outputs != (QUEUE,):
        raise ValueError(f"the call centre takes one column, `{QUEUE}` (customers) or `{LOG_QUEUE}` (log(1 + "
                         f"customers)); got {', '.join(data.outputs)}. Name it with --outputs.")
    note = f"The readings are taken as log(1 + {QUEUE}), those below zero as zero."
    return dataclasses.replace(data, y=np.log1p(np.maximum(data.y, 0.0)), outputs=(LOG_QUEUE,), note=note)


@functools.cache
def _simulator(link: str, force: str, service: float, period: float, functions: int) -> Callable[..., lfm.Simulation]:
    """Return the simulator, compiled once for all seeds."""
    parameters = {name: TRUTH[name] for name in names(force)}
    system = build(**parameters, force=force, link=link, service=service, period=period, functions=functions)
    grid = np.arange(0.0, DAYS * period + 1e-9, INTERVAL / 10)
    return jax.jit(lambda key: lfm.simulate(key, system, grid, steps=4))


def _check_period(period: float) -> None:
    """Raise for a period that is not positive."""
    if not period > 0:
        raise ValueError(f"period must be positive, got {period:g} min. Give the length of a cycle.")


def _service(service: Any) -> Any:
    """Return a service rate as a function of time."""
    return service if callable(service) else lfm.Input([0.0], [service])


def _check_service(omega: Any) -> None:
    """Raise for a known service rate below zero."""
    values = getattr(omega, "values", 0.0)
    if isinstance(values, jax.core.Tracer):
        return
    if (lowest := np.asarray(values).min()) < 0:
        raise ValueError(f"the service rate must not be negative, got {lowest:g} customers/min. Give zero where nobody "
                         "serves.")


def _warn_overload(times: np.ndarray, rates: np.ndarray, service: float) -> None:
    """Warn where more customers come than are served for a long time."""
    over = np.flatnonzero(np.diff(np.concatenate([[0], (rates > service).astype(int), [0]])))
    starts, ends = over[::2], over[1::2] - 1
    longest = float(np.max(times[ends] - times[starts], initial=0.0))
    if longest > WARNED:
        warnings.warn(f"arrivals exceed the service rate for {longest:.0f} min; the queue grows meanwhile.",
                      stacklevel=2)
