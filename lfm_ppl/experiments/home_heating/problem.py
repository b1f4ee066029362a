"""The problem: a real house whose heating power was recorded, simulated homes under a thermostat, and their models."""

from __future__ import annotations

import functools
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from numpyro import handlers

from lfm_ppl import loading
from lfm_ppl.data import Data
from lfm_ppl.inference.bound_model import likelihood_site
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.model.inputs import Input
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.switching.rule import Thermostat
from lfm_ppl.switching.switched_simulation import simulate_switched

METHODS = ("SQM", "CQM", "WQM", "periodic", "none", "matern", "resonator")
STORES = ("one store", "envelope")
FILE = "house_hourly.csv"
TRAIN_DAYS, DAY = 4, 24
TRAIN = TRAIN_DAYS * DAY
TIMES = np.arange(TRAIN + DAY, dtype=float)
"""Hours from the midnight at which a window begins: four days to learn from, one to predict."""

PER_HOUR = 6
"""Decisions of a thermostat in an hour, every ten minutes as in the source."""

FINE = TRAIN - 1 + np.arange(1, (DAY + 1) * PER_HOUR) / PER_HOUR
"""Times of a prediction under a thermostat, from the last measurement on."""

OUTDOOR = ("outdoor_mean", "outdoor_scale", "outdoor_lengthscale")
_POWER = 100.0
"""Unit of the recorded heating power, so that full power is about one."""

_HOME = {"alpha": 0.1, "beta": 2.5, "scale": 0.3, "lengthscale": 0.5, "memory": 5.0, "noise_sd": 0.05,
         "outdoor_mean": 6.0, "outdoor_scale": 3.0, "outdoor_lengthscale": 10.0, "gamma": 0.05, "psi": 0.05}
"""The simulated home, that of the model file's default data and its walls."""

_METER_ERROR = 1e-3
_VARIED = ("alpha", "beta", "scale", "gamma", "psi")
_FUNCTIONS = 15


class Window(NamedTuple):
    """Five days of a home.

    Attributes:
        y: (120, 3), indoor and outdoor temperature (degC) and heater, from each hour to the next.
        outdoor: what is known of the temperature outside from the first four days, name -> value.
        set_points: (120,) degC, from each hour to the next; None where nobody recorded them.
        fine: (149, 3), the same at the times `FINE`; None for the real house.
        on: whether the heater is on at the last measurement of the first four days.
    """

    y: np.ndarray
    outdoor: dict[str, float]
    set_points: np.ndarray | None = None
    fine: np.ndarray | None = None
    on: int = 0


@functools.cache
def model_file() -> loading.ModelFile:
    """Return the shipped model."""
    return loading.load("home-heating")


def keywords(method: str, store: str, functions: int) -> dict[str, Any]:
    """Return the options of the model file."""
    return {"residual": method, "envelope": store == STORES[1], "functions": functions}


def data_folder(given: str | None = None) -> Path | None:
    """Return the folder of the real house: the given one, that in LFM_DATA, or ../shared/data; None: there is none.

    Raises:
        FileNotFoundError: a folder is given that has no such file.
    """
    if given is not None:
        if not (Path(given) / FILE).is_file():
            raise FileNotFoundError(f"{given} has no file {FILE}; leave --data out for simulated homes only.")
        return Path(given)
    folder = Path(os.environ.get("LFM_DATA", "../shared/data")) / "house"
    return folder if (folder / FILE).is_file() else None


@functools.cache
def house(folder: str) -> tuple[Window, ...]:
    """Return every window of the real house: four days and the one after them.

    Raises:
        ValueError: a file without the columns, with gaps, or with fewer than five days.
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
    first = int(-frame.index[0].hour % DAY)
    starts = range(first, len(y) - len(TIMES) + 1, DAY)
    if not starts:
        raise ValueError(f"{path} has {len(y)} hours; expected at least five whole days.")
    return tuple(_window(y[start:start + len(TIMES)]) for start in starts)


def _window(y: np.ndarray, **more: Any) -> Window:
    learnt = Data(TIMES[:TRAIN], y[:TRAIN, :2], model_file().outputs or ())
    return Window(y, model_file().anchors(learnt), **more)


def site(method: str, store: str, functions: int, values: dict[str, Any], y: Any,
         times: np.ndarray = TIMES) -> MarginalLikelihood:
    """Return the likelihood of ``times`` with these parameters, which may be traced, and the heater of ``y`` (T, 3)."""
    y, inputs = given(y, times)
    return likelihood_site(model_file().model, (times, y), {**keywords(method, store, functions), "inputs": inputs},
                           jax.random.key(0), values).example


def given(y: Any, times: np.ndarray = TIMES) -> tuple[jax.Array, dict[str, Input]]:
    """Split measurements (T, 3) into temperatures (T, 2) and the known input."""
    y = jnp.asarray(y)
    return y[:, :2], {"heater": Input(times, y[:, 2])}


def under(method: str, store: str, functions: int, values: dict[str, Any], heater: Any) -> LatentForceModel:
    """Return the model while the heater has one value."""
    y = jnp.zeros((len(TIMES), 3)).at[:, 2].set(heater)
    return site(method, store, functions, values, y).model


@functools.cache
def names(method: str, store: str) -> tuple[str, ...]:
    """Return the names of the parameters that are learnt."""
    return tuple(name for name in _priors(method, store) if name not in OUTDOOR)


@functools.cache
def medians(method: str, store: str) -> np.ndarray:
    """Return the logarithms of the prior medians (P,)."""
    return np.array([float(_priors(method, store)[name].loc) for name in names(method, store)])


@functools.cache
def _priors(method: str, store: str) -> dict[str, Any]:
    with jax.ensure_compile_time_eval():
        seeded = handlers.seed(model_file().model, jax.random.key(0))
        trace = handlers.trace(seeded).get_trace(TIMES, np.zeros((len(TIMES), 2)), **keywords(method, store, 3))
    return {name: one["fn"] for name, one in trace.items() if one["type"] == "sample" and not one["is_observed"]}


@functools.lru_cache(maxsize=256)
def home(index: int, store: str, seed: int = 0) -> Window:
    """Return a simulated home with a residual drawn from SQM, under a thermostat with its own set points.

    Rates vary by a fifth from home to home. The set points of the last day differ from those before.
    """
    generator = np.random.default_rng([seed, index, STORES.index(store)])
    points = _set_points(generator)
    values = {name: _HOME[name] * np.exp(0.2 * generator.normal()) if name in _VARIED else _HOME[name]
              for name in _HOME if store == STORES[1] or name not in ("gamma", "psi")}
    key = jax.random.fold_in(jax.random.key(seed), index)
    y, inputs = (np.asarray(part) for part in _simulator(store)(key, values, points))
    share = inputs[:-1].reshape(-1, PER_HOUR).mean(axis=1)
    hourly = np.column_stack([y[:-1:PER_HOUR, :2], share])
    last = (TRAIN - 1) * PER_HOUR
    fine = np.column_stack([y[last + 1:-1, :2], inputs[last + 1:-1]])
    return _window(hourly, set_points=points, fine=fine, on=int(inputs[last]))


def _set_points(generator: np.random.Generator) -> np.ndarray:
    """Return set points (120,): a night and a day every day, and another day on the last one."""
    night, day, wake, sleep = 16.0 + generator.normal(), 20.0, generator.integers(5, 8), generator.integers(21, 24)
    hours = np.arange(DAY)
    usual = np.where((hours >= wake) & (hours < sleep), day, night)
    away = (hours >= 10) & (hours < 15)
    changed = np.where(away, night, usual + generator.choice([-1.0, 1.0]) * (usual == day))
    return np.concatenate([*[usual] * TRAIN_DAYS, changed])


@functools.cache
def _simulator(store: str) -> Any:
    times = np.arange(len(TIMES) * PER_HOUR + 1) / PER_HOUR

    def draw(key: jax.Array, values: dict[str, Any], points: jax.Array) -> tuple[jax.Array, jax.Array]:
        build = lambda heater: _metered(under("SQM", store, _FUNCTIONS, values, heater), heater)  # noqa: E731
        found = simulate_switched(key, build, thermostat(points), times, steps=1)
        return found.y[:, 0], found.inputs[:, 0]

    return jax.jit(draw)


def _metered(home: LatentForceModel, heater: Any) -> LatentForceModel:
    """Return a home whose heater has a meter, a third output: the errors of the simulated homes are drawn for three."""
    own = home.observation
    observation = GaussianObservation(
        lambda x, u, t: jnp.append(own.function(x, u, t), heater), jnp.append(own.covariance, _METER_ERROR**2))
    return LatentForceModel(home.dynamics, home.forces, observation, home.initial_state, state_names=home.state_names)


def thermostat(set_points: Any) -> Thermostat:
    """Return the thermostat of a home.

    Raises:
        ValueError: nobody recorded its set points.
    """
    return Thermostat(None if set_points is None else Input(TIMES, set_points))
