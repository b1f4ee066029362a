"""A real house with recorded heating power, simulated homes under a thermostat, and their models.

1. A window has hourly temperatures, indoor and outdoor, and the heater: four days of training and the fifth day.
2. The real house provides one window for each day (`house`).
3. A simulated home has random rates and set points. Its residual comes from the SQM model, and its heater from the
   switched simulation of temperature and thermostat (`home`).
4. A model is a residual, a heat store and a number of eigenfunctions (`Model`); the model file has the equations.
"""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from numpyro import handlers

import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.likelihoods.likelihood_site import likelihood_site

METHODS = ("SQM", "CQM", "WQM", "periodic", "none", "matern", "resonator")
STORES = ("one store", "envelope")
OUTDOOR = ("outdoor_mean", "outdoor_scale", "outdoor_lengthscale")
FILE = "house_hourly.csv"
TRAIN_DAYS, DAY = 4, 24
TRAIN = TRAIN_DAYS * DAY
TIMES = np.arange(TRAIN + DAY, dtype=float)
"""Hours after the midnight at which a window begins: four days of training and one day to predict."""

PER_HOUR = 6
FINE = TRAIN - 1 + np.arange(1, (DAY + 1) * PER_HOUR) / PER_HOUR
"""Times of a prediction under a thermostat after the last measurement: every ten minutes, as in the source."""

_POWER = 100.0
"""Unit of the recorded heating power, so that full power is about one."""

_HOME = {"alpha": 0.1, "beta": 2.5, "scale": 0.3, "lengthscale": 0.5, "memory": 5.0, "noise_sd": 0.05,
         "outdoor_mean": 6.0, "outdoor_scale": 3.0, "outdoor_lengthscale": 10.0, "gamma": 0.05, "psi": 0.05}
"""Parameters of the simulated home: the model file's values for its default data, and values for walls."""

_VARIED = ("alpha", "beta", "scale", "gamma", "psi")
_METER_ERROR, _FUNCTIONS = 1e-3, 15


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Window:
    """Five days of a home.

    Attributes:
        y: (120, 3) indoor and outdoor temperature (degC) at every hour, and heater until the next hour.
        outdoor: parameters of the outdoor temperature, estimated from the first four days.
        set_points: (120,) set points (degC), from each hour to the next; None if they were not recorded.
        fine: (149, 3) entries of ``y`` at the times `FINE`; None for the real house.
        on: 1 if the heater is on at the last measurement of the first four days, else 0.
    """

    y: np.ndarray
    outdoor: dict[str, float]
    set_points: np.ndarray | None = None
    fine: np.ndarray | None = None
    on: int = 0

    @property
    def learnt(self) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Measurements (96, 3) of the first four days, and the parameters of the outdoor temperature."""
        return jnp.asarray(self.y[:TRAIN]), {name: jnp.asarray(self.outdoor[name]) for name in OUTDOOR}


class Model(NamedTuple):
    """A model: a residual of `METHODS`, a heat store of `STORES`, and the number of eigenfunctions."""

    method: str
    store: str
    functions: int

    @property
    def keywords(self) -> dict[str, Any]:
        """Options of the model file."""
        return {"residual": self.method, "envelope": self.store == STORES[1], "functions": self.functions}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the P learnt parameters."""
        return tuple(name for name in _priors(self) if name not in OUTDOOR)

    @property
    def medians(self) -> np.ndarray:
        """Logarithms (P,) of the prior medians."""
        return np.array([float(_priors(self)[name].loc) for name in self.names])

    def program(self, learnt: tuple[jax.Array, dict[str, jax.Array]]) -> None:
        """Run the NumPyro model of a window's training data, see `Window.learnt`."""
        (y, outdoor), times = learnt, TIMES[:TRAIN]
        heater = lfm.Input(times, y[:, 2])
        lfm.fix(model_file().model, outdoor)(times, y[:, :2], inputs={"heater": heater}, **self.keywords)

    def values(self, z: Any, outdoor: dict[str, Any]) -> dict[str, Any]:
        """Return every parameter by name; the logarithms z (P,) may be traced."""
        return dict(zip(self.names, jnp.exp(z), strict=True)) | outdoor

    def likelihood(self, values: dict[str, Any], heater: Any) -> lfm.MarginalLikelihood:
        """Return the likelihood of five days, given parameters and a heater (120,) or one value; both may be traced."""
        inputs = {"heater": lfm.Input(TIMES, jnp.broadcast_to(jnp.asarray(heater, float), TIMES.shape))}
        return likelihood_site(model_file().model, (TIMES, np.zeros((len(TIMES), 2))),
                               {**self.keywords, "inputs": inputs}, jax.random.key(0), values).example


@functools.cache
def model_file() -> loading.ModelFile:
    """Return the shipped model."""
    return loading.load("home-heating")


@functools.cache
def _priors(model: Model) -> dict[str, Any]:
    with jax.ensure_compile_time_eval():
        seeded = handlers.seed(model_file().model, jax.random.key(0))
        trace = handlers.trace(seeded).get_trace(TIMES, np.zeros((len(TIMES), 2)), **model.keywords)
    return {name: site["fn"] for name, site in trace.items() if site["type"] == "sample" and not site["is_observed"]}


def data_folder(folder_name: str | None = None) -> Path | None:
    """Return the folder of the real house: ``folder_name``, which must exist, or the one in LFM_DATA or ../shared/data.

    Returns:
        The folder; None if there is no default folder.
    """
    folder = Path(os.environ.get("LFM_DATA", "../shared/data")) / "house" if folder_name is None else Path(folder_name)
    if (folder / FILE).is_file():
        return folder
    if folder_name is not None:
        raise FileNotFoundError(f"{folder_name} has no file {FILE}; leave --data out for simulated homes only.")
    return None


@functools.cache
def house(folder: str) -> tuple[Window, ...]:
    """Return every window of the real house.

    Raises:
        ValueError: the file lacks columns, has gaps, or has fewer than five days.
    """
    path = Path(folder) / FILE
    frame = pd.read_csv(path, index_col=0, parse_dates=True)
    if missing := {"Ti", "Ta", "Ph"} - set(frame.columns):
        raise ValueError(f"{path} has no column {sorted(missing)[0]!r}; expected Ti, Ta (degC) and Ph (power).")
    y = frame[["Ti", "Ta", "Ph"]].to_numpy(float) / np.array([1.0, 1.0, _POWER])
    gaps = np.diff(frame.index.to_numpy()) != np.timedelta64(1, "h")
    if gaps.any() or not np.isfinite(y).all():
        row = int(np.argmax(gaps)) if gaps.any() else int(np.argmax(~np.isfinite(y).all(axis=1)))
        raise ValueError(f"{path}: expected a row an hour without gaps; see the row after {frame.index[row]}.")
    starts = range(-frame.index[0].hour % DAY, len(y) - len(TIMES) + 1, DAY)
    if not starts:
        raise ValueError(f"{path} has {len(y)} hours; expected at least five whole days.")
    return tuple(_window(y[start:start + len(TIMES)]) for start in starts)


def _window(y: np.ndarray, **more: Any) -> Window:
    return Window(y, model_file().anchors(lfm.Data(TIMES[:TRAIN], y[:TRAIN, :2], model_file().outputs or ())), **more)


@functools.lru_cache(maxsize=256)
def home(index: int, store: str, seed: int = 0) -> Window:
    """Return a simulated home with a residual drawn from SQM, under a thermostat with random set points.

    Rates vary by a fifth between homes. There is one set point for the night and one for the day. The hours of the day
    are equal on the first four days and differ on the last.
    """
    generator, hours = np.random.default_rng([seed, index, STORES.index(store)]), np.arange(DAY)
    night, day, wake, sleep = 16.0 + generator.normal(), 20.0, generator.integers(5, 8), generator.integers(21, 24)
    usual = np.where((hours >= wake) & (hours < sleep), day, night)
    is_away = (hours >= 10) & (hours < 15)
    last_day = np.where(is_away, night, usual + generator.choice([-1.0, 1.0]) * (usual == day))
    set_points = np.concatenate([*[usual] * TRAIN_DAYS, last_day])
    values = {name: _HOME[name] * np.exp(0.2 * generator.normal()) if name in _VARIED else _HOME[name]
              for name in _HOME if store == STORES[1] or name not in ("gamma", "psi")}
    key = jax.random.fold_in(jax.random.key(seed), index)
    y, heater = (np.asarray(path) for path in _simulator(store)(key, values, set_points))
    hourly = np.column_stack([y[:-1:PER_HOUR, :2], heater[:-1].reshape(-1, PER_HOUR).mean(axis=1)])
    last = (TRAIN - 1) * PER_HOUR
    fine = np.column_stack([y[last + 1:-1, :2], heater[last + 1:-1]])
    return _window(hourly, set_points=set_points, fine=fine, on=int(heater[last]))


@functools.cache
def _simulator(store: str) -> Any:
    model, times = Model("SQM", store, _FUNCTIONS), np.arange(len(TIMES) * PER_HOUR + 1) / PER_HOUR

    def draw(key: jax.Array, values: dict[str, Any], set_points: jax.Array) -> tuple[jax.Array, jax.Array]:
        def metered(heater: Any) -> lfm.LatentForceModel:
            # The heater's meter, the third output, is part of the stored simulations' random numbers.
            home = model.likelihood(values, heater).model
            observation = lfm.GaussianObservation(
                lambda x, u, t: jnp.append(home.observation.function(x, u, t), heater),
                covariance=jnp.append(home.observation.covariance, _METER_ERROR**2))
            return lfm.LatentForceModel(home.dynamics, home.forces, observation, home.initial_state,
                                        state_names=home.state_names)

        simulation = lfm.simulate_switched(key, metered, thermostat(set_points), times, steps=1)
        return simulation.y[:, 0], simulation.inputs[:, 0]

    return jax.jit(draw)


def thermostat(set_points: Any) -> lfm.Thermostat:
    """Return the thermostat of a home; raise ValueError if there are no set points."""
    return lfm.Thermostat(None if set_points is None else lfm.Input(TIMES, set_points))
