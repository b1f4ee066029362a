"""Periodic and quasi-periodic forces: eigenfunctions of a periodic kernel, with constant or evolving weights.

1. The periodic kernel is expanded in its eigenfunctions: ``k(t, s) = sum_j mu_j phi_j(t) phi_j(s)``. For a stationary
   kernel they are sines and cosines with the Fourier coefficients as variances; for any other kernel Nystrom's method
   computes them (`lfm_ppl.forces.basis`).
2. The leading J are kept: `significant_functions` counts those above a share gamma of the largest eigenvalue.
3. The weight of each function is an independent copy of the evolution, a force of unit variance (`CQM`, `SQM`, `WQM`,
   a constant for `Periodic`). The state is the Kronecker product of the basis and the state of the evolution.
4. F is the Kronecker sum of the feedbacks, the transition the Kronecker product of the transitions. Jumps and process
   noise of the evolution apply to each weight, scaled by mu_j.
5. `warn_of_lost_variance` reports a force whose J functions explain too little of the kernel's variance.

Source: Reece, Ghosh, Rogers, Roberts and Jennings (2014), Efficient state-space inference of periodic latent force
models, Journal of Machine Learning Research 15, sections 5 and 6.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.basis import Basis, Eigenfunctions, Waves, cycle_points, spectrum, waves
from lfm_ppl.forces.constant import Constant
from lfm_ppl.forces.parameters import Mean, mean_parameter
from lfm_ppl.forces.periodic_kernels import PeriodicCovariance
from lfm_ppl.forces.sde import ApproximationWarning, Force
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import safe_sqrt

_POINTS = 100
"""Default number of points of Nystrom's method in a cycle."""

_MOST_HARMONICS = 1024
"""Largest number of harmonics that the searches for a number of functions consider."""

EXPLAINED_VARIANCE = 0.99
"""Share of a kernel's variance below which `warn_of_lost_variance` warns."""


class QuasiPeriodic(Force):
    r"""A nearly periodic force: its kernel is the product of a periodic kernel and the kernel of an evolution.

        u(t) = mean(t) + sum_j a_j(t) phi_j(t),    a_j ~ GP(0, mu_j k_evolution) independent,
        k(t, s) = k_periodic(t, s) k_evolution(t, s),

    with the leading eigenfunctions phi_j of the periodic kernel, their eigenvalues mu_j, and any process for the
    weights: `CQM`, `SQM`, `WQM`, or another force of scale 1, such as a Matern force of any order.

    The error of the covariance is at most the sum of the omitted eigenvalues, at every lag for a stationary kernel and
    on average over a cycle for other kernels. At the default gamma this is less than 0.01 of the variance for the
    periodic squared exponential and the periodic Matern of order 2 at any lengthscale, up to 0.015 for order 1 and
    0.064 for order 0. Rough kernels need more functions, that is a smaller gamma. A warning reports functions that
    explain less than ``explained_variance`` of the variance, and the number that would explain it.

    A small lost share of the variance can still change the log likelihood: data of many cycles determine slowly
    changing weights precisely, so that 0.005% of the variance can change it by several nats. Where data can
    distinguish the truncated from the full kernel, `lfm.filter`, `lfm.smooth` and `lfm.MarginalLikelihood` warn and
    name a sufficient number of functions; see `lfm_ppl.model.truncation`.

    A stationary kernel has the Fourier series ``sum_j q_j cos(2 pi j t / D)``, whose coefficients are integrals of
    the kernel, so that no eigendecomposition is needed; each pair of sine and cosine rotates in its state, and the
    force has constant matrices. The eigenfunctions of other kernels are computed by Nystrom's method, see
    `lfm_ppl.forces.basis`. Both are differentiable with respect to all parameters, including the period.

    Args:
        kernel: a periodic kernel, such as `PeriodicMatern`.
        evolution: a force of mean zero and, as a rule, of scale 1.
        functions: J, the number of eigenfunctions; a Python int, since it sets the number of states. None: the count of
            `significant_functions`, which needs kernel parameters that are known before compilation. A stationary
            kernel has one constant function and pairs, so that J is odd.
        gamma: share of the largest eigenvalue above which an eigenvalue is significant.
        mean: a number, or a function of time.
        points: points of Nystrom's method in a cycle, for kernels that are not stationary.
        explained_variance: share of the kernel's variance below which there is a warning. 0: the functions themselves
            are the model, and no check compares them with the kernel.

    Warns:
        ApproximationWarning: outside of compiled code, where the functions explain less.

    Raises:
        ValueError: the kernel is not positive definite, the number of functions is not possible, or it is missing
            although the kernel's parameters are traced.
        TypeError: the kernel is not a periodic kernel, or the evolution is not a force.

    Example:
        >>> from lfm_ppl.forces import CQM, PeriodicMatern
        >>> kernel = PeriodicMatern(scale=2.0, lengthscale=1.0, period=24.0, order=2)
        >>> force = QuasiPeriodic(kernel, CQM(lengthscale=48.0))
        >>> force.state_dim, round(float(force.covariance(48.0, 0.0)), 4)
        (5, 1.4715)

    Source: Reece, Ghosh, Rogers, Roberts and Jennings (2014), Efficient state-space inference of periodic latent force
    models, Journal of Machine Learning Research 15, sections 5 and 6.
    """

    kernel: PeriodicCovariance
    evolution: Force
    basis: Basis
    mean: Any
    explained_variance: float = eqx.field(static=True)

    def __init__(self, kernel: PeriodicCovariance, evolution: Force, functions: int | None = None, gamma: float = 0.01,
                 mean: Mean = 0.0, points: int = _POINTS, explained_variance: float = EXPLAINED_VARIANCE):
        _check_kernel(kernel)
        if not isinstance(evolution, Force):
            raise TypeError("evolution must be CQM, SQM or WQM of lfm.forces, or a force of scale 1, got "
                            f"{type(evolution).__name__}.")
        level = checks.concrete(evolution.mean_at(0.0))
        if level is not None and level != 0.0:
            raise ValueError(f"evolution must have mean zero, got {float(level):g}; the force itself takes a mean.")
        checks.positive_integer("points", points)
        self.kernel, self.evolution, self.mean = kernel, evolution, mean_parameter(mean)
        self.basis = _basis(kernel, functions, gamma, points)
        warn_of_lost_variance(kernel, self.basis, explained_variance, points)
        self.explained_variance = float(explained_variance)

    @property
    def period(self) -> jax.Array:
        """The period D of the kernel, in units of time."""
        return self.kernel.period

    @property
    def functions(self) -> int:
        """Number J of eigenfunctions."""
        return self.basis.count

    def eigenfunctions(self, t: ArrayLike) -> jax.Array:
        """Return phi_j at times t, in a new last axis (..., J), of mean square one over a cycle."""
        return self.basis.eigenfunctions(t)

    def eigenvalues(self) -> jax.Array:
        """Return mu_j (J,), the prior variances of the weights."""
        return self.basis.eigenvalues()

    @property
    def state_dim(self) -> int:
        """J times the states of the evolution."""
        return self.basis.count * self.evolution.state_dim

    @property
    def stationary(self) -> bool:
        """Whether both kernels are stationary."""
        return self.basis.stationary and self.evolution.stationary

    def initial_covariance(self) -> jax.Array:
        """Return P0 (n, n)."""
        return self._scaled_by_variances(self.evolution.initial_covariance())

    def feedback(self) -> jax.Array:
        """Return F (n, n), the Kronecker sum of the feedbacks of basis and evolution."""
        rotation = jnp.kron(self.basis.feedback(), np.eye(self.evolution.state_dim))
        return rotation + jnp.kron(np.eye(self.basis.count), self.evolution.feedback())

    def dispersion(self) -> jax.Array:
        """Return L (n, S)."""
        return jnp.kron(jnp.diag(safe_sqrt(self.basis.variances())), self.evolution.dispersion())

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (n, n) and process noise (n, n) over a step of length dt >= 0."""
        transition, noise = self.evolution.discretise(dt)
        # The covariance of a pair is a multiple of the identity, which its rotation does not change.
        return jnp.kron(self.basis.transition(dt), transition), self._scaled_by_variances(noise)

    def measurement(self, t: ArrayLike) -> jax.Array:
        """Return H(t) (n,)."""
        return jnp.kron(self.basis.row(t), self.evolution.measurement(t))

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the product of both kernels, without truncation to J functions.

        Where the kernel or the evolution is not stationary, t and s are times of the model.
        """
        return self.kernel(t, s) * self.evolution.covariance(t, s)

    def sde_covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the covariance of the force with its J eigenfunctions, including jumps; times as in `covariance`."""
        return self.basis.covariance(t, s) * self.evolution.sde_covariance(t, s)

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Raise NotImplementedError."""
        raise NotImplementedError(f"a {type(self).__name__} force has no spectral density in closed form; use "
                                  "`covariance`.")

    def sde_spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return the spectral density of the state-space form.

        Raises:
            NotImplementedError: the weights are constant, so that the spectrum consists of lines; or the force is not
                stationary.
        """
        if self.noise_dim == 0:
            raise NotImplementedError(f"the spectrum of a {type(self).__name__} force without noise consists of lines: "
                                      "it has no spectral density; `eigenvalues` gives their strengths.")
        return super().sde_spectral_density(omega)

    def covariance_in_model(self, t: ArrayLike, s: ArrayLike, initial_time: ArrayLike) -> jax.Array:
        """Return the product of the two kernels in a model that starts at ``initial_time``."""
        return self.kernel(t, s) * self.evolution.covariance_in_model(t, s, initial_time)

    def check_span(self, name: str, first: float, last: float) -> None:
        """Check that a fixed period is not longer than the data."""
        period = checks.concrete(self.period)
        if self.kernel.has_fixed_period and period is not None and period > (last - first) * (1 + 1e-9):
            raise ValueError(f"the force {name!r} has a period of {float(period):g}, longer than the data, which span "
                             f"{last - first:g} from {first:g} to {last:g}: nothing repeats in them. Check the unit of "
                             "the period, or take lfm.Matern.")

    @property
    def jump_times(self) -> tuple[float, ...]:
        """The change points of the evolution."""
        return self.evolution.jump_times

    def jump(self, index: int) -> tuple[jax.Array, jax.Array]:
        """Return G (n, n) and Q (n, n): the jump of the evolution, applied to every weight."""
        transition, noise = self.evolution.jump(index)
        return jnp.kron(np.eye(self.basis.count), transition), self._scaled_by_variances(noise)

    def _scaled_by_variances(self, covariance: jax.Array) -> jax.Array:
        """Return the covariance (n, n) of all weights, given that of the evolution."""
        return jnp.kron(jnp.diag(self.basis.variances()), covariance)


class Periodic(QuasiPeriodic):
    """A force that repeats exactly: ``u(t) = mean(t) + sum_j w_j phi_j(t)`` with constant weights w_j ~ N(0, mu_j).

    The phi_j are the leading eigenfunctions of a periodic kernel and the mu_j their eigenvalues; `QuasiPeriodic`
    describes their computation and number. At the default gamma the error of the covariance is up to 0.064 of the
    variance for a periodic Matern force of order 0, and less than 0.01 for order 2 and for a periodic squared
    exponential.

    For a stationary kernel phi_1 is a constant. The force therefore contains an unknown level, its mean over a cycle,
    with prior variance mu_1, beside the season about it. The data cannot tell this level from another constant of the
    model, such as an offset of the observation; figures of the force show the sum of level and season.

    Args:
        kernel: a periodic kernel, such as `PeriodicMatern`.
        functions: J, the number of eigenfunctions; see `QuasiPeriodic`.
        gamma: share of the largest eigenvalue above which an eigenvalue is significant.
        mean: a number, or a function of time.
        points: points of Nystrom's method in a cycle, for kernels that are not stationary.
        explained_variance: as in `QuasiPeriodic`.

    Warns:
        ApproximationWarning: as in `QuasiPeriodic`.

    Raises:
        ValueError, TypeError: as in `QuasiPeriodic`.

    Example:
        >>> from lfm_ppl.forces import PeriodicSquaredExponential
        >>> force = Periodic(PeriodicSquaredExponential(scale=1.0, lengthscale=1.0, period=24.0), functions=5)
        >>> force.state_dim, round(float(force.sde_covariance(24.0)), 3)
        (5, 0.997)

    Source: Reece et al. (2014), section 5.
    """

    def __init__(self, kernel: PeriodicCovariance, functions: int | None = None, gamma: float = 0.01, mean: Mean = 0.0,
                 points: int = _POINTS, explained_variance: float = EXPLAINED_VARIANCE):
        super().__init__(kernel, Constant(1.0), functions, gamma, mean, points, explained_variance)


def significant_functions(kernel: PeriodicCovariance, gamma: float = 0.01, points: int = _POINTS) -> int:
    """Return the number of eigenfunctions with an eigenvalue above ``gamma`` times the largest.

    For a stationary kernel these are a constant and pairs of cosine and sine, up to the last significant pair. The
    eigenvalue of a pair counts twice, since both functions together are one oscillation of any phase: twice the
    eigenvalue is the share of the variance that is lost without the pair.

    Args:
        kernel: a periodic kernel with concrete parameters.
        gamma: share of the largest eigenvalue; > 0 and < 1.
        points: points of Nystrom's method in a cycle, for kernels that are not stationary.

    Raises:
        ValueError: the kernel has traced parameters or is not positive definite, or gamma is out of range.

    Example:
        >>> from lfm_ppl.forces import PeriodicMatern
        >>> significant_functions(PeriodicMatern(scale=1.0, lengthscale=1.0, period=24.0, order=2))
        5

    Source: Reece et al. (2014), definition 1.
    """
    checks.positive("gamma", gamma)
    if not gamma < 1:
        raise ValueError(f"gamma must be below 1, got {gamma:g}. It is a share of the largest eigenvalue.")
    if checks.traced(kernel):
        raise ValueError("the number of functions sets the number of states, so it cannot depend on traced parameters. "
                         "Pass functions=J; lfm.Periodic(kernel).functions is J for typical values. "
                         "(Inside compiled code, such as a NumPyro model, all numbers are traced.)")
    if not kernel.stationary:
        values = spectrum(kernel, points)
        return int((values > gamma * values[0]).sum())
    harmonics = 32
    while harmonics <= _MOST_HARMONICS:
        values = spectrum(kernel, harmonics)
        values[1:] *= 2.0
        last = int(np.flatnonzero(values > gamma * values.max()).max())
        if last < harmonics // 2:
            return 1 + 2 * last
        harmonics *= 2
    raise ValueError(f"the kernel {kernel.name!r} has more than {_MOST_HARMONICS} significant functions in a cycle; "
                     "use a larger gamma or a longer lengthscale, or pass functions.")


def stationary_basis(kernel: PeriodicCovariance, functions: int | None, gamma: float) -> Waves:
    """Return the level and pairs of a stationary kernel, J functions in all; None: the significant ones.

    Raises:
        TypeError, ValueError: as in `QuasiPeriodic`; or the kernel is not stationary.
    """
    _check_kernel(kernel)
    if not kernel.stationary:
        raise ValueError(f"the kernel {kernel.name!r} is not stationary, so its eigenfunctions are not oscillations of "
                         "one frequency each; use lfm.Periodic or lfm.QuasiPeriodic.")
    if functions is None:
        functions = significant_functions(kernel, gamma)
    checks.positive_integer("functions", functions, "It is the number of eigenfunctions.")
    if functions % 2 == 0:
        raise ValueError("functions must be odd for a stationary kernel, one constant and pairs of cosine and "
                         f"sine; got {functions}. Take {functions - 1} or {functions + 1}.")
    return waves(kernel, functions // 2)


def warn_of_lost_variance(kernel: PeriodicCovariance, basis: Basis, least_share: float,
                          points: int = _POINTS) -> None:
    """Warn where the functions explain less than ``least_share`` of the variance; do nothing in compiled code.

    Raises:
        ValueError: the share is outside of [0, 1).
    """
    if not 0 <= least_share < 1:
        raise ValueError("explained_variance must lie in [0, 1), a share of the kernel's variance, got "
                         f"{least_share!r}.")
    if not least_share or checks.traced((kernel, basis, jnp.zeros(()) + 0.0)):
        return
    times = kernel.start if kernel.stationary else cycle_points(kernel, points)
    total = float(jnp.mean(kernel(times, times)))
    share = float(basis.eigenvalues().sum()) / total
    if share >= least_share - 1e-9:
        return
    sufficient = _sufficient_functions(kernel, least_share * total, points)
    most = 1 + 2 * _MOST_HARMONICS if kernel.stationary else points
    remedy = (f"functions={sufficient} would keep {least_share:.0%}" if sufficient is not None else
              f"no number of functions up to {most} keeps {least_share:.0%}: use a smoother kernel"
              f"{'' if kernel.stationary else ', more points'} or a longer lengthscale")
    checks.warn(f"a periodic force keeps {np.floor(share * 1000) / 10:.1f}% of the variance of its kernel {kernel.name}"
                f"{_parameters(kernel)} with {basis.count} functions; {remedy}. To accept a smaller share, pass "
                f"explained_variance={np.floor(share * 100) / 100:.2f}.", ApproximationWarning)


def _sufficient_functions(kernel: PeriodicCovariance, variance: float, points: int) -> int | None:
    """Return the least number of functions that explain ``variance``, None where the search finds no number."""
    harmonics = 32
    while True:
        values = spectrum(kernel, harmonics if kernel.stationary else points)
        if kernel.stationary:
            values[1:] *= 2.0
        sufficient = np.flatnonzero(np.cumsum(values) >= variance)
        if sufficient.size:
            return 1 + int(sufficient[0]) * (2 if kernel.stationary else 1)
        if not kernel.stationary or harmonics >= _MOST_HARMONICS:
            return None
        harmonics *= 2


def _parameters(kernel: PeriodicCovariance) -> str:
    lengthscale = getattr(kernel, "lengthscale", None)
    return "" if lengthscale is None else f" of lengthscale {float(lengthscale):.3g}"


def _basis(kernel: PeriodicCovariance, functions: int | None, gamma: float, points: int) -> Basis:
    if kernel.stationary:
        return stationary_basis(kernel, functions, gamma)
    if functions is None:
        functions = significant_functions(kernel, gamma, points)
    checks.positive_integer("functions", functions, "It is the number of eigenfunctions.")
    if functions > points:
        raise ValueError(f"functions must be at most points = {points}, got {functions}; use more points.")
    if not checks.traced(kernel):
        spectrum(kernel, points)  # raises where the kernel is not positive definite
    return Eigenfunctions(kernel, functions, points)


def _check_kernel(kernel: PeriodicCovariance) -> None:
    if not isinstance(kernel, PeriodicCovariance):
        raise TypeError(f"kernel must be a periodic kernel such as lfm.forces.PeriodicMatern, got {kernel!r}. Wrap a "
                        "function k(t, s) in lfm.forces.PeriodicKernel.")
