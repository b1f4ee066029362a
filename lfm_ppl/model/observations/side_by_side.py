"""Several families side by side, for the outputs of one model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

from lfm_ppl import checks
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.observations.family import ObservationFamily


class _GaussianFamily(ObservationFamily):
    """Gaussian measurements, entry by entry, as a family among others."""

    variance: jax.Array
    per_entry: ClassVar[tuple[str, ...]] = ("variance",)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        return norm.logpdf(y, predictor, jnp.sqrt(self.variance))

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = norm.cdf(y, predictor, jnp.sqrt(self.variance))
        return found, found

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        return predictor + jnp.sqrt(self.variance) * jax.random.normal(key, predictor.shape)


class Observations(ObservationFamily):
    r"""Families side by side: the entries of one part after those of another.

    Args:
        *parts: observation families, a `lfm_ppl.GaussianObservation` with variances (D,) among them; the columns of y
            are those of the first part, then those of the second, and so on.

    Raises:
        TypeError: a part is no observation.
        ValueError: no parts; a Gaussian part whose covariance is a full matrix or a function, or that has angles.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> observation = lfm.Observations(
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        ...     lfm.PoissonObservation(lambda x, u, t: u))
        >>> len(observation.parts)
        2
    """

    parts: tuple[ObservationFamily, ...]
    sizes: tuple[int, ...] | None = eqx.field(static=True)
    per_entry: ClassVar[tuple[str, ...]] = ()

    def __init__(self, *parts: Any):
        if not parts:
            raise ValueError("Observations needs at least one observation, such as lfm.PoissonObservation(function).")
        self.parts = tuple(_as_family(index, part) for index, part in enumerate(parts))
        self.function = _Stacked(tuple(part.function for part in self.parts))
        self.sizes = None

    def resolved(self, size: Callable[[Callable], int]) -> Observations:
        """Return the same families told their numbers of outputs."""
        sizes = tuple(size(part.function) for part in self.parts)
        other = object.__new__(Observations)
        for name, value in (("parts", self.parts), ("function", self.function), ("sizes", sizes)):
            object.__setattr__(other, name, value)
        return other

    def _columns(self) -> list[slice]:
        if self.sizes is None:
            raise ValueError("Observations knows which columns belong to which part as a part of a model; take "
                             "model.observation.")
        ends = np.cumsum(self.sizes)
        return [slice(int(end) - size, int(end)) for end, size in zip(ends, self.sizes, strict=True)]

    def _each(self) -> Any:
        return zip(self.parts, self._columns(), strict=True)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return the log densities (D,)."""
        return jnp.concatenate([part.log_prob(predictor[columns], y[columns]) for part, columns in self._each()])

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw entries (D,)."""
        keys = jax.random.split(key, len(self.parts))
        return jnp.concatenate([part.sample(one, predictor[columns])
                                for one, (part, columns) in zip(keys, self._each(), strict=True)])

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        found = [part.cumulative(predictor[columns], y[columns]) for part, columns in self._each()]
        return jnp.concatenate([low for low, _ in found]), jnp.concatenate([high for _, high in found])

    def possible(self, predictor: jax.Array) -> jax.Array:
        """Return entries (D,) inside the supports."""
        return jnp.concatenate([part.possible(predictor[columns]) for part, columns in self._each()])

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return what the entries are on average (D,)."""
        return jnp.concatenate([part.mean(predictor[columns]) for part, columns in self._each()])

    def of_rows(self) -> bool:
        """Whether a parameter of a part differs from row to row of the data."""
        return any(part.of_rows() for part in self.parts)

    def typical(self) -> Observations:
        """Return the families with parameters averaged over the rows."""
        return eqx.tree_at(lambda family: family.parts, self, tuple(part.typical() for part in self.parts))

    def at(self, row: Any) -> Observations:
        """Return the families of one row of the data."""
        return eqx.tree_at(lambda family: family.parts, self, tuple(part.at(row) for part in self.parts))

    def check_shapes(self, outputs: int) -> None:
        """Check the parameters of the parts."""
        for part, size in zip(self.parts, self.sizes or (), strict=True):
            part.check_shapes(size)

    def check_rows(self, rows: int) -> None:
        """Check the parameters of the parts."""
        for part in self.parts:
            part.check_rows(rows)

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Say for which entries the law of the data is not finite."""
        return np.concatenate([part.overflows(predictor[columns]) for part, columns in self._each()])

    def check_data(self, y: Any, first_column: int = 0, names: Sequence[str] = ()) -> None:
        """Check the columns of each part."""
        known = checks.concrete(y)
        if known is None:
            return
        for part, columns in self._each():
            part.check_data(known[:, columns], first_column + columns.start, names)


class _Stacked(eqx.Module):
    """The predictors of all parts, one after the other."""

    functions: tuple[Callable[..., jax.Array], ...]

    def __call__(self, x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
        return jnp.concatenate([jnp.asarray(function(x, u, t), float) for function in self.functions])


def _as_family(index: int, part: Any) -> ObservationFamily:
    if isinstance(part, ObservationFamily):
        return part
    if not isinstance(part, GaussianObservation):
        raise TypeError(f"part {index} of Observations must be an observation, such as lfm.PoissonObservation("
                        f"function), got {type(part).__name__}.")
    if part.varies_with_state or part.covariance.ndim != 1 or part.angular:
        raise ValueError(f"part {index} of Observations is Gaussian, and there needs variances (D,) that are numbers, "
                         "and no angles: entries are independent given the predictor.")
    return _GaussianFamily(part.function, part.covariance)
