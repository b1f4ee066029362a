"""The structure of a function: which of its inputs are non-linear."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class InputStructure:
    """The use that a function makes of its inputs w = (x, u), as static index tuples.

    Attributes:
        points: non-linear inputs, in which a rule places its points.
        averaged: inputs that are linear given the points, with a Jacobian that depends on the points or on time; a
            rule averages it.
        constant: linear inputs with a constant Jacobian.
        jacobian: (D, M + R) Booleans, whether an output depends on an input.
        offset_varies: whether the function depends explicitly on time.
    """

    points: tuple[int, ...]
    averaged: tuple[int, ...]
    constant: tuple[int, ...]
    jacobian: tuple[tuple[bool, ...], ...]
    offset_varies: bool

    @property
    def linear(self) -> bool:
        """Whether the function is linear in w with a constant Jacobian."""
        return not (self.points or self.averaged)
