"""A lock on a folder, which the system releases when a process ends."""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path

import filelock

from lfm_ppl.parallel.errors import FolderInUseError

FILE, HOLDER = ".lock", ".held-by"


class FolderLock:
    """Lock of an existing folder, held until `release`.

    Args:
        folder: the folder. A file system without locks locks nothing.
        label: its name in messages; None: its path.

    Raises:
        FolderInUseError: another run holds it.
    """

    def __init__(self, folder: Path, label: str | None = None) -> None:
        self._holder = folder / HOLDER
        self._lock: filelock.BaseFileLock | None = filelock.FileLock(folder / FILE, thread_local=False)
        try:
            self._lock.acquire(timeout=0)
        except filelock.Timeout:
            holder = "another run"
            with contextlib.suppress(OSError):
                holder += f" ({self._holder.read_text(encoding='utf-8').strip()})"
            raise FolderInUseError(f"{label or folder} is in use by {holder}. Wait until it ends, or choose another "
                                   "folder.") from None
        except (NotImplementedError, OSError):
            self._lock = None
        with contextlib.suppress(OSError):
            self._holder.write_text(f"process {os.getpid()} on {socket.gethostname()}\n", encoding="utf-8")

    def release(self) -> None:
        """Release the lock."""
        with contextlib.suppress(OSError):
            self._holder.unlink(missing_ok=True)
        if self._lock is not None:
            self._lock.release()
            self._lock = None
