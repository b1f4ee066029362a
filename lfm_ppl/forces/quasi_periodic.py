"""Periodic and quasi-periodic forces: eigenfunctions of a periodic kernel, with weights that stay or evolve."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl import checks
from lfm_ppl.forces.basis import Basis, Eigenfunctions, Waves, cycle_points, spectrum, waves
from lfm_ppl.forces.constant import Constant
from lfm_ppl.forces.parameters import mean_parameter
from lfm_ppl.forces.periodic_kernels import Kernel
from lfm_ppl.forces.sde import ApproximationWarning, Force
from lfm_ppl.linalg import safe_sqrt

_POINTS = 100
_MOST = 1024

EXPLAINED_VARIANCE = 0.99
"""Share of a kernel's variance that the functions of a force are to keep."""


class QuasiPeriodic(Force):
    r"""A force that nearly repeats: the product of a periodic kernel and that of how its weights evolve.

        u(t) = mean(t) + sum_j a_j(t) phi_j(t),    a_j ~ GP(0, mu_j k_evolution) independent,
        k(t, s) = k_periodic(t, s) k_evolution(t, s),

    with the leading eigenfunctions phi_j of the periodic kernel, their eigenvalues mu_j, and any process for the
    weights: `CQM`, `SQM`, `WQM`, or another force of scale 1, such as a Matern force of any order. For a stationary
    kernel the covariance misses at no lag more than the eigenvalues left out, for others it does so on average over a
    cycle. Where those above 1/100 of the largest are kept, as by default, that is less than 0.01 of the variance for
    the periodic squared exponential and for order 2 of the periodic Matern, whatever the lengthscale; up to 0.015 for
    order 1 and 0.064 for order 0. Rough kernels need more functions, that is a smaller gamma. Functions that keep less
    than ``explained_variance`` of the variance are reported, with the number that would keep it.

    A share of the variance says little of the log likelihood: weights that change slowly are seen through the noise of
    many cycles, so that 0.005% of the variance can be worth nats. Where data can tell the functions from the whole
    kernel, `lfm.filter`, `lfm.smooth` and `lfm.MarginalLikelihood` warn, and say how many functions suffice; see
    `lfm_ppl.model.truncation`.

    A stationary kernel has the Fourier series ``sum_j q_j cos(2 pi j t / D)``, whose coefficients are integrals of
    the kernel, so that no eigen-decomposition is needed; each pair turns in its state and the force has constant
    matrices. The eigenfunctions of another kernel are found by Nystrom's method, see `lfm_ppl.forces.basis`. Both can
    be differentiated by all parameters, the period included.

    Args:
        kernel: a periodic kernel, such as `PeriodicMatern`.
        evolution: a force of mean zero and, as a rule, of scale 1.
        functions: J, how many eigenfunctions; a Python int, since it sets the number of states. None: those that
            `significant_functions` counts, for which the kernel's parameters must be known before compilation. A
            stationary kernel has one constant function and pairs, so that J is odd.
        gamma: share of the largest eigenvalue above which one is significant.
        mean: a number, or a function of time.
        points: of Nystrom's method in a cycle, for kernels that are not stationary.
        explained_variance: share of the kernel's variance that the functions are to keep. 0: the functions themselves
            are the model, and are compared with nothing.

    Warns:
        ApproximationWarning: outside of compiled code, where they keep less.

    Raises:
        ValueError: a kernel that is not positive definite, a number of functions that does not fit, or one that is not
            given although the kernel's parameters are traced.
        TypeError: a kernel or an evolution that is none.

    Example:
        >>> from lfm_ppl.forces import CQM, PeriodicMatern
        >>> kernel = PeriodicMatern(scale=2.0, lengthscale=1.0, period=24.0, order=2)
        >>> force = QuasiPeriodic(kernel, CQM(lengthscale=48.0))
        >>> force.state_dim, round(float(force.covariance(48.0, 0.0)), 4)
        (5, 1.4715)

    Source: Reece, Ghosh, Rogers, Roberts and Jennings (2014), Efficient state-space inference of periodic latent force
    models, Journal of Machine Learning Research 15, sections 5 and 6.
    """

    kernel: Kernel
    evolution: Force
    basis: Basis
    mean: Any
    explained_variance: float = eqx.field(static=True)

    def __init__(self, kernel: Kernel, evolution: Force, functions: int | None = None, gamma: float = 0.01,
                 mean: Any = 0.0, points: int = _POINTS, explained_variance: float = EXPLAINED_VARIANCE):
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
    def noise_dim(self) -> int:
        """J times the Brownian motions of the evolution."""
        return self.basis.count * self.evolution.noise_dim

    @property
    def stationary(self) -> bool:
        """Whether both kernels are stationary."""
        return self.basis.stationary and self.evolution.stationary

    def initial_covariance(self) -> jax.Array:
        """Return P0 (n, n)."""
        return self._weighted(self.evolution.initial_covariance())

    def feedback(self) -> jax.Array:
        """Return F (n, n), the sum of turning and evolution."""
        turning = jnp.kron(self.basis.feedback(), np.eye(self.evolution.state_dim))
        return turning + jnp.kron(np.eye(self.basis.count), self.evolution.feedback())

    def dispersion(self) -> jax.Array:
        """Return L (n, S)."""
        return jnp.kron(jnp.diag(safe_sqrt(self.basis.variances())), self.evolution.dispersion())

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (n, n) and process noise (n, n) over a step of length dt >= 0."""
        transition, noise = self.evolution.discretise(dt)
        # Turning leaves the covariance of a pair, a multiple of the identity, as it is.
        return jnp.kron(self.basis.transition(dt), transition), self._weighted(noise)

    def measurement(self, t: ArrayLike) -> jax.Array:
        """Return H(t) (n,)."""
        return jnp.kron(self.basis.row(t), self.evolution.measurement(t))

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the product of the two kernels, of which the force keeps the leading eigenfunctions.

        Where the kernel or the evolution is not stationary, the times are the model's.
        """
        return self.kernel(t, s) * self.evolution.covariance(t, s)

    def sde_covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the covariance that the force has with its J eigenfunctions, jumps included; times as above."""
        return self.basis.covariance(t, s) * self.evolution.sde_covariance(t, s)

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Raise NotImplementedError."""
        raise NotImplementedError(f"a {type(self).__name__} force has no spectral density in closed form; use "
                                  "`covariance`.")

    def sde_spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return the spectral density of the state-space form; as in `Force`.

        Raises:
            NotImplementedError: for weights that stay, whose spectrum is lines; or a force that is not stationary.
        """
        if self.noise_dim == 0:
            raise NotImplementedError(f"a {type(self).__name__} force without noise has lines for a spectrum, and no "
                                      "spectral density; `eigenvalues` says how strong they are.")
        return super().sde_spectral_density(omega)

    def covariance_in_model(self, t: ArrayLike, s: ArrayLike, initial_time: ArrayLike) -> jax.Array:
        """Return the product of the two kernels in a model that starts at ``initial_time``."""
        return self.kernel(t, s) * self.evolution.covariance_in_model(t, s, initial_time)

    def check_span(self, name: str, first: float, last: float) -> None:
        """Check that a cycle is not longer than the data, where the period was given as a number."""
        period = checks.concrete(self.period)
        if self.kernel.given and period is not None and period > (last - first) * (1 + 1e-9):
            raise ValueError(f"the force {name!r} has a period of {float(period):g}, longer than the data, which span "
                             f"{last - first:g} from {first:g} to {last:g}: nothing repeats in them. Check the unit of "
                             "the period, or take lfm.Matern.")

    @property
    def jump_times(self) -> tuple[float, ...]:
        """The change points of the evolution."""
        return self.evolution.jump_times

    def jump(self, index: int) -> tuple[jax.Array, jax.Array]:
        """Return G (n, n) and Q (n, n), those of the evolution for every weight."""
        transition, noise = self.evolution.jump(index)
        return jnp.kron(np.eye(self.basis.count), transition), self._weighted(noise)

    def _weighted(self, covariance: jax.Array) -> jax.Array:
        return jnp.kron(jnp.diag(self.basis.variances()), covariance)


class Periodic(QuasiPeriodic):
    """A force that repeats exactly: ``u(t) = mean(t) + sum_j w_j phi_j(t)`` with constant weights w_j ~ N(0, mu_j).

    The phi_j are the leading eigenfunctions of a periodic kernel, the mu_j their eigenvalues; `QuasiPeriodic` says how
    they are found and how many are needed. At the default gamma the covariance of a periodic Matern force of order 0 is
    up to 0.064 of the variance off, that of order 2 and that of a periodic squared exponential less than 0.01.

    Args:
        kernel: a periodic kernel, such as `PeriodicMatern`.
        functions: J, how many eigenfunctions; see `QuasiPeriodic`.
        gamma: share of the largest eigenvalue above which one is significant.
        mean: a number, or a function of time.
        points: of Nystrom's method in a cycle, for kernels that are not stationary.
        explained_variance: as in `QuasiPeriodic`.

    Warns:
        ApproximationWarning: as `QuasiPeriodic`.

    Raises:
        ValueError, TypeError: as `QuasiPeriodic`.

    Example:
        >>> from lfm_ppl.forces import PeriodicSquaredExponential
        >>> force = Periodic(PeriodicSquaredExponential(scale=1.0, lengthscale=1.0, period=24.0), functions=5)
        >>> force.state_dim, round(float(force.sde_covariance(24.0)), 3)
        (5, 0.997)

    Source: Reece et al. (2014), section 5.
    """

    def __init__(self, kernel: Kernel, functions: int | None = None, gamma: float = 0.01, mean: Any = 0.0,
                 points: int = _POINTS, explained_variance: float = EXPLAINED_VARIANCE):
        super().__init__(kernel, Constant(1.0), functions, gamma, mean, points, explained_variance)


def significant_functions(kernel: Kernel, gamma: float = 0.01, points: int = _POINTS) -> int:
    """Return how many eigenfunctions have an eigenvalue above ``gamma`` times the largest.

    For a stationary kernel they are a constant and pairs of cosine and sine, up to the last significant pair. The two
    of a pair are one oscillation of any phase, whose eigenvalue counts twice: that is its share of the variance, and
    what the covariance misses without it.

    Args:
        kernel: a periodic kernel whose parameters are known.
        gamma: the share; > 0 and < 1.
        points: of Nystrom's method in a cycle, for kernels that are not stationary.

    Raises:
        ValueError: a kernel with traced parameters or one that is not positive definite, or a gamma out of range.

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
        raise ValueError("the number of functions sets the number of states, and cannot follow from traced parameters. "
                         "Give functions=J; lfm.forces.significant_functions(kernel) says how many for typical values. "
                         "(Inside compiled code, such as a NumPyro model, numbers become traced, too.)")
    if not kernel.stationary:
        values = spectrum(kernel, points)
        return int((values > gamma * values[0]).sum())
    harmonics = 32
    while harmonics <= _MOST:
        values = spectrum(kernel, harmonics)
        values[1:] *= 2.0
        last = int(np.flatnonzero(values > gamma * values.max()).max())
        if last < harmonics // 2:
            return 1 + 2 * last
        harmonics *= 2
    raise ValueError(f"the kernel {kernel.name!r} has more than {_MOST} significant functions in a cycle; take a "
                     "larger gamma or a longer lengthscale, or give functions.")


def stationary_basis(kernel: Kernel, functions: int | None, gamma: float) -> Waves:
    """Return the level and the pairs of a stationary kernel, as many as were asked for or are significant.

    Raises:
        TypeError, ValueError: as `QuasiPeriodic`; a kernel that is not stationary.
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


def warn_of_lost_variance(kernel: Kernel, basis: Basis, wanted: float, points: int = _POINTS) -> None:
    """Warn where functions keep less than the share ``wanted`` of the variance; nothing happens in compiled code.

    Raises:
        ValueError: a share outside of [0, 1).
    """
    if not 0 <= wanted < 1:
        raise ValueError(f"explained_variance must lie in [0, 1), a share of the kernel's variance, got {wanted!r}.")
    if not wanted or checks.traced((kernel, basis, jnp.zeros(()) + 0.0)):
        return
    at = kernel.start if kernel.stationary else cycle_points(kernel, points)
    total = float(jnp.mean(kernel(at, at)))
    share = float(basis.eigenvalues().sum()) / total
    if share >= wanted - 1e-9:
        return
    needed = _needed(kernel, wanted * total, points)
    remedy = (f"functions={needed} would keep {wanted:.0%}" if needed is not None else
              f"no number of functions up to {1 + 2 * _MOST if kernel.stationary else points} keeps {wanted:.0%}: take "
              f"a smoother kernel{'' if kernel.stationary else ', more points'} or a longer lengthscale")
    checks.warn(f"a periodic force keeps {np.floor(share * 1000) / 10:.1f}% of the variance of its kernel {kernel.name}"
                f"{_parameters(kernel)} with {basis.count} functions; {remedy}. Where less will do, say so with "
                f"explained_variance={np.floor(share * 100) / 100:.2f}.", ApproximationWarning)


def _needed(kernel: Kernel, variance: float, points: int) -> int | None:
    """Return the least number of functions that keep so much variance, None where there are too many."""
    harmonics = 32
    while True:
        values = spectrum(kernel, harmonics if kernel.stationary else points)
        if kernel.stationary:
            values[1:] *= 2.0
        enough = np.flatnonzero(np.cumsum(values) >= variance)
        if enough.size:
            return 1 + int(enough[0]) * (2 if kernel.stationary else 1)
        if not kernel.stationary or harmonics >= _MOST:
            return None
        harmonics *= 2


def _parameters(kernel: Kernel) -> str:
    lengthscale = getattr(kernel, "lengthscale", None)
    return "" if lengthscale is None else f" of lengthscale {float(lengthscale):.3g}"


def _basis(kernel: Kernel, functions: int | None, gamma: float, points: int) -> Basis:
    if kernel.stationary:
        return stationary_basis(kernel, functions, gamma)
    if functions is None:
        functions = significant_functions(kernel, gamma, points)
    checks.positive_integer("functions", functions, "It is the number of eigenfunctions.")
    if functions > points:
        raise ValueError(f"functions must be at most points = {points}, got {functions}; take more points.")
    if not checks.traced(kernel):
        spectrum(kernel, points)
    return Eigenfunctions(kernel, functions, points)


def _check_kernel(kernel: Kernel) -> None:
    if not isinstance(kernel, Kernel):
        raise TypeError(f"kernel must be a periodic kernel such as lfm.forces.PeriodicMatern, got {kernel!r}. Wrap a "
                        "function k(t, s) in lfm.forces.PeriodicKernel.")
