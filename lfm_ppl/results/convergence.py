"""Warnings on the convergence of chains, and their remedies.

1. R-hat and effective sample sizes of all scalars are compared with thresholds.
2. Divergences, unconverged factors and few weighted trajectories give further messages.
3. Each message names the number, its threshold and the remedy.

Source: Vehtari et al. (2021), Bayesian Analysis 16(2), for the thresholds.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

MAX_R_HAT = 1.01
MIN_ESS_PER_CHAIN = 100
LEAST_TRAJECTORIES = 10
"""Worth of weighted trajectories below which the error of a log likelihood, about .3, is said."""

_NAMED = 5

_OF_FAMILY = ("Take a smaller share of each new factor, factors=lfm.FactorSettings(damping=0.5), half powers, "
              "factors=lfm.FactorSettings(power=0.5), or a tighter prior.")
_OF_CONSTRAINTS = ("Let the constraints hold at fewer times (grid, --grid), or see with lfm.full_information whether "
                   "they can be respected at all.")


def messages(summary: pd.DataFrame, chains: int, draws: int, divergences: int) -> list[str]:
    """Return one message for each way in which the draws cannot be trusted.

    Args:
        summary: table with columns sd, ess_bulk, ess_tail and r_hat, one row per scalar.
        chains: number of chains.
        draws: number of draws per chain.
        divergences: number of divergent transitions after warm-up.

    Returns:
        Messages that name parameters, values and a remedy; empty where nothing is wrong.
        Rows that do not vary (fixed or derived from fixed values) are passed over.
    """
    varying = summary[summary["sd"] != 0.0]
    broken = varying.index[~np.isfinite(varying["mean"])]
    sound = varying.drop(broken)
    warnings_found = []
    if len(broken):
        warnings_found.append(f"draws are not finite for {join_names(list(broken))}: nothing computed from them holds. "
                              "Tighten the priors, or choose starting values where the model is finite.")
    if chains < 2:
        warnings_found.append("R-hat needs at least two chains and there is one: agreement between chains was not "
                              "checked. Run with chains=4.")
    elif draws < 4:
        warnings_found.append(f"{draws} draws per chain are too few for R-hat and ESS. Raise samples.")
    high = sound["r_hat"][sound["r_hat"] > MAX_R_HAT].sort_values(ascending=False)
    if len(high):
        warnings_found.append(
            f"R-hat is above {MAX_R_HAT} for {join_names(_with_values(high, '.4f'))}: the chains have not reached the "
            "same distribution. Run longer (warmup, samples); if it stays, look at the trace plot for several modes "
            "and for parameters that the data do not identify.")
    minimum = MIN_ESS_PER_CHAIN * chains
    for kind, part in (("bulk", "centre"), ("tail", "tails")):
        low = sound[f"ess_{kind}"][sound[f"ess_{kind}"] < minimum].sort_values()
        if len(low):
            warnings_found.append(
                f"{kind} effective sample size is below {minimum} ({MIN_ESS_PER_CHAIN} per chain) for "
                f"{join_names(_with_values(low, '.0f'))}: too little is known of the {part} of the posterior. Raise "
                f"samples (or thin) about {math.ceil(minimum / max(low.iloc[0], 1.0))}-fold, or lower the correlation "
                "between parameters.")
    if divergences:
        share = 100.0 * divergences / (chains * draws)
        warnings_found.append(
            f"{divergences} of {chains * draws} transitions diverged ({share:.2g}%): draws may miss a narrow region. "
            "Raise target_accept_prob to 0.95 or 0.99 (--target-accept), take more steps where the integration breaks "
            "down, or reparameterise where the pairs plot marks them.")
    return warnings_found


def of_factors(points: int, unconverged: int, impossible: int, *, constrained: bool = False,
               from_mode: bool = False) -> list[str]:
    """Return what to say where factors do not converge near the draws; nothing where they do.

    Args:
        points: a step away from the draws, at which it was tried.
        unconverged: of them, where factors do not converge.
        impossible: of them, where the likelihood is zero, for that reason or another.
        constrained: they are factors of constraints, and not of an observation family.
        from_mode: the points are draws of a Laplace approximation.
    """
    if not unconverged:
        return []
    which, remedy = (("constraints", _OF_CONSTRAINTS) if constrained else ("observation family", _OF_FAMILY))
    where = "draws of the Laplace approximation" if from_mode else "points a step away from the draws"
    message = (f"the factors of the {which} do not converge at {unconverged} of {points} {where} "
            f"({100.0 * unconverged / points:.3g}%), ")
    if not impossible:
        return [f"{message}where the likelihood is that of assumed density filtering, which is rougher. {remedy}"]
    return [f"{message}and the likelihood is zero at {impossible} of the {points}"
            f"{'' if from_mode else ': draws may miss these parameters'}. {remedy}"]


def of_degenerate_mode(rows: pd.DataFrame) -> list[str]:
    """Return what to say of a mode that is a spike of the density; nothing where no parameter is concerned.

    Args:
        rows: of the summary of a Laplace approximation, of the parameters that are concerned.
    """
    if not len(rows):
        return []
    values = _with_values(rows["mode"], ".2g") if "mode" in rows else list(rows.index)
    return [
        f"the posterior mode is degenerate in {join_names(values)}: the density has a spike there that holds hardly "
        "any of the posterior, as where the scale of a group goes to zero and its members become equal, so that the "
        'draws mean nothing. Sample with NUTS (sampler="nuts"), and write a hierarchical model in non-centred form: '
        "theta = mu + tau * z with z ~ Normal(0, 1), or numpyro.infer.reparam.LocScaleReparam(0)."
    ]


def of_weights(trajectories: int, median: float, least: float) -> list[str]:
    """Return what to say of an evidence under constraints that rests on few of its trajectories.

    Args:
        trajectories: that are weighted; 0: none.
        median: what they are worth at half of the draws.
        least: at the worst.
    """
    if not trajectories or median >= LEAST_TRAJECTORIES:
        return []
    if median < 1.0:
        return ["the likelihood under the constraints is zero at half of the draws or more: results that rest on them "
                f"mean nothing. {_OF_CONSTRAINTS}"]
    few = trajectories < LEAST_TRAJECTORIES
    off = "by more than so few can tell" if few else f"by about {log_mean_error(median, trajectories):.1f}"
    return [
        f"the {trajectories} weighted trajectories of the evidence under constraints are worth {median:.2g} at half of "
        f"the draws, and {least:.2g} at the worst: the log likelihood is off {off}, differently at other parameters. "
        "Let the constraints hold at fewer times (grid, --grid), or weight more trajectories (draws of "
        "lfm.MarginalLikelihood)."
    ]


def log_mean_error(worth: float, count: int) -> float:
    """Return the standard error of the logarithm of a mean of independent weights, to first order.

    The coefficient of variation of N weights w that are worth n = (sum w)^2 / sum w^2 equal ones has the square
    (N / n - 1) N / (N - 1), and that of their mean is 1 / N of it.

    Args:
        worth: n.
        count: N; with fewer than two nothing is known.
    """
    return math.sqrt(max(count / worth - 1.0, 0.0) / (count - 1)) if count > 1 else math.nan


def _with_values(values: pd.Series, form: str) -> list[str]:
    return [f"{label} ({value:{form}})" for label, value in values.items()]


def join_names(names: list[str]) -> str:
    """Return the first names of a list, and the number of the others."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
