"""Tasks that are stored one by one: the same numbers wherever they run, and resumed after every interruption."""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from lfm_ppl.parallel import cluster
from lfm_ppl.parallel.cluster import start_workers
from lfm_ppl.parallel.errors import ClusterError, TasksFailedError
from lfm_ppl.parallel.run import outcomes, run_tasks
from lfm_ppl.parallel.task import Task
from lfm_ppl.utils.errors import FolderInUseError
from lfm_ppl.utils.progress import Console, TaskProgress
from tests.processes import ROOT, is_running, start_python, wait_until


@pytest.fixture(scope="module")
def workers():
    """Two worker processes, for all tests of this file."""
    with start_workers(2) as running:
        yield running


def tasks(count=4, **settings):
    return [Task(f"noise/{index:03d}", 7, {"size": 3, **settings}) for index in range(count)]


def noise(task):
    draws = np.asarray(jax.random.normal(task.key, (task.settings["size"],)))
    return {"mean": draws.mean(), "draws": draws, "label": "normal", "count": 3, "flag": True}


def record_noise(task):
    """Write process and task to a log, and compute the noise."""
    with open(task.settings["log"], "a") as log:
        log.write(f"{os.getpid()} {task.name}\n")
    time.sleep(task.settings.get("seconds", 0.0))
    if task.name == task.settings.get("failing"):
        raise ValueError("this one fails")
    return noise(task)


def read_log(folder):
    """Return (process, task) of every computation of `record_noise`, in the order of time."""
    return [line.split() for line in (folder / "log").read_text().splitlines()] if (folder / "log").exists() else []


def assert_same(first, second):
    assert first.keys() == second.keys()
    for name, result in first.items():
        assert result.keys() == second[name].keys()
        for entry, value in result.items():
            np.testing.assert_array_equal(value, second[name][entry], strict=True)


def test_an_interrupted_run_keeps_its_results_and_resumes_with_the_rest(tmp_path):
    running = outcomes(tasks(log=f"{tmp_path}/log"), record_noise, tmp_path)
    assert [next(running).task.name for _ in range(2)] == ["noise/000", "noise/001"]
    with pytest.raises(FolderInUseError, match=rf"process {os.getpid()} on "):
        run_tasks(tasks(), noise, tmp_path)
    running.close()
    assert sorted(path.name for path in tmp_path.glob("[!.]*.npz")) == ["noise-000.npz", "noise-001.npz"]
    result = run_tasks(tasks(log=f"{tmp_path}/log"), record_noise, tmp_path)
    assert [name for _, name in read_log(tmp_path)] == list(result)
    assert_same(result, run_tasks(tasks(), noise, None))
    assert result["noise/000"]["label"] == "normal" and result["noise/000"]["flag"] is True
    assert len({entries["mean"] for entries in result.values()}) == 4


def test_several_processes_compute_the_same_numbers_in_any_order(tmp_path, workers):
    expected, lines = run_tasks(tasks(), noise, None), []
    assert_same(expected, run_tasks(tasks(), noise, tmp_path, workers=workers, report=lines.append))
    assert lines[0].startswith("dashboard http") and lines[-1].startswith("computed: 4 of 4 tasks, noise/00")
    backward = run_tasks(tasks()[::-1], noise, None, workers=workers)
    assert list(backward) == list(expected)[::-1]
    assert_same({name: backward[name] for name in expected}, expected)


def describe_process(task):
    time.sleep(0.2)
    variables = "PJRT_NPROC", "OMP_NUM_THREADS", "XLA_PYTHON_CLIENT_PREALLOCATE"
    return {"process": os.getpid(), "cache": str(jax.config.jax_compilation_cache_dir),
            "environment": " ".join(os.environ[name] for name in variables)}


@pytest.mark.thorough
def test_workers_have_one_thread_and_share_the_cache_of_compiled_programs(workers):
    processes = run_tasks(tasks(8), describe_process, None, workers=workers).values()
    assert len({process["process"] for process in processes} - {os.getpid()}) == 2
    assert {process["environment"] for process in processes} == {"1 1 false"}
    assert {process["cache"] for process in processes} == {str(jax.config.jax_compilation_cache_dir)}


@pytest.mark.slow
def test_workers_share_a_temporary_cache_where_there_is_none():
    folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        processes = run_tasks(tasks(4), describe_process, None, workers=2).values()
    finally:
        jax.config.update("jax_compilation_cache_dir", folder)
    (cache,) = {process["cache"] for process in processes}
    assert "lfm-ppl-" in cache and not Path(cache).exists()


@pytest.mark.parametrize("attempts", [1, 2], ids=["here", "workers"])
def test_a_failed_task_is_named_and_does_not_stop_the_others(tmp_path, workers, attempts):
    lines, several = [], tasks(log=f"{tmp_path}/log", failing="noise/001")
    with pytest.raises(TasksFailedError, match="1 of 4 tasks failed: noise/001: ValueError: this one fails") as failed:
        run_tasks(several, record_noise, tmp_path, workers=1 if attempts == 1 else workers, report=lines.append)
    assert "failed: noise/001: ValueError: this one fails" in lines
    assert list(failed.value.failed) == ["noise/001"] and isinstance(failed.value.__cause__, ValueError)
    assert len(read_log(tmp_path)) == 3 + attempts
    run_tasks(several, noise, tmp_path, report=lines.append)
    assert "3 of 4 tasks are stored already" in lines


def die(task):
    """End the process as often as the settings say."""
    for count in range(task.settings["deaths"].get(task.name, 0)):
        marker = Path(f"{task.settings['folder']}/{task.stem}-{count}")
        if not marker.exists():
            marker.touch()
            os._exit(9)
    return noise(task)


@pytest.mark.thorough
def test_a_task_whose_worker_died_is_computed_again(tmp_path, workers):
    result = run_tasks(tasks(deaths={"noise/001": 1}, folder=str(tmp_path)), die, None, workers=workers)
    assert_same(result, run_tasks(tasks(), noise, None))
    assert (tmp_path / "noise-001-0").exists()


@pytest.mark.slow
def test_a_task_that_ends_its_workers_is_named(tmp_path):
    deaths = {"noise/001": 9, "noise/002": 1}
    with pytest.raises(TasksFailedError, match="1 of 6 tasks failed: noise/001: .*workers died"):
        run_tasks(tasks(6, deaths=deaths, folder=str(tmp_path)), die, tmp_path / "out", workers=2)
    assert len(list((tmp_path / "out").glob("*.npz"))) == 5


def test_results_of_other_settings_are_refused_or_replaced(tmp_path):
    run_tasks(tasks(2), noise, tmp_path)
    with pytest.raises(ValueError, match=r"size is 3 there and 5 now.*--overwrite"):
        run_tasks(tasks(2, size=5), noise, tmp_path)
    with pytest.raises(ValueError, match="seed is 7 there and 1 now"):
        run_tasks([Task("noise/000", 1, {"size": 3})], noise, tmp_path)
    assert run_tasks(tasks(2, size=5), noise, tmp_path, overwrite=True)["noise/000"]["draws"].shape == (5,)


@pytest.mark.parametrize("damage", ["empty", "cut", "other"])
def test_a_damaged_file_is_computed_again_with_a_warning(tmp_path, damage):
    expected, path = run_tasks(tasks(2), noise, tmp_path), tmp_path / "noise-001.npz"
    if damage == "other":
        np.savez(path, x=1.0)
    else:
        path.write_bytes(path.read_bytes()[:-40] if damage == "cut" else b"")
    with pytest.warns(UserWarning, match="noise-001.npz"):
        assert_same(run_tasks(tasks(2), noise, tmp_path), expected)


@pytest.mark.parametrize("error, name, make", [
    (TasksFailedError, "model", lambda: run_tasks([Task("a", 0)], lambda task: {"model": object()}, None)),
    (TypeError, "a", lambda: Task("a", 0, {"model": object()})),
    (ValueError, "a b", lambda: Task("a b", 0)),
    (ValueError, "a-b.npz", lambda: run_tasks([Task("a/b", 0), Task("a-b", 0)], noise, None)),
    (ValueError, "workers", lambda: run_tasks(tasks(), noise, None, workers=0)),
    (ValueError, "localhost:8786", lambda: run_tasks(tasks(), noise, None, workers="localhost:8786")),
    (ClusterError, "tcp://127.0.0.1:9", lambda: run_tasks(tasks(), noise, None, workers="tcp://127.0.0.1:9")),
])
def test_malformed_tasks_and_workers(monkeypatch, error, name, make):
    monkeypatch.setattr(cluster, "_ANSWER_S", 0.5)
    with pytest.raises(error, match=name):
        make()


def test_the_time_left_follows_from_the_median_task_after_as_many_tasks_as_workers(monkeypatch):
    monkeypatch.setattr("lfm_ppl.utils.progress.EVERY_S", 0.0)
    lines = []
    with TaskProgress(lines.append, 11, 1) as progress:
        for seconds in (300.0, None, 30.0, 20.0, 30.0):
            progress.end_task("name", seconds, 2)
    assert [line.partition("name")[2] for line in lines] == [
        "", "", "; about 2 min left", "; about 90 s left", "; about 75 s left"]


def test_a_terminal_has_a_bar(monkeypatch):
    monkeypatch.setattr(screen := io.StringIO(), "isatty", lambda: True, raising=False)
    with pytest.raises(TasksFailedError):
        run_tasks(tasks(2), lambda task: {"x": object()}, None, report=Console(screen))
    assert "failed: noise/001: TypeError" in screen.getvalue() and "2/2" in screen.getvalue()


def test_one_process_needs_no_dask(monkeypatch):
    code = ("import sys; from tests.parallel.test_run import *; run_tasks(tasks(), noise, None); "
            "assert not {'dask', 'distributed'} & set(sys.modules)")
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=120, check=True)
    monkeypatch.setattr(cluster, "_HAS_DASK", False)
    assert cluster.available() == 1
    with pytest.raises(ClusterError, match=r"pip install 'lfm_ppl\[cluster\]'"):
        run_tasks(tasks(), noise, None, workers=2)


@pytest.mark.thorough
def test_a_scheduler_with_workers_that_were_started_by_hand(tmp_path, monkeypatch):
    file = tmp_path / "scheduler.json"
    processes = [start_python("-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
                              "--no-dashboard", "--scheduler-file", str(file), stderr=subprocess.DEVNULL)]
    try:
        wait_until(lambda: file.exists() and "tcp://" in file.read_text())
        address = next(word for word in file.read_text().split('"') if word.startswith("tcp://"))
        with monkeypatch.context() as patch, pytest.raises(ClusterError, match=f"{address}.*dask worker"):
            patch.setattr(cluster, "_ANSWER_S", 0.5)
            run_tasks(tasks(), noise, None, workers=address)
        processes += [start_python("-m", "distributed.cli.dask_worker", address, "--no-dashboard", "--no-nanny",
                                   "--nthreads", "1", stderr=subprocess.DEVNULL) for _ in range(2)]
        assert_same(run_tasks(tasks(), noise, None, workers=address), run_tasks(tasks(), noise, None))
        with monkeypatch.context() as patch, pytest.raises(ClusterError, match="same versions"):
            patch.setattr(cluster, "_versions", lambda: {"jax": "0.1"})
            run_tasks(tasks(), noise, None, workers=address)
        with pytest.raises(ClusterError, match="connection to the scheduler is lost"):
            for _ in outcomes(tasks(seconds=0.5, log=f"{tmp_path}/log"), record_noise, tmp_path, workers=address):
                processes[0].kill()
        assert list(tmp_path.glob("*.npz"))
    finally:
        for process in processes:
            process.kill()
            process.wait()


def start_run(folder):
    """Start a run of 300 tasks by two workers, which takes at least 45 s."""
    return start_python("-c", f"""
import jax
from tests.parallel.test_run import record_noise, run_tasks, tasks
jax.config.update("jax_enable_x64", True)
run_tasks(tasks(300, seconds=0.3, log={f"{folder}/log"!r}), record_noise, {str(folder)!r}, workers=2)
""", stderr=subprocess.PIPE)


def read_files(folder):
    return {path.stem: path.read_bytes() for path in folder.glob("[!.]*.npz")}


def wait_for_workers(folder):
    """Wait until the workers of a run have ended."""
    wait_until(lambda: not any(is_running(int(pid)) for pid, _ in read_log(folder)))


@pytest.mark.slow
def test_a_run_killed_at_any_moment_loses_unfinished_tasks_only(tmp_path):
    generator, files, log, kills = np.random.default_rng(0), {}, [], 6
    for _ in range(kills):
        process = start_run(tmp_path)
        time.sleep(generator.uniform(0.5, 12.0))
        assert process.poll() is None, process.communicate()
        process.kill()
        process.communicate()
        wait_for_workers(tmp_path)
        assert not files.keys() & {name.replace("/", "-") for _, name in read_log(tmp_path)[len(log):]}
        assert files.items() <= read_files(tmp_path).items()
        files, log = read_files(tmp_path), read_log(tmp_path)
    assert 20 < len(files) < 300
    process = start_run(tmp_path)
    assert process.wait(timeout=300) == 0, process.communicate()
    settings = {"seconds": 0.3, "log": f"{tmp_path}/log"}
    assert_same(run_tasks(tasks(300, **settings), None, tmp_path), run_tasks(tasks(300, **settings), noise, None))
    assert len(read_log(tmp_path)) <= 300 + 4 * kills  # each worker has a task in hand and a result under way


@pytest.mark.slow
def test_ctrl_c_keeps_the_results_and_ends_the_workers(tmp_path):
    process = start_run(tmp_path)
    wait_until(lambda: len(read_files(tmp_path)) >= 4)
    start_time = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to the workers too
    _, errors = process.communicate(timeout=60)
    assert process.returncode == -signal.SIGINT and errors.rstrip().endswith("KeyboardInterrupt"), errors
    assert time.monotonic() - start_time < 15 and errors.count("Traceback") == 1, errors
    wait_for_workers(tmp_path)
    assert len(read_files(tmp_path)) >= 4


def compute_nothing(task):
    return {"x": 1.0}


@pytest.mark.performance
def test_a_task_costs_under_20_ms(tmp_path, workers):
    run_tasks(tasks(8), compute_nothing, None, workers=workers)
    start_time = time.perf_counter()
    run_tasks(tasks(200), compute_nothing, tmp_path, workers=workers)
    assert (time.perf_counter() - start_time) / 200 < 0.02
