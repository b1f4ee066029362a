"""How many computations run at once: in a batch, and side by side."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.inference.trajectories import scores, trajectories
from lfm_ppl.utils import batching, compilation


def relaxation(times, y=None):
    """Linear, so that little is compiled; its process noise is unknown."""
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    system = lfm.LatentForceModel(
        lambda x, u, t: -x, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        lfm.Gaussian(jnp.array([0.5]), jnp.array([[0.2]])), process_noise=noise * jnp.eye(1))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=1), obs=y)


@pytest.fixture
def two_cpus(monkeypatch):
    monkeypatch.setattr(compilation, "cpus", lambda: 2)
    monkeypatch.delenv("PJRT_NPROC", raising=False)


def test_there_is_a_thread_for_each_cpu_unless_the_process_has_one(two_cpus, monkeypatch):
    assert batching.threads() == 2
    with jax.enable_x64(False):  # settings of this thread alone
        assert batching.threads() == 1
    monkeypatch.setenv("PJRT_NPROC", "1")
    assert batching.threads() == 1


@pytest.mark.parametrize(("quota", "expected"), [("150000 100000", 2), ("max 100000", 8), (None, 8)])
def test_a_container_may_have_a_share_of_the_cpus(quota, expected, monkeypatch, tmp_path):
    monkeypatch.setattr(compilation.os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    older = tmp_path / "quota", tmp_path / "period"
    monkeypatch.setattr(compilation, "_SHARE", str(tmp_path / "cpu.max"))
    monkeypatch.setattr(compilation, "_OLDER", tuple(map(str, older)))
    if quota is not None:
        (tmp_path / "cpu.max").write_text(f"{quota}\n")
    assert compilation.cpus() == expected
    if quota is not None:
        (tmp_path / "cpu.max").unlink()
        for file, number in zip(older, quota.replace("max", "-1").split(), strict=True):
            file.write_text(f"{number}\n")
        assert compilation.cpus() == expected


def test_calls_run_side_by_side_and_come_in_their_order():
    together = threading.Barrier(2, timeout=60)

    def program(number):
        together.wait()  # passes when two are here
        return number

    assert list(batching.side_by_side(program, [(number,) for number in range(6)], 2)) == list(range(6))


def test_after_an_error_nothing_more_begins():
    started, passes = [], threading.Event()

    def program(number):
        started.append(number)
        if number:
            passes.wait(60)
        return 1 / number

    threading.Timer(0.2, passes.set).start()
    with pytest.raises(ZeroDivisionError):
        list(batching.side_by_side(program, [(number,) for number in range(20)], 2))
    assert len(started) <= 3


@pytest.mark.thorough
def test_an_interruption_between_two_batches_ends_the_others(two_cpus):
    bound, count = lfm.bind(relaxation, np.arange(4.0), np.array([[0.3], [0.9], [np.nan], [-0.8]])), 70
    stored_parts = {}

    class Kept(dict):
        def put(self, start, part):
            stored_parts[start] = part
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scores(jax.random.key(0), bound, {"noise": np.linspace(0.5, 0.8, count)}, store=Kept())
    assert list(stored_parts) == [0]
    assert not [thread for thread in threading.enumerate() if "side by side" in thread.name]


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


@pytest.mark.thorough
def test_draws_are_shared_out_to_the_threads_with_the_same_numbers(two_cpus, monkeypatch):
    bound, count = lfm.bind(relaxation, np.arange(4.0), np.array([[0.3], [0.9], [np.nan], [-0.8]])), 70
    draws = {"noise": np.linspace(0.5, 0.8, count)}
    recorder = Recorder()
    compute = {"scores": lambda **more: scores(jax.random.key(0), bound, draws, **more),
               "trajectories": lambda **more: trajectories(jax.random.key(0), bound, draws, None, **more)}
    several = {name: run(store=recorder) for name, run in compute.items()}
    assert recorder.starts == [0, 20, 40, 60] * 2  # full batches of fours
    monkeypatch.setattr(compilation, "cpus", lambda: 1)
    for name, run in compute.items():
        alone = run()
        for entry, value in several[name].items():
            np.testing.assert_array_equal(value, alone[entry], err_msg=f"{name}: {entry}")
