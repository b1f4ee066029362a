"""Errors beside the published ones: what is better than published is said to be so, with z."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import pandas as pd

from lfm_ppl.experiments.scores import SE

ERRORS = 3.0
"""Standard errors of a difference within which it is none."""

BOUND = ERRORS * math.sqrt(2.0)
"""Three standard errors of the difference, 4.2 of ours, where the published mean has an error as large as ours."""

FEWEST = 5
"""As many data sets make a standard error with which errors can be compared."""


class Verdict(NamedTuple):
    """How our error compares with the published one.

    Lower is better, and so counts as consistent, though it is no agreement: the text says which of the two it is.

    Attributes:
        z: (ours - published) / standard error; NaN where there is none.
        bound: of z, beyond which the two differ.

    Example:
        >>> [str(Verdict(z)) for z in (1.2, -5.1, 5.1)]
        ['consistent', 'lower than published (z = -5.1)', 'higher than published (z = 5.1)']
    """

    z: float
    bound: float = BOUND

    @property
    def known(self) -> bool:
        """Whether there is a standard error to compare with."""
        return not math.isnan(self.z)

    @property
    def lower(self) -> bool:
        """Whether our error is lower than published, beyond the bound."""
        return self.z < -self.bound

    @property
    def higher(self) -> bool:
        """Whether our error is higher than published, beyond the bound."""
        return self.z > self.bound

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


def beside(frame: pd.DataFrame, ours: str, published: str) -> dict[str, Verdict]:
    """Return row -> verdict on our error, where a published one stands beside it; both have standard errors.

    Args:
        frame: a table with the columns ``ours``, ``published``, and with those of their standard errors.
        ours: column of our error.
        published: column of the published one.

    Example:
        >>> frame = pd.DataFrame({"RMSE": [1.0], "RMSE se": [0.3], "source": [4.0], "source se": [0.4]}, ["SQM"])
        >>> {row: str(one) for row, one in beside(frame, "RMSE", "source").items()}
        {'SQM': 'lower than published (z = -6.0)'}
    """
    error = (frame[f"{ours}{SE}"] ** 2 + frame[f"{published}{SE}"] ** 2) ** 0.5
    z = (frame[ours] - frame[published]) / error
    return {str(row): Verdict(float(one), ERRORS) for row, one in z[frame[published].notna()].items()}


def said(what: str, verdicts: dict[str, Verdict]) -> str:
    """Return one sentence on the verdicts: their numbers, and what each row is that differs from the published.

    Example:
        >>> print(said("RMSE", {"SQM": Verdict(-6.0), "CQM": Verdict(0.5)}))  # doctest: +NORMALIZE_WHITESPACE
        RMSE: 2 of 2 cells count as consistent with the published table, 1 of them lower than published; 0 higher.
        SQM: lower than published (z = -6.0).
    """
    apart = [f" {row}: {one}." for row, one in verdicts.items() if one.lower or one.higher]
    return f"{what}: {summary(verdicts.values())}{''.join(apart)}"
