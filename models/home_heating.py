"""Temperature of a heated home, with an unknown residual heat that nearly repeats every day.

The temperature T inside (degC) follows, with one store of heat or with the walls T_w as a second one,

    dT/dt = alpha (T_out - T) + beta E + R(t)                                            (one store)
    dT/dt = alpha (T_w - T) + beta E + R(t),   dT_w/dt = gamma (T - T_w) + psi (T_out - T_w)     (envelope=true)
    y_k = (T(t_k), T_out(t_k)) + e_k,    e_k ~ N(0, diag(noise_sd^2, 0.1^2)),

where E is the heater, a known input, T_out the temperature outside, a Gaussian process with a Matern-3/2
covariance that is measured too, and R the heat of sun, people and everything else that the equation omits. The
option `residual` defines R, with a day of 24 h:

    SQM, CQM, WQM   quasi-periodic: a periodic Matern-1/2 force whose weights change with each midnight (SQM,
                    WQM) or continuously (CQM)
    periodic        identical every day            matern   a Matern-1/2 force without a period
    resonator       oscillations of a day and its harmonics, with damping and noise         none   no residual

`memory` is the number of days over which the shape of R changes: the lengthscale of SQM and CQM; for WQM the variance
gained in a day is 1/memory of the first day's variance. `lengthscale` is relative to the chord of the periodic kernel,
at 1 about a third of a day; for `matern` it is in hours. With the envelope there are two more sites, `gamma` and
`psi`; some residuals have fewer sites, and the resonator has different ones.

A data file has a time column (dates, or time_h with midnight a multiple of 24), the outputs indoor and outdoor, and
the known input heater: its power from that time to the next, in any unit, such as the share of full power. Outdoor
mean, scale and lengthscale are estimated from the outdoor column unless they are freed.

The default data are four days of hourly measurements under a thermostat that switches every ten minutes; the heater
column is the share of each hour in which it was on.

Sources: S. Reece and others, Efficient state-space inference of periodic latent force models, Journal of Machine
Learning Research 15 (2014), section 9; P. Bacher and H. Madsen, Identifying suitable models for the heat dynamics of
buildings, Energy and Buildings 43 (2011).
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("indoor", "outdoor")
INPUTS = {"heater": "previous"}
UNITS = {"time": "h", "indoor": "degC", "outdoor": "degC", "heater": "1", "walls": "degC", "air": "degC",
         "weather": "degC", "residual": "K/h"}
RESIDUALS = ("SQM", "CQM", "WQM", "periodic", "matern", "resonator", "none")
OPTIONS = {
    "residual": ("SQM", str, f"the force R: {', '.join(RESIDUALS)}"),
    "envelope": (False, bool, "whether the walls are a second store of heat"),
    "functions": (5, int, "eigenfunctions of the periodic kernel, an odd number"),
}
PARAMETERS = {
    "alpha": "rate at which the air approaches the temperature outside, or of the walls (1/h)",
    "beta": "warming by the heater at full power (K/h)",
    "scale": "standard deviation of the residual (K/h)",
    "lengthscale": "lengthscale of the residual within a day, relative to the chord (1)",
    "memory": "days over which the shape of the residual changes (1)",
    "noise_sd": "standard deviation of a measurement inside (degC)",
    "outdoor_mean": "mean of the temperature outside (degC)",
    "outdoor_scale": "its standard deviation (degC)",
    "outdoor_lengthscale": "its lengthscale (h)",
}
DAY, OUTDOOR_NOISE = 24.0, 0.1
START = (18.0, 3.0, 15.0, 5.0)  # mean and standard deviation of the first temperatures of air and walls (degC)
HARMONICS = 4  # of the resonator
TRUTH = {
    "alpha": 0.1, "beta": 2.5, "scale": 0.3, "lengthscale": 0.5, "memory": 5.0, "noise_sd": 0.05,
    "outdoor_mean": 6.0, "outdoor_scale": 3.0, "outdoor_lengthscale": 10.0,
}
DAYS, DECISIONS = 4, 6  # of the default data; decisions of the thermostat in an hour


def residual_force(kind, scale, lengthscale, memory, functions, midnights, period=DAY, noise=0.0, damping=0.0):
    """Return the residual R.

    Args:
        kind: one of RESIDUALS but none.
        scale: see PARAMETERS.
        lengthscale: of the kernel; of `matern` in hours.
        memory: days.
        functions: number of eigenfunctions.
        midnights: times at which the weights of SQM and WQM change.
        period: period of the resonator (h).
        noise: noise of the resonator (K/h/sqrt(h)).
        damping: damping of the resonator (1/h).

    Raises:
        ValueError: the kind is unknown.
    """
    if kind == "matern":
        return lfm.Matern(scale, lengthscale, order=0)
    if kind == "resonator":
        # Harmonics weaken with their number, like the harmonics of a force with kinks.
        waves = [lfm.Resonator(period / k, scale / k, noise / k, damping) for k in range(1, HARMONICS + 1)]
        return sum(waves, lfm.Constant(scale))
    if kind not in RESIDUALS:
        raise ValueError(f"residual must be one of {', '.join(RESIDUALS)}, got {kind!r}.")
    kernel = lfm.forces.PeriodicMatern(scale, lengthscale, DAY, order=0)
    if kind == "periodic":
        return lfm.Periodic(kernel, functions, explained_variance=0.0)
    evolution = {
        "SQM": lambda: lfm.forces.SQM(memory, midnights),
        "CQM": lambda: lfm.forces.CQM(DAY * memory),
        "WQM": lambda: lfm.forces.WQM(1.0 / memory, midnights),
    }[kind]()
    return lfm.QuasiPeriodic(kernel, evolution, functions, explained_variance=0.0)


def build(heater, residual, alpha, beta, noise_sd, outdoor, gamma=None, psi=None, units=None) -> lfm.LatentForceModel:
    """Return the home.

    Args:
        heater: the known input, a function of time.
        residual: the force R, or None.
        alpha: see PARAMETERS.
        beta: see PARAMETERS.
        noise_sd: see PARAMETERS.
        outdoor: mean, scale and lengthscale of the temperature outside.
        gamma: rate at which the walls approach the temperature of the air (1/h); None: no walls.
        psi: rate at which the walls approach the temperature outside (1/h).
        units: name -> unit.
    """
    has_walls = gamma is not None

    def dynamics(x, u, t):
        residual_heat = u[1] if residual is not None else 0.0
        if not has_walls:
            return jnp.stack([alpha * (u[0] - x[0]) + beta * heater(t) + residual_heat])
        return jnp.stack([
            alpha * (x[1] - x[0]) + beta * heater(t) + residual_heat,
            gamma * (x[0] - x[1]) + psi * (u[0] - x[1]),
        ])

    mean, scale, lengthscale = outdoor
    size = 2 if has_walls else 1
    return lfm.LatentForceModel(
        dynamics=dynamics,
        forces={"weather": lfm.Matern(scale, lengthscale, order=1, mean=mean),
                **({} if residual is None else {"residual": residual})},
        observation=lfm.GaussianObservation(
            lambda x, u, t: jnp.stack([x[0], u[0]]),
            sd=jnp.stack([jnp.asarray(noise_sd, float), jnp.asarray(OUTDOOR_NOISE)])),
        initial_state=lfm.Gaussian(jnp.array(START[::2][:size]), jnp.diag(jnp.array(START[1::2][:size]) ** 2)),
        state_names=("air", "walls")[:size],
        output_names=OUTPUTS,
        units=units,
    )


def model(times, y=None, inputs=None, residual: str = "SQM", envelope: bool = False, functions: int = 5,
          units=None) -> None:
    """Sample the parameters of home and residual, and score the temperatures.

    Args:
        times: hours, shape (T,), midnight a multiple of 24.
        y: indoor and outdoor, shape (T, 2), NaN where missing. None draws temperatures from the prior.
        inputs: ``{"heater": function of time}``; None: on in the morning and in the evening.
        residual: the force R, one of RESIDUALS.
        envelope: whether the walls are a second store of heat.
        functions: eigenfunctions of the periodic kernel, an odd number.
        units: name -> unit, for plots.
    """
    if residual not in RESIDUALS:
        raise ValueError(f"residual must be one of {', '.join(RESIDUALS)}, got {residual!r}.")

    def positive(name, median, spread):
        return numpyro.sample(name, dist.LogNormal(jnp.log(median), spread))

    is_periodic = residual in ("SQM", "CQM", "WQM", "periodic")
    rates = {"alpha": positive("alpha", 0.1, 1.0), "beta": positive("beta", 1.0, 1.0)}
    if envelope:
        rates |= {"gamma": positive("gamma", 0.05, 1.0), "psi": positive("psi", 0.03, 1.0)}
    hyper = {"scale": 0.0, "lengthscale": 0.0, "memory": 0.0}
    if residual != "none":
        hyper["scale"] = positive("scale", 0.3, 1.0)
    if is_periodic:
        hyper["lengthscale"] = positive("lengthscale", 0.5, 0.7)
    if residual in ("SQM", "CQM", "WQM"):
        hyper["memory"] = positive("memory", 5.0, 1.0)
    if residual == "matern":
        hyper["lengthscale"] = positive("lengthscale", 5.0, 1.0)
    if residual == "resonator":
        hyper |= {"period": positive("period", DAY, 0.05), "noise": positive("noise", 0.03, 1.0),
                  "damping": positive("damping", 0.01, 1.0)}
    noise_sd = positive("noise_sd", 0.1, 0.7)
    outdoor = (numpyro.sample("outdoor_mean", dist.Normal(8.0, 8.0)), positive("outdoor_scale", 4.0, 0.5),
               positive("outdoor_lengthscale", 10.0, 0.5))
    force = None
    if residual != "none":
        force = residual_force(residual, functions=functions, midnights=_midnights(times, residual), **hyper)
    system = build(_heater(inputs), force, noise_sd=noise_sd, outdoor=outdoor, units=units, **rates)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=1), obs=y)


def anchors(data: lfm.Data) -> dict[str, float]:
    """Return mean, standard deviation and lengthscale of the temperature outside, as estimated from the data.

    The slope of a Matern-3/2 process has the variance 3 scale^2 / lengthscale^2.
    """
    observed = np.isfinite(data.y[:, 1])
    if observed.sum() < 3:
        return {}
    times, temperature = data.times[observed], data.y[observed, 1]
    scale = max(float(temperature.std()), 0.1)
    gap = np.diff(times)
    slope = np.diff(temperature)[gap > 0] / gap[gap > 0]
    return {"outdoor_mean": float(temperature.mean()), "outdoor_scale": scale,
            "outdoor_lengthscale": float(np.sqrt(3.0) * scale / max(np.sqrt(np.mean(slope**2)), 1e-2 * scale))}


def prepare(data: lfm.Data) -> lfm.Data:
    """Check the heater of a data file.

    Raises:
        ValueError: the heater is constant.
    """
    heater = data.inputs["heater"].values
    if not np.any(heater != heater[0]):
        raise ValueError(f"the heater is {heater[0]:g} all the time, so that its effect cannot be estimated; expected "
                         "the power of a heater that is switched.")
    return data


def thermostat(hysteresis: float = 0.0) -> lfm.Thermostat:
    """Return the thermostat of the default data: 20 degC from 6 to 22 o'clock, 16 degC at night."""

    def set_point(t):
        hour = jnp.mod(t, DAY)
        return jnp.where((hour >= 6.0) & (hour < 22.0), 20.0, 16.0)

    return lfm.Thermostat(set_point, hysteresis)


def simulate(seed: int = 0, residual: str = "SQM", envelope: bool = False, functions: int = 5) -> lfm.Data:
    """Simulate four days of a home under its thermostat.

    Args:
        seed: random seed of forces, paths and errors.
        residual: the force R, one of RESIDUALS.
        envelope: whether the walls are a second store of heat.
        functions: eigenfunctions of the periodic kernel.
    """
    grid = np.arange(DAYS * 24 * DECISIONS + 1) / DECISIONS
    simulation = _simulator(residual, envelope, functions)(jax.random.key(seed))
    hourly = slice(None, None, DECISIONS)
    heater = np.asarray(simulation.inputs[:, 0])
    # The share of each hour in which the heater is on; the last time has no following hour.
    share = np.append(heater[:-1].reshape(-1, DECISIONS).mean(axis=1), heater[-1])
    wall_rates = {"gamma": 0.05, "psi": 0.05} if envelope else {}
    return lfm.Data(
        times=grid[hourly], y=np.asarray(simulation.y)[hourly, 0], outputs=OUTPUTS, units=UNITS,
        inputs={"heater": (grid[hourly], share, "previous")},
        truth={"times": grid, "state": simulation.state[:, 0],
               "forces": {name: path[:, 0] for name, path in simulation.forces.items()},
               "parameters": TRUTH | wall_rates})


@functools.cache
def _simulator(residual: str, envelope: bool, functions: int):
    """Return the simulator, compiled once for all seeds."""
    grid = np.arange(DAYS * 24 * DECISIONS + 1) / DECISIONS
    values = TRUTH | {"lengthscale": 5.0} if residual == "matern" else TRUTH
    force = None if residual == "none" else residual_force(
        residual, values["scale"], values["lengthscale"], values["memory"], functions, _midnights(grid, residual),
        noise=0.02, damping=0.005)
    wall_rates = {"gamma": 0.05, "psi": 0.05} if envelope else {}
    outdoor = (TRUTH["outdoor_mean"], TRUTH["outdoor_scale"], TRUTH["outdoor_lengthscale"])

    def home(heater):
        return build(lambda t: heater, force, TRUTH["alpha"], TRUTH["beta"], TRUTH["noise_sd"], outdoor,
                     **wall_rates)

    return jax.jit(lambda key: lfm.simulate_switched(key, home, thermostat(), grid, steps=1))


def _midnights(times, residual: str) -> tuple[float, ...]:
    """Return the midnights after the first time, up to the end of a forecast as long as the data."""
    if residual not in ("SQM", "WQM"):
        return ()
    times = np.asarray(times)
    last = 2 * times[-1] - times[0]  # end of the forecast; midnights after the last time have no effect
    return tuple(DAY * np.arange(np.floor(times[0] / DAY) + 1, np.floor(last / DAY) + 1))


def _heater(inputs):
    """Return the heater as a function of time."""
    if inputs is not None:
        return inputs["heater"]
    return lambda t: jnp.where((jnp.mod(t, DAY) >= 6.0) & (jnp.mod(t, DAY) < 9.0)
                               | (jnp.mod(t, DAY) >= 16.0) & (jnp.mod(t, DAY) < 22.0), 1.0, 0.0)
