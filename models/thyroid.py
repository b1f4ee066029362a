"""Pituitary and thyroid, driven by an unmeasured hormone of the hypothalamus.

TRH, released in the hypothalamus, makes the pituitary secrete TSH, which makes the thyroid secrete T4; T4 is converted
to T3, and the T3 of the pituitary inhibits TSH. With th = GT TSH / (TSH + DT), the thyroid's secretion of T4,

    dT4/dt  = aT th - bT T4,
    dT3/dt  = a31 [GD1 FT4 / (FT4 + KM1) + GD2 FT4 / (FT4 + KM2) + GT3 TSH / (TSH + DT)
              + GD1 q / (q + KM1) + GD2 q / (q + KM2)] - b31 T3,    q = th TSH / (TSH + k),
    dT3c/dt = a32 GD2 FT4 / (FT4 + KM2) - b32 T3c,
    dTSH/dt = aS GH TRH / [(TRH + DH) (1 + SS z / (z + DS)) (1 + LS T3R)] - bS TSH.

T3c is the T3 within the pituitary, which binds to its receptor as T3R = T3N / (T3N + DR), T3N = T3c / (1 + K31 IBS).
z is the TSH within the pituitary, which inhibits its own secretion and relaxes at a rate of 140 per second; it is at
its steady state, the positive root of (1 + SS) z^2 + (DS - c) z - c DS = 0 with c = aS2 GH TRH / [bS2 (TRH + DH)
(1 + LS T3R)]. The secretion of TSH then is aS bS2 / aS2 z. The delays of the sources (2 to 60 minutes) are left out.

TSH and the free hormones FT3 = T3 / (1 + K30 TBG) and FT4 = T4 / (1 + K41 TBG + K42 TBPA) are measured once an hour,
with the same relative error. TRH is a Gaussian process with a Matern-3/2 covariance about its level. A concentration
cannot be negative: `lfm.full_information` and `lfm.constrained_posterior` take `lower={"TRH": 0.0}`.

The constants of Berberich et al. (2018) are taken from public implementations. For the production of T3 these disagree:
with GD1 = 22 nmol/s and GT3 = 394 fmol/s, used here, the steady state at TRH = 6.9 nmol/l agrees with the published
state in all printed digits, T4 122.02, T3 3.1615, T3c 11.701 nmol/l, TSH 1.8157 mU/l; with GD1 = 23.527 nmol/s and
GT3 = 188.82 fmol/s, T3 is 3.0804 nmol/l. The table of the paper itself was not compared. The default data are a day of
a simulated patient, who starts at midnight near that state, with pulsatile TRH that is highest at 5 h.

Sources: J. Berberich, J. W. Dietrich, R. Hoermann and M. A. Mueller, Mathematical modeling of the pituitary-thyroid
feedback loop: role of a TSH-T3-shunt and sensitivity analysis, Frontiers in Endocrinology 9 (2018); J. W. Dietrich,
Der Hypophysen-Schilddruesen-Regelkreis (2002); T. M. Wolff, V. G. Lopez, M. A. Mueller and T. Beckers, Inference in
latent force models using optimal state estimation, section 4.3.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("TSH", "FT3", "FT4")
UNITS = {
    "time": "h",
    "TSH": "mU/l",
    "FT3": "pmol/l",
    "FT4": "pmol/l",
    "T4": "nmol/l",
    "T3": "nmol/l",
    "T3 of the pituitary": "nmol/l",
    "TRH": "nmol/l",
}
PARAMETERS = {
    "level": "mean of TRH (nmol/l)",
    "scale": "standard deviation of TRH about its mean (nmol/l)",
    "lengthscale": "lengthscale of TRH (h)",
    "variation": "coefficient of variation of the assays (1)",
}
# TRH of the default data is not a draw of a Gaussian process; scale and lengthscale approximate its variation.
TRUTH = {"level": 6.9, "scale": 3.5, "lengthscale": 1.0, "variation": 0.03}

# mol, mU, l and s; the states are in nmol/l and mU/l, and times in hours.
HOUR, NANO, PICO = 3600.0, 1e-9, 1e-12
A_T, A_S, A_S2, A_31, A_32 = 0.1, 0.4, 2.6e5, 2.6e-2, 1.3e5
B_T, B_S, B_S2, B_31, B_32 = 1.1e-6, 2.3e-4, 140.0, 8.0e-6, 8.3e-4
G_T, G_H, G_D1, G_D2, G_T3 = 3.375e-12, 473.0214, 22e-9, 4.3e-15, 394e-15
K_M1, K_M2, SHUNT = 5e-7, 1e-9, 1.0
D_T, D_S, D_H, D_R = 2.75, 50.0, 4.7e-8, 1e-10
S_S, L_S = 100.0, 1.6879e6
BOUND_T4 = 1.0 + 2e10 * 3e-7 + 2e8 * 4.5e-6  # to TBG and TBPA
BOUND_T3 = 1.0 + 2e9 * 3e-7  # to TBG
BOUND_T3N = 1.0 + 2e9 * 8e-6  # within the pituitary

STEADY = np.array([122.01549898546, 3.16152081809660, 11.7010568388255, 1.81568047101211])  # at TRH = 6.9 nmol/l
START_SD = np.array([0.15, 0.15, 0.15, 0.3]) * STEADY
FREE = np.array([STEADY[3], STEADY[1] * NANO / PICO / BOUND_T3, STEADY[0] * NANO / PICO / BOUND_T4])
GRID = np.linspace(0.0, 24.0, 241)
PULSES, WIDTH = 10, 0.6  # of TRH in a day; their standard deviation in hours


def axis(x, trh) -> jax.Array:
    """Return the rates of T4, T3, T3c (nmol/l/h) and TSH (mU/l/h) at states (4,) and TRH (nmol/l).

    For TRH < 0, which a Gaussian force allows, the secretion of TSH is continued by its tangent at zero.
    """
    t4, t3, t3c, tsh = x
    ft4 = t4 * NANO / BOUND_T4
    th = G_T * tsh / (tsh + D_T)
    q = th * tsh / (tsh + SHUNT)
    t3_production = G_D1 * (ft4 / (ft4 + K_M1) + q / (q + K_M1)) + G_D2 * (ft4 / (ft4 + K_M2) + q / (q + K_M2))
    t3_production = t3_production + G_T3 * tsh / (tsh + D_T)
    t3n = t3c * NANO / BOUND_T3N
    stimulus = trh * NANO / (jnp.maximum(trh, 0.0) * NANO + D_H)
    c = A_S2 * G_H / B_S2 * stimulus / (1.0 + L_S * t3n / (t3n + D_R))
    positive = jnp.maximum(c, 0.0)
    root = jnp.sqrt((D_S - positive) ** 2 + 4.0 * (1.0 + S_S) * positive * D_S)
    z = jnp.where(c > 0.0, 2.0 * positive * D_S / (D_S - positive + root), c)
    return HOUR * jnp.stack([
        A_T * th / NANO - B_T * t4,
        A_31 * t3_production / NANO - B_31 * t3,
        A_32 * G_D2 / NANO * ft4 / (ft4 + K_M2) - B_32 * t3c,
        A_S * B_S2 / A_S2 * z - B_S * tsh,
    ])


def assays(x, u, t) -> jax.Array:
    """Return TSH (mU/l), FT3 and FT4 (pmol/l)."""
    return jnp.stack([x[3], x[1] * NANO / PICO / BOUND_T3, x[0] * NANO / PICO / BOUND_T4])


def build(level, scale, lengthscale, variation, trh=None, start_sd=START_SD, units=None) -> lfm.LatentForceModel:
    """Return the axis with these parameters.

    Args:
        level: see PARAMETERS.
        scale: see PARAMETERS.
        lengthscale: see PARAMETERS.
        variation: see PARAMETERS; relative to the concentrations of the steady state.
        trh: function of time that replaces the latent force; None: the force.
        start_sd: standard deviations of the states at the first time (4,).
        units: name -> unit.
    """
    force = {} if trh else {"TRH": lfm.Matern(scale=scale, lengthscale=lengthscale, order=1, mean=level)}
    return lfm.LatentForceModel(
        dynamics=lambda x, u, t: axis(x, trh(t) if trh else u[0]),
        forces=force,
        observation=lfm.GaussianObservation(assays, sd=variation * FREE),
        initial_state=lfm.Gaussian(jnp.asarray(STEADY), jnp.diag(jnp.asarray(start_sd) ** 2)),
        state_names=("T4", "T3", "T3 of the pituitary", "TSH"),
        output_names=OUTPUTS,
        units=units,
    )


def model(times, y=None, units=None) -> None:
    """Sample the parameters of TRH and of the assays, and score the concentrations.

    Args:
        times: of the samples of blood (h), shape (T,).
        y: TSH, FT3 and FT4, shape (T, 3); NaN is missing, None draws from the prior predictive.
        units: name -> unit, for plots.
    """
    level = numpyro.sample("level", dist.LogNormal(jnp.log(7.0), 0.3))
    scale = numpyro.sample("scale", dist.LogNormal(jnp.log(3.0), 0.5))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(1.5), 0.5))
    variation = numpyro.sample("variation", dist.LogNormal(jnp.log(0.04), 0.5))
    system = build(level, scale, lengthscale, variation, units=units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=4), obs=y)


def simulate(seed: int = 0) -> lfm.Data:
    """Simulate a day of a patient, measured every hour."""
    trh, simulation = _simulator()(jax.random.key(seed))
    observed = np.arange(0, len(GRID), 10)
    return lfm.Data(
        times=GRID[observed],
        y=np.asarray(simulation.y)[observed],
        outputs=OUTPUTS,
        units=UNITS,
        truth={"times": GRID, "forces": {"TRH": np.asarray(trh)}, "state": simulation.state, "parameters": TRUTH},
    )


@functools.cache
def _simulator() -> Callable[[jax.Array], tuple[jax.Array, lfm.Simulation]]:
    """Return the simulator, compiled once for all seeds."""

    def run(key: jax.Array) -> tuple[jax.Array, lfm.Simulation]:
        keys = jax.random.split(key, 3)
        # One pulse in each tenth of the day; pulses carry three tenths of TRH on average.
        pulse_times = (jnp.arange(PULSES) + jax.random.uniform(keys[0], (PULSES,))) * GRID[-1] / PULSES
        height = jax.random.exponential(keys[1], (PULSES,)) * GRID[-1] / (PULSES * WIDTH * np.sqrt(2.0 * np.pi))

        def trh(t):
            circadian = 1.0 + 0.6 * jnp.cos(2.0 * np.pi * t / 24.0 - 5.0 * np.pi / 12.0)
            pulses = (height * jnp.exp(-0.5 * ((t - pulse_times) / WIDTH) ** 2)).sum()
            return TRUTH["level"] * circadian * (0.7 + 0.3 * pulses)

        return jax.vmap(trh)(jnp.asarray(GRID)), lfm.simulate(keys[2], build(**TRUTH, trh=trh), GRID, steps=2)

    return jax.jit(run)
