"""The verdict of an accuracy report (trust, corrected, re-run or inconclusive), with the reason and the remedies.

1. Steps that are too long come first: the verdict is re-run with the command.
2. Unreliable weights: inconclusive if more draws or particles may change this; else re-run, with remedies by cost (more
   iterations if they bring the likelihood closer, exact chains).
3. Reliable weights: corrected if a mean or an sd changes noticeably, else trust.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from lfm_ppl.accuracy.importance_weights import LARGEST_K
from lfm_ppl.accuracy.log_likelihoods import finer_tolerance
from lfm_ppl.results.convergence import join_names

SHIFT = 0.1
"""Change of a mean, in posterior sds, that does not matter."""

WIDTH = 0.1
"""Relative change of an sd that does not matter."""

STEP_CHANGE = 0.1
"""Variation over the posterior of the log likelihood's change under doubled steps that does not matter."""

NOISE_SD = 0.3
"""Noise of a log ratio that does not matter."""

CORRECT = "lfm-ppl check RESULT --correct"
"""The command that samples the exact posterior, where no weights can be relied on."""

NOISE_SHARE = 0.5
"""Share of noise in the variance of the log ratios from which unreliable weights say nothing of the filter."""

LEAST_DRAWS = 40
"""Fewer draws have no tail to fit a Pareto distribution to."""

_CLOSER = 0.5
"""Share of the sd of the log ratios that iterations must leave to be recommended."""

_SIGMAS = 2.0


@dataclass(frozen=True)
class Findings:
    """What a verdict rests on; see `lfm_ppl.accuracy.check_accuracy.AccuracyReport` for the numbers.

    Attributes:
        table: of the parameters.
        k, threshold: Pareto shape and where it stops being reliable.
        exact: whether the filter is exact and no reference was run.
        step_change_sd: sd over the draws of the change of the log likelihood under doubled steps.
        noise_sd, noise_share: of the log ratios; zero of an exact reference.
        particles: of the reference; zero where there are none.
        checked: number of draws with ratios.
        available: number of draws of the posterior.
        impossible: number of draws that the reference gives a likelihood of zero.
        sampler: that made the draws.
        refit: the command that made the result; empty where it is not known.
        steps, max_step, tolerance: of the Gaussian filter.
        iterations: number of iterations of posterior linearisation that were tried in place of the fit's; zero: none.
        ratio_sd, iterated_ratio_sd: sd over the draws of the log ratios, of the fit and with these iterations.
    """

    table: pd.DataFrame
    k: float
    threshold: float
    exact: bool
    step_change_sd: float
    noise_sd: float
    noise_share: float
    particles: int
    checked: int
    available: int
    impossible: int
    sampler: str
    refit: str
    steps: int
    max_step: float | None
    tolerance: float | None = None
    iterations: int = 0
    ratio_sd: float = math.nan
    iterated_ratio_sd: float = math.nan


class Verdict(NamedTuple):
    """Judgement of a posterior of the Gaussian filter.

    Attributes:
        word: trust, corrected, re-run or inconclusive.
        reason: in words.
        command: the command to type next; empty for none.
        remedies: all commands that make the posterior right, the cheapest first, each with its cost.
    """

    word: str
    reason: str
    command: str
    remedies: tuple[str, ...] = ()


def judge(findings: Findings) -> Verdict:
    """Return the verdict on a Gaussian-filter posterior.

    - "re-run" where the posterior must be sampled again: the integration steps are too long, or the importance ratios
      too uneven to correct with;
    - "inconclusive" where the check needs more draws or particles to tell;
    - "corrected" where some mean or sd is off, and the importance weights can be relied on;
    - "trust" otherwise: every mean within 0.1 sd and every sd within 10% of the corrected one, or within two Monte
      Carlo standard errors.
    """
    word, reason, command = _verdict_from(findings)
    notes = _notes(findings)
    remedies = {command: _cost(command)} if command else {}
    refit = _refit_with_iterations(findings)
    if word == "corrected":
        remedies |= refit
    elif command == CORRECT:
        # A few gradients for each one of the fit are far cheaper than a particle filter at every step of a chain.
        remedies = refit | remedies
        command = next(iter(remedies))
        if refit:
            reason += (f" With {findings.iterations} iterations of posterior linearisation the log likelihood differs "
                       f"from the exact one by {findings.iterated_ratio_sd:.2g} (sd over the draws) in place of "
                       f"{findings.ratio_sd:.2g}.")
    costs = tuple(f"{line} ({cost})" for line, cost in remedies.items())
    return Verdict(word, " ".join([reason, *notes]), command, costs)


def _cost(command: str) -> str:
    """Return the cost of a command of a verdict in words."""
    if command == CORRECT:
        return "hours: chains with a particle filter's likelihood"
    if "--correct" in command:
        return "minutes: draws are weighted, no new chains"
    return "minutes" if command.startswith("lfm-ppl check") else "a second fit"


def _refit_with_iterations(findings: Findings) -> dict[str, str]:
    """Return the command of a fit with more iterations and its cost, where they bring the likelihood closer."""
    if not findings.iterations or not findings.iterated_ratio_sd < _CLOSER * findings.ratio_sd:
        return {}
    command = f"{findings.refit} --iterations {findings.iterations}" if findings.refit else (
        f"lfm.fit of the model with iterations={findings.iterations}")
    return {command: "a second fit, some four times as long"}


def _verdict_from(findings: Findings) -> tuple[str, str, str]:
    if not findings.step_change_sd <= STEP_CHANGE:
        if findings.tolerance is None:
            finer, advice = f"--steps {2 * findings.steps}", f"with {2 * findings.steps} steps"
        else:
            tighter = finer_tolerance(findings.tolerance)
            finer = f"--steps {2 * findings.steps} --tolerance {tighter:g}"
            advice = f"with a tolerance of {tighter:g} and {2 * findings.steps} steps"
        if findings.max_step is not None:
            finer += f" --max-step {findings.max_step / 2:g}"
        reason = (f"the integration steps are too long: twice as many change the log likelihood by amounts that vary "
                  f"by {findings.step_change_sd:.2g} (sd) over the posterior, more than {STEP_CHANGE}.")
        if not findings.refit:
            return "re-run", f"{reason} Fit again {advice}.", ""
        return "re-run", reason, f"{findings.refit} {finer}"
    if findings.exact:
        return "trust", "the model is linear with Gaussian noise, for which the filter is exact.", ""
    if not findings.k < findings.threshold:
        return _unreliable(findings)
    shifted = _changed(findings.table)
    if shifted:
        reason = (f"the Gaussian filter has moved {join_names(shifted)}; the importance weights can be relied on "
                  f"(k = {findings.k:.2f}, below {findings.threshold:.2f}), and so can the corrected mean and sd.")
        return "corrected", reason, "lfm-ppl check RESULT --correct --overwrite"
    reason = (f"no mean is off by more than {SHIFT} sd and no sd by more than {WIDTH:.0%}, beyond Monte Carlo error "
              f"(k = {findings.k:.2f}, below {findings.threshold:.2f}).")
    unseen = _SIGMAS * float(np.nanmax(findings.table["shift_se"], initial=0.0))
    if unseen <= 2.0 * SHIFT:
        return "trust", reason, ""
    more = min(math.ceil(findings.checked * (unseen / (2.0 * SHIFT)) ** 2 / 100) * 100, findings.available)
    reason += f" Shifts up to {unseen:.2f} sd cannot be told from Monte Carlo error with {findings.checked} draws."
    return "trust", reason, f"lfm-ppl check RESULT --draws {more} --overwrite" if more > findings.checked else ""


def _unreliable(findings: Findings) -> tuple[str, str, str]:
    """Return the verdict on importance ratios that cannot be relied on."""
    if not math.isfinite(findings.k) and findings.checked < min(LEAST_DRAWS, findings.available):
        return ("inconclusive", f"{findings.checked} draws are too few for a Pareto k.",
                f"lfm-ppl check RESULT --draws {min(200, findings.available)} --overwrite")
    digits = 2 if f"{findings.k:.2f}" != f"{findings.threshold:.2f}" else 4
    start = (f"k = {findings.k:.{digits}f} is not below {findings.threshold:.{digits}f}, so that the importance "
             "weights cannot be relied on")
    if findings.noise_share > NOISE_SHARE:
        reason = (f"{start}; {findings.noise_share:.0%} of the variance of the log ratios is noise of the particle "
                  "filter, which makes k larger.")
        return "inconclusive", reason, f"lfm-ppl check RESULT --particles {4 * findings.particles} --overwrite"
    # The threshold rises with the number of draws.
    draws_needed = math.ceil(10.0 ** (1.0 / (1.0 - findings.k))) if 0.0 < findings.k < LARGEST_K else math.inf
    if findings.checked < draws_needed <= findings.available:
        more = min(2 * int(draws_needed), findings.available)  # a margin, because k itself is an estimate
        command = f"lfm-ppl check RESULT --draws {more} --overwrite"
        return "inconclusive", f"{start} with {findings.checked} draws.", command
    reason = (f"{start}: the posterior of the Gaussian filter is too far from the exact one. One command samples the "
              "exact one, with the likelihood of a particle filter.")
    return "re-run", reason, CORRECT


def _changed(table: pd.DataFrame) -> list[str]:
    """Name the parameters whose mean or sd is off, the worst first."""
    changes = []
    for label, row in table.iterrows():
        shift, width = abs(row["shift"]), abs(row["sd_ratio"] - 1.0)
        parts = []
        if shift > max(SHIFT, _SIGMAS * row["shift_se"]):
            parts.append(f"the mean of {label} (by {-row['shift']:+.2f} +- {row['shift_se']:.2f} sd)")
        if width > max(WIDTH, _SIGMAS * row["sd_ratio_se"]):
            parts.append(f"the sd of {label} (to {1.0 / row['sd_ratio']:.2f} times the exact one)")
        changes += [(max(shift, width), part) for part in parts]
    return [part for _, part in sorted(changes, reverse=True)]


def _notes(findings: Findings) -> list[str]:
    notes = []
    if findings.sampler == "map" and not findings.exact:
        notes.append("The draws come from a Laplace approximation at the mode, whose own error is not seen here.")
    if findings.noise_sd > NOISE_SD:
        notes.append(f"The noise of the particle filter (sd {findings.noise_sd:.2f} of a log ratio) is above "
                     f"{NOISE_SD}; it is part of the Monte Carlo errors, which more --particles lower.")
    if findings.impossible:
        notes.append(f"The reference finds the data impossible at {findings.impossible} of {findings.checked} draws; "
                     "they have weight zero.")
    return notes
