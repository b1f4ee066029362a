"""Heat in a rod with sensors along it: an unknown source in space and time.

The temperature x of a rod above its surroundings, at the place r, obeys

    x_t = diffusivity x_rr - decay x + s(r, t),    x_r = 0 at both ends,
    y_k = x(r_k, t_k) + e_k,    e_k ~ N(0, noise_sd^2).

The source s is a Gaussian process with a Matern-3/2 covariance in space, times a Matern-1/2 covariance in time. The
initial temperature is unknown, with the same covariance in space and a standard deviation of 3 K. Temperature and
source are expanded in the eigenfunctions of the Laplacian, for which the model is linear, so that filter, smoother and
likelihood are exact.

Columns of a data file are named by the place of their sensor, as in ``r=0.25`` or ``0.25``, in metres from one end. The
default data are simulated: eight sensors on a rod of one metre, for 20 minutes.

Sources: S. Sarkka, M. Alvarez and N. Lawrence, Gaussian process latent force models for learning and stochastic control
of physical systems, IEEE Trans. Automatic Control 64 (2019), section V; A. Solin and S. Sarkka, Hilbert space methods
for reduced-rank Gaussian process regression, Statistics and Computing 30 (2020).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

UNITS = {"time": "min"}
OPTIONS = {"length": (1.0, float, "length of the rod (m)"), "modes": (8, int, "number of eigenfunctions")}
PARAMETERS = {
    "diffusivity": "thermal diffusivity (m^2/min)",
    "decay": "rate at which heat is lost to the surroundings (1/min)",
    "scale": "standard deviation of the source (K/min)",
    "space_lengthscale": "lengthscale of the source along the rod (m)",
    "time_lengthscale": "lengthscale of the source in time (min)",
    "noise_sd": "standard deviation of the measurement noise (K)",
}
TRUTH = {"diffusivity": 0.01, "decay": 0.1, "scale": 1.0, "space_lengthscale": 0.3, "time_lengthscale": 4.0,
         "noise_sd": 0.1}
INITIAL_SD = 3.0


def positions(outputs) -> np.ndarray:
    """Return the places (m) in the names of sensors."""
    try:
        return np.array([float(name.rpartition("=")[2]) for name in outputs])
    except ValueError:
        raise ValueError("columns must be named by the place of their sensor in metres, as in r=0.25; got "
                         f"{', '.join(outputs)}.") from None


def source(parameters, length: float = 1.0, modes: int = 8) -> lfm.SpectralField:
    """Return the source of heat with these parameters."""
    basis = lfm.LaplaceBasis((0.0, length), modes, "neumann")
    return lfm.SpectralField(basis, lfm.Matern(parameters["scale"], parameters["space_lengthscale"], order=1),
                             lfm.Matern(1.0, parameters["time_lengthscale"], order=0))


def build(diffusivity, decay, scale, space_lengthscale, time_lengthscale, noise_sd, outputs, length: float = 1.0,
          modes: int = 8, units=None) -> lfm.LatentForceModel:
    """Return the rod with these parameters."""
    process = source({"scale": scale, "space_lengthscale": space_lengthscale, "time_lengthscale": time_lengthscale},
                     length, modes)
    initial = lfm.Gaussian(jnp.zeros(modes), (INITIAL_SD / scale * process.amplitudes)**2)
    return lfm.heat(process, diffusivity, decay, sensors=positions(outputs), sd=noise_sd, initial=initial,
                    output_names=outputs, units=units)


def model(times, y=None, length: float = 1.0, modes: int = 8, outputs=("r=0.5",), units=None) -> None:
    """Sample the parameters of the rod and of the source, and score the temperatures.

    Args:
        times: observation times, shape (T,).
        y: temperatures, shape (T, D); NaN is missing, None draws from the prior predictive.
        length: length of the rod.
        modes: number of eigenfunctions.
        outputs: names of the columns, which say where the sensors are.
        units: name -> unit, for plots.
    """
    parameters = {
        "diffusivity": numpyro.sample("diffusivity", dist.LogNormal(-4.6, 0.7)),
        "decay": numpyro.sample("decay", dist.LogNormal(-2.3, 0.7)),
        "scale": numpyro.sample("scale", dist.LogNormal(0.0, 0.7)),
        "space_lengthscale": numpyro.sample("space_lengthscale", dist.LogNormal(-1.2, 0.4)),
        "time_lengthscale": numpyro.sample("time_lengthscale", dist.LogNormal(1.2, 0.7)),
        "noise_sd": numpyro.sample("noise_sd", dist.HalfNormal(0.5)),
    }
    system = build(**parameters, outputs=outputs, length=length, modes=modes, units=units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def fields(data, length: float = 1.0, modes: int = 8) -> dict:
    """Return temperature and source, for figures."""
    sensors = positions(data.outputs)
    return {
        "temperature": {"field": lfm.LaplaceBasis((0.0, length), modes, "neumann"), "sensors": sensors, "unit": "K",
                        "length_unit": "m"},
        "source": {"field": lambda parameters: source(parameters, length, modes), "sensors": sensors, "unit": "K/min",
                   "length_unit": "m"},
    }


def simulate(seed: int = 0, length: float = 1.0, modes: int = 8) -> lfm.Data:
    """Simulate eight sensors, two measurements of each per minute."""
    outputs = tuple(f"r={place:.2f}" for place in length * (np.arange(8) + 0.5) / 8)
    times = 0.5 * np.arange(41)
    simulation = lfm.simulate(jax.random.key(seed), build(**TRUTH, outputs=outputs, length=length, modes=modes), times)
    return lfm.Data(
        times=times,
        y=np.asarray(simulation.y),
        outputs=outputs,
        units={**UNITS, **dict.fromkeys(outputs, "K")},
        truth={"times": times, "forces": simulation.forces, "state": simulation.state, "parameters": TRUTH},
    )
