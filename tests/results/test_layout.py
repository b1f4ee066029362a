"""The layout of the groups of a result: dimensions of the parameters, and the true outputs."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.results.labels import Labels
from lfm_ppl.results.layout import TrajectoryDraws, lay_out

TIMES = np.arange(3.0)
NAMES = ("a", "b")
TRUTH = {"times": TIMES, "state": np.ones((3, 2)), "forces": {"u": np.zeros(3)}, "parameters": {"rate": [1.0, 2.0]}}


def two_outputs(rate):
    return lfm.LatentForceModel(
        lambda x, u, t: u[0] - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        lfm.GaussianObservation(lambda x, u, t: 2.0 * x, 0.01 * jnp.ones(2)), lfm.Gaussian(jnp.zeros(2), jnp.eye(2)),
        output_names=NAMES)


def laid_out(infer=None, plate=None, build=two_outputs, truth=None):
    """Return the groups of a model with a vector of two rates and two outputs."""
    def model(times, y=None):
        if plate:
            with numpyro.plate(plate, 2):
                rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5), infer=infer)
        else:
            rate = numpyro.sample("rate", dist.LogNormal(jnp.zeros(2), 0.5).to_event(1), infer=infer)
        numpyro.sample("y", lfm.MarginalLikelihood(build(rate), times), obs=y)

    bound = lfm.bind(model, TIMES, np.zeros((3, 2)))
    return lay_out(bound, {"rate": np.ones((1, 2, 2)) + np.arange(2.0)[:, None]}, {}, None, TrajectoryDraws(), truth,
                   Labels.of(bound))


@pytest.mark.parametrize(("keywords", "dimension", "labels"), [
    ({}, "rate_dim_0", [0, 1]),
    ({"plate": "compartment"}, "compartment", [0, 1]),
    ({"plate": "output"}, "output", list(NAMES)),
    ({"infer": {"event_dims": ["output"]}}, "output", list(NAMES)),
])
def test_only_a_parameter_that_says_so_is_of_the_outputs(keywords, dimension, labels):
    rate = laid_out(**keywords)["posterior"]["rate"]
    assert rate.dims == ("chain", "draw", dimension) and rate[dimension].values.tolist() == labels


def test_true_outputs_are_computed_or_a_warning_says_why_not():
    truth = laid_out(truth=TRUTH)["truth"]
    np.testing.assert_allclose(truth["outputs"], 2.0)

    def build(rate):
        if not isinstance(rate, jax.core.Tracer) and float(rate[1]) == 2.0:
            raise RuntimeError("no such rate")
        return two_outputs(rate)

    with pytest.warns(UserWarning, match="true outputs are left out.*RuntimeError: no such rate"):
        truth = laid_out(build=build, truth=TRUTH)["truth"]
    assert "outputs" not in truth and "forces" in truth
