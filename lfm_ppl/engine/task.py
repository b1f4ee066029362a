"""One piece of a larger computation, with a name, a random key, and a file of its own."""

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
    """One piece of a computation: what is computed in one go and stored in one file.

    Attributes:
        name: unlike that of every other task of the computation, such as ``state/EKF/007``.
        seed: of the computation. The key of the task follows from it and from the name alone.
        settings: whatever the result depends on, in values that JSON knows.
        data: what else is computed with, such as arrays; not stored. A digest of it belongs into the settings.

    Example:
        >>> task = Task("state/EKF/007", 0, {"model": "ginzburg-landau", "steps": 60})
        >>> task.file
        'state-EKF-007.npz'
    """

    name: str
    seed: int
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    data: Any = dataclasses.field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the name and that the settings can be stored."""
        if not self.name or set(self.name) - _ALLOWED:
            raise ValueError(f"the name of a task takes letters, digits and any of / - _ . ( ), got {self.name!r}.")
        try:
            json.dumps(dict(self.settings), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise TypeError(f"the settings of task {self.name} must be what JSON can store: {error}.") from None

    @property
    def file(self) -> str:
        """Name of the file that holds the result."""
        return f"{self.name.replace('/', '-')}.npz"

    @property
    def key(self) -> jax.Array:
        """JAX random key of the task, the same whatever else runs and in whatever order."""
        digest = hashlib.sha256(self.name.encode()).digest()
        return jax.random.fold_in(jax.random.key(self.seed), int.from_bytes(digest[:4], "big"))

    def record(self) -> dict[str, Any]:
        """Return what is stored beside the result, as JSON gives it back."""
        return json.loads(json.dumps({"name": self.name, "seed": self.seed, "settings": dict(self.settings)}))


def check_distinct(tasks: Iterable[Task]) -> None:
    """Raise ValueError where two tasks share a name, or a file.

    Example:
        >>> check_distinct([Task("a/b", 0), Task("a-b", 0)])
        Traceback (most recent call last):
            ...
        ValueError: the tasks 'a/b' and 'a-b' share the file a-b.npz; give every task a name of its own.
    """
    seen: dict[str, str] = {}
    for task in tasks:
        if task.file in seen:
            raise ValueError(f"the tasks {seen[task.file]!r} and {task.name!r} share the file {task.file}; give every "
                             "task a name of its own.")
        seen[task.file] = task.name
