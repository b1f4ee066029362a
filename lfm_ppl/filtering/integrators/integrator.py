"""The interface of integrators, which predict the moments over an interval of the scan.

1. `Integrator` takes moments at the start of an interval to a `Prediction` at its end, with a table of what depends on
   the length of the interval only.
2. `EqualSteps` divides the interval into `TimeGrid.steps` steps, and records them where posterior linearisation needs
   them. For `AdaptiveSteps` it attempts a step, too: by default two steps, whose difference from one step of their
   length estimates the error.
3. `RepeatedStep` takes one step after the other. A subclass has a method `step`.

A method of integration is a subclass of `RepeatedStep` in a module of its own, and an entry of `METHODS` in
`lfm_ppl.filtering.integrators.methods`. Integrators are frozen dataclasses: equal ones share compiled programs.
"""

from __future__ import annotations

import abc
import enum
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.dynamics import Dynamics, columns, linearisation_indices, minimum_sd
from lfm_ppl.filtering.moments import Moments, Prediction, Record, compose
from lfm_ppl.filtering.transition import integrating_factor
from lfm_ppl.model.state_space import Span


class Stepping(enum.Enum):
    """The steps of an integrator over an interval."""

    NONE = "none: one exact transition"
    EQUAL = "as many as the time grid says"
    ADAPTIVE = "as many as their errors need"


class Section(NamedTuple):
    """A section of time, an interval or a step of it, with the moments at its start.

    Attributes:
        span: times from the start of the section on.
        length: length of the section.
        moments: at its start.
        about: moments to linearise about: (J + 1, ...) at the ends of the J steps of an interval, or (3, ...) at start,
            middle and end of a step; None: the filter's moments.
    """

    span: Span
    length: jax.Array
    moments: Moments
    about: Moments | None = None


class Attempt(NamedTuple):
    """An attempted step.

    Attributes:
        prediction: at its end.
        error: estimated error of the mean (k,) and the rows (k, n) of the covariance of the first k states.
        stage: what the next step takes over; None for nothing.
    """

    prediction: Prediction
    error: Moments
    stage: Any = None


class StepRecord(NamedTuple):
    """Recorded steps of an interval, see `Record.LINEARIZATION`; k linearised states.

    Attributes:
        mean: (J, k), predicted at the end of each step.
        covariance: (J, k, n), with the whole state.
        phi: (J, n, n), of each step.
    """

    mean: jax.Array
    covariance: jax.Array
    phi: jax.Array


class Integrator(abc.ABC):
    """Prediction of the moments over an interval.

    Attributes:
        stepping: the steps that it takes.
        is_explicit: whether a step is unstable where a state decays within it. Long steps then warn, and models that
            are linearised in forces alone take a quadrature instead. A step that is not explicit lets a fast state
            settle, and simulations take exponential steps.
    """

    stepping: ClassVar[Stepping]
    is_explicit: ClassVar[bool] = False

    @abc.abstractmethod
    def tabulate(self, dynamics: Dynamics, length: jax.Array, steps: int, is_shared: bool = False) -> Any:
        """Return what all intervals of a length share, a pytree of arrays, the ``table`` of `predict`.

        Args:
            dynamics: the model and the rule.
            length: of the interval.
            steps: number of steps.
            is_shared: whether many intervals share it, so that a larger table is cheap.
        """

    @abc.abstractmethod
    def predict(self, dynamics: Dynamics, table: Any, interval: Section, steps: int, record: Record) -> Prediction:
        """Predict over an interval.

        Args:
            dynamics: the model and the rule.
            table: result of `tabulate` for the length of the interval.
            interval: the interval.
            steps: number of steps; of adaptive ones, a fifth of the largest number of attempts.
            record: recorded output. The map for `Record.SMOOTHER`; for `Record.LINEARIZATION`, of equal steps only,
                ``nodes`` of the result is a `StepRecord`.
        """


class EqualSteps(Integrator):
    """Prediction in steps of equal length.

    Attributes:
        error_order: order in the length of a step of the error that an attempt estimates: p + 1 for a method of order p
            with the attempts by default.
    """

    stepping: ClassVar[Stepping] = Stepping.EQUAL
    error_order: ClassVar[int]

    def attempts(self, dynamics: Dynamics, interval: Section,
                 record: Record) -> tuple[Any, Callable[[Section, Any], Attempt]]:
        """Return the first stage of an interval, and the function (step, stage) -> `Attempt`.

        By default an attempt is two steps, and its error their difference from one step; there are no stages.
        """

        def attempt(step: Section, stage: Any) -> Attempt:
            def predict(steps: int, record: Record) -> Prediction:
                table = self.tabulate(dynamics, step.length, steps)
                return self.predict(dynamics, table, step, steps, record)

            fine, coarse = predict(2, record), predict(1, Record.LIKELIHOOD)
            size = dynamics.ssm.physical_dim
            return Attempt(fine, jax.tree.map(lambda a, b: (a - b)[:size], fine.moments, coarse.moments))

        return None, attempt

    def longest_step(self, stage: Any) -> jax.Array | None:
        """Return the longest step that is worth an attempt from a stage; None for any."""
        return None


class RepeatedStep(EqualSteps):
    """Prediction in equal steps, one after the other; a subclass has a `step`."""

    def tabulate(self, dynamics: Dynamics, length: jax.Array, steps: int, is_shared: bool = False) -> Any:
        """Return the integrating factor of a step, which `minimum_sd` needs as well."""
        return integrating_factor(dynamics.ssm, dynamics.linear, length / steps)

    @abc.abstractmethod
    def step(self, dynamics: Dynamics, table: Any, step: Section, min_sd: jax.Array) -> Prediction:
        """Predict over one step; the result has the map of the step. Arguments as in `predict` and `minimum_sd`."""

    def predict(self, dynamics: Dynamics, table: Any, interval: Section, steps: int, record: Record) -> Prediction:
        """Predict over an interval in ``steps`` equal steps."""
        h = interval.length / steps
        is_explicit = self.is_explicit
        at_start = minimum_sd(dynamics, table, interval.span.time(), h, interval.moments) if is_explicit else None

        def integrate(previous: Prediction, inputs: tuple) -> tuple[Prediction, StepRecord | None]:
            index, points = inputs
            step = Section(interval.span.shifted(index * h), h, previous.moments, points)
            # A fast state settles during the interval.
            min_sd = at_start if at_start is not None else minimum_sd(
                dynamics, table, step.span.time(), h, step.moments, settles=True)
            return advance(dynamics, previous, self.step(dynamics, table, step, min_sd), record)

        initial = start_of_steps(interval.moments, record)
        points = jax.tree.map(lambda nodes: _by_steps(insert_midpoints(nodes)), interval.about)
        last, nodes = jax.lax.scan(jax.checkpoint(integrate, prevent_cse=False), initial, (jnp.arange(steps), points))
        return last._replace(nodes=nodes)


def start_of_steps(moments: Moments, record: Record) -> Prediction:
    """Return the prediction before the first step; its map is the identity for `Record.SMOOTHER`, and empty if not."""
    size = moments.mean.shape[0]
    if record is not Record.SMOOTHER:
        return Prediction(moments, jnp.zeros(0), jnp.zeros(0))
    return Prediction(moments, jnp.eye(size), jnp.zeros((size, size)))


def advance(dynamics: Dynamics, previous: Prediction, step: Prediction,
            record: Record) -> tuple[Prediction, StepRecord | None]:
    """Return the prediction after a step, and the record of the step."""
    phi, process_cov = previous.phi, previous.process_cov
    if record is Record.SMOOTHER:
        phi, process_cov = compose((phi, process_cov), (step.phi, step.process_cov))
    return Prediction(step.moments, phi, process_cov), _step_record(dynamics, step, record)


def identity_prediction(dynamics: Dynamics, moments: Moments, record: Record, steps: int) -> Prediction:
    """Predict over an interval of length zero, with the structure of a prediction in equal steps."""
    size = moments.mean.shape[0]
    step = Prediction(moments, jnp.eye(size), jnp.zeros((size, size)))
    nodes = jax.tree.map(lambda a: jnp.broadcast_to(a, (steps, *a.shape)), _step_record(dynamics, step, record))
    return start_of_steps(moments, record)._replace(nodes=nodes)


def _step_record(dynamics: Dynamics, step: Prediction, record: Record) -> StepRecord | None:
    if record is not Record.LINEARIZATION:
        return None
    indices = linearisation_indices(dynamics.ssm, dynamics.rule)
    return StepRecord(columns(step.moments.mean, indices), columns(step.moments.covariance, indices).T, step.phi)


def insert_midpoints(step_ends: jax.Array) -> jax.Array:
    """Return the ends (J + 1, ...) of steps with their midpoints in between, (2 J + 1, ...)."""
    middles = 0.5 * (step_ends[:-1] + step_ends[1:])
    pairs = jnp.stack([step_ends[:-1], middles], axis=1)
    return jnp.concatenate([pairs.reshape(2 * len(middles), *step_ends.shape[1:]), step_ends[-1:]])


def _by_steps(nodes: jax.Array) -> jax.Array:
    """Return first, middle and last node (J, 3, ...) of each step, from 2 J + 1 nodes."""
    return jnp.stack([nodes[:-2:2], nodes[1::2], nodes[2::2]], axis=1)
