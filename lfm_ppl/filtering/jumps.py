"""What a jump of the forces does to a prediction."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.predict import Prediction, compose, moved
from lfm_ppl.model.state_space import StateSpaceModel


def jump_map(ssm: StateSpaceModel, jumps: tuple[jax.Array, jax.Array], index: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the map s -> phi s + N(0, process_cov) of the joint state that a jump is; arguments as in `after_jump`."""
    size = ssm.physical_dim
    return (jax.scipy.linalg.block_diag(jnp.eye(size), jumps[0][index]),
            jax.scipy.linalg.block_diag(jnp.zeros((size, size)), jumps[1][index]))


def after_jump(ssm: StateSpaceModel, jumps: tuple[jax.Array, jax.Array], index: jax.Array, one: Prediction,
               with_map: bool) -> Prediction:
    """Let the forces jump at the end of an interval.

    Args:
        ssm: the model.
        jumps: G and Q of all jumps, from `lfm_ppl.forces.sde.Stack.jump_table`.
        index: of the jump; -1 for none.
        one: the prediction over the interval.
        with_map: whether it has phi and process_cov.
    """
    jump = jump_map(ssm, jumps, index)
    one = one._replace(moments=moved(one.moments, *jump))
    if not with_map:
        return one
    phi, process_cov = compose((one.phi, one.process_cov), jump)
    return one._replace(phi=phi, process_cov=process_cov)
