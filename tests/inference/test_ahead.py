"""What is compiled ahead is not compiled again, and what cannot be is left for its call."""

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


def test_a_call_finds_what_was_compiled_ahead():
    function = jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x))
    ahead = Ahead(lambda: [function.lower(jax.ShapeDtypeStruct((17, 17), float))])
    ahead.wait()
    x = jnp.ones((17, 17))
    with compilations() as compiled:
        function(x)
    assert not compiled


def test_what_fails_ahead_is_left_for_the_call():
    def broken():
        raise ValueError("no program")

    Ahead(broken).wait()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_fit_compiles_scores_and_trajectories_once(monkeypatch):
    found = []
    for ahead in (True, False):
        monkeypatch.setattr("lfm_ppl.fitting.worthwhile", lambda ahead=ahead: ahead)

        def model(times, y=None):
            noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
            numpyro.sample("y", lfm.MarginalLikelihood(systems.double_well(dispersion=noise), times, steps=1), obs=y)

        jax.clear_caches()
        with compilations() as compiled:
            lfm.fit(model, np.arange(4.0), np.ones((4, 1)), sampler="ram", chains=2, warmup=8, samples=6,
                    trajectory_draws=4, progress=False)
        found.append([sum(name in one for one in compiled) for name in ("per_draw", "<lambda>")])
    assert found[0] == found[1] and sum(found[0]) >= 2
