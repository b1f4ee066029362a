"""Errors of tasks, without imports, so that the command line starts fast."""

from __future__ import annotations

from collections.abc import Mapping

from lfm_ppl.utils.errors import RunError

_SHOWN = 5
"""Number of failed tasks whose reasons a message names."""


class ClusterError(RunError):
    """No workers: no Dask, no scheduler, other versions, or a lost connection."""


class TasksFailedError(RunError):
    """Some tasks failed; all others are computed and stored.

    Attributes:
        failed: name of a task -> reason.
    """

    def __init__(self, failed: Mapping[str, str], total: int, stored: bool = True) -> None:
        self.failed, self.total, self.stored = dict(failed), total, stored
        named_failures = "; ".join(f"{name}: {reason.rstrip('.')}" for name, reason in list(failed.items())[:_SHOWN])
        more = f"; and {len(failed) - _SHOWN} more" if len(failed) > _SHOWN else ""
        remedy = (" The results of the others are stored; the same call or command computes only the failed tasks."
                if stored and len(failed) < total else "")
        super().__init__(f"{len(failed)} of {total} tasks failed: {named_failures}{more}.{remedy}")

    def __reduce__(self) -> tuple:
        """Return the arguments for pickling."""
        return type(self), (self.failed, self.total, self.stored)
