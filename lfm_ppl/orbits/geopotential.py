"""The Earth's gravity field: spherical harmonics to degree and order eight.

1. Positions are in the frame that rotates with the Earth.
2. Compute the solid harmonics V_nm, W_nm by a recursion over the degree, for all orders at a time.
3. The acceleration is a linear combination of the harmonics of one degree more, with constant weights.

Source: Montenbruck and Gill (2005), Satellite Orbits, section 3.2; coefficients of EGM2008, Pavlis et al. (2012).
"""

from __future__ import annotations

import functools
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np

GM = 398600.4415
"""Of the Earth, in km^3/s^2, as the coefficients need it."""
RADIUS = 6378.1363
"""Of the Earth at the equator, in km, as the coefficients need it."""
DEGREE = 8

_EGM2008 = """
2 0 -4.841651437908150e-04 0.000000000000000e+00
2 1 -2.066155090741760e-10 1.384413891379790e-09
2 2 2.439383573283130e-06 -1.400273703859340e-06
3 0 9.571612070934730e-07 0.000000000000000e+00
3 1 2.030462010478640e-06 2.482004158568720e-07
3 2 9.047878948095281e-07 -6.190054751776180e-07
3 3 7.213217571215680e-07 1.414349261929410e-06
4 0 5.399658666389910e-07 0.000000000000000e+00
4 1 -5.361573893888670e-07 -4.735673465180860e-07
4 2 3.505016239626490e-07 6.624800262758289e-07
4 3 9.908567666723210e-07 -2.009567235674520e-07
4 4 -1.885196330230330e-07 3.088038821491940e-07
5 0 6.867029137366810e-08 0.000000000000000e+00
5 1 -6.292119230425290e-08 -9.436980733957690e-08
5 2 6.520780431761639e-07 -3.233531925405220e-07
5 3 -4.518471523288430e-07 -2.149554083060460e-07
5 4 -2.953287611756290e-07 4.980705501023510e-08
5 5 1.748117954960020e-07 -6.693799351801650e-07
6 0 -1.499539279785270e-07 0.000000000000000e+00
6 1 -7.592100818925270e-08 2.651225932136470e-08
6 2 4.864889246046900e-08 -3.737893245237520e-07
6 3 5.724516111756530e-08 8.952011300107300e-09
6 4 -8.602379371916110e-08 -4.714255734290950e-07
6 5 -2.671664237030380e-07 -5.364931515002060e-07
6 6 9.470687497568821e-09 -2.373823533510050e-07
7 0 9.051208445216180e-08 0.000000000000000e+00
7 1 2.808875557766730e-07 9.512593628692749e-08
7 2 3.304079937022350e-07 9.299692906240920e-08
7 3 2.504584092257290e-07 -2.171182877296100e-07
7 4 -2.749939355916310e-07 -1.240584035143430e-07
7 5 1.647732559346580e-09 1.792817827514380e-08
7 6 -3.587984234648890e-07 1.517982574436690e-07
7 7 1.507464728726750e-09 2.410687672863030e-08
8 0 4.947560030051990e-08 0.000000000000000e+00
8 1 2.316079912483290e-08 5.889745409276060e-08
8 2 8.001436047365990e-08 6.528050436673691e-08
8 3 -1.937453817152900e-08 -8.596393391256940e-08
8 4 -2.443604800070960e-07 6.980725084727770e-08
8 5 -2.570114772679910e-08 8.920348917458810e-08
8 6 -6.596486800314080e-08 3.089467307830650e-07
8 7 6.725697517714831e-08 7.486860637382310e-08
8 8 -1.240227719171360e-07 1.205518893849970e-07
"""
# Degree, order, and the fully normalised C and S of EGM2008, tide free, from degree two on.


def acceleration(r: jax.Array, degree: int = DEGREE) -> jax.Array:
    """Return the acceleration of the Earth's field (3,), in km/s^2, in the frame of ``r``.

        a = grad GM/r sum_nm (R/r)^n Pnm(sin phi) (C_nm cos m lambda + S_nm sin m lambda).

    It is computed from solid harmonics V_nm + i W_nm ~ Pnm(sin phi) e^(i m lambda) / r^(n+1), which have no pole.

    Args:
        r: (3,) position in the frame that turns with the Earth (km).
        degree: highest degree and order, from 0 (a point mass) to 8.

    Raises:
        ValueError: a degree out of range.

    Example:
        >>> import jax.numpy as jnp
        >>> a = acceleration(jnp.array([26_560.0, 0.0, 0.0]), degree=0)
        >>> round(float(a[0]) * 1e6, 3)
        -565.043

    Source: O. Montenbruck and E. Gill, Satellite Orbits (2005), section 3.2; N. K. Pavlis and others, The development
    and evaluation of the Earth Gravitational Model 2008, J. Geophys. Res. 117 (2012).
    """
    if not 0 <= degree <= DEGREE:
        raise ValueError(f"degree must lie in 0..{DEGREE}, got {degree}.")
    v, w = _solid_harmonics(r, degree + 1)
    of_v, of_w = _weights(degree)
    return GM / RADIUS**2 * ((of_v * v).sum((1, 2)) + (of_w * w).sum((1, 2)))


@functools.cache
def coefficients() -> tuple[np.ndarray, np.ndarray]:
    """Return C and S (9, 9) without normalisation, the central term included."""
    c, s = np.zeros((DEGREE + 1, DEGREE + 1)), np.zeros((DEGREE + 1, DEGREE + 1))
    c[0, 0] = 1.0
    for line in _EGM2008.strip().splitlines():
        degree, order, *values = line.split()
        n, m = int(degree), int(order)
        root = np.sqrt((1 if m == 0 else 2) * (2 * n + 1) * factorial(n - m) / factorial(n + m))
        c[n, m], s[n, m] = root * np.array(values, dtype=float)
    return c, s


@functools.cache
def _weights(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what V and W (degree + 2, degree + 2) contribute to x, y and z, each (3, degree + 2, degree + 2)."""
    c, s = coefficients()
    of_v, of_w = np.zeros((2, 3, degree + 2, degree + 2))
    for n in range(degree + 1):
        for m in range(n + 1):
            cnm, snm = c[n, m], s[n, m]
            of_v[2, n + 1, m] -= (n - m + 1) * cnm
            of_w[2, n + 1, m] -= (n - m + 1) * snm
            half = 1.0 if m == 0 else 0.5
            of_v[0, n + 1, m + 1] -= half * cnm
            of_w[1, n + 1, m + 1] -= half * cnm
            if m > 0:
                of_w[0, n + 1, m + 1] -= half * snm
                of_v[1, n + 1, m + 1] += half * snm
                fall = half * (n - m + 1) * (n - m + 2)
                of_v[0, n + 1, m - 1] += fall * cnm
                of_w[0, n + 1, m - 1] += fall * snm
                of_w[1, n + 1, m - 1] -= fall * cnm
                of_v[1, n + 1, m - 1] += fall * snm
    return of_v, of_w


def _solid_harmonics(r: jax.Array, degree: int) -> tuple[jax.Array, jax.Array]:
    """Return V and W (degree + 1, degree + 1), rows n and columns m; all orders of a degree at a time."""
    square = (r * r).sum()
    x, y, z = r * RADIUS / square
    rho = RADIUS**2 / square
    one_v, one_w = RADIUS / jnp.sqrt(square), jnp.zeros(())
    sectoral = [(one_v, one_w)]
    for m in range(1, degree + 1):
        one_v, one_w = (2 * m - 1) * (x * one_v - y * one_w), (2 * m - 1) * (x * one_w + y * one_v)
        sectoral.append((one_v, one_w))
    start = jnp.stack([jnp.stack(column) for column in zip(*sectoral, strict=True)])
    orders = np.arange(degree + 1)
    previous, current = jnp.zeros_like(start), start * (orders == 0)
    rows = [current]
    for n in range(1, degree + 1):
        gap = np.maximum(n - orders, 1)
        climb, drop = (2 * n - 1) / gap * (orders < n), (n + orders - 1) / gap * (orders < n)
        previous, current = current, climb * z * current - drop * rho * previous + start * (orders == n)
        rows.append(current)
    v, w = jnp.stack(rows, axis=1)
    return v, w
