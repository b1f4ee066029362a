"""What the distance of an error from the published one means."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

BOUND = 3.0 * math.sqrt(2.0)
"""Three standard errors of the difference, 4.2 of ours: the published mean has an error as large as ours."""

TRUST = (
    "Where elliptical slice sampling is lower than published it is trusted: it has the exact posterior of a linear "
    "link and agrees with blackjax's independent elliptical slice sampler on five data sets (both are tests), and "
    "chains whose R-hat is above 1.01 go on, up to five times as long (`mixed` and `ESS` say how that ended). This "
    "says nothing of LA and GFS, which draw nothing.")
"""Why a lower error is believed."""


class Verdict(NamedTuple):
    """How our error compares with the published one.

    Lower is better, and so counts as consistent, though it is no agreement: the text says which of the two it is.

    Attributes:
        z: (ours - published) / standard error of ours; NaN where there is none.

    Example:
        >>> [str(Verdict(z)) for z in (1.2, -5.1, 5.1)]
        ['consistent', 'lower than published (z = -5.1)', 'higher than published (z = 5.1)']
    """

    z: float

    @property
    def known(self) -> bool:
        """Whether there is a standard error to compare with."""
        return not math.isnan(self.z)

    @property
    def lower(self) -> bool:
        """Whether our error is lower than published, beyond the bound."""
        return self.z < -BOUND

    @property
    def higher(self) -> bool:
        """Whether our error is higher than published, beyond the bound."""
        return self.z > BOUND

    @property
    def consistent(self) -> bool:
        """Whether the cell counts as consistent: our error is not higher than published."""
        return self.known and not self.higher

    def __str__(self) -> str:
        """Return the verdict, with z where it is beyond the bound."""
        if not self.known:
            return "-"
        if not (self.lower or self.higher):
            return "consistent"
        return f"{'lower' if self.lower else 'higher'} than published (z = {self.z:.1f})"


def summary(found: Iterable[Verdict]) -> str:
    """Return how many cells are consistent with the published table, and how many of them are lower.

    Example:
        >>> summary([Verdict(1.2), Verdict(-5.1), Verdict(5.1)])
        '2 of 3 cells count as consistent with the published table, 1 of them lower than published; 1 higher.'
    """
    known = [one for one in found if one.known]
    consistent, lower, higher = (sum(getattr(one, name) for one in known) for name in ("consistent", "lower", "higher"))
    return (f"{consistent} of {len(known)} cells count as consistent with the published table, {lower} of them lower "
            f"than published; {higher} higher.")
