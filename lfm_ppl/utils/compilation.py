"""How XLA compiles, set for a whole process before its first computation."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path

_SHARE = "/sys/fs/cgroup/cpu.max"
"""What a container may use, on Linux: microseconds of CPU time in so many microseconds."""

_OLDER = "/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"
"""The same of older systems, each in a file of its own; a negative share is none."""

_OPTION = "xla_cpu_small_while_loop_byte_threshold"
_BYTES = 1_000_000
_FLAG = "--xla_backend_extra_options="
_DEVICES = "--xla_force_host_platform_device_count"

MOST_DEVICES = 64
"""Largest number of devices of a process, one for each chain."""

ONE_THREAD = {"PJRT_NPROC": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment in which a process computes with one thread: JAX reads it at its first computation, NumPy when imported.

Processes side by side would otherwise have as many threads each as there are CPUs, which hand small operations to one
another: two Hamiltonian chains on two CPUs took over four times as long as a single one."""


def cpus() -> int:
    """Return how many CPUs this process may use, where it is kept to some, or a container to a share of their time."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in ((_SHARE,), _OLDER):
        with contextlib.suppress(OSError, ValueError):  # no such file, or "max"
            share, of = map(int, " ".join(Path(name).read_text() for name in files).split())
            if share > 0:
                count = min(count, -(-share // of))
    return count


def one_thread() -> bool:
    """Whether this process was told to compute with one thread, as by `ONE_THREAD`."""
    return os.environ.get("PJRT_NPROC") == "1"


def fast_loops() -> None:
    """Let XLA compile a loop over small matrices as one function, which its CPU runtime calls once.

    JAX 0.10, the newest for Python 3.11, hands every operation of every pass through a loop to its runtime; with this
    setting filters and their gradients take a half to a quarter of the time there. From JAX 0.12 on it is how loops are
    compiled anyway. The option is added to the environment variable ``XLA_FLAGS``, which XLA reads at the first
    computation. An option that is set already stays. `prepare_chains` and the command line call this.
    """
    words = os.environ.get("XLA_FLAGS", "").split()
    if any(_OPTION in word for word in words):
        return
    option = f"{_OPTION}={_BYTES}"
    for index, word in enumerate(words):
        if word.startswith(_FLAG):
            words[index] = f"{word},{option}"  # the flag takes one list
            break
    else:
        words.append(_FLAG + option)
    os.environ["XLA_FLAGS"] = " ".join(words)


def prepare_chains(chains: int) -> None:
    """Give JAX a CPU device for each chain, and `fast_loops`; without effect after its first computation.

    JAX fixes the devices, and reads XLA's flags, at that computation. A number of devices that is set already, by
    ``numpyro.set_host_device_count`` or JAX's own option, stays. Devices of a process with one thread would only take
    turns, so it keeps one.
    """
    import jax

    if one_thread() or jax.config.jax_num_cpu_devices >= 0:  # type: ignore[attr-defined]
        return
    flag = re.search(rf"{_DEVICES}=(\d+)", os.environ.get("XLA_FLAGS", ""))
    try:
        # JAX refuses a new number once it has computed; XLA's flags would then only change the keys of its cache.
        jax.config.update("jax_num_cpu_devices", int(flag[1]) if flag else min(chains, MOST_DEVICES))
    except RuntimeError:
        return
    fast_loops()


def quick_compilation(level: int) -> None:
    """Reduce the compilation effort of XLA, for short programs such as tests.

    Its older emitters compile the small loops of a filter faster, and a program is compiled in one piece: by default
    XLA cuts it into 32, for threads that there may not be, and compiles what they share in each. Newer versions may
    lack these switches, and XLA ends the process at a switch that it does not know. Flags that are set already stay.

    Args:
        level: of optimisation, 0 to 3. Programs at level 0 are compiled in a third of the time and run many times
            slower; at level 1 they run about as fast as ever.
    """
    import jaxlib.version  # takes 30 ms, which the command line, with `fast_loops` alone, does not need

    flags = [f"--xla_backend_optimization_level={level}"]
    if jaxlib.version.__version_info__ < (0, 13):
        flags.append("--xla_cpu_parallel_codegen_split_count=1")
    if jaxlib.version.__version_info__ < (0, 11):
        flags.append("--xla_cpu_use_fusion_emitters=false")
    os.environ["XLA_FLAGS"] = " ".join([*flags, os.environ.get("XLA_FLAGS", "")]).strip()
