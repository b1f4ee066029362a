"""Errors of tasks, without imports, so that the command line starts fast."""

from __future__ import annotations

from collections.abc import Mapping

from lfm_ppl.utils.errors import RunError


class ClusterError(RunError):
    """No workers: no Dask, no scheduler, other versions, or a lost connection."""


class TasksFailedError(RunError):
    """Some tasks failed; all others are computed. Its attribute ``failed`` maps their names to reasons."""

    def __init__(self, failed: Mapping[str, str], total: int, stored: bool = True) -> None:
        self.failed = dict(failed)
        reasons = [f"{name}: {reason.rstrip('.')}" for name, reason in failed.items()]
        more = f"; and {len(reasons) - 5} more" if len(reasons) > 5 else ""
        remedy = (" The results of the others are stored; the same call or command computes only the failed tasks."
                  if stored and len(failed) < total else "")
        super().__init__(f"{len(failed)} of {total} tasks failed: {'; '.join(reasons[:5])}{more}.{remedy}")
