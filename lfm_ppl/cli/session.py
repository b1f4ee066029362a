"""Settings of the process that must precede any numerical work."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import warnings
from pathlib import Path

from lfm_ppl.utils.compilation import MOST_DEVICES, ONE_THREAD, fast_loops

SWITCH = "LFM_PPL_CACHE"
"""Environment variable that switches the cache of compiled programs off with the value "off"."""

_SHORTEST_S = 0.2
"""Shortest compilation that is cached: dozens of shorter ones together save half a second."""

_LARGEST = 2**30
"""Largest size of the cache in bytes; a fit adds one to five million."""


def start(chains: int, keep_programs: bool = True, one_thread: bool = False) -> None:
    """Enable float64, fast loops, one device per chain and the cache of compiled programs.

    JAX fixes the number of devices with the first array. Devices share cores if there are fewer cores than chains,
    which is still faster than one chain after another.

    Args:
        chains: number of parallel chains.
        keep_programs: see `cache_folder`.
        one_thread: compute with one thread, as the workers of a cluster.
    """
    if one_thread:
        os.environ.update(ONE_THREAD)
    import jax
    import numpyro

    jax.config.update("jax_enable_x64", True)
    fast_loops()
    numpyro.set_host_device_count(min(chains, MOST_DEVICES))
    if keep_programs and not jax.config.jax_compilation_cache_dir:  # type: ignore[attr-defined]
        folder = cache_folder()
        if folder is not None and _is_ready(folder):
            _add_missing_stamps(folder)
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_compilation_cache_max_size", _LARGEST)
            jax.config.update("jax_persistent_cache_min_compile_time_secs", _SHORTEST_S)


def cache_folder() -> Path | None:
    """Return the folder of compiled programs; None: no cache.

    The folder is ``$XDG_CACHE_HOME/lfm_ppl``, or ``~/.cache/lfm_ppl``, and in it one for each kind of CPU: programs
    hold its instructions, and a home may be shared by several machines. The environment variable ``LFM_PPL_CACHE=off``
    switches it off; a folder that ``JAX_COMPILATION_CACHE_DIR`` names takes its place.
    """
    if os.environ.get(SWITCH, "").lower() in ("off", "0", "no", "false"):
        return None
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):  # the XDG specification ignores relative paths
        base = os.path.expanduser("~/.cache")
    return Path(base) / "lfm_ppl" / hashlib.sha256(_cpu().encode()).hexdigest()[:12]


def _add_missing_stamps(folder: Path) -> None:
    """Write the time of the last use that JAX stores beside each program, where a killed process has not.

    JAX 0.10 caches nothing more after one program without it (``jax/_src/lru_cache.py``).
    """
    names = set(os.listdir(folder))
    programs = (name.removesuffix("-cache") for name in names if name.endswith("-cache"))
    for stamp in {f"{program}-atime" for program in programs} - names:
        (folder / stamp).write_bytes(bytes(8))


def _cpu() -> str:
    """Return the features of the CPU."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if line.lower().startswith(("flags", "features")):
                return f"{platform.machine()} {line}"
    return f"{platform.machine()} {platform.processor()}"


def _is_ready(folder: Path) -> bool:
    """Make the folder, writable by its owner only since its programs are executed; warn on failure."""
    try:
        for path in (folder.parent, folder):
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
        owner = getattr(os, "getuid", lambda: status.st_uid)()
        if not os.access(folder, os.W_OK | os.X_OK) or status.st_uid != owner or status.st_mode & 0o022:
            raise PermissionError(f"{folder} is not writable by this user alone")
    except OSError as error:
        warnings.warn(f"compiled programs are not cached: {error}. {SWITCH}=off or --no-cache silences this.",
                      stacklevel=3)
        return False
    return True
