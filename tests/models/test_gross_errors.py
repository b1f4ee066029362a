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
from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.optimise import newton, quasi_newton
from lfm_ppl.io import loading

ROOT = Path(__file__).resolve().parent.parent.parent
P53 = Path(os.environ.get("LFM_DATA", ROOT.parent / "shared" / "data")) / "p53" / "p53_targets.csv"
needs_p53 = pytest.mark.skipif(not P53.is_file(), reason=f"{P53} is not there; LFM_DATA says where")
SHARE, SIZE = 0.05, 20.0


def shifts(file, data, noise_sd, df, places, known=None):
    """Return how far gross errors move each parameter, in sds.

    Args:
        file: the model.
        data: without gross errors.
        noise_sd: of which an error is 20.
        df: degrees of freedom of Student's t errors; 0: Gaussian errors.
        places: number of draws of which entries are spoilt.
        known: parameters that are fixed besides the model's own.

    Returns:
        Shifts (places, d) of the unconstrained parameters but the noise's, and those of the noise's.
    """
    keywords = file.keywords(data, {"df": df})
    bound = bind(file.model, data.times, data.y, **keywords).fix(file.anchors(data) | (known or {}))
    start = bound.draw(jax.random.key(0))
    result = []
    for place in range(places):
        rng = np.random.default_rng(place)
        spoilt = np.zeros(data.y.size, bool)
        spoilt[rng.choice(spoilt.size, round(SHARE * spoilt.size), replace=False)] = True
        spoilt = spoilt.reshape(data.y.shape)
        error = SIZE * noise_sd * rng.choice([-1.0, 1.0], data.y.shape)
        fits = []
        for y in (np.where(spoilt, np.nan, data.y), np.where(spoilt, data.y + error, data.y)):
            objective = bound.with_data(y).objective()
            fits.append(newton(objective, quasi_newton(objective, start).point))
            start = fits[0].point
        without, with_errors = fits
        assert max(without.decrement, with_errors.decrement) < 1e-8
        sd = np.sqrt(np.diag(without.curvature.factor @ without.curvature.factor.T))
        result.append((with_errors.point - without.point) / sd)
    noise = np.array([name.startswith("noise_sd") for name in bound.names])
    moved = np.array(result)
    rates, scales = moved[:, ~noise], moved[:, noise]
    print(f"df = {df:g}: largest {np.abs(rates).max(1).round(3)}, root mean square",
          np.sqrt((rates**2).mean(1)).round(3), "noise", np.abs(scales).max(1, initial=0).round(2))
    return rates, scales


@pytest.mark.slow
def test_ballistic():
    """The noise is known: 6 of 120 distances are off by 600 m."""
    file = loading.load("ballistic")
    data = file.simulate()
    robust, _ = shifts(file, data, 30.0, 4.0, 3)
    gaussian, _ = shifts(file, data, 30.0, 0.0, 3)
    assert np.abs(robust).max() < 0.2 and np.abs(gaussian).max(1).min() > 1.0


@pytest.mark.slow
@needs_p53
def test_p53_with_known_noise():
    """Five of 105 values are off by 20 standard deviations of 0.07 of a gene's largest value."""
    file = loading.load("transcription")
    data = file.prepare(lfm.read_csv(P53))
    known = {"noise_sd": np.full(5, 0.07)}
    robust, _ = shifts(file, data, 0.07, 4.0, 6, known)
    gaussian, _ = shifts(file, data, 0.07, 0.0, 6, known)
    assert np.abs(robust).max() < 0.2 and np.abs(gaussian).max(1).min() > 1.0


@pytest.mark.slow
@needs_p53
def test_p53_with_noise_that_is_learnt():
    """The scale of a gene with gross errors grows, and its own rates follow: not each is within 0.2 sds."""
    file = loading.load("transcription")
    data = file.prepare(lfm.read_csv(P53))
    robust, scales = shifts(file, data, 0.07, 4.0, 6)
    gaussian, noise = shifts(file, data, 0.07, 0.0, 6)
    assert np.sqrt((robust**2).mean(1)).max() < 0.2 and np.abs(robust).max() < 0.5
    assert np.abs(gaussian).max(1).min() > 1.0
    assert np.all(np.abs(noise).max(1) > 2.5 * np.abs(scales).max(1))
