"""Code that tests run in a process of its own."""

import os
import subprocess
import sys
import time
from pathlib import Path

import jax

ROOT = Path(__file__).resolve().parents[1]


def on_two_devices(code: str) -> subprocess.CompletedProcess:
    """Run code on two CPU devices, for chains that really run in parallel; they exist in a fresh process only."""
    environment = os.environ | {
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2",
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir or "",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=environment,
                          timeout=300)


def start_python(*arguments: str, **options) -> subprocess.Popen:
    """Start Python in a session of its own; options as of `Popen`."""
    return subprocess.Popen([sys.executable, *arguments], cwd=ROOT, start_new_session=True, text=True, **options)


def is_running(pid: int) -> bool:
    """Return whether a process runs; an ended process that nobody has waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(condition, seconds: float = 120.0) -> None:
    """Wait until a condition holds; fail after some seconds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)
