"""Keys that are picked on the host equal the keys of JAX; few programs make any number of keys."""

import jax
import numpy as np
import pytest

from lfm_ppl.utils.random_keys import split_keys
from tests.compiled_programs import compilations


@pytest.mark.parametrize("kind", ["threefry2x32", "rbg"])
@pytest.mark.parametrize("partitionable", [True, False])
def test_keys_are_those_of_jax(kind, partitionable):
    with jax.threefry_partitionable(partitionable):
        key = jax.random.key(7, impl=kind)
        for count in (0, 1, 64, 65, np.int64(5)):
            assert (split_keys(key, count)(slice(None)) == jax.random.split(key, count)).all()


def test_numbers_of_keys_share_a_program():
    key = jax.random.key(7)
    split_keys(key, 3)(0)
    with compilations() as compiled:
        for count in (2, 20, 64):
            split_keys(key, count)(-1)
    assert not compiled
