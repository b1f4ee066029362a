"""The posterior of a field in space and time, from the trajectories of a result.

A field is a sum of states or forces with weights that depend on the place. The weights may depend on parameters, such
as a lengthscale in space; they are then computed for each draw.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.results.arviz_data import add_group
from lfm_ppl.results.result_view import ResultView

GROUP = "field_"
"""Prefix of the names of groups that hold stored fields."""


def evaluate_field(result: Any, field: Any, points: Any = None, *, sensors: Any = None, name: str = "field",
                   unit: str = "", length_unit: str = "") -> xr.Dataset:
    """Return the posterior of a field at places, at the times of the trajectories.

    Args:
        result: of `lfm_ppl.fit`, of one series, with the group trajectories.
        field: what the model was made with: a `LaplaceBasis` (the solution of `heat` or `wave`), a `SpectralField` or a
            `SeparableField`; or a function from the parameters, name -> value, to it.
        points: (P,) or (P, d); None: a grid over the domain of the field.
        sensors: their places (D,) or (D, d), or a function of time that returns them, for figures.
        name: of the field, for figures.
        unit: of the field.
        length_unit: unit of length.

    Returns:
        Variables ``draws`` (chain, draw, time, place) given the states and forces; ``mean`` and ``sd`` (time, place),
        the sd with the variance beyond the forces of a `SeparableField`; ``truth`` (time, place) where it is known.
        The places are ``r`` (place, axis).

    Raises:
        ValueError: the result has no trajectories of the states or forces of the field.

    Example:
        >>> import lfm_ppl as lfm
        >>> from lfm_ppl.results.arviz_data import build
        >>> states = (("chain", "draw", "time", "state"), np.ones((2, 5, 4, 1)))
        >>> named = {"time": np.arange(4.0), "draw": np.arange(5), "state": ["mode 0"]}
        >>> posterior = xr.Dataset({"decay": (("chain", "draw"), np.ones((2, 5)))}, {"draw": np.arange(5)})
        >>> result = build({"trajectories": xr.Dataset({"states": states}, named), "posterior": posterior})
        >>> evaluate_field(result, lfm.LaplaceBasis((0.0, 1.0), 1), [0.5])["mean"].values[0].round(4).tolist()
        [1.4142]
    """
    import jax  # figures of a stored field need no JAX

    view = ResultView.of(result)
    trajectories = view.group("trajectories")
    posterior = view.posterior.sel(draw=trajectories["draw"]).transpose("chain", "draw", ...)
    parameters = {str(label): variable.values.reshape(-1, *variable.shape[2:]) for label, variable in posterior.items()}
    count = posterior.sizes["chain"] * posterior.sizes["draw"]
    for label, value in view.decoded("fixed").items():
        parameters.setdefault(label, np.broadcast_to(value, (count, *np.shape(value))))

    def make(values: Mapping[str, Any]) -> Any:
        return field if hasattr(field, "weights") else field(values)

    example = make({label: values[0] for label, values in parameters.items()})
    positions = np.asarray(_grid(example.domain) if points is None else points, float)
    weights, variance = jax.jit(jax.vmap(
        lambda values: jax.tree.map(jax.numpy.asarray, make(values).weights(positions))))(parameters)
    coefficients = _coefficients(trajectories, example.names).drop_duplicates("time")
    values = coefficients.transpose("chain", "draw", "time", ...).values
    times, dims = coefficients["time"].values, ("time", "place")
    draws = values.reshape(-1, *values.shape[2:]) @ np.asarray(weights).swapaxes(1, 2)
    variables = {"draws": (("chain", "draw", *dims), draws.reshape(*values.shape[:2], *draws.shape[1:])),
                 "mean": (dims, draws.mean(0)),
                 "sd": (dims, np.sqrt(draws.var(0) + np.asarray(variance).mean(0)))}
    if (truth := _truth(view, make, positions, times)) is not None:
        variables["truth"] = (dims, truth)
    if sensors is not None:
        sensor_positions = np.stack([np.asarray(sensors(t) if callable(sensors) else sensors, float) for t in times])
        variables["sensors"] = (("time", "sensor", "axis"), sensor_positions.reshape(*sensor_positions.shape[:2], -1))
    coords = {"time": coefficients["time"], "r": (("place", "axis"), positions.reshape(len(positions), -1))}
    return xr.Dataset(variables, coords, {"name": name, "unit": unit, "length_unit": length_unit})


def add_fields(result: Any, fields: Mapping[str, Mapping[str, Any]]) -> None:
    """Store fields in a result that has trajectories: name -> keyword arguments of `evaluate_field`."""
    view = ResultView.of(result)
    for name, arguments in fields.items() if "trajectories" in view.groups else ():
        add_group(result, f"{GROUP}{name}", evaluate_field(view, name=name, **arguments).drop_vars("draws"))


def _coefficients(dataset: xr.Dataset, names: tuple[str, ...]) -> xr.DataArray:
    """Return the states or forces of these names from a group with trajectories."""
    for kind in ("state", "force"):
        if f"{kind}s" in dataset and set(names) <= set(map(str, dataset[kind].values)):
            return dataset[f"{kind}s"].sel({kind: list(names)})
    raise ValueError(f"the result has no trajectories of the states or forces {names[0]!r}, ..., {names[-1]!r} of the "
                     "field. Was its model made with this field?")


def _truth(view: ResultView, make: Callable[[Any], Any], positions: np.ndarray, times: np.ndarray) -> np.ndarray | None:
    """Return the true field (K, P) where its coefficients and parameters are known."""
    try:
        truth = view.group("truth")
        field = make({str(label): variable.values for label, variable in truth.items()})
        paths = _coefficients(truth, field.names)
    except (KeyError, ValueError):
        return None
    paths = paths.drop_duplicates("time").interp(time=times).transpose("time", ...)
    return paths.values @ np.asarray(field.weights(positions)[0]).T


def _grid(domain: Any) -> np.ndarray:
    axes = [np.linspace(low, high, 60 if len(domain) == 1 else 20) for low, high in domain]
    positions = np.stack([grid.ravel() for grid in np.meshgrid(*axes, indexing="ij")], axis=1)
    return positions[:, 0] if len(domain) == 1 else positions
