"""The record of a run: settings, versions and digests, by which a resumed run recognizes its own checkpoint."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_SHOWN = 6
"""Number of differences between two runs that a message names."""


def digest(*values: Any) -> str:
    """Return a digest of arrays (shape, type, bytes) and of the repr of other values, without addresses.

    Example:
        >>> digest(np.arange(3.0)) == digest(np.arange(3.0)), digest([1, 2]) == digest([2, 1])
        (True, False)
    """
    sha = hashlib.sha256()
    for value in values:
        if isinstance(value, (np.ndarray, np.generic, jax.Array)):
            array = np.asarray(value)
            sha.update(f"{array.shape}{array.dtype}".encode() + array.tobytes())
        else:
            sha.update(re.sub(r"0x[0-9a-f]+", "", repr(value)).encode())
    return _DIGEST + sha.hexdigest()


_DIGEST = "sha256:"

_MODEL_SETTINGS = ("rule", "steps", "max_step", "iterations", "tolerance", "method", "constraints", "factors",
                   "fixed")
"""Entries of a record that the digest of the model depends on."""


def versions() -> dict[str, str]:
    """Return the versions of the packages that numbers depend on, and the precision."""
    packages = {"python": sys.version.split()[0], "precision": str(np.dtype(jnp.result_type(float)))}
    for name in ("lfm_ppl", "jax", "jaxlib", "numpyro", "numpy", "equinox"):
        try:
            packages[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            packages[name] = "not installed"
    return packages


def check_same(folder: str | Path, stored: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Raise ValueError if two records differ; the message lists the differences."""
    record = as_json(record)
    differences = list(_differences(stored, record))
    if any(part.partition(" ")[0] in _MODEL_SETTINGS for part in differences):
        # The digest of the model depends on these, too.
        differences = [part for part in differences if part != "model differs"]
    if differences:
        more = [f"and {len(differences) - _SHOWN} more"] if len(differences) > _SHOWN else []
        raise ValueError(f"cannot resume the run in {folder}, which differs from this one: "
                         f"{'; '.join(differences[:_SHOWN] + more)}. Use the settings of that run, or start a new run "
                         "in another folder.")


def _differences(stored: Mapping[str, Any], record: Mapping[str, Any]) -> Iterator[str]:
    for name in dict.fromkeys([*stored, *record]):
        old, new = stored.get(name), record.get(name)
        if old == new:
            continue
        if str(old).startswith(_DIGEST) or str(new).startswith(_DIGEST):
            yield f"{name} {'differ' if name.endswith('s') or name == 'data' else 'differs'}"
        elif isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from _differences({f"{name} {key}": value for key, value in old.items()},
                                    {f"{name} {key}": value for key, value in new.items()})
        else:
            yield f"{name} was {_format_value(old)} and is {_format_value(new)}"


def _format_value(value: Any) -> str:
    return "not given" if value is None else json.dumps(value) if isinstance(value, (dict, list)) else str(value)


def as_json(values: Any) -> Any:
    """Return values as read back from JSON."""
    def encode(value: Any) -> Any:
        if isinstance(value, (np.ndarray, np.generic, jax.Array)):
            return np.asarray(value).tolist()
        return re.sub(r"0x[0-9a-f]+", "", repr(value))

    return json.loads(json.dumps(values, default=encode))
