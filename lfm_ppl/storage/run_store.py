"""Storage of runs: a locked folder with one atomic file of arrays per name.

1. A run locks its folder; the system releases the lock when the process ends.
2. `RunStore.put` writes the arrays of a name to a temporary file and renames it, so that a kill leaves either the old
   or the new file.
3. `RunStore.get` returns them. A resumed run computes only the missing names.

Chains (`lfm_ppl.storage.checkpoint`), batches of draws and tasks (`lfm_ppl.parallel`) use this store.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import filelock
import numpy as np

from lfm_ppl.utils.atomic_files import atomic_write
from lfm_ppl.utils.errors import FolderInUseError

_LOCK, _OWNER = ".lock", ".held-by"

_RECORD = "__task__"
"""Entry of a file that holds the settings of the arrays."""


class DamagedFileError(ValueError):
    """A stored file cannot be read."""


class RunStore:
    """Arrays in a folder, by name.

    Args:
        folder: the folder; `put` makes it.
        label: its name in messages; None: its path.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     store = RunStore(folder)
        ...     _ = store.put("draws", {"x": np.arange(3)})
        ...     store.get("draws")["x"].tolist(), store.get("scores")
        ([0, 1, 2], None)
    """

    def __init__(self, folder: str | Path, label: str | None = None) -> None:
        self.folder, self._label = Path(folder), label or str(folder)
        self._lock: filelock.BaseFileLock | None = None

    def lock(self) -> None:
        """Make the folder and lock it; a file system without locks locks nothing.

        Raises:
            FolderInUseError: another run has locked it.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = filelock.FileLock(self.folder / _LOCK, thread_local=False)
        try:
            self._lock.acquire(timeout=0)
        except filelock.Timeout:
            owner = "another run"
            with contextlib.suppress(OSError):
                owner += f" ({(self.folder / _OWNER).read_text(encoding='utf-8').strip()})"
            raise FolderInUseError(f"{self._label} is in use by {owner}. Wait until it ends, or choose another "
                                   "folder.") from None
        except (NotImplementedError, OSError):
            self._lock = None
        with contextlib.suppress(OSError):
            owner = f"process {os.getpid()} on {socket.gethostname()}\n"
            (self.folder / _OWNER).write_text(owner, encoding="utf-8")

    def release(self) -> None:
        """Release the lock, if there is one."""
        if self._lock is not None:
            with contextlib.suppress(OSError):
                (self.folder / _OWNER).unlink(missing_ok=True)
            self._lock.release()
            self._lock = None

    def __enter__(self) -> RunStore:
        self.lock()
        return self

    def __exit__(self, *error: Any) -> None:
        self.release()

    def path(self, name: str) -> Path:
        """Return the file of a name."""
        return self.folder / f"{name}.npz"

    def names(self) -> list[str]:
        """Return the stored names, sorted."""
        return sorted(path.stem for path in self.folder.glob("*.npz"))

    def has(self, name: str) -> bool:
        """Return whether a name is stored."""
        return self.path(name).is_file()

    def get(self, name: str, record: Mapping[str, Any] | None = None,
            overwrite: bool = False) -> dict[str, np.ndarray] | None:
        """Return the arrays of a name; None if it is not stored.

        Args:
            name: the name.
            record: settings with which the arrays must have been stored.
            overwrite: return None for other settings, which are an error otherwise.

        Raises:
            DamagedFileError: the file cannot be read.
            ValueError: the arrays were stored with other settings.
        """
        path = self.path(name)
        if not path.is_file():
            return None
        try:
            with np.load(path) as file:
                arrays = {key: file[key] for key in file.files}
            stored = {} if record is None else json.loads(str(arrays.pop(_RECORD)))
        except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise DamagedFileError(f"{path} is damaged ({type(error).__name__}: {error}). Start the run anew with "
                                   "overwrite=True (--overwrite), or in another folder.") from error
        if record is None or stored == record:
            return arrays
        if overwrite:
            return None
        old, new = ({**entries, **entries.get("settings", {}), "settings": None} for entries in (stored, record))
        differences = [f"{key} is {old.get(key)!r} there and {new.get(key)!r} now"
                       for key in {**old, **new} if old.get(key) != new.get(key)]
        raise ValueError(f"{path} holds a result with other settings: {', '.join(differences[:3])}. Choose another "
                         "folder, or replace it with overwrite=True (--overwrite on the command line).")

    def put(self, name: str, arrays: Mapping[str, Any], record: Mapping[str, Any] | None = None) -> Path:
        """Store the arrays of a name with the settings of `get`, atomically, and return the file."""
        path, entries = self.path(name), {} if record is None else {_RECORD: json.dumps(record)}
        with atomic_write(path, overwrite=True) as temporary, temporary.open("wb") as file:
            np.savez(file, **{**entries, **arrays})
        return path

    def clear(self) -> None:
        """Remove everything but the lock."""
        for path in self.folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name not in (_LOCK, _OWNER):
                path.unlink()

    def remove(self) -> None:
        """Release the lock and remove the folder."""
        self.release()
        shutil.rmtree(self.folder, ignore_errors=True)
