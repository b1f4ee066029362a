"""ArviZ's functions on a result, on ArviZ 0.23 and on ArviZ 1.x."""

import warnings

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

from lfm_ppl.results.result_view import ResultView

IS_DATATREE = int(az.__version__.split(".")[0]) >= 1


def check_arviz(result, counts):
    """Run ArviZ's comparisons, predictive checks and sensitivities on a result.

    Args:
        result: of a fit.
        counts: name of a variable of the observed data -> number of observed entries.

    Returns:
        Name of a variable -> pointwise expected log predictive densities, by entry.
    """
    posterior, observed = ResultView.of(result).posterior, ResultView.of(result).group("observed_data")
    for name in ("posterior_predictive", "log_likelihood"):
        xr.testing.assert_equal(ResultView.of(result).group(name)["draw"], posterior["draw"])
        xr.testing.assert_equal(ResultView.of(result).group(name)["chain"], posterior["chain"])
        assert {label: variable.shape[2:] for label, variable in ResultView.of(result).group(name).items()} == {
            label: variable.shape for label, variable in observed.items()}
    pointwise = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of few draws
        for name, count in counts.items():
            selection = {"var_name": name} if len(counts) > 1 else {}
            loo = az.loo(result, pointwise=True, **selection)
            pointwise[name] = np.asarray(loo.elpd_i if IS_DATATREE else loo.loo_i)
            assert loo.n_data_points == count and np.isfinite(pointwise[name]).all()
            assert len(az.compare({"a": result, "b": result}, **selection)) == 2
        pits = az.loo_pit(result) if IS_DATATREE else {name: az.loo_pit(result, y=name) for name in counts}
        for name, count in counts.items():
            pit = np.asarray(pits[name])
            assert pit.shape == (count,) and np.all((pit >= 0) & (pit <= 1))
        if IS_DATATREE:
            for plot in (az.plot_ppc_dist, az.plot_ppc_pit, az.plot_loo_pit):
                plot(result)
                plt.close("all")
            table = az.psense_summary(result)
            assert np.isfinite(table[["prior", "likelihood"]].to_numpy(float)).all()
        else:
            for name in counts:
                az.plot_loo_pit(result, y=name)
            az.plot_ppc(result, num_pp_samples=10)
            plt.close("all")
            for component in ("prior", "likelihood"):
                assert az.psens(result, component=component).sizes is not None
    return pointwise
