"""Checks of the arguments that filter, smoother and likelihood share."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import Cubature
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.utils import checks


def check_observations(y: Any, count: int, outputs: int, empty: bool = False,
                       model: LatentForceModel | None = None) -> jax.Array:
    """Return y as an array (T, D) after checking it.

    Args:
        y: observations, (T, D) or (T,) for one output.
        count: T.
        outputs: D.
        empty: whether all entries may be missing.
        model: model whose observation family the entries must belong to; None: any numbers are valid.

    Raises:
        ValueError: a wrong shape, infinite entries, nothing observed at all, or data that the family cannot give.
    """
    y = checks.unmask(y)
    shape = np.shape(y)
    if shape == (count,) and outputs == 1:
        y, shape = jnp.reshape(jnp.asarray(y), (count, 1)), (count, 1)
    if shape != (count, outputs):
        raise ValueError(f"y must have one row for each of the {count} times and one column for each of the {outputs} "
                         f"outputs, shape ({count}, {outputs}); got {shape}.")
    values = checks.concrete(y)
    if values is not None:
        if values.dtype.kind not in "biuf":
            raise TypeError(f"y must be numeric, got dtype {values.dtype}.")
        if np.isinf(values).any():
            row, column = np.argwhere(np.isinf(values))[0]
            raise ValueError(f"y[{row}, {column}] is infinite; use NaN for a missing entry.")
        if np.isnan(values).all() and not empty:
            raise ValueError("every entry of y is missing (NaN); there is nothing to learn from.")
        if model is not None:
            model.observation.check_data(values, names=model.output_names)
    return jnp.asarray(y, float)


def check_iterations(iterations: int | None, damping: float, tolerance: float | None = None) -> None:
    """Raise ValueError for a negative number of iterations, a damping outside (0, 1], or a tolerance beside them."""
    if iterations is not None and iterations != 0:
        checks.positive_integer("iterations", iterations)
    if not 0 < damping <= 1:
        raise ValueError("damping must lie in (0, 1] (the largest fraction of each new iterate that is taken), "
                         f"got {damping}.")
    if iterations and tolerance is not None:
        raise ValueError("iterations need equal integration steps, and with a tolerance the steps follow the moments; "
                         f"leave out tolerance={tolerance:g} or iterations.")


def as_rule(rule: Any) -> Rule:
    """Return the rule, `Cubature()` for None; raise TypeError for anything else."""
    if rule is None:
        return Cubature()
    if not isinstance(rule, Rule):
        hint = " Call it: lfm.Cubature()." if isinstance(rule, type) else ""
        raise TypeError(f"rule must be a linearisation rule such as lfm.Cubature(), got {rule!r}.{hint}")
    return rule


_has_warned = False


def warn_single_precision() -> None:
    """Warn once when JAX runs in single precision."""
    global _has_warned
    if not _has_warned and jnp.result_type(float) != jnp.float64:
        import warnings

        _has_warned = True
        warnings.warn("JAX runs in single precision (float32), in which filters lose most of their digits. Call "
                      'jax.config.update("jax_enable_x64", True) before anything else.', stacklevel=3)
