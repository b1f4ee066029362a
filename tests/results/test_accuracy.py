"""The accuracy report: importance weights against closed forms, and the Gaussian filter against exact likelihoods."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl.accuracy import check_accuracy as accuracy_check
from lfm_ppl.accuracy import importance_weights, log_likelihoods
from lfm_ppl.accuracy.check_accuracy import check_accuracy
from lfm_ppl.accuracy.correction import correct_posterior
from lfm_ppl.accuracy.report import AccuracyReport
from lfm_ppl.accuracy.verdict import Findings, judge
from lfm_ppl.model.state_space import state_space
from lfm_ppl.plots import plot_accuracy
from lfm_ppl.results import arviz_data, rebuilding
from lfm_ppl.results.result_view import ResultView

TIMES = np.arange(6.0)
Y = np.array([[0.9], [1.1], [np.nan], [0.8], [1.2], [0.7]])

# The exact posterior is N(TARGET_MEAN, TARGET_SD^2), the wrong one N(WRONG_MEAN, WRONG_SD^2).
TARGET_MEAN, TARGET_SD, WRONG_MEAN, WRONG_SD = 1.3, 0.9, 1.0, 1.0


def log_ratio(x):
    return (-0.5 * ((x - TARGET_MEAN) / TARGET_SD) ** 2 - np.log(TARGET_SD)
            + 0.5 * ((x - WRONG_MEAN) / WRONG_SD) ** 2 + np.log(WRONG_SD))


def autoregressive(generator, chains, samples, coefficient):
    """Draws of N(WRONG_MEAN, WRONG_SD^2) in chains with a known autocorrelation."""
    x = np.empty((chains, samples))
    x[:, 0] = generator.normal(size=chains)
    for t in range(1, samples):
        x[:, t] = coefficient * x[:, t - 1] + np.sqrt(1 - coefficient**2) * generator.normal(size=chains)
    return WRONG_MEAN + WRONG_SD * x


def test_average_is_the_log_of_the_mean_with_the_variance_of_the_jackknife():
    sd, replicates = 0.4, 4
    generator = np.random.default_rng(0)
    noise = generator.normal(-0.5 * sd**2, sd, (20_000, replicates))  # mean one on the scale of the likelihood
    result = importance_weights.average(3.0 + noise)
    assert abs(np.exp(result.log_mean - 3.0).mean() - 1.0) < 4 * np.sqrt(np.expm1(sd**2) / noise.size)
    # The spread over 20,000 draws is known to 0.5%; the jackknife's bias is of second order in the variance, 0.16 / 4.
    np.testing.assert_allclose(np.sqrt(result.variance.mean()), result.log_mean.std(), rtol=0.04)
    np.testing.assert_allclose(importance_weights.average(np.array([[1.0, 1.0]])).log_mean, [1.0])
    assert importance_weights.average(np.full((1, 3), -np.inf)).log_mean[0] == -np.inf
    assert np.isnan(importance_weights.average(np.zeros((2, 1))).variance).all()


@pytest.mark.thorough
@pytest.mark.parametrize("coefficient", [0.0, 0.6], ids=["independent", "autocorrelated"])
@pytest.mark.parametrize("noise", [0.0, 0.3], ids=["exact ratios", "noisy ratios"])
def test_corrected_moments_are_right_within_calibrated_errors(coefficient, noise):
    """z-scores over 300 repetitions against the closed form: mean zero, sd one."""
    generator = np.random.default_rng(1)
    indices = np.linspace(0, 399, 100).round().astype(int)
    scores = []
    for _ in range(300):
        x = autoregressive(generator, 4, 400, coefficient)
        ratio = log_ratio(x[:, indices]) + generator.normal(-0.5 * noise**2, noise, (4, len(indices)))
        weights = importance_weights.smooth(ratio)
        row = importance_weights.corrected_moments({"x": x}, indices, weights.log_weight).loc["x"]
        sd = row["sd"]
        scores.append([(row["corrected_mean"] - TARGET_MEAN) / row["corrected_mean_se"],
                       (row["sd_ratio"] - TARGET_SD / WRONG_SD) / row["sd_ratio_se"],
                       (row["shift"] * sd - (TARGET_MEAN - WRONG_MEAN)) / (row["shift_se"] * sd)])
    scores = np.array(scores)
    # sd of a mean of 300 z-scores 0.06, of their sd 0.04; smoothing and normalising have biases below a tenth of an sd.
    assert np.all(np.abs(scores.mean(axis=0)) < 0.3), scores.mean(axis=0)
    assert np.all(np.abs(scores.std(axis=0) - 1.0) < 0.17), scores.std(axis=0)


def test_without_a_difference_nothing_changes():
    x = np.random.default_rng(0).normal(size=(4, 100))
    indices = np.arange(0, 100, 10)
    weights = importance_weights.smooth(np.full((4, 10), 2.5))
    assert weights.k == -np.inf and weights.reliable
    np.testing.assert_allclose(weights.ess, 40.0)
    row = importance_weights.corrected_moments({"x": x, "fixed": np.ones((4, 100))}, indices, weights.log_weight)
    assert abs(row.loc["x", "shift"]) < 1e-12 and abs(row.loc["x", "sd_ratio"] - 1.0) < 1e-12
    assert row.loc["fixed"].tolist() == [1, 0, 1, 0, 0, 0, 1, 0, 0]


def test_k_tells_heavy_tails():
    """Ratios that are Pareto variables of shape k have tails of shape k."""
    uniform = np.random.default_rng(3).uniform(size=(1, 4000))
    for k in (0.2, 0.5, 0.9):
        result = importance_weights.smooth(-k * np.log(uniform))
        assert abs(result.k - k) < 0.2  # 190 tail draws: sd (1 + k) / sqrt(190), at most 0.14
        assert result.reliable == (result.k < 0.7)
    assert importance_weights.smooth(np.arange(4.0)[None]).k == np.inf  # too few draws
    with pytest.raises(ValueError, match="zero"):
        importance_weights.smooth(np.full((2, 10), -np.inf))
    with pytest.raises(ValueError, match="NaN"):
        importance_weights.smooth(np.array([[0.0, np.nan]]))


def test_an_impossible_draw_has_no_weight():
    ratio = np.random.default_rng(0).normal(size=(1, 200))
    ratio[0, :3] = -np.inf
    assert np.all(importance_weights.smooth(ratio).log_weight[0, :3] == -np.inf)


def test_resampling_copies_in_proportion():
    weight = np.array([[0.5, 0.125], [0.25, 0.125]])
    count = np.bincount(importance_weights.resample(np.log(weight), 800, seed=1), minlength=4)
    np.testing.assert_array_equal(count, [400, 100, 200, 100])


def findings(**changes):
    table = importance_weights.corrected_moments({"rate": np.random.default_rng(0).normal(size=(4, 50))}, np.arange(50),
                                         np.full((4, 50), -np.log(200)))
    rows = {name: changes.pop(name) for name in list(changes) if name in table.columns}
    table = table.assign(**rows)
    return Findings(**{"table": table, "k": 0.2, "threshold": 0.565, "exact": False, "step_change_sd": 0.0,
                       "noise_sd": 0.0, "noise_share": 0.0, "particles": 0, "checked": 200, "available": 4000,
                       "impossible": 0, "sampler": "nuts", "refit": "lfm-ppl fit well", "steps": 10,
                       "max_step": None, **changes})


ITERATED = {"iterations": 3, "ratio_sd": 2.0, "iterated_ratio_sd": 0.3}


@pytest.mark.parametrize(("changes", "word", "command"), [
    ({}, "trust", ""), ({"exact": True}, "trust", ""), ({"shift": 0.3, "shift_se": 0.2}, "trust", "--draws 800"),
    ({"shift": 0.3, "shift_se": 0.05}, "corrected", "--correct"),
    ({"sd_ratio": 0.8, "sd_ratio_se": 0.05}, "corrected", "--correct"), ({"k": 0.6}, "inconclusive", "--draws 634"),
    ({"k": 0.6, "available": 200}, "re-run", "check RESULT --correct"),
    ({"k": 0.9}, "re-run", "check RESULT --correct"),
    ({"k": 0.9, **ITERATED}, "re-run", "lfm-ppl fit well --iterations 3"),
    ({"k": 0.9, **ITERATED, "iterated_ratio_sd": 1.5}, "re-run", "check RESULT --correct"),
    ({"k": 0.9, "noise_share": 0.8, "particles": 500}, "inconclusive", "--particles 2000"),
    ({"k": np.inf, "checked": 10}, "inconclusive", "--draws 200"),
    ({"step_change_sd": 0.2}, "re-run", "lfm-ppl fit well --steps 20"),
    ({"step_change_sd": np.nan, "max_step": 0.5}, "re-run", "--steps 20 --max-step 0.25"),
    ({"noise_sd": 0.5}, "trust", ""), ({"sampler": "map"}, "trust", ""), ({"impossible": 3}, "trust", ""),
])
def test_verdicts(changes, word, command):
    verdict = judge(findings(**changes))
    assert verdict.word == word and verdict.reason
    assert command in verdict.command and bool(command) == bool(verdict.command)


def test_remedies_are_listed_by_cost():
    refit, chains = judge(findings(k=0.9, **ITERATED)).remedies
    assert "lfm-ppl fit well --iterations 3" in refit and "check RESULT --correct" in chains
    weights, refit = judge(findings(shift=0.3, shift_se=0.05, **ITERATED)).remedies
    assert "--correct" in weights and "--iterations 3" in refit
    assert judge(findings()).remedies == ()


def relaxation(times, y=None):
    """Linear, one state with noise: the Gaussian filter is exact."""
    rate = numpyro.sample("rate", dist.LogNormal(-0.5, 0.5))
    numpyro.deterministic("half_life", jnp.log(2.0) / rate)
    system = lfm.LatentForceModel(
        lambda x, u, t: -rate * x, {}, lfm.GaussianObservation(lambda x, u, t: x, 0.1 * jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.array([[0.7]]))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=3), obs=y)


def well(times, y=None, noise=0.5):
    """A double well, far from linear."""
    depth = numpyro.sample("depth", dist.LogNormal(0.0, 0.4))
    system = lfm.LatentForceModel(
        lambda x, u, t: depth * (x - x**3), {}, lfm.GaussianObservation(lambda x, u, t: x, noise**2 * jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.array([[0.7]]))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=10), obs=y)


def fitted(model, **keywords):
    return lfm.fit(model, TIMES, Y, sampler="map", samples=400, trajectory_draws=10, progress=False, **keywords)


@pytest.fixture(scope="module")
def linear():
    return fitted(relaxation)


@pytest.fixture(scope="module")
def bent():
    return fitted(well, truth={"parameters": {"depth": 1.0}})


@pytest.fixture(scope="module")
def checked(bent):
    """The double well against the grid."""
    return bent, check_accuracy(bent, well, draws=100, progress=False)


def test_a_linear_model_needs_no_reference(linear):
    report = check_accuracy(linear, relaxation, progress=False)
    assert report.exact and report.verdict.word == "trust"
    assert np.all(report.log_ratio == 0.0)
    assert np.all(report.table[["shift", "shift_se"]] == 0.0)
    assert np.abs(report.step_change).max() < 1e-8


@pytest.mark.slow
def test_ratios_of_a_linear_model_are_zero_on_the_grid(linear):
    report = check_accuracy(linear, relaxation, reference="grid", draws=40, progress=False)
    assert np.abs(report.log_ratio).max() < 2 * log_likelihoods.GRID_ERROR
    assert report.verdict.word == "trust" and "grid" in report.reference
    assert report.table["shift"].abs().max() < 0.01
    assert set(report.table.index) == {"rate", "half_life"}


@pytest.mark.thorough
def test_ratios_of_a_linear_model_are_zero_up_to_the_noise_of_particles(linear):
    report = check_accuracy(linear, relaxation, reference="particles", draws=60, particles=200, seed=1, progress=False)
    z = report.log_ratio / np.sqrt((report.dataset["noise_sd"].values ** 2).mean())
    assert abs(z.mean()) < 0.5 + 0.5 * report.noise_sd  # 60 draws; the log of a mean is low by half its variance
    assert 0.7 < z.std() < 1.4, z.std()
    assert 0.5 < report.noise_share <= 1.0
    assert report.verdict.word != "corrected"


@pytest.mark.slow
def test_particles_and_grid_agree(bent):
    result, exact = bent, check_accuracy(bent, well, draws=400, progress=False)
    copy = arviz_data.build({"posterior": ResultView.of(result).posterior,
                             "data": ResultView.of(result).group("data")},
                            ResultView.of(result).attrs)
    noisy = check_accuracy(copy, well, reference="particles", draws=400, particles=300, progress=False)
    np.testing.assert_array_equal(noisy.dataset["draw"], exact.dataset["draw"])
    difference = noisy.log_ratio - exact.log_ratio
    assert 0.02 < noisy.noise_sd < 0.1
    # The log of a mean is low by half its variance; 400 draws.
    bound = log_likelihoods.GRID_ERROR + 0.5 * noisy.noise_sd**2 + 4 * noisy.noise_sd / np.sqrt(400)
    assert abs(difference.mean()) < bound
    assert abs(difference.std() / noisy.noise_sd - 1.0) < 0.2  # 4 sd / sqrt(800), and the grid's error
    rows = noisy.table.loc["depth"], exact.table.loc["depth"]
    assert abs(rows[0]["shift"] - rows[1]["shift"]) < 4 * rows[0]["shift_se"]


@pytest.mark.slow
def test_the_corrected_posterior_is_the_exact_one_on_a_grid_of_parameters(bent):
    """Importance weights from draws of the wrong posterior against quadrature with the exact likelihood."""
    single_pass = lfm.approximate(well, iterations=0)
    result = arviz_data.build({name: ResultView.of(bent).group(name) for name in ("posterior", "data")}, {})
    problem = rebuilding.problem(result, single_pass)
    nodes = np.linspace(0.15, 5.0, 60)
    posteriors = {}
    at_nodes = replace(problem, draws={"depth": nodes})
    prior = np.asarray(dist.LogNormal(0.0, 0.4).log_prob(nodes))
    exact = log_likelihoods.on_grid(at_nodes, log_likelihoods.ReferenceSettings("grid", None, 1)).estimates[:, 0, 0]
    wrong = log_likelihoods.gaussian(at_nodes)
    for name, log in (("exact", exact), ("wrong", wrong)):
        density = np.exp(log + prior - (log + prior).max())
        density /= density.sum()
        mean = density @ nodes
        posteriors[name] = density, mean, np.sqrt(density @ (nodes - mean) ** 2)
    # 4 chains of independent draws from the wrong posterior, by inversion between the nodes.
    cumulative = np.cumsum(posteriors["wrong"][0]) - 0.5 * posteriors["wrong"][0]
    draws = np.interp(np.random.default_rng(0).uniform(size=(4, 100)), cumulative, nodes)
    replaced = arviz_data.build({"posterior": xr.Dataset({"depth": (("chain", "draw"), draws)}),
                                 "data": ResultView.of(result).group("data")}, {"sampler": "nuts"})
    report = check_accuracy(replaced, single_pass, draws=400, progress=False)
    row = report.table.loc["depth"]
    assert report.reliable
    assert abs(posteriors["exact"][1] - posteriors["wrong"][1]) > 0.15 * posteriors["wrong"][2]
    assert abs(row["corrected_mean"] - posteriors["exact"][1]) < 3.5 * row["corrected_mean_se"] + 0.01
    assert abs(row["corrected_sd"] / row["sd"] - posteriors["exact"][2] / posteriors["wrong"][2]) \
        < 3.5 * row["sd_ratio_se"] + 0.02
    corrected = correct_posterior(replaced, single_pass)
    depths = ResultView.of(corrected).posterior["depth"].values
    assert depths.shape == (4, 100) and set(depths.ravel()) <= set(draws.ravel())
    assert abs(depths.mean() - posteriors["exact"][1]) < 4 * posteriors["exact"][2] / np.sqrt(report.ess)
    assert ResultView.of(corrected).attrs["sampler"] == "nuts + importance resampling"


@pytest.mark.thorough
def test_the_report_survives_the_file(checked, tmp_path):
    result, report = checked
    path = arviz_data.save(result, tmp_path / "posterior.nc")
    loaded = AccuracyReport.of(arviz_data.load(path))
    xr.testing.assert_identical(report.to_dataset(), loaded.to_dataset())
    assert str(loaded) == str(report) and loaded.verdict == report.verdict
    assert loaded.table.equals(report.table)


@pytest.mark.thorough
def test_densities_keep_to_the_support_and_their_mass_and_are_dashed_where_unreliable(checked):
    result, report = checked
    draws = np.abs(np.random.default_rng(0).normal(size=(1, 6000)))  # half a normal: densest at the end of its support
    indices = np.arange(0, 6000, 6000 // report.log_weight.size)[:report.log_weight.size]
    for k, dashed in ((0.1, False), (2.0, True)):
        stored = report.to_dataset().assign_attrs(pareto_k=k).assign_coords(draw=indices)
        posterior = xr.Dataset({"depth": (("chain", "draw"), draws)}, {"chain": [0], "draw": np.arange(6000)})
        axes = plot_accuracy(arviz_data.build({"posterior": posterior, "accuracy": stored})).axes[1]
        (band,) = axes.collections
        x, y = band.get_paths()[0].vertices.T
        assert x.min() >= 0.0
        top = {edge: y[x == edge].max() for edge in np.unique(x)}
        grid, density = np.array(list(top)), np.array(list(top.values()))
        np.testing.assert_allclose(np.trapezoid(density, grid), 1.0, atol=0.02)
        index = np.searchsorted(grid, 0.1)
        np.testing.assert_allclose(density[index], 2 * stats.norm.pdf(0.1), rtol=0.1)
        (corrected,) = [line for line in axes.lines if line.get_linestyle() != "None" and len(line.get_xdata()) > 2]
        assert corrected.is_dashed() is dashed
        assert corrected.get_xdata().min() >= 0.0


@pytest.mark.thorough
def test_correction_keeps_data_truth_and_the_layout_of_trajectories(checked):
    result, report = checked
    assert report.reliable
    corrected = correct_posterior(result, well, trajectory_draws=6)
    old, new = (ResultView.of(source).group("trajectories") for source in (result, corrected))
    assert new["states"].dims == old["states"].dims and new["states"].shape == (1, 6, *old["states"].shape[2:])
    np.testing.assert_array_equal(new["time"], old["time"])
    chains, draws = (ResultView.of(corrected).posterior.sizes[name] for name in ("chain", "draw"))
    for name in ("log_likelihood", "posterior_predictive"):
        assert ResultView.of(corrected).group(name)["y"].shape[:2] == (chains, draws)
    assert {"data", "truth"} <= set(ResultView.of(corrected).groups)
    assert "states_summary" in new  # of the corrected draws, where the result has none


@pytest.mark.slow
def test_a_panel_is_the_sum_of_its_series():
    def build(p):
        return lfm.LatentForceModel(
            lambda x, u, t: p["rate"] * (x - x**3), {},
            lfm.GaussianObservation(lambda x, u, t: x, 0.1 * jnp.ones(1)),
            lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.array([[0.7]]))

    def panel(times, y=None):
        rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.3))
        with numpyro.plate("series", 2):
            numpyro.sample("y", lfm.panel(build, {"rate": jnp.repeat(rate, 2)}, times, steps=5), obs=y)

    def single(times, y=None):
        rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.3))
        numpyro.sample("y", lfm.MarginalLikelihood(build({"rate": rate}), times, steps=5), obs=y)

    draws = xr.Dataset({"rate": (("chain", "draw"), np.linspace(0.5, 1.5, 8).reshape(2, 4))})
    result = arviz_data.build({"posterior": draws})

    def run(model, y, **keywords):
        return check_accuracy(
            result, model, TIMES, y, draws=8, progress=False, **keywords)

    alone, together = run(single, Y), run(panel, np.stack([Y, Y]))
    np.testing.assert_allclose(together.log_ratio, 2 * alone.log_ratio, atol=4 * log_likelihoods.GRID_ERROR)
    particles = run(panel, np.stack([Y, Y]), reference="particles", particles=1000)
    assert np.abs(particles.log_ratio - together.log_ratio).max() < 5 * particles.noise_sd + 0.02


@pytest.mark.thorough
def test_enough_particles_are_found(bent):
    """The pilot raises the number until the noise is below its target."""
    problem = rebuilding.problem(bent, well).select(np.arange(0, 400, 25))
    settings = log_likelihoods.ReferenceSettings("particles", None, 2)

    def noise(e):
        return accuracy_check.noise(importance_weights.average(e))

    result = log_likelihoods.by_particles(problem, settings, noise, 0.02, 1e12)
    assert result.particles > 1000 and not result.limited
    assert noise(result.estimates) < 0.03
    limited = log_likelihoods.by_particles(problem, settings, noise, 0.001, 1e6)
    assert limited.particles == 1000 and limited.limited


@pytest.mark.thorough
def test_more_particles_are_run_only_until_the_verdict_is_settled(bent, monkeypatch):
    problem = rebuilding.problem(bent, well).select(np.arange(0, 400, 50))
    settings = log_likelihoods.ReferenceSettings("particles", None, 2)
    monkeypatch.setattr(log_likelihoods, "_FIRST_WORK", 1.0)
    shapes, answers = [], iter([False, True])

    def is_settled(estimates):
        shapes.append(estimates.shape)
        return next(answers)

    result = log_likelihoods.by_particles(problem, settings, lambda estimates: 3.0, 0.3, 1e12, is_settled)
    assert result.particles == 4000 and not result.limited and shapes == [(8, 1, 2)] * 2


def test_replicates_of_each_series_are_averaged_apart():
    likelihood = np.array([[[1.0, 3.0], [2.0, 6.0]]])  # one draw, two series, two replicates
    averaged = accuracy_check._summed(np.log(likelihood))
    np.testing.assert_allclose(averaged.log_mean, np.log(2.0 * 4.0))
    parts = importance_weights.average(np.log(likelihood[0]))
    np.testing.assert_allclose(averaged.variance, parts.variance.sum())


@pytest.mark.thorough
@pytest.mark.parametrize(("changes", "name"), [
    ({"reference": "exact"}, "reference"), ({"draws": 0}, "draws"), ({"particles": 0}, "particles"),
    ({"replicates": 1}, "replicates"), ({"steps": 0}, "steps"), ({"y": Y[:3]}, "y"),
    ({"model_kwargs": {"noise": 0.3}}, "log likelihoods"), ({"y": 2 * Y}, "log likelihoods"),
])
def test_mistakes(bent, changes, name):
    with pytest.raises((ValueError, TypeError), match=name):
        check_accuracy(bent, well, progress=False, **changes)


@pytest.mark.thorough
def test_mistakes_about_the_result(bent, linear):
    posterior, observed = (ResultView.of(bent).group(name) for name in ("posterior", "data"))
    for groups, attrs, model, name in (
            ({}, {}, well, "data"), ({"data": observed}, {}, relaxation, "rate"),
            ({}, {"sampler": "pmmh"}, well, "pmmh"), ({}, {"sampler": "hmc"}, well, "hmc")):
        with pytest.raises(ValueError, match=name):
            check_accuracy(arviz_data.build({"posterior": posterior, **groups}, attrs), model)
    with pytest.raises(ValueError, match="steps"):
        check_accuracy(bent, relaxation)
    with pytest.raises(ValueError, match="accuracy"):
        AccuracyReport.of(arviz_data.build({"posterior": posterior}))


def test_the_grid_takes_one_state(linear):
    def driven(times, y=None):
        rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.3))
        system = lfm.LatentForceModel(
            lambda x, u, t: u - rate * x**3, {"u": lfm.Matern(1.0, 1.0)},
            lfm.GaussianObservation(lambda x, u, t: x, jnp.ones(1)), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)

    draws = arviz_data.build({"posterior": ResultView.of(linear).posterior})
    with pytest.raises(ValueError, match="reference"):
        check_accuracy(draws, driven, TIMES, Y, reference="grid")


@pytest.mark.slow
def test_fixed_parameters_stay_fixed():
    def model(times, y=None):
        depth = numpyro.sample("depth", dist.LogNormal(0.0, 0.4))
        sd = numpyro.sample("sd", dist.LogNormal(-1.0, 0.4))
        system = lfm.LatentForceModel(
            lambda x, u, t: depth * (x - x**3), {}, lfm.GaussianObservation(lambda x, u, t: x, sd**2 * jnp.ones(1)),
            lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.array([[0.7]]))
        numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=10), obs=y)

    result = fitted(model, fixed={"sd": 0.3})
    report = check_accuracy(result, model, reference="particles", particles=50, draws=8, progress=False)
    assert list(report.table.index) == ["depth"]


def test_the_grid_is_not_for_models_with_events():
    model = lfm.LatentForceModel(
        lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1), events=[lfm.Dose([1.0], 1.0, "x0")])
    assert accuracy_check._kind("auto", state_space(model)) == "particles"
    with pytest.raises(ValueError, match="events"):
        accuracy_check._kind("grid", state_space(model))
    with pytest.raises(ValueError, match="events"):
        lfm.fokker_planck(model, np.arange(3.0), np.ones((3, 1)))
