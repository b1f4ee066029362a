"""A task: a part of a computation with a name, a random key and a file."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import string
from collections.abc import Iterable, Mapping
from typing import Any

import jax

Result = dict[str, Any]
"""Name -> number, text or small array."""

_ALLOWED = frozenset(string.ascii_letters + string.digits + "/-_.()")


@dataclasses.dataclass(frozen=True)
class Task:
    """A part of a computation, stored in one file.

    Attributes:
        name: unique name, such as ``state/EKF/007``.
        seed: seed of the computation; seed and name determine the random key of the task.
        settings: values that the result depends on, storable as JSON.
        data: further arguments, such as arrays, which are not stored. Put a digest of them into the settings.

    Example:
        >>> task = Task("state/EKF/007", 0, {"model": "ginzburg-landau", "steps": 60})
        >>> task.stem
        'state-EKF-007'
    """

    name: str
    seed: int
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    data: Any = dataclasses.field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the name and that the settings can be stored."""
        if not self.name or set(self.name) - _ALLOWED:
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


def check_distinct(tasks: Iterable[Task]) -> None:
    """Raise ValueError if two tasks share a name or a file.

    Example:
        >>> check_distinct([Task("a/b", 0), Task("a-b", 0)])
        Traceback (most recent call last):
            ...
        ValueError: the tasks 'a/b' and 'a-b' share the file a-b.npz; use unique names.
    """
    seen: dict[str, str] = {}
    for task in tasks:
        if task.stem in seen:
            raise ValueError(f"the tasks {seen[task.stem]!r} and {task.name!r} share the file {task.stem}.npz; use "
                             "unique names.")
        seen[task.stem] = task.name
