"""The number of steps and draws of a chain."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Schedule:
    """Numbers of steps and draws of each chain.

    Attributes:
        warmup: steps before the first draw.
        samples: number of draws.
        thin: steps of one draw.
        chain_method: "parallel" (one device for each chain), "vectorized" or "sequential"; None: parallel where there
            are enough devices, sequential otherwise.
    """

    warmup: int
    samples: int
    thin: int = 1
    chain_method: str | None = None

    @property
    def steps(self) -> int:
        """Number of steps of each chain in all."""
        return self.warmup + self.samples * self.thin

    def draws_after(self, steps: int) -> int:
        """Return the number of draws of each chain after so many steps."""
        return max((steps - self.warmup) // self.thin, 0)
