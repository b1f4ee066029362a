"""Tasks that are stored one by one: resumed to the same numbers, never mixed with other settings, wherever they run."""

import ctypes
import dataclasses
import io
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from lfm_ppl.parallel import cluster
from lfm_ppl.parallel.cluster import Cluster, started
from lfm_ppl.parallel.errors import ClusterError, TasksFailedError
from lfm_ppl.parallel.run import outcomes, run_tasks
from lfm_ppl.parallel.store import read_result, write_result
from lfm_ppl.parallel.task import Task
from lfm_ppl.parallel.worker import return_memory
from lfm_ppl.utils.errors import FolderInUseError
from lfm_ppl.utils.progress import Console, duration
from lfm_ppl.utils.run_store import RunStore

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def workers():
    """Two worker processes, for all tests of this file."""
    with started(2) as running:
        yield running


def tasks(count=4, **settings):
    return [Task(f"noise/{index:02d}", 7, {"size": 3, **settings}) for index in range(count)]


def noise(task):
    draws = np.asarray(jax.random.normal(task.key, (task.settings["size"],)))
    return {"mean": draws.mean(), "draws": draws, "label": "normal", "count": 3}


def same(first, second):
    assert first.keys() == second.keys()
    for name in first:
        for entry, value in first[name].items():
            np.testing.assert_array_equal(value, second[name][entry])


def test_a_killed_run_ends_with_the_same_numbers(tmp_path):
    whole = run_tasks(tasks(), noise, tmp_path / "whole")
    done = []

    def killed(task):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(task.name)
        return noise(task)

    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks(), killed, tmp_path / "half")
    assert sorted(path.name for path in (tmp_path / "half").glob("[!.]*")) == ["noise-00.npz", "noise-01.npz"]
    resumed = []
    result = run_tasks(tasks(), lambda task: resumed.append(task.name) or noise(task), tmp_path / "half")
    assert resumed == ["noise/02", "noise/03"]
    same(whole, result)


def broken(task):
    if task.name.endswith("01"):
        raise ValueError("number one is broken")
    return noise(task)


def test_several_processes_find_the_same_numbers(tmp_path, workers):
    """Also in double precision, as this process has it."""
    alone = run_tasks(tasks(), noise, tmp_path / "alone")
    lines = []
    same(alone, run_tasks(tasks(), noise, tmp_path / "together", workers=workers, report=lines.append))
    assert lines[-1].startswith("computed: 4 of 4 tasks")
    same(alone, run_tasks(tasks(), noise, None, workers=workers))
    with pytest.raises(ValueError, match="workers"):
        run_tasks(tasks(), noise, tmp_path, workers=0)


@pytest.mark.parametrize("where", ["here", "workers"])
def test_a_failed_task_does_not_stop_the_others_and_is_named(tmp_path, workers, where):
    lines = []
    with pytest.raises(TasksFailedError, match=r"1 of 4 tasks failed: noise/01: ValueError: number one is broken\. The "
                                               "results of the others are stored") as failed:
        run_tasks(tasks(), broken, tmp_path, workers=1 if where == "here" else workers, report=lines.append)
    assert "failed: noise/01: ValueError: number one is broken" in lines
    assert list(failed.value.failed) == ["noise/01"] and isinstance(failed.value.__cause__, ValueError)
    assert {path.name for path in tmp_path.glob("*.npz")} == {"noise-00.npz", "noise-02.npz", "noise-03.npz"}
    computed = []
    run_tasks(tasks(), lambda task: computed.append(task.name) or noise(task), tmp_path)
    assert computed == ["noise/01"]


def process(task):
    return {"process": os.getpid(), "cache": str(jax.config.jax_compilation_cache_dir),
            "variables": " ".join(f"{name}={os.environ[name]}" for name in (
                "PJRT_NPROC", "OMP_NUM_THREADS", "XLA_PYTHON_CLIENT_PREALLOCATE"))}


def test_workers_have_one_thread_and_share_compiled_programs(workers):
    result = run_tasks(tasks(8), process, None, workers=workers)
    assert len({one["process"] for one in result.values()} - {os.getpid()}) == 2
    assert {one["variables"] for one in result.values()} == {
        "PJRT_NPROC=1 OMP_NUM_THREADS=1 XLA_PYTHON_CLIENT_PREALLOCATE=false"}
    assert {one["cache"] for one in result.values()} == {jax.config.jax_compilation_cache_dir}


def timed(task):
    began = time.time()
    time.sleep(0.5)
    if task.settings.get("fails"):
        raise ValueError("the first one fails")
    return {"began": began, "ended": time.time()}


@pytest.mark.parametrize("alike", [False, True])
def test_where_tasks_are_alike_the_first_one_begins_by_itself(workers, alike):
    run_tasks(tasks(2), noise, None, workers=workers)  # both have imported what they need
    first, *others = (outcome.result for outcome in outcomes(tasks(4), timed, None, workers=workers, alike=alike))
    assert (min(one["began"] for one in others) > first["ended"]) is alike


def test_where_the_first_of_tasks_that_are_alike_fails_the_second_begins_by_itself_too(workers):
    several = [Task(f"noise/{index:02d}", 7, {"fails": index == 0}) for index in range(4)]
    failed, second, *others = outcomes(several, timed, None, workers=workers, alike=True)
    assert failed.reason == "ValueError: the first one fails"
    assert min(one.result["began"] for one in others) > second.result["ended"]


def test_no_more_wait_for_the_first_one_than_a_minute(workers, monkeypatch):
    monkeypatch.setattr(cluster, "_ALONE_S", 0.0)
    first, *others = (outcome.result for outcome in outcomes(tasks(4), timed, None, workers=workers, alike=True))
    assert min(one["began"] for one in others) < first["ended"]


def test_processes_share_a_folder_of_programs_where_there_is_none():
    own = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        folder = cluster.programs_folder()
    finally:
        jax.config.update("jax_compilation_cache_dir", own)
    assert Path(folder).is_dir() and folder != own


def dies(task):
    """Die as often as the settings say, once for each file that is not there yet."""
    for count in range(task.settings["deaths"]):
        marker = Path(task.settings["folder"]) / f"{task.stem}-{count}"
        if not marker.exists():
            marker.touch()
            os._exit(9)
    return noise(task)


def mortal(folder, *deaths):
    return [Task(f"noise/{index:02d}", 7, {"size": 3, "deaths": count, "folder": str(folder)})
            for index, count in enumerate(deaths)]


def test_a_task_whose_worker_died_is_computed_again(tmp_path, workers):
    result = run_tasks(mortal(tmp_path, 0, 1, 0), dies, tmp_path / "out", workers=workers)
    same(result, run_tasks(tasks(3), noise, None))
    assert (tmp_path / "noise-01-0").exists()


@pytest.mark.slow
def test_a_task_that_kills_its_workers_is_named(tmp_path):
    with pytest.raises(TasksFailedError, match="1 of 6 tasks failed: noise/01: .*4 workers died during this task"):
        run_tasks(mortal(tmp_path, 0, 9, 1, 0, 0, 0), dies, tmp_path / "out", workers=2)
    assert len(list((tmp_path / "out").glob("*.npz"))) == 5 and len(list(tmp_path.glob("noise-01-*"))) == 4


def logged(task):
    with open(task.settings["log"], "a", encoding="utf-8") as log:
        log.write(f"{os.getpid()} {task.name}\n")
    time.sleep(task.settings["seconds"])
    return noise(task)


def slow_tasks(count, seconds, log):
    return [Task(f"noise/{index:02d}", 7, {"size": 3, "seconds": seconds, "log": str(log)}) for index in range(count)]


CLIENT = """
import sys
sys.path.insert(0, {root!r})
from tests.parallel import test_run
from lfm_ppl.parallel.run import run_tasks
if __name__ == "__main__":
    import jax
    jax.config.update("jax_enable_x64", True)
    run_tasks(test_run.slow_tasks({count}, {seconds}, {log!r}), test_run.logged, {folder!r}, workers=2)
"""


def client(tmp_path, count, seconds):
    (tmp_path / "script.py").write_text(CLIENT.format(
        root=str(ROOT), count=count, seconds=seconds, log=str(tmp_path / "log"), folder=str(tmp_path / "out")))
    return subprocess.Popen([sys.executable, str(tmp_path / "script.py")], cwd=ROOT)


def begun(tmp_path):
    """Return (process, task) of every task that was begun."""
    log = tmp_path / "log"
    return [line.split() for line in log.read_text().splitlines()] if log.exists() else []


def until(true, seconds=120.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def gone(pids):
    """Wait until none of these processes exists."""
    pids = list(pids)
    until(lambda: not any(map(runs, pids)))


def runs(pid):
    """Whether a process runs: one that ended and that nobody has asked how does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_fifty_workers_killed_at_random_moments_and_the_client_too(tmp_path):
    """Nothing is lost, no task is computed again that was stored, and the numbers are the same."""
    generator, count, kills, clients = np.random.default_rng(0), 150, 0, 0
    running = client(tmp_path, count, 0.4)
    while running.poll() is None:
        time.sleep(generator.uniform(0.2, 1.6))
        alive = sorted({int(pid) for pid, _ in begun(tmp_path) if runs(pid)})
        if kills < 50 and alive:
            os.kill(int(generator.choice(alive)), 9)
            kills += 1
            if kills % 17 == 0:
                running.kill()
                running.wait()
                gone(alive)
                kept, before = {path.name for path in (tmp_path / "out").glob("*.npz")}, len(begun(tmp_path))
                running, clients = client(tmp_path, count, 0.4), clients + 1
                until(lambda before=before: len(begun(tmp_path)) > before)
                again = {name.replace("/", "-") + ".npz" for _, name in begun(tmp_path)[before:]}
                assert not again & kept
    assert kills == 50 and clients == 2
    # So many deaths may hit one task four times, which is then named as failed; the same call computes it.
    assert running.returncode == 0 or client(tmp_path, count, 0.4).wait() == 0
    own = slow_tasks(count, 0.4, tmp_path / "log")
    same(run_tasks([Task(task.name, task.seed, {"size": 3}) for task in own], noise, None),
         {task.name: read_result(task, RunStore(tmp_path / "out")) for task in own})
    # A worker that dies takes with it what it computes, and at most one result that the client has not fetched yet.
    assert len(begun(tmp_path)) <= count + 2 * kills + 2 * (clients + 1)


@pytest.mark.slow
def test_workers_end_with_the_one_that_started_them(tmp_path):
    """Killed by force, too: nobody is left behind, and what was stored stays."""
    running = client(tmp_path, 4, 3.0)
    until(lambda: len(begun(tmp_path)) >= 4)
    running.kill()
    running.wait()
    gone(pid for pid, _ in begun(tmp_path))
    assert len(list((tmp_path / "out").glob("*.npz"))) == 2
    running = client(tmp_path, 4, 0.0)  # the folder is free again; other settings are refused
    assert running.wait() != 0
    assert client(tmp_path, 4, 3.0).wait() == 0 and len(list((tmp_path / "out").glob("*.npz"))) == 4


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """A scheduler without workers, started by hand on the loopback interface: its address."""
    file = tmp_path_factory.mktemp("scheduler") / "scheduler.json"
    running = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port",
                                "0", "--no-dashboard", "--no-show", "--scheduler-file", str(file)], cwd=ROOT,
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until(file.exists)
    until(lambda: "tcp://" in file.read_text())
    yield next(word for word in file.read_text().split('"') if word.startswith("tcp://"))
    running.kill()
    running.wait()


def by_hand(address, *options):
    """Start a worker of a scheduler."""
    return subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_worker", address, "--no-dashboard", *options],
                            cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def test_a_scheduler_with_workers_started_by_hand(tmp_path, scheduler, monkeypatch):
    """The same numbers as in this process; without workers, or with one of several threads, an error that says so."""
    monkeypatch.setattr(cluster, "_WORKER_S", 0.5)
    with pytest.raises(ClusterError, match=f"the scheduler at {scheduler} has no workers.*dask worker"):
        run_tasks(tasks(), noise, tmp_path, workers=scheduler)
    monkeypatch.setattr(cluster, "_WORKER_S", 60)
    hands = [by_hand(scheduler, "--no-nanny", "--nthreads", "1") for _ in range(2)]
    try:
        same(run_tasks(tasks(), noise, tmp_path, workers=scheduler), run_tasks(tasks(), noise, None))
    finally:
        for hand in hands:
            hand.kill()
            hand.wait()


@pytest.mark.slow
def test_a_worker_with_several_threads_is_refused(scheduler):
    hand = by_hand(scheduler, "--no-nanny", "--nthreads", "3")
    try:
        with pytest.raises(ClusterError, match="has 3 threads.*--nthreads 1"):
            run_tasks(tasks(), noise, None, workers=scheduler)
    finally:
        hand.kill()
        hand.wait()


def test_other_versions_are_refused(workers):
    setup = dataclasses.replace(workers._setup, versions={**workers._setup.versions, "jax": "0.1"})
    with pytest.raises(ClusterError, match=r"has jax \S+ \(here 0.1\).*same versions"):
        run_tasks(tasks(), noise, None, workers=Cluster(workers._client, setup, None))
    with pytest.raises(ClusterError, match=r"the worker tcp://127.0.0.1:\d+ has jax"):
        cluster.check_fit(workers._client, setup)


@pytest.mark.parametrize("address", ["localhost", "localhost:8786", "http://localhost:8786", "tcp://localhost"])
def test_an_address_is_checked(tmp_path, address):
    with pytest.raises(ValueError, match="looks like tcp://host:8786"):
        run_tasks(tasks(), noise, tmp_path, workers=address)


def test_a_scheduler_that_does_not_answer(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "_ANSWER_S", 0.5)
    with pytest.raises(ClusterError, match="no scheduler answers at tcp://127.0.0.1:9 .*dask scheduler"):
        run_tasks(tasks(), noise, tmp_path, workers="tcp://127.0.0.1:9")


def test_without_dask_several_processes_are_refused(tmp_path, monkeypatch):
    find = cluster.importlib.util.find_spec
    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: None if name == "distributed" else find(name))
    assert cluster.available() == 1
    with pytest.raises(ClusterError, match=r"pip install 'lfm_ppl\[cluster\]', or use one process \(--jobs 1\)"):
        run_tasks(tasks(), noise, tmp_path, workers=2)


def test_one_process_imports_no_dask(tmp_path):
    code = f"""
import sys
from lfm_ppl.parallel.run import run_tasks
from lfm_ppl.parallel.task import Task
print(run_tasks([Task("a", 0)], lambda task: {{"x": 1.0}}, {str(tmp_path)!r}),
      [name for name in sys.modules if name.split(".")[0] in ("dask", "distributed")])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert result.stdout.strip() == "{'a': {'x': 1.0}} []", result.stderr


def nothing(task):
    return {"x": 1.0}


@pytest.mark.performance
def test_the_engine_takes_under_20_ms_a_task(tmp_path):
    with started(2) as running:
        run_tasks(tasks(8), nothing, None, workers=running)
        begin = time.perf_counter()
        run_tasks(tasks(200), nothing, tmp_path, workers=running)
        assert (time.perf_counter() - begin) / 200 < 0.02


def test_a_folder_that_another_run_holds(tmp_path):
    ended = outcomes(tasks(2), noise, tmp_path)
    assert next(ended).task.name == "noise/00"
    with pytest.raises(FolderInUseError, match=rf"in use by another run \(process {os.getpid()} on .*choose another"):
        run_tasks(tasks(), noise, tmp_path)
    ended.close()
    assert len(run_tasks(tasks(), noise, tmp_path)) == 4


def test_a_result_does_not_depend_on_the_order_or_on_the_other_tasks(tmp_path):
    forward = run_tasks(tasks(), noise, tmp_path / "a")
    backward = run_tasks(tasks()[:0:-1], noise, tmp_path / "b")
    for name, result in backward.items():
        np.testing.assert_array_equal(result["draws"], forward[name]["draws"])
    assert len({float(result["mean"]) for result in forward.values()}) == 4


def test_more_tasks_go_on_from_fewer(tmp_path):
    run_tasks(tasks(2), noise, tmp_path)
    computed = []
    run_tasks(tasks(4), lambda task: computed.append(task.name) or noise(task), tmp_path)
    assert computed == ["noise/02", "noise/03"]


def test_other_settings_are_refused_and_replaced_on_request(tmp_path):
    run_tasks(tasks(2), noise, tmp_path)
    with pytest.raises(ValueError, match=r"other settings: size is 3 there and 5 now.*--overwrite"):
        run_tasks(tasks(2, size=5), noise, tmp_path)
    result = run_tasks(tasks(2, size=5), noise, tmp_path, overwrite=True)
    assert result["noise/00"]["draws"].shape == (5,)


def test_another_seed_is_refused(tmp_path):
    run_tasks([Task("a", 0)], lambda task: {"x": 1.0}, tmp_path)
    with pytest.raises(ValueError, match="seed is 0 there and 1 now"):
        run_tasks([Task("a", 1)], lambda task: {"x": 1.0}, tmp_path)


@pytest.mark.parametrize("damage", [b"", b"no zip file", "cut", "other"])
def test_a_damaged_file_is_computed_again_with_a_warning(tmp_path, damage):
    whole = run_tasks(tasks(2), noise, tmp_path)
    path = tmp_path / "noise-01.npz"
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-40])
    elif damage == "other":
        np.savez(path, x=1.0)
    else:
        path.write_bytes(damage)
    with pytest.warns(UserWarning, match="noise-01.npz cannot be read"):
        result = run_tasks(tasks(2), noise, tmp_path)
    same(whole, result)


def test_values_come_back_as_they_were(tmp_path):
    task = Task("a", 0)
    values = {"number": 0.1, "whole": 3, "flag": True, "text": "ok", "array": np.arange(3.0)}
    write_result(task, values, RunStore(tmp_path))
    result = read_result(task, RunStore(tmp_path))
    assert (result["number"], result["whole"], result["flag"], result["text"]) == (0.1, 3, True, "ok")
    np.testing.assert_array_equal(result["array"], np.arange(3.0))


def test_what_cannot_be_stored_is_refused(tmp_path):
    with pytest.raises(ValueError, match="entry 'model' that is not a number"):
        write_result(Task("a", 0), {"model": object()}, RunStore(tmp_path))
    with pytest.raises(TypeError, match="must be storable as JSON"):
        Task("a", 0, {"model": object()})
    with pytest.raises(ValueError, match="name of a task"):
        Task("a b", 0)
    with pytest.raises(ValueError, match="share the file a-b.npz"):
        run_tasks([Task("a/b", 0), Task("a-b", 0)], lambda task: {"x": 1.0}, tmp_path)


def test_progress_says_how_far_it_is(tmp_path):
    lines = []
    run_tasks(tasks(2), noise, tmp_path)
    run_tasks(tasks(3), noise, tmp_path, report=lines.append)
    assert lines[0] == "2 of 3 tasks are stored already"
    assert lines[-1].startswith("computed: 3 of 3 tasks, noise/02")
    lines.clear()
    run_tasks(tasks(5), noise, None, report=lines.append)
    assert [line.split()[1] for line in lines] == ["1", "5"] and lines[0].endswith("left")  # nothing for 30 s


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_has_a_bar_with_the_time_left(tmp_path):
    run_tasks(tasks(2), noise, tmp_path)
    screen, log = Terminal(), io.StringIO()
    with pytest.raises(TasksFailedError):
        run_tasks(tasks(4), lambda task: {"x": object()}, tmp_path, report=Console(screen))
    shown = screen.getvalue()
    assert "2 of 4 tasks are stored already" in shown and "failed: noise/02: ValueError" in shown
    assert "4/4" in shown and "noise/03" in shown and "<" in shown
    run_tasks(tasks(4), noise, tmp_path, report=Console(log))
    assert log.getvalue().splitlines()[-1].startswith("computed: 4 of 4 tasks, noise/03")


def test_durations():
    assert [duration(s) for s in (0.0, 99.0, 120.0, 7200.0)] == ["0.0 s", "99 s", "2 min", "2.0 h"]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are left alone")
def test_freed_memory_goes_back_to_the_system():
    """Small blocks below one that stays: the C library keeps them when they are freed.

    Only whole pages go back, and blocks that fill holes between others free none: half of the memory is asked for.
    """
    library = ctypes.CDLL("libc.so.6")
    library.malloc.restype, library.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    blocks = [library.malloc(4000) for _ in range(25_000)]
    for block in blocks:
        ctypes.memset(block, 1, 4000)
    last = library.malloc(4000)
    for block in blocks:
        library.free(block)
    before = resident()
    return_memory()
    freed = before - resident()
    library.free(last)
    assert freed > 0.5 * len(blocks) * 4000


def resident():
    """Memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
