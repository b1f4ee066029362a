"""The positions of one satellite, and which of them may be learnt from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.orbits.bodies import sunlight
from lfm_ppl.orbits.environment import Environment

NOISE = 1e-4
"""Standard deviation of a coordinate (km): of its error, and of what gravity leaves out here, such as the ocean tides.

Published positions are smoothed, so that their scatter says nothing. With half of it, most of the radial and normal
bands were too narrow, and forces were learnt that explain decimetres; chosen from 5 and 10 cm by the errors of the GPS
satellites, as `learning.WEIGHT`.
"""


class Unusable(ValueError):
    """A satellite that cannot be predicted or judged; the message says why."""


@dataclass(frozen=True)
class Arc:
    """A satellite and the part of its positions that may be learnt from.

    Attributes:
        environment: Earth, Moon and Sun.
        times: (T,) hours, equally spaced.
        positions: (T, 3) km; NaN where missing.
        train: number of epochs to learn from.
    """

    environment: Environment
    times: np.ndarray
    positions: np.ndarray
    train: int

    def check(self, satellite: str, gaps: str) -> None:
        """Raise Unusable if too few positions exist for training, or none after it."""
        is_observed = np.isfinite(self.positions).all(axis=1)
        share = is_observed[:self.train].mean()
        if share < 0.9:
            raise Unusable(f"{satellite}: {share:.0%} of its positions in training exist, 90% are needed; missing "
                           f"{gaps}")
        if not is_observed[self.train:].any():
            raise Unusable(f"{satellite}: no position exists after training; missing {gaps}")

    def learnt(self) -> np.ndarray:
        """Return the positions (T, 3), NaN after training."""
        return np.where((np.arange(len(self.times)) < self.train)[:, None], self.positions, np.nan)

    def eclipsed(self, path: np.ndarray) -> bool:
        """Return whether the Earth's shadow falls on a path (T, 6) at any of the times."""
        return bool((np.asarray(_light(self.environment, jnp.asarray(self.times), jnp.asarray(path))) < 1.0).any())

    @property
    def digest(self) -> str:
        """What tells these positions from others."""
        return hashlib.sha256(np.ascontiguousarray(self.positions).tobytes()).hexdigest()[:16]


@jax.jit
def _light(environment: Environment, times: jax.Array, path: jax.Array) -> jax.Array:
    return jax.vmap(lambda t, x: sunlight(x[:3], environment.sun(t)))(times, path)
