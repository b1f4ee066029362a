"""Everything that was measured, in four tables."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import chains as common
from lfm_ppl.experiments.ballistic import chains, known, problem, tracking
from lfm_ppl.experiments.ballistic import parameters as estimates
from lfm_ppl.experiments.ballistic import particles as by_particles
from lfm_ppl.experiments.scores import Estimate, mean_of, pair, rate_of
from lfm_ppl.experiments.study import stacked

UNITS = {"altitude": "m", "speed": "m/s", "u": "m/s^2"}
UNKNOWN = {"most likely parameters": "likely", "parameters integrated out": "posterior"}
GAUSSIAN = "Gaussian"
NUTS, WEIGHTED = "NUTS", "weighted draws"


def joined(tasks: list[Task], results: dict[str, Result], names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return the entries ``names`` of the results of tasks that hold blocks of targets, one target after another."""
    return {name: np.concatenate([results[task.name][name] for task in tasks]) for name in names}


def of_rule(settings: Any, results: dict[str, Result], rule: str) -> dict[str, np.ndarray]:
    """Return what a Gaussian filter and smoother give at the true parameters, for all targets."""
    own = [task for task in tracking.tasks(settings) if task.settings["method"] == rule]
    return joined(own, results, ("filter_rmse", "smoother_rmse", "smoother_coverage", "log_likelihood",
                                 "filter_seconds", "smoother_seconds"))


def of_parameters(settings: Any, results: dict[str, Result], drawn: bool = False) -> dict[str, np.ndarray]:
    """Return what is known of the parameters of all targets, or of all those whose parameters are ``drawn``."""
    return joined(estimates.drawn_tasks(settings) if drawn else estimates.tasks(settings), results, (
        "likely", "exists", "posterior_mean", "posterior_sd", "below", "k", "ess", "seconds", "likely_rmse",
        "likely_coverage", "posterior_rmse", "posterior_coverage"))


def of_particles(settings: Any, results: dict[str, Result], count: int) -> dict[str, np.ndarray]:
    """Return what a number of particles gives, for the targets that have them."""
    own = [results[task.name] for task in by_particles.tasks(settings) if task.settings["particles"] == count]
    return stacked(own)


def tracked(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return one row for each Gaussian smoother.

    Returns:
        Means over targets, ``name se`` their standard errors: root mean squared error over the measurement times, and
        the share of these times at which the 95% band holds the truth; CPU seconds for one target, compilation apart.
        For the true parameters they are those of the smoother with its filter, for unknown ones those of finding the
        parameters and their posterior.
    """
    rows = {}
    for rule in settings.rules:
        found = of_rule(settings, results, rule)
        rows[rule] = _scored(found, "smoother") | pair("CPU s", mean_of(found["smoother_seconds"]))
    for drawn, ending in ((False, ""), (True, "; parameters drawn from the prior")):
        found = of_parameters(settings, results, drawn)
        for label, what in UNKNOWN.items():
            rows[f"{tracking.REPORTED}, {label}{ending}"] = _scored(found, what) | pair(
                "CPU s", mean_of(found["seconds"]))
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def _scored(found: dict[str, np.ndarray], what: str) -> dict[str, float]:
    row: dict[str, float] = {}
    for index, path in enumerate(problem.PATHS):
        row |= pair(f"RMSE {path} ({UNITS[path]})", mean_of(found[f"{what}_rmse"][:, index]))
    for index, path in enumerate(problem.PATHS):
        row |= pair(f"coverage {path}", mean_of(found[f"{what}_coverage"][:, index]))
    return row


def against_particles(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return one row for the Gaussian filter and smoother, and for each number of particles, on the same targets.

    Returns:
        RMSE; ``ratio``, the Gaussian's mean RMSE over that of the row, with the standard error of the paired
        differences; ``CPU s``, and ``times as long`` as the Gaussian takes; of the log likelihood the mean difference
        from the Gaussian's, which has the filter's error in it, and the Monte Carlo error of the particles, and its
        standard deviation; ``distinct``, through how many particles the traced paths pass at the first time.
    """
    few = min(settings.runs, settings.particle_runs)
    gaussian = {name: values[:few] for name, values in of_rule(settings, results, tracking.REPORTED).items()}
    rows: dict[str, dict[str, float]] = {}
    for what in ("filter", "smoother"):
        for label in (GAUSSIAN, *settings.particles):
            own = label == GAUSSIAN
            found = gaussian if own else of_particles(settings, results, label)
            row: dict[str, float] = {}
            for index, path in enumerate(problem.PATHS):
                row |= pair(f"RMSE {path} ({UNITS[path]})", mean_of(found[f"{what}_rmse"][:, index]))
            for index, path in enumerate(problem.PATHS if not own else ()):
                row |= pair(f"ratio {path}", paired_ratio(gaussian[f"{what}_rmse"][:, index],
                                                          found[f"{what}_rmse"][:, index]))
            row |= pair("CPU s", mean_of(found[f"{what}_seconds"]))
            if not own:
                row["times as long"] = found[f"{what}_seconds"].mean() / gaussian[f"{what}_seconds"].mean()
                difference = found["log_likelihood"] - gaussian["log_likelihood"]
                row |= pair("log likelihood - Gaussian", mean_of(difference))
                row["its sd"] = float(difference.std(ddof=1)) if few > 1 else np.nan
                if what == "smoother":
                    row["distinct"] = float(found["distinct"][:, 0].mean())
            rows[f"{what}, {label if own else f'{label:,} particles'}"] = row
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def paired_ratio(first: np.ndarray, second: np.ndarray) -> Estimate:
    """Return the ratio of means of paired values with its standard error, that of mean(first - ratio second) / mean.

    Example:
        >>> str(paired_ratio(np.array([1.0, 2.1]), np.array([2.0, 4.0])))
        '0.517 (0.011)'
    """
    ratio = first.mean() / second.mean()
    return Estimate(float(ratio), mean_of(first - ratio * second).error / float(second.mean()))


def parameters(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return one row for each parameter, in its logarithm, and one for where it is drawn from the prior.

    The last row is of the drag where the force's scale and lengthscale are known.

    Returns:
        The truth; mean and standard deviation over targets of the most likely value, where the likelihood has a
        maximum (``maximum``, the share of targets); posterior mean and standard deviation; the share of targets whose
        central posterior intervals of 50%, 80% and 95% hold the truth, with binomial standard errors; ``rank p``, the
        p-value of Kolmogorov and Smirnov's test that the posterior probability of less than the truth is uniform over
        targets; ``k > 0.7``, the share of targets whose weights have a Pareto index above 0.7, and are not to be relied
        on. For one and the same truth the shares are nominal only as far as the data outweigh the prior; for
        parameters that are drawn from the prior they are nominal if the posterior is right.
    """
    rows = {}
    for drawn in (False, True):
        for index, name in enumerate(problem.NAMES):
            found = of_parameters(settings, results, drawn)
            rows[f"log {name}{', drawn from the prior' if drawn else ''}"] = _parameter(found, index, drawn)
    below = np.concatenate([results[task.name]["below"] for task in known.tasks(settings)])
    rows["log alpha, the force's parameters known"] = _covered(below)
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def _parameter(found: dict[str, np.ndarray], index: int, drawn: bool) -> dict[str, float]:
    exists, below = found["exists"].astype(bool), found["below"][:, index]
    row: dict[str, float] = {}
    if not drawn:
        likely = found["likely"][exists, index]
        row |= {"truth": float(problem.true_z()[index]), **pair("maximum", rate_of(exists)),
                **pair("most likely", mean_of(likely)),
                "its sd": float(likely.std(ddof=1)) if len(likely) > 1 else np.nan,
                **pair("posterior mean", mean_of(found["posterior_mean"][:, index]))}
    row |= pair("posterior sd", mean_of(found["posterior_sd"][:, index]))
    return row | _covered(below) | {"k > 0.7": float((found["k"] > 0.7).mean())}


def _covered(below: np.ndarray) -> dict[str, float]:
    """Return how often central intervals hold the truth, of posterior probabilities (N,) of less than it."""
    row: dict[str, float] = {}
    for level in estimates.LEVELS:
        row |= pair(f"coverage {level:.0%}", rate_of(np.abs(below - 0.5) <= level / 2))
    row["rank p"] = float(stats.kstest(below, "uniform").pvalue)
    return row


def agreement(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return one row for NUTS, RAM and the weighted draws, on the targets that have chains.

    Returns:
        ``shift``, the largest distance of a posterior mean from that of NUTS in its standard deviations, and ``sd
        ratio``, the ratio of standard deviations furthest from one, over parameters and targets, with their Monte Carlo
        errors, to be held against them as the largest of many; ``least ESS`` of a parameter; the largest ``R-hat``, and
        Pareto index ``k`` of weights; ``divergences`` of a target; CPU seconds, compilation included for chains.
    """
    few = min(settings.runs, settings.chain_runs)
    everything = of_parameters(settings, results)
    found = {name: [results[task.name] for task in chains.tasks(settings) if task.settings["sampler"] == name]
             for name in chains.SAMPLERS}
    found[WEIGHTED] = [{"mean": everything["posterior_mean"][index], "sd": everything["posterior_sd"][index],
                        "ess": np.full(len(problem.NAMES), everything["ess"][index]),
                        "seconds": everything["seconds"][index]} for index in range(few)]
    reference, rows = found[NUTS], {}
    for label, own in found.items():
        row: dict[str, float] = {}
        if label != NUTS:
            shift, ratio = common.agreement(own, reference)
            row |= pair("shift", shift) | pair("sd ratio", ratio)
        row["least ESS"] = min(map(common.least_ess, own))
        row |= pair("CPU s", mean_of([one["seconds"] for one in own]))
        if label == WEIGHTED:
            row["k"] = float(everything["k"][:few].max())
        else:
            row["R-hat"] = max(map(common.largest_r_hat, own))
            row["divergences"] = float(np.mean([one["divergences"] for one in own]))
        rows[label] = row
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)
