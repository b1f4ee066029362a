"""The structure of a function: which of its inputs are non-linear."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class InputStructure:
    """The use that a function makes of its inputs w = (x, u), as static index tuples.

    Attributes:
        nonlinear: non-linear inputs; a sigma-point rule places its points in these coordinates only.
        averaged: inputs that are linear given the non-linear ones, with a Jacobian that depends on those or on time; a
            rule averages it.
        constant: linear inputs with a constant Jacobian.
        jacobian: (D, M + R) Booleans, whether an output depends on an input.
        offset_varies: whether the function depends explicitly on time.
    """

    nonlinear: tuple[int, ...]
    averaged: tuple[int, ...]
    constant: tuple[int, ...]
    jacobian: tuple[tuple[bool, ...], ...]
    offset_varies: bool

    @property
    def linear(self) -> bool:
        """Whether the function is linear in w with a constant Jacobian."""
        return not (self.nonlinear or self.averaged)
