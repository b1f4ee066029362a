"""Tasks that are stored one by one: resumed to the same numbers, never mixed with other settings."""

import ctypes
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from lfm_ppl.experiments.tasks import Task, _return_memory, available_cpus, duration, read, run_tasks, share, write


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
    assert sorted(path.name for path in (tmp_path / "half").iterdir()) == ["noise-00.npz", "noise-01.npz"]
    resumed = []
    found = run_tasks(tasks(), lambda task: resumed.append(task.name) or noise(task), tmp_path / "half")
    assert resumed == ["noise/02", "noise/03"]
    same(whole, found)


def broken(task):
    if task.name.endswith("01"):
        raise ValueError("number one is broken")
    return noise(task)


def test_several_processes_find_the_same_numbers(tmp_path):
    """Also in double precision, as this process has it; an error in one of them arrives, what is done stays."""
    alone = run_tasks(tasks(), noise, tmp_path / "alone")
    lines = []
    same(alone, run_tasks(tasks(), noise, tmp_path / "together", workers=2, report=lines.append))
    assert lines[-1].startswith("4/4")
    with pytest.raises(ValueError, match="number one is broken"):
        run_tasks(tasks(), broken, tmp_path / "broken", workers=2)
    assert (tmp_path / "broken" / "noise-00.npz").is_file() and not (tmp_path / "broken" / "noise-01.npz").exists()
    with pytest.raises(ValueError, match="workers"):
        run_tasks(tasks(), noise, tmp_path, workers=0)


def cpus(task):
    meeting = Path(task.settings["meeting"])  # of both processes, so that each gets one of the tasks
    meeting.mkdir(exist_ok=True)
    (meeting / str(os.getpid())).touch()
    deadline = time.monotonic() + 120
    while len(list(meeting.iterdir())) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    return {"process": os.getpid(), "cpus": np.array(sorted(os.sched_getaffinity(0))),
            "programs": jax.config.jax_compilation_cache_dir}


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system does not tell or take CPUs")
def test_each_process_keeps_to_its_share_of_the_cpus(tmp_path):
    own = os.sched_getaffinity(0)
    found = run_tasks(tasks(2, meeting=str(tmp_path / "meeting")), cpus, tmp_path, workers=2)
    shares = {int(one["process"]): one["cpus"].tolist() for one in found.values()}
    assert sorted(shares.values()) == sorted(share(own, number, 2) for number in range(2))
    assert os.sched_getaffinity(0) == own and available_cpus() == len(own)
    # What one process compiles the others find, in this process's folder of programs.
    assert {str(one["programs"]) for one in found.values()} == {jax.config.jax_compilation_cache_dir}


def test_processes_share_a_folder_of_programs_where_there_is_none(tmp_path):
    own = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        found = run_tasks(tasks(2, meeting=str(tmp_path / "meeting")), cpus, tmp_path, workers=2)
    finally:
        jax.config.update("jax_compilation_cache_dir", own)
    (folder,) = {str(one["programs"]) for one in found.values()}
    assert Path(folder).is_dir() and folder != own


@pytest.mark.parametrize("count, workers", [(5, 3), (4, 4), (16, 2), (7, 1)])
def test_shares_are_disjoint_and_leave_no_cpu_out(count, workers):
    shares = [share(range(10, 10 + count), number, workers) for number in range(workers)]
    assert sorted(sum(shares, [])) == list(range(10, 10 + count))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_more_processes_than_cpus_have_one_each():
    assert [share([4, 8], number, 5) for number in range(5)] == [[4], [8], [4], [8], [4]]


def kept(task):
    time.sleep(task.settings["seconds"])
    return {"process": os.getpid()}


@pytest.mark.slow
def test_processes_end_with_the_one_that_started_them(tmp_path):
    """Killed by force, too: nobody is left behind, and what was stored stays."""
    script = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_tasks
from lfm_ppl.experiments.tasks import run_tasks
if __name__ == "__main__":
    run_tasks(test_tasks.tasks(3, seconds=0.1) + test_tasks.tasks(9, seconds=30.0)[3:], test_tasks.kept,
              {str(tmp_path)!r}, workers=2)
"""
    (tmp_path / "script.py").write_text(script)
    parent = subprocess.Popen([sys.executable, str(tmp_path / "script.py")])
    until = time.monotonic() + 120
    while len(list(tmp_path.glob("*.npz"))) < 3 and time.monotonic() < until:
        time.sleep(0.2)
    workers = {int(read(task, tmp_path)["process"]) for task in tasks(3, seconds=0.1)}
    parent.kill()
    parent.wait()
    while any(Path(f"/proc/{pid}").exists() for pid in workers) and time.monotonic() < until:
        time.sleep(0.2)
    assert not any(Path(f"/proc/{pid}").exists() for pid in workers)
    assert len(list(tmp_path.glob("*.npz"))) == 3


def fatal(task):
    os._exit(9)


def test_a_process_that_dies_is_explained(tmp_path):
    with pytest.raises(RuntimeError, match="fewer workers"):
        run_tasks(tasks(), fatal, tmp_path, workers=2)


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
    found = run_tasks(tasks(2, size=5), noise, tmp_path, overwrite=True)
    assert found["noise/00"]["draws"].shape == (5,)


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
        found = run_tasks(tasks(2), noise, tmp_path)
    same(whole, found)


def test_values_come_back_as_they_were(tmp_path):
    task = Task("a", 0)
    write(task, {"number": 0.1, "whole": 3, "flag": True, "text": "ok", "array": np.arange(3.0)}, tmp_path)
    found = read(task, tmp_path)
    assert (found["number"], found["whole"], found["flag"], found["text"]) == (0.1, 3, True, "ok")
    np.testing.assert_array_equal(found["array"], np.arange(3.0))


def test_what_cannot_be_stored_is_refused(tmp_path):
    with pytest.raises(ValueError, match="entry 'model' that is not a number"):
        write(Task("a", 0), {"model": object()}, tmp_path)
    with pytest.raises(TypeError, match="must be what JSON can store"):
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
    assert lines[-1].startswith("3/3 noise/02")


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
    _return_memory()
    freed = before - resident()
    library.free(last)
    assert freed > 0.5 * len(blocks) * 4000


def resident():
    """Memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
