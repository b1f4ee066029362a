"""Queue of a call centre with an unknown rate of arrivals that nearly repeats from day to day.

The mean number L of customers in the queue follows the fluid approximation of a queue with one server,

    dL/dt = -Omega(t) L / (1 + L) + zeta(t),    y_k = L(t_k) + e_k,    e_k ~ N(0, noise_sd^2),

where Omega is the known service rate, a number or an `lfm.Input`, and zeta the unknown rate of arrivals. At
zeta = rho Omega < Omega the queue settles at L = rho / (1 - rho): a few more arrivals make it much longer. The state is
therefore x = log(1 + L), in which Gaussian approximations are far more accurate,

    dx/dt = (zeta - Omega (1 - exp(-x))) exp(-x),    log(1 + y_k) ~ N(x(t_k), noise_sd^2 exp(-2 x(t_k))),

where readings below zero are set to zero. The option `link` defines the effect of the force u:

    linear       zeta = u, which may be negative: customers who hang up
    softplus     zeta = log(1 + exp(u)) customers per minute, never negative

and the option `force` defines u as its mean plus

    sqm          a periodic Matern-1/2 process whose shape changes from one cycle to the next
    cqm          the same process, changing continuously
    wqm          the same process, with a variance that grows from cycle to cycle
    periodic     the same process, identical in all cycles
    matern       a Matern-1/2 process without a period
    resonator    sinusoids of the period and its fractions, with drifting amplitudes and phases

`memory` is the number of cycles over which correlations between cycles fall by a factor e, or variances double.

Times are minutes of opening hours, concatenated over days from the first opening, so that cycles begin at multiples of
the period. A data file has a column `queue` of customers, or a column `log queue` of log(1 + customers). A short
queue settles within seconds, which readings do not show but explicit integration must resolve; its rate of settling
r = Omega exp(-2 x) is therefore reduced to r / (1 + FASTEST r). For x < 0, which only the tails of the filter's
Gaussians reach, exp(-x) is continued as exp(-|x|), and L / (1 + L) = 1 - exp(-x) as an odd function.

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
    "force": ("sqm", str, f"prior of the force: {', '.join(FORCES)}"),
    "service": (10.0, float, "service rate Omega (customers/min); a Python caller may give an lfm.Input"),
    "period": (840.0, float, "length of a cycle (min)"),
    "functions": (9, int, "number of eigenfunctions of a cycle"),
}
PARAMETERS = {
    "mean": "mean of the force (customers/min)",
    "scale": "standard deviation of the force about its mean (customers/min)",
    "lengthscale": "lengthscale of the force within a cycle; a resonator has none (min)",
    "memory": "cycles over which the shape of a cycle changes; not for periodic and matern (1)",
    "noise_sd": "standard deviation of the error of a reading (customers)",
}
TRUTH = {"mean": 6.0, "scale": 1.8, "lengthscale": 200.0, "memory": 10.0, "noise_sd": 0.5}
FASTEST = 1.0  # minutes; on days of a bank it changes 1 + L by 0.6% in the median, and by 14% at most
STEPS = 20  # of two minutes, for readings every 40 minutes
LONGEST_STEP = 2.0
LONGEST_OVERLOAD = 60.0  # minutes for which arrivals may exceed the service rate without a warning
DAYS, INTERVAL = 3, 40.0


def names(force: str) -> tuple[str, ...]:
    """Return the names of the parameters of a model with this force."""
    absent = {"periodic": ("memory",), "matern": ("memory",), "resonator": ("lengthscale",)}.get(force, ())
    return tuple(name for name in PARAMETERS if name not in absent)


def arrivals(force, mean, scale, lengthscale, memory, period, functions, cycles) -> lfm.Force:
    """Return the force.

    Args:
        force: one of FORCES.
        mean: see PARAMETERS.
        scale: see PARAMETERS.
        lengthscale: see PARAMETERS.
        memory: see PARAMETERS.
        period: length of a cycle (min).
        functions: number of eigenfunctions of a cycle.
        cycles: number of cycles, with change points in between; change points after the last time have no effect.

    Raises:
        ValueError: the force is unknown, or the period is not positive.
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
    # The lengthscale is relative to the chord: a short time interval has pi / period times its length as chord.
    kernel = lfm.forces.PeriodicMatern(scale, lengthscale * np.pi / period, period, order=0)
    if force == "periodic":
        return lfm.Periodic(kernel, functions=functions, mean=mean, explained_variance=0.0)
    change_points = tuple(period * np.arange(1, cycles))
    evolution = {"cqm": lambda: lfm.forces.CQM(memory * period), "sqm": lambda: lfm.forces.SQM(memory, change_points),
                 "wqm": lambda: lfm.forces.WQM(1.0 / memory, change_points)}[force]()
    return lfm.QuasiPeriodic(kernel, evolution, functions=functions, mean=mean, explained_variance=0.0)


def build(mean, scale, noise_sd, lengthscale=None, memory=None, force="sqm", link="linear", service=10.0, period=840.0,
          functions=9, cycles=DAYS, units=None, fastest=FASTEST) -> lfm.LatentForceModel:
    """Return the queue with these parameters.

    Args:
        mean: see PARAMETERS.
        scale: see PARAMETERS.
        noise_sd: see PARAMETERS.
        lengthscale: see PARAMETERS; None for a resonator.
        memory: see PARAMETERS; None for a force without memory.
        force: one of FORCES.
        link: one of LINKS.
        service: the rate Omega, a number or an `lfm.Input` (customers/min).
        period: length of a cycle (min).
        functions: number of eigenfunctions of a cycle.
        cycles: number of cycles.
        units: name -> unit.
        fastest: shortest time in which a queue settles (min); 0: no limit.

    Raises:
        ValueError: force or link is unknown, the service rate is negative, or the period is not positive.
    """
    if link not in LINKS:
        raise ValueError(f"link must be one of {', '.join(LINKS)}, got {link!r}.")
    omega = _service(service)
    _check_service(omega)

    def dynamics(x, u, t):
        idle_fraction = jnp.exp(-jnp.abs(x))  # fraction of time in which nobody waits
        rate = jax.nn.softplus(u) if link == "softplus" else u
        settling = omega(t) * idle_fraction**2
        return (rate - omega(t) * jnp.sign(x) * (1.0 - idle_fraction)) * idle_fraction / (1.0 + fastest * settling)

    def error_sd(x, u, t):
        return noise_sd * jnp.exp(-x)

    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={"arrivals": arrivals(force, mean, scale, lengthscale, memory, period, functions, cycles)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, sd=error_sd),
        initial_state=lfm.Gaussian(0.5 * jnp.ones(1), 0.25 * jnp.ones(1)),
        state_names=(LOG_QUEUE,),
        output_names=(LOG_QUEUE,),
        units=units,
    )


def model(times, y=None, link="linear", force="sqm", service=10.0, period=840.0, functions=9, units=None) -> None:
    """Sample the parameters of arrivals and readings, and score the readings.

    Args:
        times: times of the readings in minutes of opening hours from the first opening, shape (T,).
        y: log(1 + customers), shape (T, 1); NaN is missing, None draws from the prior predictive.
        link: one of LINKS.
        force: one of FORCES.
        service: the rate Omega, a number or an `lfm.Input` (customers/min).
        period: length of a cycle (min).
        functions: number of eigenfunctions of a cycle.
        units: name -> unit, for plots.

    Raises:
        ValueError: as in `build`; the period is longer than the data; or the service rate is always zero.
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
        raise ValueError("the service rate is zero all the time; the priors are relative to it, so that it must be "
                         "positive for some of the time.")
    priors = {"mean": dist.LogNormal(jnp.log(0.6 * typical), 0.5), "scale": dist.LogNormal(jnp.log(0.2 * typical), 0.7),
              "lengthscale": dist.LogNormal(jnp.log(period / 5), 0.7), "memory": dist.LogNormal(jnp.log(10.0), 1.0),
              "noise_sd": dist.LogNormal(jnp.log(0.5), 0.7)}
    parameters = {name: numpyro.sample(name, priors[name]) for name in names(force)}
    cycles = 2 * int(np.ceil(last / period))  # include the change points of a forecast as long as the data
    system = build(**parameters, force=force, link=link, service=omega, period=period, functions=functions,
                   cycles=cycles, units=units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=STEPS, max_step=LONGEST_STEP), obs=y)


def simulate(seed: int = 0, link: str = "linear", force: str = "sqm", service: float = 10.0, period: float = 840.0,
             functions: int = 9) -> lfm.Data:
    """Simulate three cycles, the queue read every 40 minutes.

    Args:
        seed: random seed of arrivals and errors.
        link: one of LINKS.
        force: one of FORCES.
        service: the rate Omega (customers/min).
        period: length of a cycle (min).
        functions: number of eigenfunctions of a cycle.

    Warns:
        UserWarning: arrivals exceed the service rate for more than an hour at a time.
    """
    grid = np.arange(0.0, DAYS * period + 1e-9, INTERVAL / 10)
    simulation = _simulator(link, force, float(service), float(period), functions)(jax.random.key(seed))
    rates = np.asarray(simulation.forces["arrivals"])
    _warn_overload(grid, np.logaddexp(0.0, rates) if link == "softplus" else rates, service)
    truth: dict[str, Any] = {name: TRUTH[name] for name in names(force)}
    return lfm.Data(
        times=grid[::10],
        y=np.asarray(simulation.y)[::10],
        outputs=(LOG_QUEUE,),
        units=UNITS,
        truth={"times": grid, "forces": simulation.forces, "state": simulation.state, "parameters": truth},
    )


def prepare(data: lfm.Data) -> lfm.Data:
    """Return the data as log(1 + customers), with readings below zero set to zero.

    Raises:
        ValueError: there is neither a column `queue` nor a column `log queue`, or there are other columns.
    """
    if data.outputs == (LOG_QUEUE,):
        return data
    if data.outputs != (QUEUE,):
        raise ValueError(f"the call centre takes one column, `{QUEUE}` (customers) or `{LOG_QUEUE}` (log(1 + "
                         f"customers)); got {', '.join(data.outputs)}. Name it with --outputs.")
    note = f"The readings are converted to log(1 + {QUEUE}); readings below zero are set to zero."
    return dataclasses.replace(data, y=np.log1p(np.maximum(data.y, 0.0)), outputs=(LOG_QUEUE,), note=note)


@functools.cache
def _simulator(link: str, force: str, service: float, period: float, functions: int) -> Callable[..., lfm.Simulation]:
    """Return the simulator, compiled once for all seeds."""
    parameters = {name: TRUTH[name] for name in names(force)}
    system = build(**parameters, force=force, link=link, service=service, period=period, functions=functions)
    grid = np.arange(0.0, DAYS * period + 1e-9, INTERVAL / 10)
    return jax.jit(lambda key: lfm.simulate(key, system, grid, steps=4))


def _check_period(period: float) -> None:
    """Raise ValueError if the period is not positive."""
    if not period > 0:
        raise ValueError(f"period must be positive, got {period:g} min. Give the length of a cycle.")


def _service(service: Any) -> Any:
    """Return a service rate as a function of time."""
    return service if callable(service) else lfm.Input([0.0], [service])


def _check_service(omega: Any) -> None:
    """Raise ValueError if a concrete service rate is negative."""
    values = getattr(omega, "values", 0.0)
    if isinstance(values, jax.core.Tracer):
        return
    if (lowest := np.asarray(values).min()) < 0:
        raise ValueError(f"the service rate must not be negative, got {lowest:g} customers/min. Give zero where nobody "
                         "serves.")


def _warn_overload(times: np.ndarray, rates: np.ndarray, service: float) -> None:
    """Warn if arrivals exceed the service rate for a long time."""
    changes = np.flatnonzero(np.diff(np.concatenate([[0], (rates > service).astype(int), [0]])))
    first_rows, last_rows = changes[::2], changes[1::2] - 1
    longest = float(np.max(times[last_rows] - times[first_rows], initial=0.0))
    if longest > LONGEST_OVERLOAD:
        warnings.warn(f"arrivals exceed the service rate for {longest:.0f} min; the queue grows meanwhile.",
                      stacklevel=2)
