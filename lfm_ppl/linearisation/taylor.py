"""First-order Taylor expansion: the extended Kalman filter."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lfm_ppl.linearisation.input_selection import InputStructure
from lfm_ppl.linearisation.rule import AffineMap, Function, Inputs, Rule, partial_jacobian, selection
from lfm_ppl.utils.linalg import matmul


class Taylor(Rule):
    """First-order Taylor expansion about the mean: the extended Kalman filter.

    ``E[f] ~ f(m)``, ``A = f'(m)``, ``Omega = 0``. The rule neglects the curvature of f over the distribution of the
    state, and underestimates the variance where the curvature is large.

    Example:
        >>> Taylor().name
        'Taylor()'

    Source: Hartikainen (2013), section 2.3; Jazwinski (1970).
    """

    def linearise(self, function: Function, inputs: Inputs, structure: InputStructure,
                  jacobian: jax.Array) -> AffineMap:
        """See `Rule.linearise`."""
        value, extra = function(inputs.mean)
        varying = (*structure.nonlinear, *structure.averaged)
        if varying:
            varying_jacobian = partial_jacobian(function, inputs.mean, varying)
            jacobian = jacobian + matmul(varying_jacobian, selection(varying, inputs.mean.shape[0]).T)
        return AffineMap(value, jacobian, jnp.zeros((value.shape[0],) * 2), extra)
