"""How many computations run at once: in a batch, and side by side."""

import threading

import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.inference import map_draws
from lfm_ppl.inference.posterior import scores, trajectories
from lfm_ppl.utils import batching, compilation
from tests import systems


def well(times, y=None):
    """A double well whose noise is unknown."""
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(systems.double_well(dispersion=noise, noise=0.1), times, steps=1), obs=y)


@pytest.fixture
def two_cpus(monkeypatch):
    monkeypatch.setattr(compilation, "cpus", lambda: 2)
    monkeypatch.delenv("PJRT_NPROC", raising=False)


def test_there_is_a_thread_for_each_cpu_unless_the_process_has_one_or_settings_are_of_this_thread_alone(
        two_cpus, monkeypatch):
    assert batching.threads() == 2
    with jax.enable_x64(False):
        assert batching.threads() == 1
    with monkeypatch.context() as patch:
        patch.setattr(batching, "on_cpu", lambda: False)
        assert batching.threads() == 1
    monkeypatch.setenv("PJRT_NPROC", "1")
    assert batching.threads() == 1


@pytest.mark.parametrize(("said", "expected"), [("150000 100000", 2), ("50000 100000", 1), ("max 100000", 8),
                                                ("900000 100000", 8), (None, 8)])
def test_a_container_may_have_a_share_of_the_cpus(said, expected, monkeypatch, tmp_path):
    monkeypatch.setattr(compilation.os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    older = tmp_path / "quota", tmp_path / "period"
    monkeypatch.setattr(compilation, "_SHARE", str(tmp_path / "cpu.max"))
    monkeypatch.setattr(compilation, "_OLDER", tuple(map(str, older)))
    if said is not None:
        (tmp_path / "cpu.max").write_text(f"{said}\n")
    assert compilation.cpus() == expected
    if said is not None:
        (tmp_path / "cpu.max").unlink()
        for file, number in zip(older, said.replace("max", "-1").split(), strict=True):
            file.write_text(f"{number}\n")
        assert compilation.cpus() == expected


def test_calls_run_side_by_side_and_come_in_their_order():
    together = threading.Barrier(2, timeout=60)

    def program(number):
        together.wait()  # passes when two are here
        return number

    assert list(batching.side_by_side(program, [(number,) for number in range(6)], 2)) == list(range(6))


def test_after_an_interruption_nothing_more_begins():
    begun, passes = [], threading.Semaphore(2)

    def program(number):
        begun.append(number)
        passes.acquire(timeout=60)
        return number

    results = batching.side_by_side(program, [(number,) for number in range(20)], 2)
    assert next(results) == 0
    threading.Timer(0.2, passes.release, [20]).start()
    results.close()  # as by Ctrl-C between two results; waits for what runs
    assert len(begun) <= 4


def test_after_an_error_nothing_more_begins():
    begun, passes = [], threading.Event()

    def program(number):
        begun.append(number)
        if number:
            passes.wait(60)
        return 1 / number

    threading.Timer(0.2, passes.set).start()
    with pytest.raises(ZeroDivisionError):
        list(batching.side_by_side(program, [(number,) for number in range(20)], 2))
    assert len(begun) <= 3


def test_an_interruption_between_two_batches_ends_the_others(two_cpus):
    bound, count = lfm.bind(well, np.arange(4.0), np.array([[0.3], [0.9], [np.nan], [-0.8]])), 70
    kept = {}

    class Kept(dict):
        def put(self, start, part):
            kept[start] = part
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scores(bound, {"noise": np.linspace(0.5, 0.8, count)}, store=Kept())
    assert list(kept) == [0] and not [one for one in threading.enumerate() if "side by side" in one.name]


class Recorder:
    """Store that records the first draw of each batch."""

    def __init__(self):
        self.starts = []

    def get(self, start):
        return None

    def put(self, start, batch):
        self.starts.append(start)

    def flush(self):
        pass


def test_an_accelerator_has_larger_batches_and_what_is_large_by_itself_has_nothing_beside_it(two_cpus, monkeypatch):
    bound, count = lfm.bind(well, np.arange(4.0), np.array([[0.3], [0.9], [np.nan], [-0.8]])), 400
    draws = {"noise": np.linspace(0.5, 0.8, count)}

    def batches():
        recorder = Recorder()
        scores(bound, draws, store=recorder)
        return len(recorder.starts)

    numbers = 4 * 1**2 * 6  # of one draw: four rows, one state
    monkeypatch.setattr(map_draws, "_LARGEST_BATCH_SIZE", 100 * numbers)
    assert batches() == 8  # of fifty each, for two threads
    monkeypatch.setattr(map_draws, "_LARGEST_BATCH_SIZE", 10 * numbers)
    assert batches() == 50  # of eight
    monkeypatch.setattr(batching, "on_cpu", lambda: False)
    monkeypatch.setattr(map_draws, "on_cpu", lambda: False)
    assert batches() == 2


def test_draws_are_shared_out_to_the_threads_with_the_same_numbers(two_cpus, monkeypatch):
    bound, count = lfm.bind(well, np.arange(4.0), np.array([[0.3], [0.9], [np.nan], [-0.8]])), 70
    draws = {"noise": np.linspace(0.5, 0.8, count)}
    recorder = Recorder()
    compute = {"scores": lambda **more: scores(bound, draws, **more),
               "trajectories": lambda **more: trajectories(jax.random.key(0), bound, draws, None, **more)}
    several = {name: run(store=recorder) for name, run in compute.items()}
    assert recorder.starts == [0, 20, 40, 60] * 2  # full batches of fours
    monkeypatch.setattr(compilation, "cpus", lambda: 1)
    for name, run in compute.items():
        alone = run()
        for one, value in several[name].items():
            np.testing.assert_array_equal(value, alone[one], err_msg=f"{name}: {one}")
