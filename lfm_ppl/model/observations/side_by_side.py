"""Several observation families for different outputs of one model.

1. `Observations` concatenates parts: the first columns of y and entries of the predictor belong to the first part, the
   next ones to the second part, and so on.
2. A `GaussianObservation` with constant variances is converted to a family, so that all parts are families.
3. A model tells the numbers of outputs of the parts by `with_output_sizes`; only then are the columns of each part
   known.
4. Every other method splits its arguments by columns, calls the parts and concatenates their results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.utils import checks


class _GaussianFamily(ObservationFamily):
    """Gaussian measurements with independent entries, as an observation family."""

    variance: jax.Array
    per_entry: ClassVar[tuple[str, ...]] = ("variance",)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        return norm.logpdf(y, predictor, jnp.sqrt(self.variance))

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        probability = norm.cdf(y, predictor, jnp.sqrt(self.variance))
        return probability, probability

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        return predictor + jnp.sqrt(self.variance) * jax.random.normal(key, predictor.shape)


class Observations(ObservationFamily):
    r"""Observations of several families: their entries are concatenated.

    Args:
        *parts: observation families; a `lfm_ppl.GaussianObservation` with sd or variances (D,) is allowed. The columns
            of y belong to the first part, then to the second part, and so on.

    Raises:
        TypeError: a part is not an observation.
        ValueError: there are no parts; or a Gaussian part has angles, or a covariance that is a full matrix or a
            function.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> observation = lfm.Observations(
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...     lfm.PoissonObservation(lambda x, u, t: u))
        >>> len(observation.parts)
        2
    """

    parts: tuple[ObservationFamily, ...]
    sizes: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(self, *parts: Any):
        if not parts:
            raise ValueError("Observations needs at least one observation, such as lfm.PoissonObservation(function).")
        self.parts = tuple(_as_family(index, part) for index, part in enumerate(parts))
        self.function = StackedPredictor(tuple(part.function for part in self.parts))
        self.sizes = None

    def with_output_sizes(self, output_size: Callable[[Callable], int]) -> Observations:
        """Return the observations with the number of outputs of each part."""
        sizes = tuple(output_size(part.function) for part in self.parts)
        # Equinox modules are frozen and the constructor takes parts only; `sizes` is static, so tree_at cannot set it.
        observations = object.__new__(Observations)
        for name, value in (("parts", self.parts), ("function", self.function), ("sizes", sizes)):
            object.__setattr__(observations, name, value)
        return observations

    def _parts_and_columns(self) -> list[tuple[ObservationFamily, slice]]:
        if self.sizes is None:
            raise ValueError("the columns of the parts of Observations are known within a model only; use "
                             "model.observation.")
        stops = np.cumsum(self.sizes)
        return [(part, slice(int(stop) - size, int(stop)))
                for part, stop, size in zip(self.parts, stops, self.sizes, strict=True)]

    def _by_part(self, method: str, *arrays: Any) -> list[Any]:
        """Return the results of a method of each part, for its columns of the arrays."""
        return [getattr(part, method)(*(array[columns] for array in arrays))
                for part, columns in self._parts_and_columns()]

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return the log densities (D,)."""
        return jnp.concatenate(self._by_part("log_prob", predictor, y))

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw entries (D,)."""
        keys = jax.random.split(key, len(self.parts))
        return jnp.concatenate([part.sample(part_key, predictor[columns])
                                for part_key, (part, columns) in zip(keys, self._parts_and_columns(), strict=True)])

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        below, up_to = zip(*self._by_part("cumulative", predictor, y), strict=True)
        return jnp.concatenate(below), jnp.concatenate(up_to)

    def possible(self, predictor: jax.Array) -> jax.Array:
        """Return entries (D,) inside the supports."""
        return jnp.concatenate(self._by_part("possible", predictor))

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the expected entries (D,)."""
        return jnp.concatenate(self._by_part("mean", predictor))

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Return for which entries the distribution of the data is not finite."""
        return np.concatenate(self._by_part("overflows", predictor))

    def has_row_parameters(self) -> bool:
        """Return whether a parameter of a part differs between rows of the data."""
        return any(part.has_row_parameters() for part in self.parts)

    def _reduce_rows(self, reduce: Callable[[jax.Array], jax.Array]) -> Observations:
        return eqx.tree_at(lambda family: family.parts, self, tuple(part._reduce_rows(reduce) for part in self.parts))

    def check_shapes(self, outputs: int) -> None:
        """Check the parameters of the parts."""
        for part, size in zip(self.parts, self.sizes or (), strict=True):
            part.check_shapes(size)

    def check_rows(self, rows: int) -> None:
        """Check the parameters of the parts."""
        for part in self.parts:
            part.check_rows(rows)

    def check_data(self, y: Any, first_column: int = 0, names: Sequence[str] = ()) -> None:
        """Check the columns of each part."""
        data = checks.concrete(y)
        if data is None:
            return
        for part, columns in self._parts_and_columns():
            part.check_data(data[:, columns], first_column + columns.start, names)


class StackedPredictor(eqx.Module):
    """The concatenated predictors of all parts."""

    functions: tuple[Callable[..., jax.Array], ...]

    def __call__(self, x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
        """Return the predictors (D,) of all outputs."""
        return jnp.concatenate([jnp.asarray(function(x, u, t), float) for function in self.functions])


def _as_family(index: int, part: Any) -> ObservationFamily:
    if isinstance(part, ObservationFamily):
        return part
    if not isinstance(part, GaussianObservation):
        raise TypeError(f"part {index} of Observations must be an observation, such as lfm.PoissonObservation("
                        f"function), got {type(part).__name__}.")
    if part.varies_with_state or part.covariance.ndim > 1 or part.angular:
        raise ValueError(f"part {index} of Observations is Gaussian and needs sd (D,) or variances that are numbers, "
                         "and no angles, since entries are independent given the predictor.")
    return _GaussianFamily(part.function, part.covariance)
