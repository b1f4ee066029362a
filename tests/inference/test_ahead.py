"""What is compiled ahead is not compiled again, and what cannot be is left for its call."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.inference.ahead import Ahead
from tests import systems
from tests.inference.test_bound_model import compilations


def test_calls_find_what_was_compiled_ahead(monkeypatch):
    monkeypatch.setattr("lfm_ppl.compilation.cpus", lambda: 2)
    function, other = jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x)), jax.jit(lambda x: jnp.tanh(x) @ x)
    x = jnp.ones((17, 17))
    ahead = Ahead()
    first = ahead.add(lambda: [function.lower(jax.ShapeDtypeStruct((17, 17), float))])
    second = ahead.add(lambda: [other.lower(jax.ShapeDtypeStruct((17, 17), float))])
    first()
    second()
    with compilations() as compiled:
        function(x)
        other(x)
    assert not compiled


def test_what_fails_ahead_is_left_for_the_call(monkeypatch):
    monkeypatch.setattr("lfm_ppl.compilation.cpus", lambda: 2)

    def broken():
        raise ValueError("no program")

    Ahead().add(broken)()


def test_a_key_that_was_pressed_while_tracing_is_not_lost(monkeypatch):
    monkeypatch.setattr("lfm_ppl.compilation.cpus", lambda: 2)

    def pressed():
        raise ValueError("tracing") from KeyboardInterrupt()

    with pytest.raises(KeyboardInterrupt):
        Ahead().add(pressed)


def test_what_waits_is_not_compiled_after_the_end(monkeypatch):
    monkeypatch.setattr("lfm_ppl.compilation.cpus", lambda: 2)
    compiled, go_on = [], threading.Event()

    class Slow:
        def compile(self):
            go_on.wait(10.0)
            compiled.append(self)

    ahead = Ahead()
    ahead.add(lambda: [Slow(), Slow(), Slow()])
    ahead.close()
    go_on.set()
    ahead._thread.shutdown(wait=True)
    assert len(compiled) <= 1


def test_one_cpu_compiles_nothing_ahead(monkeypatch):
    monkeypatch.setattr("lfm_ppl.compilation.cpus", lambda: 1)
    asked = []
    Ahead().add(lambda: asked.append(1) or [])()
    assert not asked


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("settings", [
    {"sampler": "ram"}, {"sampler": "ram", "chain_method": "vectorized"}, {"sampler": "nuts"},
    {"sampler": "nuts", "init": "map", "chain_method": "vectorized"}, {"sampler": "map"}],
    ids=lambda one: "-".join(one.values()))
def test_a_fit_compiles_each_program_once(monkeypatch, settings):
    """As many as without a thread, and the same numbers."""
    found, draws = [], []
    for cpus in (2, 1):
        monkeypatch.setattr("lfm_ppl.compilation.cpus", lambda cpus=cpus: cpus)

        def model(times, y=None):
            noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
            numpyro.sample("y", lfm.MarginalLikelihood(systems.double_well(dispersion=noise), times, steps=1), obs=y)

        jax.clear_caches()
        with compilations() as compiled:
            result = lfm.fit(model, np.arange(4.0), np.ones((4, 1)), chains=2, warmup=8, samples=6, trajectory_draws=4,
                             progress=False, **settings)
        found.append([sum(name in one for one in compiled)
                      for name in ("per_draw", "constrain", "advance", "start", "<lambda>")])
        draws.append(np.asarray(result["posterior"]["noise"]))
    np.testing.assert_array_equal(*draws)
    assert found[0] == found[1] and found[0][0] == 2 and found[0][2] == (settings["sampler"] != "map")
