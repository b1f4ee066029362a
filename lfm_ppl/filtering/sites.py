r"""Sites: Gaussian pseudo-observations in the place of what is not Gaussian, refined until they do not change.

An entry of the data, or a constraint, is a factor p_i(f_i) of the predictor f = h(x, u, t) at a row. Its site
t_i(f_i) = exp(nu (f_i - c) - tau (f_i - c)^2 / 2) stands for it in THE filter and THE smoother. A sweep is one pass of
each; then, entry by entry, with q the smoothed marginal and q_-i = q / t_i^a the cavity,

    expectation propagation   t_i^a = (Gaussian of the moments of q_-i p_i^a) / q_-i,
    variational               nu, tau from the derivatives of E_q log p_i by the mean and the variance of q,
    Laplace                   nu, tau from those of log p_i at the mean of q,

and the log evidence, with I the integral of all sites that the filter gives,

    EP            log I + sum_i [log Z_i - log int q_-i t_i^a] / a,    Z_i = int q_-i p_i^a,
    variational   log I + sum_i [E_q log p_i - E_q log t_i],
    Laplace       log I + sum_i [log p_i - log t_i](mean of q).

The first two are stationary in the sites and in the cavities where these do not change, so that a gradient holds both
fixed and costs that of one filter. That of Laplace's goes through one more step to the mode.

What is not Gaussian enters by `EntryTerms`: to be refined by EP it needs ``tilted`` and ``present`` alone, with moments
in closed form where there are any.

Source: Minka (2001), A family of algorithms for approximate Bayesian inference; Nickisch, Solin and Grigorevskiy
(2018), ICML; Wilkinson, Särkkä and Solin (2023), Journal of Machine Learning Research 24; Khan and Lin (2017), AISTATS.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.scipy.special import ndtri

from lfm_ppl import checks
from lfm_ppl.filtering.filter import Pass, Points, Transitions, at_intervals, forward, transitions_about
from lfm_ppl.filtering.iterated import smoothed_points
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.quadrature import Marginal, Tilted, expectation, expectations, tilted_moments
from lfm_ppl.filtering.rts import Predictor, Smoothed, backward
from lfm_ppl.filtering.time_grid import TimeGrid
from lfm_ppl.filtering.update import Sites
from lfm_ppl.linalg import diagonal, inverse_and_log_det, matmul, solve_semidefinite
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel

METHODS = ("ep", "variational", "laplace")

_TOLERANCE = 1e-8
"""Largest change of a site that is left, in units of the marginal (nu times its sd, tau times its variance)."""

_SEARCH, _ALWAYS, _FOUND = 12, 3, 0.1
"""Most and least steps of the search for the mode of a tilted distribution, and its last one in standard deviations."""

_MEMORY = 3
"""Sweeps whose steps are remembered; more do not save sweeps."""

_ROUGH, _ROUGH_SWEEPS = 5e-8, 12
"""Change left above which the first sweeps are rough, and how many of them may be."""

_EARLY = 4
"""First sweeps of sites, in which changes may grow."""

_NEAR = 0.5
"""Largest change from which on steps are those of a map that is nearly linear."""

_HOPELESS = 3
"""Sweeps without any cavities from which on the first sites count for nothing."""

_PATIENCE = 12
"""Sweeps after which less and less of each new site is taken while changes are large."""

_STUCK = 1e-4
"""Share of a move below which there is no way on."""

_NEARLY_CONSTANT = 1e-13
"""Relative changes of a cavity's mean, squared, and of its variance, below which its factor is nearly constant."""

_WHOLE = 0.5
"""Share of the marginal's precision from its own site, from which the cavity is taken from leave-one-out terms."""


class SiteSettings(NamedTuple):
    """How sites are refined; hashable, so that compiled code can take it as static.

    Attributes:
        method: "ep", "variational" or "laplace".
        power: a of power EP, in (0, 1].
        damping: share of each new site that is taken at first; it is halved where changes grow.
        sweeps: most sweeps.
        relinearisations: sweeps in which the sites and the points of linearisation are refined together, before the
            points are held fixed; for models that are not linear.
    """

    method: str = "ep"
    power: float = 1.0
    damping: float = 1.0
    sweeps: int = 200
    relinearisations: int = 8


def as_settings(sites: Any, iterations: int = 0) -> SiteSettings:
    """Return settings of the sites from themselves, or from the name of a method.

    Args:
        sites: settings, the name of a method, or None for expectation propagation.
        iterations: of posterior linearisation, which are the joint sweeps of a model that is not linear; 0: as the
            settings have it.

    Raises:
        ValueError, TypeError: an unknown method, or a number out of its range.
    """
    settings = sites if isinstance(sites, SiteSettings) else SiteSettings("ep" if sites is None else sites)
    checks.one_of("method of the sites", settings.method, METHODS)
    for name in ("power", "damping"):
        if not 0.0 < getattr(settings, name) <= 1.0:
            raise ValueError(f"{name} of the sites must lie in (0, 1], got {getattr(settings, name)}.")
    if settings.method != "ep" and settings.power != 1.0:
        raise ValueError(f"power={settings.power} is one of expectation propagation; leave it out with method "
                         f"{settings.method!r}.")
    checks.positive_integer("sweeps", settings.sweeps)
    checks.positive_integer("relinearisations", settings.relinearisations)
    return settings._replace(relinearisations=iterations) if iterations else settings


class EntryTerms(Protocol):
    """What sites stand for: one factor an entry, of arrays (T, D). An entry without a factor has log Z = 0."""

    def tilted(self, cavity: Marginal, near: Marginal, power: float) -> Tilted:
        """Return log int N(f; cavity) p(f)^power df, and mean and variance of the product, normalised; (T, D) each.

        Args:
            cavity: mean and variance of each entry given everything else.
            near: its marginal as it stands, about where the product lies; of use to a quadrature.
            power: of the factor.
        """

    @property
    def present(self) -> jax.Array:
        """(T, D), whether an entry has a factor."""


class FamilyTerms(eqx.Module):
    """The factors of data under an observation family.

    Attributes:
        family: the observation family.
        y: (T, D), NaN where missing.
    """

    family: ObservationFamily
    y: jax.Array

    @property
    def present(self) -> jax.Array:
        """(T, D), whether an entry is."""
        return jnp.isfinite(self.y)

    def log_prob(self, f: jax.Array) -> jax.Array:
        """Return log p(y | f), entry by entry, zero where missing; ``f`` is (..., T, D)."""
        if f.ndim > 2:
            return jax.vmap(self.log_prob)(f)
        return jax.vmap(lambda row, f, y: row_log_prob(self.family, row, f, y))(jnp.arange(len(f)), f, self.y)

    def tilted(self, cavity: Marginal, near: Marginal, power: float, rough: bool = False) -> Tilted:
        """Return the tilted moments by quadrature, in half of the time where ``rough``."""
        # Where the rule is exact the integral does not depend on where its nodes lie; that of few nodes may, far from a
        # Gaussian product, so that nothing that is differentiated is made of rough moments.
        return tilted_moments(lambda f: power * self.log_prob(f), cavity, jax.lax.stop_gradient(near), rough)


def row_log_prob(family: ObservationFamily, row: Any, f: jax.Array, y: jax.Array) -> jax.Array:
    """Return log p(y_d | f_d) (D,) of a row, zero where missing."""
    present = jnp.isfinite(y)
    # A missing entry must not put NaN into a derivative.
    return jnp.where(present, family.at(row).log_prob(f, jnp.where(present, y, family.possible(f))), 0.0)


class Cavity(NamedTuple):
    """Marginals of the predictor (T, D), and what is left of them without an entry's own site.

    Attributes:
        cavity: without the site (to its power).
        marginal: with it.
        valid: whether both have a positive variance.
        known: whether the predictor is deterministic: it has no site, and adds log p at its mean.
    """

    cavity: Marginal
    marginal: Marginal
    valid: jax.Array
    known: jax.Array


class Converged(NamedTuple):
    """Where the sweeps end.

    Attributes:
        sites: (T, D) each.
        cavity: of the last sweep.
        log_partition: (T, D), log int q_-i p_i^a of expectation propagation with these cavities.
        change: largest change of a site that is left, as the last two sweeps tell.
        sweeps: how many were made.
        converged: whether that is below 1e-8 and every cavity valid.
    """

    sites: Sites
    cavity: Cavity
    log_partition: jax.Array
    change: jax.Array
    sweeps: jax.Array
    converged: jax.Array


class Refined(NamedTuple):
    """Sites and the points of linearisation.

    Attributes:
        found: where the sweeps ended; fixed numbers for a derivative.
        points: about which the model is linearised; None for a linear model.
        transitions: of the intervals, linearised about them; None where a pass has its own.
        assumed: log likelihood of assumed density filtering, with which a model that is not linear begins; -inf in a
            linear model.
    """

    found: Converged
    points: Points | None
    transitions: Transitions | None
    assumed: jax.Array


# --- one sweep


def cavities(predictor: Predictor, sites: Sites, present: jax.Array, power: float) -> Cavity:
    """Take an entry's own site, to a power, out of its marginal.

    With s = 1 - a tau v the cavity has the variance v / s and, from c, the mean (m - a v nu) / s. Where a site
    outweighs everything else these are differences of nearly equal numbers, and the leave-one-out terms of the
    smoother, s = C / tau and the mean (nu - u / s) / tau, are not.

    Args:
        predictor: smoothed, (T, ...).
        sites: (T, D) each.
        present: (T, D).
        power: a.
    """
    m, v = predictor.mean - sites.centre, diagonal(predictor.covariance)
    nu, tau = sites.nu, sites.tau
    known = _is_deterministic(predictor.mean, jnp.abs(v))
    v = jnp.where(known, _placeholder(predictor.mean), v)
    share = jnp.where(known, 0.0, power * tau * v)
    whole = (share > _WHOLE) & (power == 1.0)
    safe_tau = jnp.where(whole, tau, 1.0)
    left = jnp.where(whole, diagonal(predictor.precision) / safe_tau, 1.0 - share)
    valid = (left > 0) & (v > 0) & jnp.isfinite(m)
    left = jnp.where(valid, left, 1.0)
    mean = jnp.where(whole, (nu - predictor.score / left) / safe_tau, (m - power * v * nu) / left)
    mean = jnp.where(known, m, mean)
    v = jnp.where(valid, v, 1.0)
    marginal = Marginal(jnp.where(valid, predictor.mean, 0.0), v)
    cavity = Marginal(jnp.where(valid, sites.centre + mean, 0.0), v / left)
    return Cavity(cavity, marginal, valid | ~present, known)


def _ep(terms: EntryTerms, sites: Sites, at: Cavity, power: float, rough: Any = False) -> tuple:
    if not isinstance(terms, FamilyTerms):
        found = terms.tilted(at.cavity, at.marginal, power)
    elif isinstance(rough, bool):
        found = terms.tilted(at.cavity, at.marginal, power, rough)
    else:
        found = jax.lax.cond(rough, lambda at: terms.tilted(at.cavity, at.marginal, power, True),
                             lambda at: terms.tilted(at.cavity, at.marginal, power), at)
    # Where one node holds all the mass the variance is one of rounding errors, and no new site.
    usable = found.variance > 1e-13 * at.marginal.variance
    variance, unusable = jnp.where(usable, found.variance, 1.0), jnp.where(usable, 0.0, jnp.nan)
    c, v = at.cavity.mean - sites.centre, at.cavity.variance
    tau = 1.0 / variance - 1.0 / v
    # Both are the same number. A factor that hardly narrows a cavity moves it by less than its mean is rounded by.
    nu = jnp.where(variance > 0.5 * v, found.shift / variance + c * tau, (found.mean - sites.centre) / variance - c / v)
    return nu / power + unusable, tau / power + unusable, found.log_partition


def _variational(terms: Any, sites: Sites, at: Cavity, power: float, rough: Any = False) -> tuple:
    _, by_mean, by_variance = expectations(terms.log_prob, at.marginal)
    tau = -2.0 * by_variance
    return by_mean + tau * (at.marginal.mean - sites.centre), tau, jnp.zeros_like(tau)


def _laplace(terms: Any, sites: Sites, at: Cavity, power: float, rough: Any = False) -> tuple:
    m = at.marginal.mean
    first = jax.grad(lambda f: terms.log_prob(f).sum())
    slope, curvature = jax.jvp(first, (m,), (jnp.ones_like(m),))
    return slope - curvature * (m - sites.centre), -curvature, jnp.zeros_like(m)


_NEW_SITES: dict[str, Callable] = {"ep": _ep, "variational": _variational, "laplace": _laplace}


def new_sites(terms: EntryTerms, sites: Sites, at: Cavity, settings: SiteSettings,
              damping: Any, rough: Any = False) -> tuple[Sites, jax.Array, jax.Array]:
    """Return damped new sites, the largest change of one, and what EP has of log Z_i; without a cavity a site is kept.

    Those of expectation propagation may be ``rough``.
    """
    nu, tau, log_partition = _NEW_SITES[settings.method](terms, sites, at, settings.power, rough)
    nu, tau = (jnp.where(at.known, 0.0, new) for new in (nu, tau))
    usable = terms.present & at.valid & jnp.isfinite(nu) & jnp.isfinite(tau)
    nu, tau = (jnp.where(usable, new, old) for new, old in ((nu, sites.nu), (tau, sites.tau)))
    v = at.marginal.variance
    sd, eps = jnp.sqrt(v), jnp.finfo(v.dtype).eps
    change = jnp.maximum(jnp.abs(nu - sites.nu) * sd, jnp.abs(tau - sites.tau) * v)
    # A site whose sd is not far above the spacing of numbers at the predictor is known to that spacing only.
    rounding = 16.0 * eps * jnp.abs(tau) * sd * jnp.abs(at.marginal.mean)
    change = jnp.where(change > rounding, change, 0.0)
    change = jnp.max(jnp.where(usable | ~terms.present, change, jnp.inf), initial=0.0)
    mix = lambda old, new: old + damping * (new - old)  # noqa: E731
    return sites._replace(nu=mix(sites.nu, nu), tau=mix(sites.tau, tau)), change, log_partition


def gaussian_terms(sites: Sites, cavity: Marginal, power: float) -> jax.Array:
    """Return log int N(f; cavity) t(f)^power df, an entry each."""
    nu, tau, v = power * sites.nu, power * sites.tau, cavity.variance
    away, grown = cavity.mean - sites.centre, 1.0 + tau * v
    grown = jnp.where(grown > 0, grown, 1.0)
    return ((nu - 0.5 * tau * away) * away - 0.5 * jnp.log(grown) + 0.5 * (nu - tau * away) ** 2 * v / grown)


def log_evidence_terms(terms: Any, sites: Sites, at: Cavity, settings: SiteSettings,
                       log_partition: jax.Array | None = None) -> jax.Array:
    """Return what each entry (T, D) adds to the integral of all sites, zero where missing.

    Args:
        terms: what the sites stand for.
        sites: (T, D) each.
        at: their cavities, which have no derivative where ``log_partition`` is given.
        settings: of the sites.
        log_partition: (T, D), that of EP's cavities where it is known.
    """
    nu, tau = sites.nu, sites.tau
    if settings.method == "ep":
        a = settings.power
        integral = lambda: terms.tilted(at.cavity, at.marginal, a).log_partition  # noqa: E731
        found = integral() if log_partition is None else _of_known_value(integral, log_partition)
        value = (found - gaussian_terms(sites, at.cavity, a)) / a
    else:
        m, v = at.marginal
        away = m - sites.centre
        gaussian = (nu - 0.5 * tau * away) * away
        if settings.method == "variational":
            value = expectations(terms.log_prob, at.marginal)[0] - gaussian + 0.5 * tau * v
        else:
            value = terms.log_prob(m) - gaussian
    return jnp.where(terms.present, value, 0.0)


def _of_known_value(function: Callable[[], jax.Array], value: jax.Array) -> jax.Array:
    """Return ``function()``, whose value is known: it is computed for a derivative only, and where it has one."""
    converted, closed_over = jax.closure_convert(function)

    @jax.custom_jvp
    def known(value: jax.Array, *closed_over: Any) -> jax.Array:
        return value

    @functools.partial(known.defjvp, symbolic_zeros=True)
    def _jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
        moving = [i for i, tangent in enumerate(tangents[1:]) if not isinstance(tangent, SymbolicZero)]
        if not moving:
            return primals[0], jnp.zeros_like(primals[0])

        def of_moving(*values: Any) -> jax.Array:
            everything = list(primals[1:])
            for i, one in zip(moving, values, strict=True):
                everything[i] = one
            return converted(*everything)

        return primals[0], jax.jvp(of_moving, tuple(primals[1 + i] for i in moving),
                                   tuple(tangents[1 + i] for i in moving))[1]

    return known(value, *closed_over)


# --- first sites


class AssumedRow(NamedTuple):
    """The sites of a row, and log p(y_k | y_1:k-1)."""

    sites: Sites
    log_likelihood: jax.Array


def assumed_density(family: ObservationFamily) -> Callable[..., AssumedRow]:
    """Return what makes the sites of a row in the forward scan itself: the first pass of EP, assumed density filtering.

    The entries of a row are taken in one after the other, each with what the earlier ones have left of the prediction
    as its cavity. Prediction times sites then has the moments of the last tilted distribution: a positive definite
    covariance, whatever the signs of the precisions. The product of the entries' Z is a density of the row.

    Far from the data a tilted distribution may have two modes, where the law is not log-concave. The quadrature has its
    nodes about the nearer one: log Z is then off by up to a nat, and its derivative, which holds the nodes, by more.
    """

    def assumed(mean: jax.Array, covariance: jax.Array, row: jax.Array, y: jax.Array) -> AssumedRow:
        def entry(left: tuple[jax.Array, jax.Array], index: Any) -> tuple:
            m, covariance = left
            middle, spread = m[index], covariance[index, index]
            log_prob = lambda f: row_log_prob(family, row, m.at[index].set(f[0]), y)[index][None]  # noqa: E731
            cavity, found = jax.tree_util.tree_map(
                lambda a: a[0], assumed_tilted(log_prob, middle[None], spread[None]))
            known = _is_deterministic(middle, spread)
            # A quadrature has the value of a nearly constant factor, but not its slope.
            flat = ((found.shift**2 < _NEARLY_CONSTANT * cavity.variance)
                    & (jnp.abs(found.variance - cavity.variance) < _NEARLY_CONSTANT * cavity.variance))
            log_partition = jnp.where(known | flat, log_prob(middle[None])[0], found.log_partition)
            usable = ~known & jnp.isfinite(y[index]) & jnp.isfinite(log_partition) & (found.variance > 0)
            variance = jnp.where(usable, found.variance, cavity.variance)
            moved = jnp.where(usable, found.shift, 0.0)
            tau = 1.0 / variance - 1.0 / cavity.variance
            gain = covariance[:, index] / cavity.variance
            left = m + gain * moved, covariance + jnp.outer(gain, gain) * (variance - cavity.variance)
            return left, (moved / variance + tau * (middle - mean[index]), tau,
                          jnp.where(jnp.isfinite(y[index]), log_partition, 0.0))

        if mean.shape[0] == 1:
            nu, tau, log_partition = jax.tree_util.tree_map(lambda a: a[None], entry((mean, covariance), 0)[1])
        else:
            nu, tau, log_partition = jax.lax.scan(entry, (mean, covariance), jnp.arange(mean.shape[0]))[1]
        return AssumedRow(Sites(mean, nu, tau), log_partition.sum())

    return assumed


def assumed_tilted(log_prob: Callable, mean: jax.Array, variance: jax.Array) -> tuple[Marginal, Tilted]:
    """Return a prediction of a row's predictor (D,), and the moments of it tilted by log p."""
    cavity = _with_variance(mean, variance)

    def about(cavity: Marginal) -> Marginal:
        near = _mode(log_prob, cavity)
        found = tilted_moments(jax.vmap(log_prob), cavity, near)
        good = jnp.isfinite(found.log_partition) & (found.variance > 0)
        return Marginal(jnp.where(good, found.mean, near.mean), jnp.where(good, found.variance, near.variance))

    # The integral of a product with one mode does not depend on where its nodes lie.
    return cavity, tilted_moments(jax.vmap(log_prob), cavity, _held(about, cavity))


def _mode(log_prob: Callable, cavity: Marginal) -> Marginal:
    """Return the mode of N(f; cavity) p(f), entry by entry, and the variance from the curvature there."""
    first = jax.grad(lambda f: log_prob(f).sum())

    def objective(f: jax.Array) -> jax.Array:
        return log_prob(f) - 0.5 * (f - cavity.mean) ** 2 / cavity.variance

    def precision(f: jax.Array) -> tuple[jax.Array, jax.Array]:
        slope, curvature = jax.jvp(first, (f,), (jnp.ones_like(f),))
        curvature = jnp.where(jnp.isfinite(curvature), jnp.minimum(curvature, 0.0), 0.0)
        return slope, 1.0 / cavity.variance - curvature

    def step(carry: tuple) -> tuple:
        f, value, radius, _, count = carry
        slope, total = precision(f)
        move = (slope - (f - cavity.mean) / cavity.variance) / total
        move = jnp.where(jnp.isfinite(move), move, 0.0)
        tried = f + jnp.clip(move, -radius, radius)
        new = objective(tried)
        better = new > value
        return (jnp.where(better, tried, f), jnp.where(better, new, value),
                jnp.where(better, 3.0 * radius, 0.25 * radius), (move**2 * total > _FOUND**2).any(), count + 1)

    start = (cavity.mean, objective(cavity.mean), 4.0 * jnp.sqrt(cavity.variance), jnp.array(True),
             jnp.zeros((), int))
    carry = functools.reduce(lambda carry, _: step(carry), range(_ALWAYS), start)  # a loop costs more than its steps
    f = jax.lax.while_loop(lambda carry: carry[3] & (carry[4] < _SEARCH), step, carry)[0]
    return Marginal(f, 1.0 / precision(f)[1])


# --- all sweeps


def is_linear(ssm: StateSpaceModel) -> bool:
    """Whether no pass depends on about which moments the model is linearised."""
    return (ssm.drift_structure.linear and ssm.observation_structure.linear
            and not callable(ssm.model.process_noise))


def refine(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, terms: EntryTerms, settings: SiteSettings,
           start: Moments, first: Sites | None = None) -> Refined:
    """Refine sites until they do not change.

    A model that is not linear is first smoothed a fixed number of times, and after each pass linearised about the
    smoothed moments and its sites refined; all of that has a derivative. Then the points of linearisation stay, and the
    sites are refined until they do not change, with no derivative. Where they go on changing, the sites are those of
    assumed density filtering, but for precisions below zero: a variance could be negative about other points.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        grid: the time grid.
        y: (T, D), NaN where there is no factor; only that is asked of it where ``first`` is given.
        terms: what the sites stand for.
        settings: how they are refined.
        start: moments at the initial time.
        first: sites to begin with; None, of a model with an observation family: from the prior's marginals in a linear
            model, by `assumed_density` in another.
    """
    points = transitions = assumed = None
    if is_linear(ssm):
        transitions = transitions_about(ssm, rule, grid, None)
        if first is None:
            first = _held(lambda *a: _from_prior(ssm, rule, grid, _family(ssm), *a), y, start, transitions)
    else:
        begin = assumed_density(_family(ssm)) if first is None else first
        (first, points), passed = _joint_sweeps(ssm, rule, grid, y, terms, settings, start, begin)
        assumed = passed if callable(begin) else None
        transitions = transitions_about(ssm, rule, grid, points)
    # The terms hold functions, so that they are closed over, and no argument.
    found = _held(lambda *a: _until_converged(ssm, rule, grid, settings, terms, *a), y, start, first, points,
                  transitions)
    if assumed is None:
        return Refined(found, points, transitions, jnp.asarray(-jnp.inf))
    known = _held(lambda found, sites: jax.tree_util.tree_map(
        functools.partial(jnp.where, found.converged), found.sites, sites), found,
        _that_leave_cavities(_used(assumed, grid)))
    return Refined(found._replace(sites=known), points, transitions, assumed.log_likelihood.sum())


def _family(ssm: StateSpaceModel) -> ObservationFamily:
    family = ssm.model.observation
    assert isinstance(family, ObservationFamily)
    return family


def _held(function: Callable, *arguments: Any) -> Any:
    """Return ``function(*arguments)`` without a derivative, by what it closes over either."""
    converted, closed_over = jax.closure_convert(function, *arguments)
    hold = lambda tree: jax.tree_util.tree_map(_stop, tree)  # noqa: E731
    return hold(converted(*hold(arguments), *hold(closed_over)))


def _stop(leaf: Any) -> Any:
    return jax.lax.stop_gradient(leaf) if isinstance(leaf, (jax.Array, np.ndarray)) else leaf


def _from_prior(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, family: ObservationFamily, y: jax.Array,
                start: Moments, transitions: Transitions | None) -> Sites:
    """Return sites with the moments of the prior's marginals times the data's factors.

    All at once, which is faster than one after the other in the scan; in a model that is not linear the prior may run
    away from the data.
    """
    nothing = jnp.zeros_like(y)
    passed = forward(ssm, rule, grid, jnp.full(y.shape, jnp.nan), start=start, keep="moments",
                     sites=Sites(nothing, nothing, nothing), transitions=transitions)
    at = passed.site_terms
    mean, variance = at_intervals(at.value, grid.observed), at_intervals(diagonal(at.variance), grid.observed)
    cavity = _with_variance(mean, variance)
    terms = FamilyTerms(family, y)
    found = terms.tilted(cavity, _mode(terms.log_prob, cavity), 1.0, rough=True)
    usable = (jnp.isfinite(y) & jnp.isfinite(found.log_partition) & (found.variance > 0)
              & ~_is_deterministic(mean, variance))
    variance = jnp.where(usable, found.variance, 1.0)
    tau = jnp.where(usable, 1.0 / variance - 1.0 / cavity.variance, 0.0)
    return Sites(mean, jnp.where(usable, found.shift / variance, 0.0), tau)


def _is_deterministic(mean: jax.Array, variance: jax.Array) -> jax.Array:
    """Whether a predictor has no variance, or a standard deviation below the spacing of numbers at its mean."""
    info = jnp.finfo(variance.dtype)
    # The derivative of 1 / variance must not overflow.
    return variance <= (8.0 * info.eps * mean) ** 2 + float(info.tiny) ** (1.0 / 3.0)


def _placeholder(mean: jax.Array) -> jax.Array:
    """Return the variance with which a deterministic predictor goes through a quadrature that is not used."""
    return jax.lax.stop_gradient(1e-20 * (1e-6 + mean**2))


def _with_variance(mean: jax.Array, variance: jax.Array) -> Marginal:
    """Return a marginal whose variance is above zero, a placeholder of a deterministic predictor."""
    return Marginal(mean, jnp.where(_is_deterministic(mean, variance), _placeholder(mean), variance))


def _smoothed(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments,
              sites: Sites | Callable[..., AssumedRow], points: Points | None, keep: str,
              transitions: Transitions | None = None) -> tuple[Pass, Smoothed, Predictor]:
    passed = forward(ssm, rule, grid, y, start=start, linearization_point=points, keep=keep, sites=sites,
                     transitions=transitions)
    smoothed = backward(passed, start, grid, moments=False)
    assert smoothed.predictor is not None
    predictor = Predictor(*(at_intervals(a, grid.observed) for a in smoothed.predictor))
    return passed, smoothed, predictor


def _used(passed: Pass, grid: TimeGrid) -> Sites:
    """Return the sites of a forward scan (T, D)."""
    return Sites(*(at_intervals(a, grid.observed) for a in passed.site_terms.sites))


def _joint_sweeps(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, terms: EntryTerms,
                  settings: SiteSettings, start: Moments,
                  first: Sites | Callable[..., AssumedRow]) -> tuple[tuple[Sites, Points], Pass]:
    """Return sites and points of linearisation, and the first forward scan."""
    whole_intervals = grid.steps == 1 and ssm.stack.jump_table() is None

    # A sweep in which an entry has no cavity tells nothing.
    def sweep(sites: Sites | Callable[..., AssumedRow], points: Points | None) -> tuple[tuple[Sites, Points], Pass]:
        # Without nodes inside of an interval its map is all that is needed of it.
        maps = transitions_about(ssm, rule, grid, points) if points is not None and whole_intervals else None
        passed, smoothed, predictor = _smoothed(ssm, rule, grid, y, start, sites, points,
                                                "inside" if maps is None else "all", maps)
        used = _used(passed, grid)
        at = cavities(predictor, used, terms.present, settings.power)
        # Points of linearisation take the derivative of these sites, and that of rough ones is not exact enough.
        refined = new_sites(terms, used, at, settings, settings.damping)[0]
        found = smoothed_points(ssm, rule, grid, passed, smoothed, start)
        whole = _is_whole(predictor, at)
        choose = lambda a, b: jax.tree_util.tree_map(functools.partial(jnp.where, whole), a, b)  # noqa: E731
        return (choose(refined, _that_leave_cavities(used)), found if points is None else choose(found, points)), passed

    (carry, passed), more = sweep(first, None), max(settings.relinearisations - 1, 0)
    if more == 1:
        # Of the last sites nothing needs the derivative, which a loop would take.
        return sweep(*carry)[0], passed
    return jax.lax.scan(lambda carry, _: (sweep(*carry)[0], None), carry, None, length=more)[0], passed


def _is_whole(predictor: Predictor, at: Cavity) -> jax.Array:
    """Whether a sweep has all that it should."""
    return jnp.isfinite(predictor.mean).all() & jnp.isfinite(predictor.covariance).all() & at.valid.all()


def _that_leave_cavities(sites: Sites) -> Sites:
    """Return the sites of positive precision alone, under which every entry has a cavity."""
    return sites._replace(nu=jnp.where(sites.tau > 0, sites.nu, 0.0), tau=jnp.maximum(sites.tau, 0.0))


class _Loop(NamedTuple):
    """Where the search for the fixed point stands.

    Attributes:
        sites: to be tried next.
        base: nu and tau (2, T, D) of the last ones under which every entry had a cavity.
        move: by how much a sweep moved those, undamped.
        share: of a move that is taken.
        steps, changes: (_MEMORY, 2, T, D), the latest steps between such sites, and what they changed of ``move``;
            zero where there is none.
        cavity, log_partition: of the last sweep.
        change: largest change of a site that is left after it; infinite where an entry had no cavity.
        last: largest change of a site in the sweep from ``base``.
        sweeps: how many were made.
        fine: how many of them were not rough.
    """

    sites: Sites
    base: jax.Array
    move: jax.Array
    share: jax.Array
    steps: jax.Array
    changes: jax.Array
    cavity: Any
    log_partition: jax.Array
    change: jax.Array
    last: jax.Array
    sweeps: jax.Array
    fine: jax.Array


def _until_converged(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, settings: SiteSettings, terms: EntryTerms,
                     y: jax.Array, start: Moments, first: Sites, points: Points | None,
                     transitions: Transitions | None) -> Converged:
    """Sweep until the sites do not change, faster by what the last sweeps tell of the next (Anderson's mixing).

    Sites that leave an entry without a cavity are halfway too far from the last good ones. Where changes grow, two
    sites answer each other, and less of each new one is taken.

    Source: Anderson (1965), Journal of the ACM 12; Walker and Ni (2011), SIAM Journal on Numerical Analysis 49.
    """

    def sweep(loop: _Loop) -> _Loop:
        sites, rough = loop.sites, (loop.fine == 0) & (loop.change > _ROUGH) & (loop.sweeps < _ROUGH_SWEEPS)
        predictor = _smoothed(ssm, rule, grid, y, start, sites, points, "all", transitions)[2]
        at = cavities(predictor, sites, terms.present, settings.power)
        new, change, log_partition = new_sites(terms, sites, at, settings, 1.0, rough)
        change = jnp.where(_is_whole(predictor, at), change, jnp.inf)
        good = jnp.isfinite(change)
        here = jnp.stack([sites.nu, sites.tau])
        move = jnp.stack([new.nu, new.tau]) - here
        larger, switched = change > loop.last, ~rough & (loop.fine == 0)
        grown = larger & ~switched & (loop.sweeps >= early)
        share = jnp.where(grown, jnp.maximum(0.5 * loop.share, 0.05), jnp.minimum(1.5 * loop.share, settings.damping))
        share = jnp.where(good, share, 0.5 * loop.share)
        # Sites that go on answering each other are given less and less of a say.
        share = jnp.where(change < _NEAR, share, jnp.minimum(share, _PATIENCE / (1 + loop.sweeps)))
        # Where that is more than was left, rough sweeps tell nothing of fine ones.
        forget = ~good | grown | (larger & switched) | jnp.isinf(loop.last)
        slot = loop.sweeps % _MEMORY
        steps = jnp.where(forget, 0.0, loop.steps.at[slot].set(here - loop.base))
        changes = jnp.where(forget, 0.0, loop.changes.at[slot].set(move - loop.move))
        # The barrier keeps XLA from computing both again in each of their products.
        steps, changes = jax.lax.optimization_barrier((steps, changes))
        mixed = _mixed(move, steps, changes, share, at.marginal.variance)
        base, move = (jnp.where(good, a, b) for a, b in ((here, loop.base), (move, loop.move)))
        # First sites that are far off: those of a sweep from no sites at all instead.
        anew = ~good & jnp.isinf(loop.last) & (loop.sweeps == _HOPELESS)
        share = jnp.where(anew, settings.damping, share)
        nu, tau = base + jnp.where(anew, 0.0, jnp.where(good & (change < _NEAR), mixed, share * move))
        # What is left to go after this step, if it shortens the way as the last one did.
        has_moved = loop.last > 0
        shortened = jnp.clip(change / jnp.where(has_moved, loop.last, 1.0), 0.1, 1.0)
        shortened = jnp.where(forget | ~has_moved, 1.0, shortened)
        return _Loop(sites._replace(nu=nu, tau=tau), base, move, share, steps, changes, at, log_partition,
                     shortened * change,
                     jnp.where(good, change, loop.last), loop.sweeps + 1, loop.fine + ~rough)

    def going(loop: _Loop) -> jax.Array:
        return ((loop.change >= _tolerance(loop.change)) | (loop.fine == 0)) & (loop.sweeps < settings.sweeps) & (
            loop.share > _STUCK)

    safe = _that_leave_cavities(first)
    move = jnp.stack([safe.nu, safe.tau])
    nothing = jnp.zeros((_MEMORY, *move.shape))
    still, infinite, none = jnp.zeros_like(first.nu), jnp.full((), jnp.inf), jnp.zeros((), int)
    no_cavity = Cavity(Marginal(still, still), Marginal(still, still), still > 0, still > 0)
    # Points of linearisation are known from sweeps of the same sites.
    early = _EARLY if points is None else 1
    loop = _Loop(first, jnp.zeros_like(move), move, jnp.asarray(settings.damping), nothing, nothing, no_cavity, still,
                 infinite, infinite, none, none)
    loop = jax.lax.while_loop(going, sweep, loop)
    converged = (loop.change < _tolerance(loop.change)) & (loop.fine > 0)
    return Converged(loop.sites, loop.cavity, loop.log_partition, loop.change, loop.sweeps, converged)


def _mixed(move: jax.Array, steps: jax.Array, changes: jax.Array, share: jax.Array, variance: jax.Array) -> jax.Array:
    """Return the step (2, T, D) to where a linear map that agrees with the last sweeps would not move.

    Least squares in units of the marginals, as changes are measured.
    """
    units = jnp.stack([jnp.sqrt(variance), variance])
    flat = lambda a: a.reshape(*a.shape[:-3], -1)  # noqa: E731
    # The barrier keeps XLA from computing the rows again for each of their products.
    rows = jax.lax.optimization_barrier(jnp.concatenate([flat(changes), flat(move)[None]]) * flat(units))
    gram = jax.lax.dot_general(rows, rows, (((1,), (1,)), ((), ())))
    weights = solve_semidefinite(gram[:-1, :-1], gram[:-1, -1:], tolerance=1e-10)
    along = matmul(weights.T, flat(steps + share * changes)).reshape(move.shape)
    return share * move - along


def _tolerance(change: jax.Array) -> float:
    """Return the largest change of converged sites; in single precision none is as small as 1e-8."""
    return max(_TOLERANCE, 32 * float(jnp.finfo(change.dtype).eps))


def _newton_step(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, terms: EntryTerms,
                 settings: SiteSettings, start: Moments, refined: Refined) -> tuple[Sites, Cavity]:
    """Make one more step to the mode, whose derivative is the mode's.

    Laplace's evidence is not stationary in its sites. A Newton step from the mode leads back to it, and does not depend
    on where it starts, to first order: what it depends on otherwise the mode depends on.
    """
    found = refined.found
    sites = new_sites(terms, found.sites, found.cavity, settings, 1.0)[0]
    predictor = _smoothed(ssm, rule, grid, y, start, sites, refined.points, "all", refined.transitions)[2]
    at = cavities(predictor, sites, terms.present, 1.0)
    return new_sites(terms, sites, at, settings, 1.0)[0], at


class Prequential(NamedTuple):
    """What assumed density filtering leaves.

    Attributes:
        log_likelihood: (T,), log p(y_k | y_1:k-1).
        passed: the forward scan, (N, ...).
        prediction: (T, D), of the predictor, given the rows before.
    """

    log_likelihood: jax.Array
    passed: Pass
    prediction: Marginal


def assumed_density_filter(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array,
                           start: Moments | None = None) -> Prequential:
    """Filter data of a family: each observation's site is made from its prediction, once.

    Source: Maybeck (1982), Stochastic Models, Estimation and Control 2, section 12.7.
    """
    passed = forward(ssm, rule, grid, y, start=start, keep="moments", sites=assumed_density(_family(ssm)))
    at = jax.tree_util.tree_map(lambda a: at_intervals(a, grid.observed), passed)
    prediction = _with_variance(at.site_terms.value, diagonal(at.site_terms.variance))
    return Prequential(at.log_likelihood, passed, prediction)


def quantile_residuals(family: ObservationFamily, prediction: Marginal, y: jax.Array) -> jax.Array:
    """Return randomised quantile residuals (T, D), NaN where an entry is missing or its family knows no probabilities.

        e = Phi^-1(P(data < y) + v P(data = y)),    v ~ U(0, 1),

    with the probabilities of one entry given all rows before: standard normal, and independent from row to row, where
    the model holds. v is the same in every call, so that draws of the parameters do not differ by it.

    Args:
        family: of the rows of the data.
        prediction: of the predictor, (T, D), given the rows before.
        y: (T, D).

    Source: Dunn and Smyth (1996), Journal of Computational and Graphical Statistics 5.
    """

    def row(index: jax.Array, about: Marginal, y: jax.Array, v: jax.Array) -> jax.Array:
        at, present = family.at(index), jnp.isfinite(y)
        filled = jnp.where(present, y, at.possible(about.mean))

        def probability(f: jax.Array) -> jax.Array:
            below, up_to = at.cumulative(f, filled)
            return below + v * (up_to - below)

        return jnp.where(present, ndtri(jnp.clip(expectation(jax.vmap(probability), about), _LEAST, 1.0 - _LEAST)),
                         jnp.nan)

    within = jax.random.uniform(jax.random.key(0), y.shape, y.dtype)
    return jax.vmap(row)(jnp.arange(len(y)), prediction, y, within)


_LEAST = 1e-15
"""Least probability of a residual, which then is -7.9."""


def leave_one_out(predictor: Predictor, sites: Sites, entries: jax.Array) -> jax.Array:
    """Return (T,), log p(y_k | all other rows), from what is smoothed with the converged sites.

    It is the integral of a row's sites under the predictor N(m, F) without them, and what its entries add to that. With
    V = F (I + T F)^-1 and m smoothed, F = V (I - T V)^-1.

    Args:
        predictor: smoothed, (T, ...).
        sites: (T, D) each.
        entries: (T, D), of `log_evidence_terms`.
    """

    def row(mean: jax.Array, covariance: jax.Array, sites: Sites) -> jax.Array:
        # log|I + T F| = -log|I - T V|; and with a = m - c the exponent is that of the smoothed moments.
        kept, log_det = inverse_and_log_det(jnp.eye(mean.shape[0]) - sites.tau[:, None] * covariance)
        away = matmul(kept.T, (mean - sites.centre - matmul(covariance, sites.nu[:, None])[:, 0])[:, None])[:, 0]
        pull = sites.nu - sites.tau * away
        return (((sites.nu - 0.5 * sites.tau * away) * away).sum() + 0.5 * log_det
                + 0.5 * (pull * matmul(covariance, pull[:, None])[:, 0]).sum())

    return jax.vmap(row)(predictor.mean, predictor.covariance, sites) + entries.sum(1)


def _final_sites(terms: FamilyTerms, converged: Converged, by_moments: bool) -> Sites:
    """Return the sites without those of deterministic predictors, and with exact ones of nearly deterministic ones.

    Over a small variance v a factor hardly differs from a constant, and moments of the tilted distribution have its
    slope to eps / sd only. The derivatives of log p at the mean are the slope and the curvature to a share of v.

    Args:
        terms: the factors of the data.
        converged: where the sweeps ended.
        by_moments: whether sites are made from moments, as those of expectation propagation are.
    """
    sites, at = converged.sites, converged.cavity
    nu, tau = sites.nu, sites.tau
    if by_moments:
        mean, variance = at.marginal
        exact_nu, exact_tau, _ = _laplace(terms, sites, at, 1.0)
        slope = exact_nu - exact_tau * (mean - sites.centre)
        is_flat = (slope**2 * variance < _NEARLY_CONSTANT) & (jnp.abs(exact_tau) * variance < _NEARLY_CONSTANT)
        is_flat &= terms.present & at.valid & converged.converged
        nu, tau = jnp.where(is_flat, exact_nu, nu), jnp.where(is_flat, exact_tau, tau)
    return sites._replace(nu=jnp.where(at.known, 0.0, nu), tau=jnp.where(at.known, 0.0, tau))


class Evidence(NamedTuple):
    """What the evidence is made of.

    Attributes:
        log_evidence: log p(y). Where the sites do not converge, that of assumed density filtering in a model that is
            not linear, else -inf.
        entries: (T, D), what each entry adds to the integral of the sites.
        passed: the forward scan with the sites.
        refined: the sites.
    """

    log_evidence: jax.Array
    entries: jax.Array
    passed: Pass
    refined: Refined


def evidence(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, terms: EntryTerms,
             settings: SiteSettings, start: Moments | None = None, first: Sites | None = None,
             keep: str = "likelihood") -> Evidence:
    """Return the log evidence of a model under a family, with a derivative; arguments as in `refine` and `forward`."""
    start = Moments(*ssm.initial()) if start is None else start
    refined = refine(ssm, rule, grid, y, terms, settings, start, first)
    found = refined.found
    at = found.cavity
    if isinstance(terms, FamilyTerms):
        by_moments = settings.method == "ep"
        found = found._replace(sites=_held(lambda found: _final_sites(terms, found, by_moments), found))
        refined = refined._replace(found=found)
    sites = found.sites
    if settings.method == "laplace":
        newer, at = _newton_step(ssm, rule, grid, y, terms, settings, start, refined)
        sites = jax.tree_util.tree_map(functools.partial(jnp.where, found.converged), newer, sites)
    passed = forward(ssm, rule, grid, y, start=start, linearization_point=refined.points, keep=keep, sites=sites,
                     transitions=None if keep in ("steps", "inside") else refined.transitions)
    entries = log_evidence_terms(terms, sites, at, settings, found.log_partition)
    if isinstance(terms, FamilyTerms):
        predicted = at_intervals(passed.predictor, grid.observed)
        # Where the predictor is not deterministic, its mean is of no use and must not put NaN into a derivative.
        mean = jnp.where(at.known, predicted, jax.lax.stop_gradient(at.marginal.mean))
        entries = jnp.where(at.known, terms.log_prob(mean), entries)
    total = passed.log_likelihood.sum() + entries.sum()
    return Evidence(jnp.where(found.converged, total, refined.assumed), entries, passed, refined)
