"""Every shipped model converges on its own data with the default settings."""

import warnings

import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.results.arviz_data import summary
from lfm_ppl.results.result_view import ResultView
from tests.arviz_checks import check_arviz


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(loading.available()))
def test_chains_converge_and_cover_the_truth(name):
    file = loading.load(name)
    data = file.simulate()
    # As the command line does.
    options = {} if file.target_accept is None else {"target_accept_prob": file.target_accept}
    with warnings.catch_warnings():
        warnings.simplefilter("error", lfm.ConvergenceWarning)
        result = lfm.fit(file.model, data.times, data.y, model_kwargs=file.keywords(data, {}), truth=data.truth,
                         progress=False, sampler_options=options)
    view, table = ResultView.of(result), summary(result)
    assert table["r_hat"].max() <= 1.01 and table["ess_bulk"].min() >= 400
    assert not view.group("sample_stats")["diverging"].any()
    for name in {"log_likelihood", "posterior_predictive", "trajectories"} & set(view.groups):
        assert all(np.isfinite(variable).all() for variable in view.group(name).data_vars.values()), name
    check_arviz(result, {"y": int(np.isfinite(data.y).sum())})
    posterior, truth = view.posterior, view.group("truth")
    ranks = []
    for parameter in [name for name in file.parameters if name in posterior]:  # some are of another option
        draws = posterior[parameter].stack(sample=("chain", "draw"))
        ranks += np.ravel((draws < truth[parameter]).mean("sample")).tolist()
    # one data set: a rank beyond these has a probability of 1e-3 for each parameter
    assert min(ranks) > 5e-4 and max(ranks) < 1 - 5e-4, dict(zip(table.index, ranks, strict=False))
