"""Student's t errors as an option: 5% gross errors of 20 sds move parameters only where errors are Gaussian.

A fit is the mode of the posterior of the unconstrained parameters, and its standard deviations are those of Laplace's
approximation there. Its measure is the same model's fit in which the spoilt entries are missing.
"""

import os
from pathlib import Path

import jax
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl import loading
from lfm_ppl.inference.bound_model import bind
from lfm_ppl.inference.optimise import newton, quasi_newton

ROOT = Path(__file__).resolve().parent.parent.parent
P53 = Path(os.environ.get("LFM_DATA", ROOT.parent / "shared" / "data")) / "p53" / "p53_targets.csv"
SHARE, SIZE = 0.05, 20.0


def shifts(file, data, noise_sd, df):
    """Return how far gross errors move each parameter but the noise's, and the noise's, in sds."""
    rng = np.random.default_rng(0)
    spoilt = np.zeros(data.y.size, bool)
    spoilt[rng.choice(spoilt.size, round(SHARE * spoilt.size), replace=False)] = True
    spoilt = spoilt.reshape(data.y.shape)
    error = SIZE * noise_sd * rng.choice([-1.0, 1.0], data.y.shape)
    keywords = file.keywords(data, {"df": df})
    bound = bind(file.model, data.times, data.y, **keywords).fix(file.anchors(data))
    start = bound.draw(jax.random.key(0))
    found = []
    for y in (np.where(spoilt, np.nan, data.y), np.where(spoilt, data.y + error, data.y)):
        objective = bound.with_data(y).objective()
        found.append(newton(objective, quasi_newton(objective, start).point))
        start = found[0].point
    clean, with_errors = found
    sd = np.sqrt(np.diag(clean.curvature.factor @ clean.curvature.factor.T))
    moved = dict(zip(bound.names, (with_errors.point - clean.point) / sd, strict=True))
    print(f"df = {df:g}:", {name: round(float(value), 3) for name, value in moved.items()})
    noise = {name for name in moved if name.startswith("noise_sd")}
    return ({name: abs(value) for name, value in moved.items() if name not in noise},
            {name: value for name, value in moved.items() if name in noise})


@pytest.mark.slow
def test_ballistic():
    """The noise is known: 6 of 120 distances are off by 600 m."""
    file = loading.load("ballistic")
    data = file.simulate()
    robust, _ = shifts(file, data, 30.0, 4.0)
    gaussian, _ = shifts(file, data, 30.0, 0.0)
    assert max(robust.values()) < 0.2 and max(gaussian.values()) > 1.0


@pytest.mark.slow
@pytest.mark.skipif(not P53.is_file(), reason=f"{P53} is not there; LFM_DATA says where")
def test_p53():
    """Five of 105 values are off by 20 standard deviations of some 0.07 of a gene's largest value."""
    file = loading.load("transcription")
    data = file.prepare(lfm.read_csv(P53))
    robust, _ = shifts(file, data, 0.07, 4.0)
    gaussian, noise = shifts(file, data, 0.07, 0.0)
    assert max(robust.values()) < 0.2 and max(gaussian.values()) > 1.0
    assert max(noise.values()) > 3.0
