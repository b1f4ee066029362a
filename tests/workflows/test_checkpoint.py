"""Runs that are stopped, killed and gone on with give the draws of runs that are not."""

import functools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.cli import main
from lfm_ppl.inference import sampling
from lfm_ppl.inference.long_steps import EXPONENTIAL
from lfm_ppl.inference.samplers import SAMPLERS
from lfm_ppl.inference.tuning import ANCHOR
from lfm_ppl.results import arviz_data
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.storage import checkpoint as checkpoints
from lfm_ppl.storage import run_record
from lfm_ppl.storage.checkpoint import Checkpoint
from lfm_ppl.utils.progress import Progress
from tests.processes import ROOT

TIMES = np.arange(4.0)
Y = np.array([[0.3], [0.9], [np.nan], [-0.8]])
SIZES = {"chains": 2, "warmup": 8, "samples": 6, "trajectory_draws": 4, "at": [0.5, 4.0], "chain_method": "vectorized"}
OPTIONS = {"pmmh": {"particles": 10}}


def relaxation(times, y=None, width=0.3):
    """Linear, so that little is compiled; its process noise is unknown."""
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, width))
    system = lfm.LatentForceModel(
        lambda x, u, t: -x, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        lfm.Gaussian(jnp.array([0.5]), jnp.array([[0.2]])), process_noise=noise * jnp.eye(1))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=1), obs=y)


def bent(times, y=None):
    """Not linear, so that the iterations of its likelihood start at the mode."""
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    system = lfm.LatentForceModel(
        lambda x, u, t: -x - 0.2 * x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        lfm.Gaussian(jnp.array([0.5]), jnp.array([[0.2]])), process_noise=noise * jnp.eye(1))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=1), obs=y)


def settling(times, y=None):
    """Follow another state within half an explicit step of the default, so that steps are exponential."""
    growth = numpyro.sample("growth", dist.LogNormal(-0.5, 0.3))
    system = lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([growth * x[0] * (1.0 - x[0]), 20.0 * (x[0]**2 - x[1])]), {},
        lfm.GaussianObservation(lambda x, u, t: x[1:], jnp.array([0.3])),
        lfm.Gaussian(jnp.array([0.5, 0.25]), 0.01 * jnp.eye(2)))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def fit(sampler, **changes):
    settings = {"sampler_options": OPTIONS.get(sampler), **SIZES, **changes}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return lfm.fit(settings.pop("model", relaxation), settings.pop("times", TIMES), settings.pop("y", Y),
                       sampler=sampler, progress=False, **settings)


def assert_same(result, expected):
    """All groups are equal to the last bit, and so is what is said of them, but for times."""
    assert set(ResultView.of(result).groups) == set(ResultView.of(expected).groups)
    for name in ResultView.of(expected).groups:
        xr.testing.assert_identical(ResultView.of(result).group(name), ResultView.of(expected).group(name))
    ours, theirs = ResultView.of(result).attrs, ResultView.of(expected).attrs
    for attrs in (ours, theirs):
        for name in ("wall_time_s", "created_at", "run"):
            attrs.pop(name, None)
    assert ours == theirs


@pytest.fixture(autouse=True)
def many_small_blocks(monkeypatch):
    """Blocks of a step, each of them on disk."""
    monkeypatch.setattr(sampling, "BLOCK_S", 0.0)
    monkeypatch.setattr(checkpoints, "_EVERY_S", 0.0)


@pytest.fixture
def stop_after(monkeypatch):
    """Send SIGINT when so many draws are on disk; the handler is Python's, as in a program."""
    monkeypatch.setattr(signal, "default_int_handler", signal.getsignal(signal.SIGINT))

    def set_up(draws, steps=0):
        save = Checkpoint.save

        def stopping(self, saved, count):
            save(self, saved, count)
            if count >= draws and saved.done >= steps:
                monkeypatch.setattr(Checkpoint, "save", save)
                signal.raise_signal(signal.SIGINT)

        monkeypatch.setattr(Checkpoint, "save", stopping)

    return set_up


@pytest.fixture(scope="module")
def full_run():
    """Results of runs that nobody stops and nothing keeps, in blocks as long as they like."""
    return functools.cache(fit)


@pytest.mark.parametrize(("sampler", "model"), [
    pytest.param("nuts", relaxation, marks=pytest.mark.thorough), ("ram", relaxation),
    pytest.param("nuts", bent, marks=pytest.mark.slow), pytest.param("nuts", settling, marks=pytest.mark.slow),
    pytest.param("pmmh", relaxation, marks=pytest.mark.slow)])
def test_a_run_that_is_stopped_goes_on_to_the_same_draws(sampler, model, full_run, tmp_path, stop_after):
    expected = full_run(sampler, model=model)
    assert (ANCHOR in ResultView.of(expected).attrs) == (model is not relaxation)
    assert (EXPONENTIAL in ResultView.of(expected).attrs) == (model is settling)
    stop_after(0, steps=3)
    with pytest.raises(KeyboardInterrupt, match="warm-up"):
        fit(sampler, model=model, checkpoint=tmp_path / "run")
    stop_after(3)
    partial = fit(sampler, model=model, checkpoint=tmp_path / "run", resume=True)
    note = ResultView.of(partial).attrs["partial"]
    count = ResultView.of(partial).posterior.sizes["draw"]
    assert 3 <= count < 6 and note.startswith(f"{count} of 6 draws")
    for name in ("posterior", "sample_stats"):
        xr.testing.assert_identical(ResultView.of(partial).group(name),
                                    ResultView.of(expected).group(name).isel(draw=slice(count)))
    assert_same(lfm.load(tmp_path / "run"), partial)
    assert arviz_data.summary(partial)["partial"].str.startswith(f"{count} of 6 draws").all()
    assert_same(fit(sampler, model=model, checkpoint=tmp_path / "run", resume=True), expected)
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["posterior.nc"]
    assert "partial" not in arviz_data.summary(expected)


@pytest.mark.thorough
def test_a_stop_after_sampling_costs_no_draw(full_run, tmp_path, monkeypatch):
    sampler = "ram"

    def stop(*arguments, lower=False, **keywords):
        if not lower:
            raise KeyboardInterrupt
        raise ValueError("what cannot be compiled ahead changes nothing")

    with monkeypatch.context() as patch:
        patch.setattr("lfm_ppl.workflows.fit_results.trajectories", stop)
        partial = fit(sampler, checkpoint=tmp_path)
    note = ResultView.of(partial).attrs["partial"]
    assert "trajectories" in note
    assert "log_likelihood" in ResultView.of(partial).groups and "trajectories" not in ResultView.of(partial).groups
    xr.testing.assert_identical(ResultView.of(partial).posterior, ResultView.of(full_run(sampler)).posterior)
    # Nothing is searched or sampled again.
    for module in ("workflows.posterior_draws", "workflows.fit_starts", "inference.laplace_start"):
        monkeypatch.setattr(f"lfm_ppl.{module}.mode_of", stop)
    assert_same(fit(sampler, checkpoint=tmp_path, resume=True), full_run(sampler))


@pytest.mark.thorough
def test_a_run_that_nothing_keeps_gives_what_it_has(full_run, monkeypatch):
    monkeypatch.setattr(signal, "default_int_handler", signal.getsignal(signal.SIGINT))
    adapt = sampling._BlockLength.adapt
    calls = []

    def stopping(self, seconds):
        adapt(self, seconds)
        calls.append(seconds)
        if len(calls) == 11:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(sampling._BlockLength, "adapt", stopping)
    with pytest.raises(KeyboardInterrupt, match="3 of 6 draws") as raised:
        fit("nuts")
    assert ResultView.of(raised.value.result).attrs["partial"].startswith("3 of 6 draws")
    np.testing.assert_array_equal(ResultView.of(raised.value.result).posterior["noise"],
                                  ResultView.of(full_run("nuts")).posterior["noise"][:, :3])


# Refusals


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    """A folder with a run that was stopped."""
    folder = tmp_path_factory.mktemp("unfinished") / "run"
    checkpoint_save = Checkpoint.save

    def stop(self, saved, draws):
        checkpoint_save(self, saved, draws)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Checkpoint, "save", stop)
        with pytest.raises(KeyboardInterrupt):
            fit("ram", checkpoint=folder)
    assert (folder / "checkpoint" / "state.npz").is_file()
    return folder


def wider(times, y=None):
    relaxation(times, y, width=0.4)


@pytest.mark.parametrize(("changes", "name"), [
    ({"seed": 3}, "seed"), ({"samples": 7, "thin": 2}, "thin"), ({"y": Y + 1.0}, "data"),
    ({"times": TIMES + 0.5}, "times"), ({"model": wider}, "model"), ({"at": [0.5, 4.5]}, "trajectories"),
    ({"sampler_options": {"target_accept_prob": 0.5}}, "target_accept_prob"),
    ({"chain_method": "sequential"}, "chain_method"), ({"init": "map"}, "init"),
    ({"model": lfm.approximate(relaxation, steps=2)}, "steps"),
])
def test_another_run_is_not_resumed(unfinished, changes, name):
    initial_contents = {path: path.read_bytes() for path in unfinished.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=f"differs.*{name}"):
        fit("ram", checkpoint=unfinished, resume=True, **changes)
    assert {path: path.read_bytes() for path in unfinished.rglob("*") if path.is_file()} == initial_contents


@pytest.mark.thorough
def test_a_run_of_other_versions_or_in_use_is_not_resumed(unfinished, monkeypatch):
    first = Checkpoint.resume(unfinished, json.loads((unfinished / "checkpoint" / "run.json").read_text()))
    with pytest.raises(RuntimeError, match="in use"):
        fit("ram", checkpoint=unfinished, resume=True)
    first.close()
    versions = run_record.versions() | {"jax": "0.1"}
    monkeypatch.setattr(run_record, "versions", lambda: versions)
    with pytest.raises(ValueError, match="jax"):
        fit("ram", checkpoint=unfinished, resume=True)


@pytest.mark.thorough
def test_a_finished_run_is_read(full_run, tmp_path, monkeypatch):
    expected = full_run("ram")
    fit("ram", checkpoint=tmp_path)
    initial_stat = (tmp_path / "posterior.nc").stat()
    monkeypatch.setattr(sampling, "run_chains", lambda *arguments: pytest.fail("it was sampled"))
    assert_same(fit("ram", checkpoint=tmp_path, resume=True), expected)
    assert (tmp_path / "posterior.nc").stat().st_mtime_ns == initial_stat.st_mtime_ns
    with pytest.raises(ValueError, match="seed"):
        fit("ram", checkpoint=tmp_path, resume=True, seed=1)
    with pytest.raises(FileExistsError):
        fit("ram", checkpoint=tmp_path)


def test_folders_that_cannot_be_used(unfinished, tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    for keywords, error, name in (
            ({"resume": True}, ValueError, "folder"), ({"checkpoint": unfinished}, FileExistsError, ""),
            ({"checkpoint": tmp_path, "resume": True}, FileNotFoundError, ""),
            ({"checkpoint": tmp_path / "mine.txt"}, FileExistsError, "mine.txt")):
        with pytest.raises(error, match=name):
            fit("ram", **keywords)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.thorough
def test_nothing_is_left_where_nothing_was_sampled(tmp_path, monkeypatch):
    def stop(*arguments, **keywords):
        raise KeyboardInterrupt

    monkeypatch.setattr("lfm_ppl.workflows.fit_starts.mode_of", stop)
    with pytest.raises(KeyboardInterrupt):
        fit("ram", checkpoint=tmp_path)
    assert not list(tmp_path.iterdir())


# Accuracy


@pytest.mark.thorough
def test_a_check_goes_on_where_it_was_stopped(full_run, tmp_path, monkeypatch):
    result = full_run("map")
    monkeypatch.setattr("lfm_ppl.inference.draw_batches._SEQUENTIAL_BATCH", 2)

    def check(**more):
        return lfm.check_accuracy(
            result, relaxation, reference="particles", particles=20, draws=6, progress=False, **more).dataset

    expected = check()

    def stopping(self, done):
        if done >= 4 and self._label.startswith("particle filter"):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "advance", stopping)
        with pytest.raises(KeyboardInterrupt):
            check(checkpoint=tmp_path)
    put = checkpoints.Batches.put
    batch_starts = []

    def record_and_put(self, start, batch):
        batch_starts.append(start)
        put(self, start, batch)

    monkeypatch.setattr(checkpoints.Batches, "put", record_and_put)
    xr.testing.assert_identical(check(checkpoint=tmp_path, resume=True), expected)
    assert batch_starts == [4], "the first draws were not worked again"


# Progress


@pytest.mark.thorough
def test_where_there_is_no_terminal_lines_say_how_far_it_is(capfd, monkeypatch):
    monkeypatch.setattr("lfm_ppl.utils.progress.EVERY_S", 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lfm.fit(relaxation, TIMES, Y, sampler="nuts", **SIZES)
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("sampling: ")]
    assert "14 of 14 steps" in lines[-1] and "acceptance" in lines[-1]


def test_the_time_left_is_that_at_the_pace_of_the_last_minute(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    monkeypatch.setattr("lfm_ppl.utils.progress.EVERY_S", 0.0)
    lines: list[str] = []
    with Progress(lines.append, 1000, "steps", "sampling") as progress:
        progress.compile("compiling")
        for done in range(1, 1001):
            clock[0] += 10.0 if done <= 100 else 1.0
            progress.advance(done, "words")
    assert "2.5 h" in lines[99 - 1]  # 901 steps of 10 s
    assert "13 min" in lines[200 - 1]  # 800 steps of 1 s: the slow ones are forgotten


# The command line

MODEL = '''"""A relaxation."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("x",)


def model(times, y=None):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    system = lfm.LatentForceModel(
        lambda x, u, t: -x, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        lfm.Gaussian(jnp.array([0.5]), jnp.array([[0.2]])), process_noise=noise * jnp.eye(1))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=1), obs=y)


def simulate(seed=0):
    return lfm.Data(np.arange(4.0), np.array([[0.3], [0.9], [np.nan], [-0.8]]), OUTPUTS)
'''


def start(folder, *words):
    """Begin `lfm-ppl fit` in a process of its own."""
    (folder / "relaxation.py").write_text(MODEL)
    # Shells start what is in the background deaf to Ctrl-C, and so the tests, if they are.
    code = ("import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
            "from lfm_ppl.cli import main; sys.exit(main(sys.argv[1:]))")
    command = [sys.executable, "-c", code, "fit", "relaxation.py", "--quiet", "--chains", "2", "--out", "run", *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    if (cache := jax.config.jax_compilation_cache_dir) is not None:
        environment["JAX_COMPILATION_CACHE_DIR"] = cache
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                            text=True)


def count_draws(folder):
    """Return how many draws are on disk."""
    try:
        with np.load(folder / "run" / "checkpoint" / "state.npz") as file:
            return int(file["draws"])
    except OSError:
        return 0


RUN = ("--sampler", "ram", "--warmup", "10", "--samples", "1000000", "--thin", "50")


def stopped(folder):
    """Run chains that would take hours, and stop them when there are draws: the process, what it said, seconds."""
    process = start(folder, *RUN)
    until = time.monotonic() + 200
    while not count_draws(folder) and process.poll() is None and time.monotonic() < until:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    sent = time.monotonic()
    out, _ = process.communicate(timeout=200)
    return process, out, time.monotonic() - sent


@pytest.mark.slow
def test_ctrl_c_leaves_a_usable_result_within_ten_seconds(tmp_path):
    process, out, seconds = stopped(tmp_path)
    assert process.returncode == 130 and seconds < 10, out
    result = lfm.load(tmp_path / "run")
    count = ResultView.of(result).posterior.sizes["draw"]
    assert 0 < count < 1000000
    for text in (ResultView.of(result).attrs["partial"], out, (tmp_path / "run" / "summary.csv").read_text()):
        assert f"{count} of 1000000 draws" in text


@pytest.mark.thorough
def test_a_finished_run_is_left_alone_by_the_command(tmp_path, monkeypatch):
    (tmp_path / "relaxation.py").write_text(MODEL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lfm_ppl.plots.save_figures", lambda *arguments, **keywords: [])
    line = ["fit", "relaxation.py", "--sampler", "map", "--samples", "8", "--quiet", "--out", "run"]
    assert main(line) == 0
    modification_times = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").iterdir()}
    assert main([*line, "--resume"]) == 0
    for words in ([*line, "--resume", "--seed", "2"], [*line, "--resume", "--overwrite"], line,
                  [*line[:-2], "--resume"]):
        assert main(words) == 2
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "run").iterdir()} == modification_times


KILLS = 3
"""Of each sampler."""

TO_KILL = {
    "nuts": ["--warmup", "200", "--samples", "400", "--thin", "4"],
    "ram": ["--warmup", "200", "--samples", "400", "--thin", "60"],
    "pmmh": ["--warmup", "200", "--samples", "400", "--thin", "4", "--particles", "100"],
    "map": ["--samples", "4000"],
}


@pytest.fixture(scope="module")
def unkilled(tmp_path_factory):
    """Sampler -> a folder, the result there of a run that nobody kills, and the seconds that it takes."""

    def run(sampler):
        folder = tmp_path_factory.mktemp(sampler)
        begin = time.monotonic()
        process = start(folder, "--sampler", sampler, *TO_KILL[sampler])
        out, _ = process.communicate(timeout=600)
        assert process.returncode == 0, out
        return folder, lfm.load(folder / "run"), time.monotonic() - begin

    return functools.cache(run)


@pytest.mark.slow
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_killed_at_any_moment_it_goes_on_to_the_same_draws(sampler, unkilled):
    folder, expected, duration = unkilled(sampler)
    kills = KILLS
    chance = random.Random(sampler)
    while kills > 0:
        shutil.rmtree(folder / "run", ignore_errors=True)
        resume = []
        while True:
            process = start(folder, "--sampler", sampler, *TO_KILL[sampler], *resume)
            try:
                out, _ = process.communicate(timeout=chance.uniform(0.0, 1.1 * duration) if kills > 0 else 600)
            except subprocess.TimeoutExpired:
                stored_count = count_draws(folder)
                process.kill()
                process.communicate()
                kills -= 1
                assert count_draws(folder) >= stored_count
                for path in (folder / "run").glob("posterior.nc"):
                    lfm.load(path)  # it is whole, whenever the process was killed
                resume = ["--resume"]
                continue
            assert process.returncode == 0, out
            break
        assert_same(lfm.load(folder / "run"), expected)
        assert not (folder / "run" / "checkpoint").exists()
