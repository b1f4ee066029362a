"""The heat and the wave equation with an unknown source, as latent force models of their eigenfunctions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from lfm_ppl.forces.parameters import non_negative_parameter
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.space.eigenfunctions import LaplaceBasis
from lfm_ppl.space.fields import SpectralField


def heat(source: SpectralField | LaplaceBasis, diffusivity: ArrayLike, decay: ArrayLike, *, sensors: Any,
         sd: Any = None, covariance: Any = None, initial: Gaussian | None = None, **options: Any) -> LatentForceModel:
    r"""Return the heat equation with an unknown source, ``x_t = diffusivity laplacian x - decay x + s(r, t)``.

    The states are the coefficients of x in the basis, "mode 0", "mode 1", ...; the source has the forces u_j:

        c_j' = -(diffusivity w_j^2 + decay) c_j + sqrt(S(w_j)) u_j,    y_k = sum_j phi_j(r_k) c_j(t) + noise.

    The model is linear and time-invariant, so that filter, smoother and likelihood are exact for these modes.

    Args:
        source: the space-time process s, in units of x per time; a basis alone: no source.
        diffusivity: in length^2/time; zero or above.
        decay: rate at which heat is lost to the surroundings, in 1/time; zero or above.
        sensors: places (D,) or (D, d) in the domain, or a function of time that returns them.
        sd: standard deviation of the measurements, as of `GaussianObservation`; a number holds for all sensors.
        covariance: their covariance instead, as of `GaussianObservation`.
        initial: distribution of the coefficients (J,) at the initial time, see `LaplaceBasis.coefficients`; None: the
            field is zero.
        **options: ``initial_time``, ``output_names``, ``units`` and others of `LatentForceModel`.

    Raises:
        TypeError: the source is neither a field nor a basis.
        ValueError: a sensor lies outside of the domain, a parameter is negative, or a shape is wrong.

    Example:
        >>> import numpy as np
        >>> import lfm_ppl as lfm
        >>> basis = lfm.LaplaceBasis((0.0, 1.0), 8, "neumann")
        >>> source = lfm.SpectralField(basis, lfm.Matern(1.0, 0.4), lfm.Matern(1.0, 2.0))
        >>> model = lfm.heat(source, 0.02, 0.1, sensors=np.array([0.1, 0.5, 0.9]), sd=0.1)
        >>> len(model.state_names), model.output_names
        (8, ('sensor 0', 'sensor 1', 'sensor 2'))

    Source: Särkkä, Álvarez and Lawrence (2019), IEEE Transactions on Automatic Control 64, section V.
    """
    basis = _basis(source)
    rates = (non_negative_parameter("diffusivity", diffusivity) * basis.wavenumbers**2
             + non_negative_parameter("decay", decay))
    return _model(source, lambda x, s: s - rates * x, basis.names, sensors,
                  {"sd": sd, "covariance": covariance}, initial, options)


def wave(source: SpectralField | LaplaceBasis, speed: ArrayLike, damping: ArrayLike, *, sensors: Any, sd: Any = None,
         covariance: Any = None, initial: Gaussian | None = None, **options: Any) -> LatentForceModel:
    r"""Return the wave equation with an unknown source, ``x_tt = speed^2 laplacian x - damping x_t + s(r, t)``.

    The states are the coefficients of the basis, "mode 0", "mode 1", ..., and then their rates of change, "rate of
    mode 0", ...; the source has the forces u_j:

        c_j'' = -speed^2 w_j^2 c_j - damping c_j' + sqrt(S(w_j)) u_j.

    Args:
        source: the space-time process s, in units of x per time^2; a basis alone: no source.
        speed: in length/time; zero or above.
        damping: in 1/time; zero or above.
        sensors: as of `heat`.
        sd: as of `heat`.
        covariance: as of `heat`.
        initial: distribution of the coefficients and their rates (2 J,) at the initial time; None: zero.
        **options: as of `heat`.

    Raises:
        TypeError, ValueError: as of `heat`.

    Example:
        >>> import numpy as np
        >>> import lfm_ppl as lfm
        >>> model = lfm.wave(lfm.LaplaceBasis((0.0, 1.0), 8), 1.0, 0.1, sensors=np.array([0.5]), sd=0.1)
        >>> model.state_names[8]
        'rate of mode 0'

    Source: Courant and Hilbert (1953), Methods of Mathematical Physics I, chapter V.
    """
    basis = _basis(source)
    stiffness = (non_negative_parameter("speed", speed) * basis.wavenumbers)**2
    friction, size = non_negative_parameter("damping", damping), len(basis.names)

    def equation(x: jax.Array, s: Any) -> jax.Array:
        return jnp.concatenate([x[size:], s - stiffness * x[:size] - friction * x[size:]])

    names = (*basis.names, *(f"rate of {name}" for name in basis.names))
    return _model(source, equation, names, sensors, {"sd": sd, "covariance": covariance}, initial, options)


def _basis(source: Any) -> LaplaceBasis:
    if not isinstance(source, SpectralField | LaplaceBasis):
        raise TypeError("source must be an lfm.SpectralField, or an lfm.LaplaceBasis for none, got "
                        f"{type(source).__name__}.")
    return source.basis if isinstance(source, SpectralField) else source


def _model(source: Any, equation: Callable, state_names: Sequence[str], sensors: Any, noise: dict[str, Any],
           initial: Gaussian | None, options: dict[str, Any]) -> LatentForceModel:
    """Return the model of an equation, a map from coefficients and source to rates of change.

    ``noise`` are the keyword arguments ``sd`` and ``covariance`` of `GaussianObservation`.
    """
    basis, size, has_source = _basis(source), len(state_names), isinstance(source, SpectralField)
    amplitudes = source.amplitudes if has_source else 0.0
    functions = None if callable(sensors) else basis.functions(sensors)

    def readings(x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
        matrix = basis.functions(jnp.asarray(sensors(t))) if functions is None else functions
        return matrix @ x[:len(basis.names)]

    outputs = jax.eval_shape(readings, jnp.zeros(size), jnp.zeros(0), jnp.zeros(())).shape[0]
    if initial is not None and initial.mean.shape != (size,):
        raise ValueError(f"initial must be a distribution of {size} coefficients, got {initial.mean.shape[0]}.")
    options = {"output_names": [f"sensor {index}" for index in range(outputs)], **options}
    initial = Gaussian(jnp.zeros(size), jnp.zeros(size)) if initial is None else initial
    return LatentForceModel(
        lambda x, u, t: equation(x, amplitudes * u if has_source else 0.0), source.forces if has_source else {},
        GaussianObservation(readings, **noise), initial, state_names=state_names, **options)
