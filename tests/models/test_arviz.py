"""ArviZ's functions on a result of every shipped model."""

import warnings

import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.io import loading
from tests.arviz_checks import check_arviz


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(loading.available()))
def test_arviz_reads_the_result_of_a_model(name):
    file = loading.load(name)
    data = file.simulate()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = lfm.fit(file.model, data.times, data.y, model_kwargs=file.keywords(data, {}), sampler="map",
                         fixed=file.anchors(data), samples=100, trajectory_draws=0, progress=False)
    check_arviz(result, {"y": int(np.isfinite(data.y).sum())})
