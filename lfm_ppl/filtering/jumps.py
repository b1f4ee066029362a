"""What a jump of the forces does to a prediction."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.predict import Moments, Prediction
from lfm_ppl.linalg import congruence, matmul
from lfm_ppl.model.augment import StateSpaceModel


def after_jump(ssm: StateSpaceModel, jumps: tuple[jax.Array, jax.Array], index: jax.Array, one: Prediction,
               flow: bool) -> Prediction:
    """Let the forces jump at the end of a row.

    Args:
        ssm: the model.
        jumps: G and Q of all jumps, from `lfm_ppl.forces.sde.Stack.jump_table`.
        index: of the jump; -1 for none.
        one: the prediction over the row.
        flow: whether it has phi and noise.
    """
    size = ssm.physical_dim
    transition = jax.scipy.linalg.block_diag(jnp.eye(size), jumps[0][index])
    added = jax.scipy.linalg.block_diag(jnp.zeros((size, size)), jumps[1][index])
    moments = Moments(matmul(transition, one.moments.mean[:, None])[:, 0],
                      congruence(transition, one.moments.covariance) + added)
    if not flow:
        return one._replace(moments=moments)
    return one._replace(moments=moments, phi=matmul(transition, one.phi),
                        noise=congruence(transition, one.noise) + added)
