"""What the likelihood of one series and that of a panel have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import jax
import numpyro.distributions as dist


class Likelihood(dist.Distribution):
    """Distribution of the observations of one series, or of several independent ones."""

    @property
    @abstractmethod
    def members(self) -> list[Any]:
        """The distributions of all series."""

    @property
    @abstractmethod
    def first(self) -> Any:
        """The distribution of the first series."""

    @abstractmethod
    def mapped(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return ``function(distribution, *arguments)``; of several series, with the series as leading axis."""

    @abstractmethod
    def split_key(self, key: jax.Array) -> jax.Array:
        """Return a random key for each series, or the key itself for one series."""

    @property
    @abstractmethod
    def arguments(self) -> dict[str, Any]:
        """The arguments of the constructor that are given besides model and times; what is left open is not in it."""

    @abstractmethod
    def with_settings(self, **settings: Any) -> Any:
        """Return the same distribution with other settings of its filter, such as ``steps``."""

    @abstractmethod
    def with_about(self, about: Any) -> Any:
        """Return the same distribution with other smoothed moments from which its iterations start."""

    @abstractmethod
    def checked(self, value: Any) -> jax.Array:
        """Return observations as an array after checking them."""
