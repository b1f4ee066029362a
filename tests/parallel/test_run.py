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
from lfm_ppl.parallel.cluster import started
from lfm_ppl.parallel.errors import ClusterError, TasksFailedError
from lfm_ppl.parallel.run import outcomes, run_tasks
from lfm_ppl.parallel.task import Task
from lfm_ppl.utils.errors import FolderInUseError
from lfm_ppl.utils.progress import Console, TaskProgress
from tests.processes import ROOT, is_running, start_python, wait_until


@pytest.fixture(scope="module")
def workers():
    """Two worker processes, for all tests of this file."""
    with started(2) as client:
        yield client


def tasks(count=4, **settings):
    return [Task(f"noise/{index:03d}", 7, {"size": 3, **settings}) for index in range(count)]


def noise(task):
    draws = np.asarray(jax.random.normal(task.key, (task.settings["size"],)))
    return {"mean": draws.mean(), "draws": draws, "label": "normal", "count": 3, "flag": True}


def assert_same(first, second):
    assert first.keys() == second.keys()
    for name, result in first.items():
        assert result.keys() == second[name].keys()
        for entry, value in result.items():
            np.testing.assert_array_equal(value, second[name][entry], strict=True)


def test_an_interrupted_run_keeps_its_results_and_resumes_with_the_rest(tmp_path):
    names = []

    def interrupted(task):
        if len(names) == 2:
            raise KeyboardInterrupt
        names.append(task.name)
        return noise(task)

    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks(), interrupted, tmp_path)
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == ["noise-000.npz", "noise-001.npz"]
    names = []
    result = run_tasks(tasks(), lambda task: names.append(task.name) or noise(task), tmp_path)
    assert names == ["noise/002", "noise/003"]
    assert_same(result, run_tasks(tasks(), noise, None))
    assert result["noise/000"]["label"] == "normal" and result["noise/000"]["flag"] is True
    assert len({task["mean"] for task in result.values()}) == 4


def test_several_processes_compute_the_same_numbers_in_any_order(tmp_path, workers):
    expected, lines = run_tasks(tasks(), noise, None), []
    assert_same(expected, run_tasks(tasks(), noise, tmp_path, workers=workers, report=lines.append))
    assert lines[0].startswith("dashboard http") and lines[-1].startswith("computed: 4 of 4 tasks, noise/00")
    reverse = run_tasks(tasks()[::-1], noise, None, workers=workers)
    assert list(reverse) == list(expected)[::-1]
    assert_same({name: reverse[name] for name in expected}, expected)


def describe_process(task):
    time.sleep(0.2)
    variables = "PJRT_NPROC", "OMP_NUM_THREADS", "XLA_PYTHON_CLIENT_PREALLOCATE"
    return {"process": os.getpid(), "cache": str(jax.config.jax_compilation_cache_dir),
            "environment": " ".join(os.environ[name] for name in variables)}


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


def fail(task):
    if task.name.endswith("001"):
        with open(task.settings["log"], "a") as log:
            log.write(".")
        raise ValueError("number one fails")
    return noise(task)


@pytest.mark.parametrize("attempts", [1, 2], ids=["here", "workers"])
def test_a_failed_task_is_named_and_does_not_stop_the_others(tmp_path, workers, attempts):
    lines, several = [], tasks(log=str(tmp_path / "log"))
    with pytest.raises(TasksFailedError, match="1 of 4 tasks failed: noise/001: ValueError: number one") as failed:
        run_tasks(several, fail, tmp_path / "out", workers=1 if attempts == 1 else workers, report=lines.append)
    assert "failed: noise/001: ValueError: number one fails" in lines
    assert list(failed.value.failed) == ["noise/001"] and isinstance(failed.value.__cause__, ValueError)
    assert (tmp_path / "log").read_text() == "." * attempts
    names = []
    run_tasks(several, lambda task: names.append(task.name) or noise(task), tmp_path / "out")
    assert names == ["noise/001"]


def die(task):
    """End the process as often as the settings say."""
    markers = [Path(f"{task.settings['folder']}/{task.stem}-{count}") for count in range(task.settings["deaths"])]
    for marker in markers:
        if not marker.exists():
            marker.touch()
            os._exit(9)
    return noise(task)


def mortal_tasks(folder, *deaths):
    return [Task(f"noise/{index:03d}", 7, {"size": 3, "deaths": count, "folder": str(folder)})
            for index, count in enumerate(deaths)]


def test_a_task_whose_worker_died_is_computed_again(tmp_path, workers):
    result = run_tasks(mortal_tasks(tmp_path, 0, 1, 0), die, None, workers=workers)
    assert_same(result, run_tasks(tasks(3), noise, None))
    assert (tmp_path / "noise-001-0").exists()


@pytest.mark.slow
def test_a_task_that_ends_its_workers_is_named(tmp_path):
    with pytest.raises(TasksFailedError, match="1 of 6 tasks failed: noise/001: KilledWorker"):
        run_tasks(mortal_tasks(tmp_path, 0, 9, 1, 0, 0, 0), die, tmp_path / "out", workers=2)
    assert len(list((tmp_path / "out").glob("*.npz"))) == 5


def test_a_folder_is_locked_until_the_last_outcome(tmp_path):
    running = outcomes(tasks(2), noise, tmp_path)
    assert next(running).task.name == "noise/000"
    with pytest.raises(FolderInUseError, match=rf"process {os.getpid()} on "):
        run_tasks(tasks(), noise, tmp_path)
    running.close()
    assert len(run_tasks(tasks(), noise, tmp_path)) == 4


def test_results_of_other_settings_are_refused_or_replaced(tmp_path):
    run_tasks(tasks(2), noise, tmp_path)
    with pytest.raises(ValueError, match=r"size is 3 there and 5 now.*--overwrite"):
        run_tasks(tasks(2, size=5), noise, tmp_path)
    with pytest.raises(ValueError, match="seed is 7 there and 1 now"):
        run_tasks([Task("noise/000", 1, {"size": 3})], noise, tmp_path)
    assert run_tasks(tasks(2, size=5), noise, tmp_path, overwrite=True)["noise/000"]["draws"].shape == (5,)


@pytest.mark.parametrize("damage", [b"", b"no zip file", "cut", "other"])
def test_a_damaged_file_is_computed_again_with_a_warning(tmp_path, damage):
    expected = run_tasks(tasks(2), noise, tmp_path)
    path = tmp_path / "noise-001.npz"
    if damage == "other":
        np.savez(path, x=1.0)
    else:
        path.write_bytes(path.read_bytes()[:-40] if damage == "cut" else damage)
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


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_has_a_bar_and_a_file_has_lines(tmp_path):
    run_tasks(tasks(2), noise, tmp_path)
    screen, log = Terminal(), io.StringIO()
    with pytest.raises(TasksFailedError):
        run_tasks(tasks(4), lambda task: {"x": object()}, tmp_path, report=Console(screen))
    shown = screen.getvalue()
    assert "2 of 4 tasks are stored already" in shown and "failed: noise/002: TypeError" in shown and "4/4" in shown
    run_tasks(tasks(4), noise, tmp_path, report=Console(log))
    assert log.getvalue().splitlines()[-1].startswith("computed: 4 of 4 tasks, noise/003")


def test_one_process_needs_no_dask(monkeypatch):
    code = ("import sys; from tests.parallel.test_run import *; run_tasks(tasks(), noise, None); "
            "assert not {'dask', 'distributed'} & set(sys.modules)")
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=120, check=True)
    monkeypatch.setattr(cluster, "_HAS_DASK", False)
    assert cluster.available() == 1
    with pytest.raises(ClusterError, match=r"pip install 'lfm_ppl\[cluster\]'"):
        run_tasks(tasks(), noise, None, workers=2)


def log_and_wait(task):
    with open(task.settings["log"], "a") as log:
        log.write(f"{os.getpid()} {task.name}\n")
    time.sleep(task.settings["seconds"])
    return noise(task)


def read_log(folder):
    """Return (process, task) of every task that was begun."""
    return [line.split() for line in (folder / "log").read_text().splitlines()] if (folder / "log").exists() else []


@pytest.fixture
def scheduler(tmp_path):
    """A scheduler that was started by hand: its process and its address."""
    file = tmp_path / "scheduler.json"
    process = start_python("-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
                           "--no-dashboard", "--scheduler-file", str(file), stderr=subprocess.DEVNULL)
    wait_until(lambda: file.exists() and "tcp://" in file.read_text())
    yield process, next(word for word in file.read_text().split('"') if word.startswith("tcp://"))
    process.kill()
    process.wait()


def test_a_scheduler_with_workers_that_were_started_by_hand(tmp_path, scheduler, monkeypatch):
    process, address = scheduler
    with monkeypatch.context() as patch, pytest.raises(ClusterError, match=f"{address}.*dask worker"):
        patch.setattr(cluster, "_ANSWER_S", 0.5)
        run_tasks(tasks(), noise, None, workers=address)
    command = "-m", "distributed.cli.dask_worker", address, "--no-dashboard", "--no-nanny", "--nthreads"
    workers = [start_python(*command, "1", stderr=subprocess.DEVNULL) for _ in range(2)]
    try:
        assert_same(run_tasks(tasks(), noise, None, workers=address), run_tasks(tasks(), noise, None))
        with monkeypatch.context() as patch, pytest.raises(ClusterError, match="same versions"):
            patch.setattr(cluster, "_versions", lambda: {"jax": "0.1"})
            run_tasks(tasks(), noise, None, workers=address)
        several = tasks(3, seconds=0.5, log=str(tmp_path / "log"))
        with pytest.raises(ClusterError, match="connection to the scheduler is lost"):
            for outcome in outcomes(several, log_and_wait, tmp_path / "out", workers=address):
                assert outcome.result is not None
                process.kill()
        assert list((tmp_path / "out").glob("*.npz"))
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()


RUN = """
import jax
from pathlib import Path
from tests.parallel.test_run import log_and_wait, run_tasks, tasks
jax.config.update("jax_enable_x64", True)
run_tasks(tasks({count}, seconds=0.3, log={log!r}), log_and_wait, {folder!r}, workers=2)
"""


def start_run(folder, count):
    code = RUN.format(count=count, log=str(folder / "log"), folder=str(folder / "out"))
    return start_python("-c", code, stderr=subprocess.PIPE)


def stored_files(folder):
    return {path.name: path.read_bytes() for path in (folder / "out").glob("[!.]*.npz")}


@pytest.mark.slow
def test_a_run_killed_at_any_moment_loses_unfinished_tasks_only(tmp_path):
    generator, count, kills = np.random.default_rng(0), 300, 0
    stored, begun = {}, 0
    while (process := start_run(tmp_path, count)) and kills < 20:
        time.sleep(generator.uniform(0.5, 12.0))
        assert process.poll() is None, process.communicate()
        process.kill()
        process.communicate()
        kills += 1
        repeated = {name.replace("/", "-") + ".npz" for _, name in read_log(tmp_path)[begun:]} & set(stored)
        assert not repeated
        files = stored_files(tmp_path)
        assert stored.items() <= files.items()
        wait_until(lambda: not any(is_running(int(pid)) for pid, _ in read_log(tmp_path)))
        stored, begun = files, len(read_log(tmp_path))
    assert 20 < len(stored) < count
    assert process.wait(timeout=300) == 0, process.communicate()
    settings = {"seconds": 0.3, "log": str(tmp_path / "log")}
    assert_same(run_tasks(tasks(count, **settings), fail, tmp_path / "out"),  # computes nothing
                run_tasks(tasks(count, **settings), noise, None))
    assert len(read_log(tmp_path)) <= count + 2 * 2 * kills  # two workers with a task in hand and a result to store


@pytest.mark.slow
def test_ctrl_c_keeps_the_results_and_ends_the_workers(tmp_path):
    process = start_run(tmp_path, 300)
    wait_until(lambda: len(stored_files(tmp_path)) >= 4)
    start_time = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to the workers too
    _, errors = process.communicate(timeout=60)
    assert process.returncode == -signal.SIGINT and errors.rstrip().endswith("KeyboardInterrupt"), errors
    assert time.monotonic() - start_time < 15 and errors.count("Traceback") < 3, errors
    wait_until(lambda: not any(is_running(int(pid)) for pid, _ in read_log(tmp_path)))
    assert len(run_tasks(tasks(3, seconds=0.3, log=str(tmp_path / "log")), fail, tmp_path / "out")) == 3


def compute_nothing(task):
    return {"x": 1.0}


@pytest.mark.performance
def test_a_task_costs_under_20_ms(tmp_path, workers):
    run_tasks(tasks(8), compute_nothing, None, workers=workers)
    start_time = time.perf_counter()
    run_tasks(tasks(200), compute_nothing, tmp_path, workers=workers)
    assert (time.perf_counter() - start_time) / 200 < 0.02
