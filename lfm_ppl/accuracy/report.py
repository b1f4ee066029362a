"""The accuracy report: its numbers as a dataset, and as text.

1. `AccuracyReport` wraps the group ``accuracy`` of a result.
2. `text` prints reference, table, verdict and remedies.
"""

from __future__ import annotations

import json
import shutil
import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from lfm_ppl.accuracy import importance_weights
from lfm_ppl.accuracy.verdict import Verdict
from lfm_ppl.results import tables
from lfm_ppl.results.result_view import ResultView

GROUP = "accuracy"
EXACT = "none needed"
SHOWN = ("mean", "sd", "corrected_mean", "corrected_sd", "shift", "shift_se", "sd_ratio", "sd_ratio_se")


@dataclass(frozen=True)
class AccuracyReport:
    """What the Gaussian filter's approximation does to a posterior.

    Attributes:
        dataset: everything, as the group ``accuracy`` of a result holds it: along (chain, draw) the
            ``log_likelihood`` of the Gaussian filter, that of the reference, that with doubled steps, the noise sd of
            each log ratio and the smoothed ``log_weight``; along ``parameter`` the columns of ``table``; and as
            attributes what the properties below return.
    """

    dataset: xr.Dataset

    @classmethod
    def of(cls, result: Any) -> AccuracyReport:
        """Return the report that ``result`` holds.

        Raises:
            ValueError: it holds none.
        """
        return cls(ResultView.of(result).group(GROUP))

    def to_dataset(self) -> xr.Dataset:
        """Return the group that a result stores."""
        return self.dataset

    @property
    def table(self) -> pd.DataFrame:
        """One row for each scalar parameter.

        Columns: mean, sd, corrected_mean, corrected_sd, shift (corrected mean - mean, in sds), shift_se (its Monte
        Carlo standard error), sd_ratio (corrected sd / sd), sd_ratio_se, corrected_mean_se.
        """
        columns = {name: self.dataset[name].values for name in importance_weights.COLUMNS}
        return pd.DataFrame(columns, index=[str(label) for label in self.dataset["parameter"].values])

    @property
    def log_ratio(self) -> np.ndarray:
        """(C, S) log importance ratios, log p_reference(y | theta) - log p_filter(y | theta)."""
        return (self.dataset["log_likelihood_reference"] - self.dataset["log_likelihood"]).values

    @property
    def log_weight(self) -> np.ndarray:
        """(C, S) smoothed, normalised log weights."""
        return self.dataset["log_weight"].values

    @property
    def k(self) -> float:
        """Pareto shape of the ratios: the filter's posterior is far from the exact one where it is large."""
        return float(self.dataset.attrs["pareto_k"])

    @property
    def threshold(self) -> float:
        """The k below which weighted means of so many draws are reliable."""
        return float(self.dataset.attrs["threshold"])

    @property
    def reliable(self) -> bool:
        """Whether the corrected moments can be relied on."""
        return self.k < self.threshold

    @property
    def ess(self) -> float:
        """Effective number of draws after weighting, autocorrelation counted."""
        return float(self.dataset.attrs["ess"])

    @property
    def noise_sd(self) -> float:
        """Root mean square, over the draws, of the noise sd of a log ratio; zero of an exact reference."""
        return float(self.dataset.attrs["noise_sd"])

    @property
    def noise_share(self) -> float:
        """Share of the variance of the log ratios over the draws that is noise."""
        return float(self.dataset.attrs["noise_share"])

    @property
    def step_change(self) -> tuple[float, float]:
        """Mean and sd over the draws of the change of the filter's log likelihood under doubled steps."""
        return float(self.dataset.attrs["step_change_mean"]), float(self.dataset.attrs["step_change_sd"])

    @property
    def reference(self) -> str:
        """What the filter was compared with."""
        return str(self.dataset.attrs["reference"])

    @property
    def exact(self) -> bool:
        """Whether the filter is exact for this model, so that no reference was needed."""
        return self.reference.startswith(EXACT)

    @property
    def verdict(self) -> Verdict:
        """The word (trust, corrected, re-run, inconclusive), the reason, the next command, and all remedies by cost."""
        attrs = self.dataset.attrs
        word, reason, command = (str(attrs[name]) for name in ("verdict", "reason", "command"))
        return Verdict(word, reason, command, tuple(json.loads(attrs.get("remedies", "[]"))))

    def text(self, width: int | None = None, result: str = "RESULT", command: bool = True) -> str:
        """Return the report as text for a terminal.

        Args:
            width: characters per line; None: the terminal's.
            result: path of the result, for the command.
            command: whether to name the next command.
        """
        width = width or shutil.get_terminal_size().columns
        table = tables.text_table(self.table[list(SHOWN)], width=width)
        word, reason, following, remedies = self.verdict
        entries_after = [("verdict", f"{word}: {reason}")]
        if len(remedies) > 1:
            entries_after += [(f"remedy {number}", remedy.replace("RESULT", result))
                      for number, remedy in enumerate(remedies, start=1)]
        if command and following:
            entries_after.append(("next", following.replace("RESULT", result)))
        return f"{_labelled(self.numbers(), width)}\n\n{table}\n\n{_labelled(entries_after, width)}"

    def __str__(self) -> str:
        """Return the report as text."""
        return self.text()

    def numbers(self) -> list[tuple[str, str]]:
        """Return what was compared with what, and the numbers that the verdict rests on, as (label, text)."""
        attrs, number = self.dataset.attrs, tables.format_number
        count = self.log_ratio.size
        mean, sd = self.step_change
        lines = [("reference", self.reference)]
        if not self.exact:
            finite = self.log_ratio[np.isfinite(self.log_ratio)]
            lines.append(("ratios", f"log ratio of the likelihoods {number(finite.mean())} +- {number(finite.std())} "
                          f"(mean, sd over {count} draws); {self.ess:.0f} effective draws"))
            lines.append(("Pareto k", f"{self.k:.2f} (reliable below {self.threshold:.2f})"))
        if int(attrs["particles"]):
            limited = "; as many particles as the limit on work allows" if int(attrs["particles_limited"]) else ""
            lines.append(("noise", f"sd {self.noise_sd:.2g} of a log ratio, {self.noise_share:.0%} of their variance"
                          f"{limited}"))
        lines.append(("steps", f"{int(attrs['steps'])} between observations; doubled, the log likelihood changes by "
                      f"{number(mean, 2)} +- {number(sd, 2)} (mean, sd over the draws)"))
        return lines


def _labelled(lines: list[tuple[str, str]], width: int) -> str:
    return "\n".join(textwrap.fill(text, max(width, 40), initial_indent=f"{label:<11}", subsequent_indent=" " * 11,
                                   break_on_hyphens=False, break_long_words=False) for label, text in lines)
