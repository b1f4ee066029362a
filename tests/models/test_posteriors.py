"""Every shipped model converges on its own data with the default settings."""

import warnings

import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.results.arviz_data import group, summary

MODELS = sorted(loading.available())


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_default_run_converges_and_covers_the_truth(name):
    file = loading.load(name)
    data = file.simulate()
    with warnings.catch_warnings():
        warnings.simplefilter("error", lfm.ConvergenceWarning)
        result = lfm.fit(
            file.model,
            data.times,
            data.y,
            model_kwargs=file.keywords(data, {}),
            truth=data.truth,
            progress=False,
        )
    table = summary(result)
    assert table["r_hat"].max() <= 1.01
    assert table["ess_bulk"].min() >= 400
    assert float(group(result, "sample_stats")["diverging"].mean()) < 0.005
    posterior, truth = group(result, "posterior"), group(result, "truth")
    ranks = []
    for parameter in file.parameters:
        draws = posterior[parameter].stack(sample=("chain", "draw"))
        ranks += np.ravel((draws < truth[parameter]).mean("sample")).tolist()
    # one data set: a rank beyond these has a probability of 1e-3 for each parameter
    assert min(ranks) > 5e-4 and max(ranks) < 1 - 5e-4, dict(zip(table.index, ranks, strict=False))
