"""One run at a time in a folder; the system lets the next one in when a process ends, however it ends."""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path

import filelock

from lfm_ppl.engine.errors import FolderInUseError

FILE, HOLDER = ".lock", ".held-by"


class FolderLock:
    """Keeps other runs out of a folder, which exists, until `release`.

    Args:
        folder: the folder. On a file system without locks nobody is kept out.
        what: what a message calls it; None: its path.

    Raises:
        FolderInUseError: another run holds it.
    """

    def __init__(self, folder: Path, what: str | None = None) -> None:
        self._holder = folder / HOLDER
        self._lock: filelock.BaseFileLock | None = filelock.FileLock(folder / FILE, thread_local=False)
        try:
            self._lock.acquire(timeout=0)
        except filelock.Timeout:
            holder = "another run"
            with contextlib.suppress(OSError):
                holder += f" ({self._holder.read_text(encoding='utf-8').strip()})"
            raise FolderInUseError(f"{what or folder} is in use by {holder}. Wait until that ends, or choose another "
                                   "folder.") from None
        except (NotImplementedError, OSError):
            self._lock = None
        with contextlib.suppress(OSError):
            self._holder.write_text(f"process {os.getpid()} on {socket.gethostname()}\n", encoding="utf-8")

    def release(self) -> None:
        """Let others in."""
        with contextlib.suppress(OSError):
            self._holder.unlink(missing_ok=True)
        if self._lock is not None:
            self._lock.release()
            self._lock = None
