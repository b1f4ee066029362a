"""Programs share machine code where their texts are equal, and nowhere else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lfm_ppl.utils.programs import Program, shared_jit
from tests.compiled_programs import compilations


def table_program(table):
    return Program(lambda index, unused: jnp.asarray(table)[index])


def test_equal_texts_are_compiled_once_and_a_changed_entry_is_another_text():
    table = np.linspace(0.0, 1.0, 10_000)
    changed = np.where(np.arange(10_000) == 9_000, 7.0, table)
    assert float(table_program(table)(9_000, 0.0)) == table[9_000]
    with compilations() as compiled:
        assert float(table_program(table.copy())(9_000, 0.0)) == table[9_000]
    assert compiled == []
    assert float(table_program(changed)(9_000, 0.0)) == 7.0
    assert float(table_program(jnp.asarray(changed))(9_000, 0.0)) == 7.0


def test_arguments_of_other_kinds_and_results_of_other_structures_have_programs_of_their_own():
    program = Program(lambda tree: jax.tree.map(lambda leaf: leaf + 1, tree))
    for tree in ({"a": 1.0}, {"b": 1.0}, {"a": jnp.ones(2)}, {"a": np.ones(2)}, {"a": 1}, (1.0, jnp.ones(3, bool))):
        expected = jax.tree.map(lambda leaf: np.asarray(leaf) + 1, tree)
        jax.tree.map(np.testing.assert_array_equal, program(tree), expected)
    assert Program(lambda x: {"a": 2.0 * x})(1.0).keys() == {"a"}
    assert Program(lambda x: {"b": 2.0 * x})(1.0).keys() == {"b"}


@pytest.mark.parametrize("transformation", [jax.jit, jax.vmap, jax.grad, lambda f: jax.jit(jax.grad(f))])
def test_in_compiled_code_a_program_is_a_part_of_the_outer_one(transformation):
    def function(x):
        return Program(lambda y: y * x)(3.0) + Program(jnp.sin)(x)

    def plain(x):
        return 3.0 * x + jnp.sin(x)

    x = jnp.linspace(0.1, 1.0, 3) if transformation is jax.vmap else 0.4
    np.testing.assert_allclose(transformation(function)(x), transformation(plain)(x), rtol=1e-12)


def test_threads_may_call_an_executable():
    program = Program(lambda x: x + 1.0)
    run = program.compile(1.0)
    assert float(run(2.0)) == 3.0


def test_a_shared_function_keeps_settings_apart():
    @shared_jit
    def power(x, function, exponent=1):
        return function(x) ** exponent

    assert [float(power(2.0 * jnp.ones(()), jnp.negative, exponent)) for exponent in (1, 2, True)] == [-2.0, 4.0, -2.0]
    with compilations() as compiled:
        assert float(power(2.0 * jnp.ones(()), lambda x: jnp.negative(x), 2)) == 4.0
    assert compiled == []
