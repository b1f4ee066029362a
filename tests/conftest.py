"""Settings that every test needs: double precision, and compiled programs kept between runs."""

import os
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

# Most of the time of a test is compilation. JAX_COMPILATION_CACHE_DIR moves the cache.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    root = Path(__file__).resolve().parent.parent
    jax.config.update("jax_compilation_cache_dir", str(root / ".jax_cache"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
