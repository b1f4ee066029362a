"""The protocol of observation families: a predictor h(x, u, t), and the distribution of each entry of y given it.

1. A family holds the function h and its parameters, and implements `log_prob` and `sample` entry by entry.
2. Optional methods serve plots and checks: `cumulative` for residuals, `mean` for predictions, `problem` for impossible
   data, `overflows` for impossible predictors, `possible` for placeholders of missing entries.
3. Parameters named in ``per_entry`` may have one value per row of the data; `select_row` selects a row, and `typical`
   averages the rows for times without data.
4. The properties of Gaussian observations (``covariance``, ``angular``, ...) exist with trivial values, so that a model
   can treat both kinds of observations alike.
5. `check_shapes`, `check_rows`, `check_predictor` and `check_data` raise errors that name the entry.

Source: Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, chapter 3.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.utils import checks
from lfm_ppl.utils.gaussian_residuals import TURN


class ObservationFamily(eqx.Module):
    r"""Non-Gaussian observations whose entries are independent given a predictor.

        f_k = h(x, u, t_k) (D,),    y_kd ~ p(. | f_kd).

    A user-defined family has the field ``function`` and fields for its parameters, and implements `log_prob` and
    `sample`. Parameters named in ``per_entry`` may be scalars, (D,), or (T, D) with a value for each entry of the data.

    Attributes:
        function: ``h(x, u, t) -> (D,)``.
        per_entry: names of the fields whose parameters may differ between entries of the data.

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
        """Raise TypeError if the function is not callable."""
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
        """Return P(data < y) and P(data <= y), (D,) each, for residuals.

        They differ where a single value has a positive probability, as for counts and detection limits. The default is
        NaN: the family then has no residuals.
        """
        undefined = jnp.full(jnp.broadcast_shapes(predictor.shape, y.shape), jnp.nan)
        return undefined, undefined

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the expected entries (D,) under ``predictor``, for plots; by default the predictor itself."""
        return predictor

    def possible(self, predictor: jax.Array) -> jax.Array:
        """Return entries (D,) inside the support, as placeholders for missing entries."""
        return jnp.ones_like(predictor)

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str] | None:
        """Return which data (T, D) are impossible, and the requirement as text; None: any data are possible.

        Missing entries are ignored.
        """
        return None

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Return for which entries (D,) of a predictor the distribution of the data is not finite."""
        return ~np.isfinite(predictor)

    def with_output_sizes(self, output_size: Callable[[Callable], int]) -> ObservationFamily:
        """Return the family with its numbers of outputs; ``output_size`` maps a predictor function to its number."""
        return self

    def select_row(self, row: Any) -> ObservationFamily:
        """Return the family for one row of the data: parameters (T, D) become (D,)."""
        return self._reduce_rows(lambda parameter: parameter[row])

    def typical(self) -> ObservationFamily:
        """Return the family with parameters (T, D) averaged over the rows, for times without data."""
        return self._reduce_rows(lambda parameter: jnp.mean(parameter, axis=0))

    def _row_parameters(self) -> list[str]:
        return [name for name in self.per_entry if np.ndim(getattr(self, name)) == 2]

    def _reduce_rows(self, reduce: Callable[[jax.Array], jax.Array]) -> ObservationFamily:
        names = self._row_parameters()
        return self if not names else eqx.tree_at(lambda family: [getattr(family, name) for name in names], self,
                                                  [reduce(getattr(self, name)) for name in names])

    def has_row_parameters(self) -> bool:
        """Return whether a parameter differs between rows, so that times without data have no distribution."""
        values = [checks.concrete(getattr(self, name)) for name in self._row_parameters()]
        return any(value is None or bool((value != value[:1]).any()) for value in values)

    # Attributes that `GaussianObservation` has as well.

    @property
    def angular(self) -> tuple[int, ...]:
        """Indices of angles: none."""
        return ()

    @property
    def period(self) -> float:
        """Period of angles, of which there are none."""
        return TURN

    @property
    def covariance(self) -> Any:
        """None: there is no noise covariance."""
        return None

    @property
    def varies_with_state(self) -> bool:
        """Whether the covariance is a function of (x, u, t): False."""
        return False

    def covariance_at(self, x: jax.Array, u: jax.Array, t: jax.Array, row: Any) -> jax.Array:
        """Return zeros (D, D): the predictor has no noise."""
        size = jax.eval_shape(self.function, x, u, t).shape[0]
        return jnp.zeros((size, size))

    def check_shapes(self, outputs: int) -> None:
        """Raise ValueError if a parameter is neither a scalar, nor (D,), nor (T, D)."""
        for name in self.per_entry:
            shape = np.shape(getattr(self, name))
            if len(shape) > 2 or (shape and shape[-1] not in (1, outputs)):
                raise ValueError(f"{name} of {type(self).__name__} must be a number, ({outputs},) for the outputs, or "
                                 f"(T, {outputs}) for all entries of the data; it has shape {shape}.")

    def check_rows(self, rows: int) -> None:
        """Raise ValueError if a parameter (T, D) has another number of rows than the data."""
        for name in self._row_parameters():
            if (size := np.shape(getattr(self, name))[0]) != rows:
                raise ValueError(f"{name} of {type(self).__name__} has {size} rows, one for each time, but there are "
                                 f"{rows} times.")

    def check_predictor(self, predictor: np.ndarray, where: str, names: Sequence[str]) -> None:
        """Raise ValueError if the distribution of an entry is not finite at a predictor (D,)."""
        overflow = np.atleast_1d(self.select_row(0).overflows(predictor))
        if overflow.any():
            index = int(np.argmax(overflow))
            raise ValueError(f"the law of the output {names[index]!r} is not finite {where}, where its predictor is "
                             f"{predictor[index]:g}. Change initial_state.mean or the units of the predictor, or use "
                             "another link, such as link='softplus'.")

    def check_data(self, y: Any, first_column: int = 0, names: Sequence[str] = ()) -> None:
        """Raise ValueError for data (T, D) that are impossible under the family; the message names row and column.

        Args:
            y: (T, D), NaN where missing.
            first_column: index of the first of these columns among all columns of the data, for the message.
            names: names of all outputs, for the message.
        """
        data = checks.concrete(y)
        if data is None or checks.traced(self):
            return
        with np.errstate(invalid="ignore"):
            problem = self.problem(data)
        if problem is None:
            return
        impossible, requirement = problem
        self._refuse(impossible, data, f"{type(self).__name__} needs {requirement}", first_column, names)

    def _refuse(self, impossible: np.ndarray, data: np.ndarray, requirement: str, first_column: int,
                names: Sequence[str]) -> None:
        """Raise ValueError if an observed entry is ``impossible``."""
        impossible = impossible & np.isfinite(data)
        if impossible.any():
            row, column = np.argwhere(impossible)[0]
            index = int(column) + first_column
            label = f" ({names[index]}, row {row + 1} of the data)" if len(names) > index else ""
            order = f" Outputs are in the order {', '.join(names)}." if len(names) > 1 else ""
            raise ValueError(f"y[{row}, {index}]{label} is {data[row, column]:g}, but {requirement}; use NaN for a "
                             f"missing entry.{order}")


def as_parameter(name: str, value: Any) -> jax.Array:
    """Return a parameter of a family as an array; raise ValueError if it is not finite and positive."""
    checks.positive(name, value)
    return jnp.asarray(value, float)


def is_not_count(y: np.ndarray) -> np.ndarray:
    """Return which entries are not counts."""
    return (y < 0) | (y != np.round(y))
