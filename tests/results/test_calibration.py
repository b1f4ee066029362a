"""Ranks of simulation-based calibration: their statistics, their file and their figure."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl.accuracy import calibration
from lfm_ppl.plots import plot_calibration

DRAWS = 63


@pytest.mark.parametrize("shape", [(0.7, 0.7), (1.5, 1.5), (1.5, 1.0)], ids=["too narrow", "too wide", "shifted"])
def test_the_statistics_see_miscalibration(shape):
    bad = np.random.default_rng(0).beta(*shape, size=1000)
    assert min(calibration.p_values((bad * (DRAWS + 1)).astype(int), DRAWS).values()) < 0.001


def test_the_statistics_accept_uniform_ranks():
    uniform = np.random.default_rng(0).integers(0, DRAWS + 1, 1000)
    assert min(calibration.p_values(uniform, DRAWS).values()) > 0.01


@pytest.mark.thorough
def test_p_values_are_those_of_pearson_and_kolmogorov():
    """Many data sets and possible ranks: the simulated distributions approach the known ones."""
    rank = np.random.default_rng(4).integers(0, 1024, 2000)
    result = calibration.p_values(rank, 1023, 16)
    counts = np.bincount(rank // 64, minlength=16)
    # 20,000 simulations: a standard error of at most 0.0035
    assert abs(result["chi-square"] - stats.chisquare(counts).pvalue) < 0.02
    assert abs(result["ecdf"] - stats.kstest((rank + 0.5) / 1024, "uniform").pvalue) < 0.05


def level(times, y=None, noise=1.0):
    mean = numpyro.sample("level", dist.Normal(jnp.zeros(2), 1.0).to_event(1))
    system = lfm.LatentForceModel(
        lambda x, u, t: jnp.zeros(2), {}, lfm.GaussianObservation(lambda x, u, t: x, noise * jnp.ones(2)),
        lfm.Gaussian(mean, jnp.zeros((2, 2))))
    numpyro.sample("data", lfm.MarginalLikelihood(system, times), obs=y)


class Exact:
    """A kernel that draws independently from the posterior of `level`, or from a wider Gaussian."""

    def __init__(self, widen):
        self.widen = widen

    def init(self, key, warmup, init_params, arguments, keywords):
        return self.sample(State({"level": jnp.zeros(2)}, key), arguments, keywords)

    def sample(self, state, arguments, keywords):
        key, draw_key = jax.random.split(state.key)
        y = arguments[1]
        precision = 1.0 + y.shape[0]
        noise = self.widen * jax.random.normal(draw_key, (2,)) / jnp.sqrt(precision)
        return State({"level": y.sum(0) / precision + noise}, key)

    def postprocess_fn(self, arguments, keywords):
        return lambda z: z


def run(widen, **options):
    return calibration.calibrate(jax.random.key(5), level, np.arange(3.0), lambda model: Exact(widen), data_sets=400,
                                 thin=1, warmup=1, **options)


@pytest.fixture(scope="module")
def conjugate():
    """Ranks of a level with a known posterior, from a sampler that is exact, and from one whose draws are too wide."""
    return run(1.0), run(1.6)


@jax.tree_util.register_pytree_node_class
class State:
    def __init__(self, z, key):
        self.z, self.key = z, key

    def tree_flatten(self):
        return (self.z, self.key), None

    @classmethod
    def tree_unflatten(cls, _, children):
        return cls(*children)


def test_exact_draws_are_calibrated_and_wide_ones_are_not(conjugate):
    exact, wide = conjugate
    assert set(exact.ranks) == {"level[0]", "level[1]", "log likelihood"}
    assert all(rank.shape == (400,) and rank.min() >= 0 and rank.max() <= 63 for rank in exact.ranks.values())
    for name, rank in exact.ranks.items():
        assert min(calibration.p_values(rank, 63).values()) > 0.001, name
        assert calibration.p_values(wide.ranks[name], 63)["ecdf"] < 0.001, name


@pytest.mark.thorough
def test_one_by_one_finds_the_same_ranks(conjugate):
    result = run(1.0, method="sequential")
    for name, rank in conjugate[0].ranks.items():
        np.testing.assert_array_equal(result.ranks[name], rank)


@pytest.mark.slow
def test_tasks_in_a_folder_find_the_same_ranks_and_go_on(conjugate, tmp_path):
    lines = []
    for count in (2, 1, 0):
        result = run(1.0, batch=200, checkpoint=tmp_path, report=lines.append)
        for name, rank in conjugate[0].ranks.items():
            np.testing.assert_array_equal(result.ranks[name], rank)
        assert sum("data-sets/" in line for line in lines) == count
        lines.clear()
        if count == 2:
            (tmp_path / "data-sets-00200-00399.npz").unlink()
    with pytest.raises(ValueError, match="key"):
        calibration.calibrate(jax.random.key(6), level, np.arange(3.0), lambda model: Exact(1.0), data_sets=400, thin=1,
                              warmup=1, batch=200, checkpoint=tmp_path)


def test_ranks_survive_a_file_and_are_not_overwritten(tmp_path):
    original = calibration.Calibration({"decay[0]": np.array([0, 7, 3]), "log likelihood": np.array([1, 2, 3])}, 7)
    path = calibration.save(original, tmp_path / "deep" / "ranks.npz")
    result = calibration.load(path)
    assert result.draws == 7 and set(result.ranks) == set(original.ranks)
    for name in original.ranks:
        np.testing.assert_array_equal(result.ranks[name], original.ranks[name])
    with pytest.raises(FileExistsError):
        calibration.save(original, path)
    assert calibration.save(original, path, overwrite=True) == path


def test_figure_counts_the_ranks(conjugate):
    figure = plot_calibration(conjugate[1])
    for axes, rank in zip(figure.axes, conjugate[1].ranks.values(), strict=True):
        heights = axes.patches[-1].get_data().values
        assert heights.sum() == 400 and heights[0] == (rank < 4).sum()


def test_mistakes(conjugate):
    with pytest.raises(ValueError, match="decay"):
        plot_calibration(conjugate[0], ["decay"])
    with pytest.raises(ValueError, match="bins"):
        plot_calibration(conjugate[0], bins=10)
    for options, name in (({"data_sets": 0}, "data_sets"), ({"method": "parallel"}, "method"), ({}, "site")):
        with pytest.raises(ValueError, match=name):
            calibration.calibrate(jax.random.key(0), lambda times, y=None: None, [0.0], lfm.RAM, **options)
