"""What an observation family is: a predictor h(x, u, t), and the law of the data given it, entry by entry."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks


class ObservationFamily(eqx.Module):
    r"""Observations whose entries are independent given a predictor, from a family beyond the Gaussian.

        f_k = h(x, u, t_k) (D,),    y_kd ~ p(. | f_kd).

    A family of one's own holds ``function`` and its parameters, and implements `log_prob` and `sample`; the parameters
    named in ``per_entry`` may be scalars, (D,), or (T, D) with a value for each entry of the data.

    Attributes:
        function: ``h(x, u, t) -> (D,)``.
        per_entry: names of the fields that hold such parameters.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> class Exponential(ObservationFamily):
        ...     def log_prob(self, predictor, y):
        ...         return -predictor - y * jnp.exp(-predictor)
        ...     def sample(self, key, predictor):
        ...         return jnp.exp(predictor) * jax.random.exponential(key, predictor.shape)
        >>> Exponential(lambda x, u, t: x).log_prob(jnp.zeros(2), jnp.ones(2)).tolist()
        [-1.0, -1.0]
    """

    function: Callable[..., jax.Array]
    per_entry: ClassVar[tuple[str, ...]] = ()

    def __check_init__(self) -> None:
        """Raise TypeError where the function cannot be called."""
        if not callable(self.function):
            raise TypeError("observation function must be callable as h(x, u, t), got "
                            f"{type(self.function).__name__}.")

    @abc.abstractmethod
    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return the log densities (D,) of the entries of ``y`` (D,) under ``predictor`` (D,)."""

    @abc.abstractmethod
    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw entries (D,) under ``predictor`` (D,)."""

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each, for residuals; NaN where they are not known: there are none.

        The two are the same but where a single value has a probability, as counts and limits of detection have.
        """
        unknown = jnp.full(jnp.broadcast_shapes(predictor.shape, y.shape), jnp.nan)
        return unknown, unknown

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return what the entries (D,) are on average under ``predictor``, for plots: here the predictor itself."""
        return predictor

    def possible(self, predictor: jax.Array) -> jax.Array:
        """Return entries (D,) inside the support, to stand where one is missing."""
        return jnp.ones_like(predictor)

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str] | None:
        """Say what data (T, D) cannot be: where (T, D), and what they must be. Of missing entries nothing is asked."""
        return None

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Say for which entries (D,) of a predictor the law of the data is not finite."""
        return ~np.isfinite(predictor)

    def resolved(self, size: Callable[[Callable], int]) -> ObservationFamily:
        """Return the same family told the number of its outputs, where it needs that; ``size`` gives a function's."""
        return self

    def at(self, row: Any) -> ObservationFamily:
        """Return the family of one row of the data: parameters (T, D) become (D,)."""
        rows = {name: getattr(self, name)[row] for name in self.per_entry if np.ndim(getattr(self, name)) == 2}
        if not rows:
            return self
        names = list(rows)
        return eqx.tree_at(lambda family: [getattr(family, name) for name in names], self, list(rows.values()))

    def of_rows(self) -> bool:
        """Whether a parameter differs from row to row of the data, so that no other row has a law."""
        given = (getattr(self, name) for name in self.per_entry if np.ndim(getattr(self, name)) == 2)
        return any((known := checks.concrete(one)) is None or bool((known != known[:1]).any()) for one in given)

    def typical(self) -> ObservationFamily:
        """Return the family with parameters (T, D) averaged over the rows, for times that are no row of the data."""
        return _averaged(self)

    # What the rest of the library asks of any observation.

    @property
    def angular(self) -> tuple[int, ...]:
        """No entry is an angle."""
        return ()

    @property
    def covariance(self) -> Any:
        """There is no covariance: sites have precisions of their own."""
        return None

    @property
    def varies_with_state(self) -> bool:
        """Whether a covariance is a function of (x, u, t)."""
        return False

    def covariance_at(self, x: jax.Array, u: jax.Array, t: jax.Array, row: Any) -> jax.Array:
        """Return zeros (D, D): the predictor itself has no noise."""
        size = jax.eval_shape(self.function, x, u, t).shape[0]
        return jnp.zeros((size, size))

    def check_shapes(self, outputs: int) -> None:
        """Raise ValueError where a parameter fits neither an entry, nor a row, nor the data."""
        for name in self.per_entry:
            shape = np.shape(getattr(self, name))
            if len(shape) > 2 or (shape and shape[-1] not in (1, outputs)):
                raise ValueError(f"{name} of {type(self).__name__} must be a number, ({outputs},) for the outputs, or "
                                 f"(T, {outputs}) for all entries of the data; it has shape {shape}.")

    def check_rows(self, rows: int) -> None:
        """Raise ValueError where a parameter for each entry of the data has another number of rows."""
        for name in self.per_entry:
            shape = np.shape(getattr(self, name))
            if len(shape) == 2 and shape[0] != rows:
                raise ValueError(f"{name} of {type(self).__name__} has {shape[0]} rows, one for each time, but there "
                                 f"are {rows} times.")

    def check_predictor(self, predictor: np.ndarray, where: str, names: Sequence[str]) -> None:
        """Raise ValueError where the link overflows at a predictor (D,)."""
        wrong = np.atleast_1d(self.at(0).overflows(predictor))
        if wrong.any():
            index = int(np.argmax(wrong))
            raise ValueError(f"the law of the output {names[index]!r} is not finite {where}, where its predictor is "
                             f"{predictor[index]:g}. Change initial_state.mean or the units of the predictor, or take "
                             "another link, such as link='softplus'.")

    def check_data(self, y: Any, first_column: int = 0, names: Sequence[str] = ()) -> None:
        """Raise ValueError for data (T, D) that the family cannot give; the message names row and column.

        Args:
            y: (T, D), NaN where missing.
            first_column: which column of all data the first of these is, for the message.
            names: of all outputs, for the message.
        """
        known = checks.concrete(y)
        if known is None or checks.traced(self):
            return
        with np.errstate(invalid="ignore"):
            found = self.problem(known)
        if found is None:
            return
        wrong, expected = found
        self._refuse(wrong, known, f"{type(self).__name__} needs {expected}", first_column, names)

    def _refuse(self, wrong: np.ndarray, known: np.ndarray, needs: str, first_column: int,
                names: Sequence[str]) -> None:
        """Raise ValueError where an entry that is there is ``wrong``."""
        wrong = wrong & np.isfinite(known)
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            place = int(column) + first_column
            of = f" ({names[place]}, row {row + 1} of the data)" if len(names) > place else ""
            order = f" Outputs are in the order {', '.join(names)}." if len(names) > 1 else ""
            raise ValueError(f"y[{row}, {place}]{of} is {known[row, column]:g}, but {needs}; use NaN for a "
                             f"missing entry.{order}")


def _averaged(family: ObservationFamily) -> ObservationFamily:
    rows = {name: jnp.mean(getattr(family, name), axis=0) for name in family.per_entry
            if np.ndim(getattr(family, name)) == 2}
    if not rows:
        return family
    names = list(rows)
    return eqx.tree_at(lambda one: [getattr(one, name) for name in names], family, list(rows.values()))


def parameter(name: str, value: Any, positive: bool = True) -> jax.Array:
    """Return a parameter of a family as an array; raise ValueError where it is not finite (and positive)."""
    (checks.positive if positive else checks.finite)(name, value)
    return jnp.asarray(value, float)


def not_counts(y: np.ndarray) -> np.ndarray:
    """Say which entries are no counts."""
    return (y < 0) | (y != np.round(y))
