"""``lfm-ppl version``: what is installed."""

from __future__ import annotations

import argparse
import platform
from importlib import metadata

import lfm_ppl

STANDS_ON = ("jax", "numpyro", "arviz", "equinox", "numpy")


def run(arguments: argparse.Namespace) -> int:
    """Print one line for each package."""
    print(f"lfm_ppl {lfm_ppl.__version__}")
    for name in STANDS_ON:
        print(f"{name} {metadata.version(name)}")
    print(f"python {platform.python_version()}")
    return 0
