"""Axes in which a satellite's small forces are simple."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

AXES = {"RTN": ("radial", "tangential", "normal"), "DYB": ("sunward", "panel", "remaining")}
"""Frame -> names of its axes."""


def rtn(r: jax.Array, v: jax.Array) -> jax.Array:
    """Return (3, 3), whose columns are the radial, the tangential and the normal direction.

        e_R = r/|r|,    e_N = r x v/|r x v|,    e_T = e_N x e_R.

    Args:
        r: (3,) position.
        v: (3,) velocity in a frame that does not turn.

    Source: Hartikainen, Seppanen and Sarkka (2012), section 6.
    """
    radial, normal = _unit(r), _unit(jnp.cross(r, v))
    return jnp.stack([radial, jnp.cross(normal, radial), normal], axis=1)


def rtn_along(path: np.ndarray) -> np.ndarray:
    """Return the radial, tangential and normal directions (T, 3, 3), as columns, along positions and velocities (T, 6).

    Example:
        >>> rtn_along(np.array([[26_560.0, 0.0, 0.0, 0.0, 13_900.0, 0.0]])).shape
        (1, 3, 3)
    """
    return np.asarray(_rtn_along(jnp.asarray(path)))


@jax.jit
def _rtn_along(path: jax.Array) -> jax.Array:
    return jax.vmap(lambda x: rtn(x[:3], x[3:]))(path)


def dyb(r: jax.Array, sun: jax.Array) -> jax.Array:
    """Return (3, 3), whose columns are the directions of a satellite that keeps its panels to the Sun.

        e_D to the Sun,    e_Y = e_D x r/|e_D x r| along the axis of the panels,    e_B = e_D x e_Y.

    Where Sun, Earth and satellite stand in a line, e_Y is not defined; it is zero there, and near it it turns fast.

    Args:
        r: (3,) position.
        sun: (3,) position.

    Source: G. Beutler and others, Extended orbit modeling techniques at the CODE processing center, Manuscripta
    Geodaetica 19 (1994).
    """
    sunward = _unit(sun - r)
    panel = _unit(jnp.cross(sunward, r))
    return jnp.stack([sunward, panel, jnp.cross(sunward, panel)], axis=1)


def _unit(vector: jax.Array) -> jax.Array:
    square = (vector * vector).sum()
    is_defined = square > 0.0
    return jnp.where(is_defined, vector / jnp.sqrt(jnp.where(is_defined, square, 1.0)), 0.0)
