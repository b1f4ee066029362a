"""A day ahead under a thermostat: run with ``pytest -m performance tests/performance/test_heating_speed.py -n 0``."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from lfm_ppl.studies.home_heating import prediction, problem

pytestmark = pytest.mark.performance


def test_a_day_ahead_with_a_thousand_particles(benchmark):
    """Envelope, quasi-periodic residual of 15 functions, a decision every ten minutes: under 2 s."""
    model = problem.Model("SQM", "envelope", 15)
    window = problem.home(0, "envelope")
    z = model.medians

    def predict():
        return jax.block_until_ready(prediction.predict_under_thermostat(model, window, z, 1000, jax.random.key(0))[1])

    result = predict()
    assert np.isfinite(result.mean).all() and result.inputs.shape == (149, 1000)
    benchmark.pedantic(predict, rounds=3)
    assert benchmark.stats.stats.median < 2.0
