"""Options of samplers that do not exist, or are arguments of `fit`, are named before anything is computed."""

from __future__ import annotations

import pytest

import lfm_ppl as lfm
from lfm_ppl.inference.kernels.options import KERNELS, check_options
from lfm_ppl.inference.samplers import SAMPLERS


def never(times, y=None):
    raise AssertionError("the model must not run")


@pytest.mark.parametrize("sampler, options", [
    ("nuts", {"target_accept": 0.9}), ("ram", {"target_accept": 0.3}), ("pmmh", {"particle": 100}),
    ("nuts", {"particles": 100}), ("nuts", {"num_samples": 100}), ("ram", {"init_strategy": None}),
    ("map", {"restarts": 3}),
])
def test_unknown_options(sampler, options):
    with pytest.raises(ValueError, match=f"'{next(iter(options))}'"):
        lfm.fit(never, [0.0, 1.0], [[0.0], [1.0]], sampler=sampler, sampler_options=options)


def test_every_sampler_has_a_kernel_but_the_mode():
    assert set(KERNELS) == set(SAMPLERS) - {"map"}


def test_options_that_are_known():
    check_options("nuts", {"target_accept_prob": 0.9, "max_tree_depth": 8, "dense_mass": True})
    check_options("ram", {"target_accept_prob": 0.3, "adapt": "throughout"})
    check_options("pmmh", {"particles": 100, "delayed": True, "particle_steps": 20})
    check_options("map", {})
    check_options("nuts", None)
    with pytest.raises(TypeError, match="sampler_options"):
        check_options("nuts", [("particles", 1)])
