"""Log predictive densities under an observation family, along the paths of a forecast."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.draw_batches import DrawFunction, map_draws
from lfm_ppl.likelihoods.panel import Panel
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.results.series import times_of

_PATH, _VALUES, _TIMES = "path of the inputs", "held-out values", "times of the path"
"""Under these names they go with the draws; no site has such a name."""


def log_densities(bound: BoundModel, draws: Mapping[str, Any], predicted: xr.Dataset, y: np.ndarray) -> np.ndarray:
    """Return log p(y | state and forces, parameters) of each draw, (S, ...) for y (...).

    Args:
        bound: the model.
        draws: site name -> (S, ...), the parameters of each path.
        predicted: paths, with variables ``states`` and ``forces`` where there are any.
        y: (K, D), or (B, K, D) for a panel; NaN where missing.

    Raises:
        ValueError: the observation is no family.
    """
    observation = bound.site.example.ssm.model.observation
    if not isinstance(observation, ObservationFamily):
        raise ValueError("the observation of the model is Gaussian, whose densities the predictions hold already; "
                         "leave out numpyro_model.")
    times = np.asarray(times_of(predicted).values, float)
    w = _inputs(predicted, y.shape[:-1])
    count = len(w)

    def series_log_prob(distribution: SeriesLikelihood, w: jax.Array, y: jax.Array, times: jax.Array) -> jax.Array:
        ssm = distribution.ssm
        family = ssm.model.observation
        assert isinstance(family, ObservationFamily)
        family = family.typical()

        def entry(w: jax.Array, t: jax.Array, y: jax.Array) -> jax.Array:
            f = ssm.observe(w, t)
            return family.log_prob(f, jnp.where(jnp.isfinite(y), y, family.possible(f)))

        return jax.vmap(entry)(w, times, y)

    def per_draw(values: dict, key: jax.Array, data: Any) -> jax.Array:
        values = dict(values)
        w, y, times = values.pop(_PATH), values.pop(_VALUES), values.pop(_TIMES)
        distribution = bound.likelihood(values, data)
        if isinstance(distribution, Panel):
            times = jnp.broadcast_to(times, (y.shape[0], times.shape[-1]))
        return distribution.mapped(series_log_prob, w, y, times)

    log_densities = map_draws(bound, DrawFunction(("log densities", y.shape), per_draw),
                      {**draws, _PATH: w, _VALUES: np.broadcast_to(y, (count, *y.shape)),
                       _TIMES: np.broadcast_to(times, (count, *times.shape))}, jax.random.key(0))
    return np.where(np.isfinite(y), log_densities, np.nan)


def _inputs(predicted: xr.Dataset, rows: tuple[int, ...]) -> np.ndarray:
    """Return w (S, ..., K, M + R) along the paths."""
    parts = []
    for name, kind in (("states", "state"), ("forces", "force")):
        if name in predicted:
            series = [dim for dim in predicted[name].dims if dim not in ("chain", "draw", "time", kind)]
            values = predicted[name].transpose("chain", "draw", *series, "time", kind).values
            parts.append(np.asarray(values, float).reshape(-1, *rows, values.shape[-1]))
    return np.concatenate(parts, axis=-1)
