"""A task: a part of a computation with a name, a random key and a file."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

Result = dict[str, Any]
"""Name -> number, text or small array."""


@dataclasses.dataclass(frozen=True)
class Task:
    """A part of a computation, stored in one file.

    Attributes:
        name: unique name, such as ``state/EKF/007``.
        seed: seed of the computation; seed and name determine the random key of the task.
        settings: values that the result depends on, storable as JSON.
        data: further arguments, such as arrays, which are not stored. Put a digest of them into the settings.
    """

    name: str
    seed: int
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    data: Any = dataclasses.field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9/_.()-]+", self.name):
            raise ValueError(f"the name of a task may have letters, digits and / - _ . ( ), got {self.name!r}.")
        try:
            json.dumps(dict(self.settings), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise TypeError(f"the settings of task {self.name} must be storable as JSON: {error}.") from None

    @property
    def stem(self) -> str:
        """Name of the result in a store: the file without its suffix."""
        return self.name.replace("/", "-")

    @property
    def key(self) -> jax.Array:
        """JAX random key of the task, independent of other tasks and of the order."""
        digest = hashlib.sha256(self.name.encode()).digest()
        return jax.random.fold_in(jax.random.key(self.seed), int.from_bytes(digest[:4], "big"))

    def record(self) -> dict[str, Any]:
        """Return name, seed and settings as read back from JSON."""
        return json.loads(json.dumps({"name": self.name, "seed": self.seed, "settings": dict(self.settings)}))


Compute = Callable[[Task], Mapping[str, Any]]
TimedArrays = tuple[dict[str, np.ndarray], float]
Computed = tuple[Task, TimedArrays | Exception, int]


def compute_task(compute: Compute, task: Task) -> TimedArrays:
    """Return the result of a task as arrays, and the seconds that it took."""
    start_time = time.perf_counter()
    arrays = {name: np.asarray(value) for name, value in compute(task).items()}
    for name, array in arrays.items():
        if array.dtype.kind not in "biufU":
            raise TypeError(f"entry {name!r} of the result must be a number, an array of numbers or text, got "
                            f"{type(array.ravel()[0]).__name__}.")
    return arrays, time.perf_counter() - start_time
