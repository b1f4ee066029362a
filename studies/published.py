"""Comparison of errors with published ones: consistent, lower or higher, with the z-score."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import pandas as pd

from .scores import SE

ERRORS = 3.0
"""Largest difference that counts as consistent, in standard errors of the difference."""

BOUND = ERRORS * math.sqrt(2.0)
"""The same bound in standard errors of our mean, where the published mean is taken to have an equal standard error."""

FEWEST = 5
"""Smallest number of data sets whose standard error supports a comparison."""


@dataclass(frozen=True)
class PublishedComparison:
    """Comparison of an error with a published one.

    An error below the published one counts as consistent; the text names it as lower.

    Attributes:
        z: (ours - published) / standard error; NaN without a standard error.
        bound: largest absolute value of z that shows no difference.

    Example:
        >>> [str(PublishedComparison(z)) for z in (1.2, -5.1, 5.1)]
        ['consistent', 'lower than published (z = -5.1)', 'higher than published (z = 5.1)']
    """

    z: float
    bound: float = BOUND

    @property
    def has_standard_error(self) -> bool:
        """Whether a standard error is available."""
        return not math.isnan(self.z)

    @property
    def is_lower(self) -> bool:
        """Whether the error is lower than published, beyond the bound."""
        return self.z < -self.bound

    @property
    def is_higher(self) -> bool:
        """Whether the error is higher than published, beyond the bound."""
        return self.z > self.bound

    @property
    def is_consistent(self) -> bool:
        """Whether the error is not higher than published."""
        return self.has_standard_error and not self.is_higher

    def __str__(self) -> str:
        """Return the verdict, with z beyond the bound."""
        if not self.has_standard_error:
            return "-"
        if not (self.is_lower or self.is_higher):
            return "consistent"
        return f"{'lower' if self.is_lower else 'higher'} than published (z = {self.z:.1f})"


def summarize_comparisons(comparisons: Iterable[PublishedComparison]) -> str:
    """Return a sentence with the numbers of consistent, lower and higher cells.

    Example:
        >>> summarize_comparisons([PublishedComparison(1.2), PublishedComparison(-5.1), PublishedComparison(5.1)])
        '2 of 3 cells count as consistent with the published table, 1 of them lower than published; 1 higher.'
    """
    valid = [comparison for comparison in comparisons if comparison.has_standard_error]
    consistent = sum(comparison.is_consistent for comparison in valid)
    lower = sum(comparison.is_lower for comparison in valid)
    higher = sum(comparison.is_higher for comparison in valid)
    return (f"{consistent} of {len(valid)} cells count as consistent with the published table, {lower} of them lower "
            f"than published; {higher} higher.")


def compare_with_published(frame: pd.DataFrame, ours: str, published: str) -> dict[str, PublishedComparison]:
    """Return row name -> comparison, for the rows that have a published error.

    Args:
        frame: table with the columns ``ours`` and ``published`` and the columns of their standard errors.
        ours: column of our errors.
        published: column of the published errors.

    Example:
        >>> frame = pd.DataFrame({"RMSE": [1.0], "RMSE se": [0.3], "source": [4.0], "source se": [0.4]}, ["SQM"])
        >>> {row: str(comparison) for row, comparison in compare_with_published(frame, "RMSE", "source").items()}
        {'SQM': 'lower than published (z = -6.0)'}
    """
    error = (frame[f"{ours}{SE}"] ** 2 + frame[f"{published}{SE}"] ** 2) ** 0.5
    z = (frame[ours] - frame[published]) / error
    return {str(row): PublishedComparison(float(value), ERRORS) for row, value in z[frame[published].notna()].items()}


def describe_comparisons(title: str, comparisons: dict[str, PublishedComparison]) -> str:
    """Return a sentence with the numbers of consistent cells, and one for each row that differs from the published one.

    Example:
        >>> comparisons = {"SQM": PublishedComparison(-6.0), "CQM": PublishedComparison(0.5)}
        >>> print(describe_comparisons("RMSE", comparisons))  # doctest: +NORMALIZE_WHITESPACE
        RMSE: 2 of 2 cells count as consistent with the published table, 1 of them lower than published; 0 higher.
        SQM: lower than published (z = -6.0).
    """
    differences = [f" {row}: {comparison}." for row, comparison in comparisons.items()
                   if comparison.is_lower or comparison.is_higher]
    return f"{title}: {summarize_comparisons(comparisons.values())}{''.join(differences)}"
