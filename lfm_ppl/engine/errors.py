"""What can go wrong when many tasks are computed; imports nothing, so that the command line knows it at no cost."""

from __future__ import annotations

from collections.abc import Mapping

_SHOWN = 5
"""Failed tasks that a message names with their reasons; the others are counted."""


class EngineError(RuntimeError):
    """A run of tasks cannot go on, or not all of them could be computed."""


class ClusterError(EngineError):
    """Workers cannot be had: no Dask, no scheduler, none that fits, or they are gone."""


class FolderInUseError(EngineError):
    """Another run writes to the folder."""


class TasksFailedError(EngineError):
    """Some tasks failed; all others are computed and stored.

    Attributes:
        failed: name of a task -> why it failed.
    """

    def __init__(self, failed: Mapping[str, str], total: int, stored: bool = True) -> None:
        self.failed, self.total, self.stored = dict(failed), total, stored
        shown = "; ".join(f"{name}: {reason.rstrip('.')}" for name, reason in list(failed.items())[:_SHOWN])
        more = f"; and {len(failed) - _SHOWN} more" if len(failed) > _SHOWN else ""
        left = (" The results of the others are stored; the same call or command computes only what failed."
                if stored and len(failed) < total else "")
        super().__init__(f"{len(failed)} of {total} tasks failed: {shown}{more}.{left}")

    def __reduce__(self) -> tuple:
        """Return how to pickle it: by what it was made of."""
        return type(self), (self.failed, self.total, self.stored)
