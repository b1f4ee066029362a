"""How a function uses its inputs: what a rule needs to know before it places points."""

from __future__ import annotations

from typing import NamedTuple


class InputStructure(NamedTuple):
    """How a function uses its inputs w = (x, u), as static index tuples.

    Attributes:
        points: non-linear inputs; a rule places its points in them.
        averaged: linear given the points, with a Jacobian that depends on the points or on time.
        constant: linear, with a constant Jacobian.
        jacobian: (D, M + R) Booleans, which output depends on which input.
        offset_varies: whether the function depends on time other than through its inputs' Jacobian.
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
