"""The checkpoint of a run: state of the chains, their draws, and batches of results computed from the draws.

The folder ``checkpoint`` beside the result, a `RunStore`, exists until the result is complete:

    run.json            record of the run: settings, versions, digests of model and data
    setup.npz           numbers that were chosen before the first step, as JSON
    state.npz           number of steps, and the state of all chains with adaptation and random keys
    draws-NAME.npy      (C, N, ...) draws, of which the first ``draws`` of ``state.npz`` are valid
    NAME/000123.npz     results computed from the draws from number 123 on

1. Write new draws, then replace ``state.npz`` atomically: a killed run resumes from the last state and writes later
   draws again.
2. From time to time write the draws so far as a partial result.
3. Remove the folder when the result is complete.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.inference.sampling import Saved
from lfm_ppl.results import arviz_data
from lfm_ppl.results.files import CHECKPOINT, POSTERIOR
from lfm_ppl.results.run_record import as_json, check_same
from lfm_ppl.utils.atomic_files import atomic_write
from lfm_ppl.utils.run_store import DamagedFileError, RunStore

_RUN, _SETUP, _STATE = "run.json", "setup", "state"

_EVERY_S = 1.0
"""Shortest time between two states on disk."""

_PARTIAL_S, _PARTIAL_SHARE = 15.0, 0.01
"""Shortest time between two partial results on disk, and the share of the time that they may take."""


class Checkpoint:
    """Storage of a run in ``folder/checkpoint``; made by `begin` or `resume`.

    Attributes:
        folder: folder of the result.
        record: record of the run.
        write_partial: writes a partial result of draws, name -> (C, n, ...).
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.record: dict[str, Any] = {}
        self.write_partial: Callable[[Mapping[str, np.ndarray]], None] | None = None
        self._store = RunStore(folder / CHECKPOINT, f"the run in {folder}")
        self._stored_draws = 0
        self._state_time = self._partial_time = time.perf_counter()
        self._partial_seconds = 0.0
        self._earlier_seconds, self._start_time = 0.0, time.perf_counter()

    @classmethod
    def begin(cls, folder: str | Path, record: Mapping[str, Any]) -> Checkpoint:
        """Begin a run in the folder of its result, and remove an earlier one."""
        checkpoint = cls(Path(folder))
        checkpoint._store.lock()
        checkpoint._store.clear()
        checkpoint.record = as_json(record)
        with atomic_write(checkpoint._store.folder / _RUN, overwrite=True) as temporary:
            temporary.write_text(json.dumps(checkpoint.record, indent=1), encoding="utf-8")
        return checkpoint

    @classmethod
    def resume(cls, folder: str | Path, record: Mapping[str, Any]) -> Checkpoint:
        """Resume a run.

        Raises:
            FileNotFoundError: the folder holds no unfinished run.
            ValueError: the run has another record; the message lists the differences.
            FolderInUseError: another process has resumed it.
        """
        checkpoint = cls(Path(folder))
        path = checkpoint._store.folder / _RUN
        if not path.is_file():
            raise FileNotFoundError(f"{folder} holds no run to resume; expected the folder of an unfinished run.")
        with _explain_damage(path):
            checkpoint.record = dict(json.loads(path.read_text(encoding="utf-8")))
        check_same(folder, checkpoint.record, record)
        state = checkpoint._store.get(_STATE)
        checkpoint._earlier_seconds = 0.0 if state is None else float(state["seconds"])
        checkpoint._store.lock()
        for temporary in Path(folder).glob(".*.part*"):  # of a killed process
            temporary.unlink(missing_ok=True)
        return checkpoint

    @property
    def seconds(self) -> float:
        """Time that the run has taken, with earlier parts."""
        return self._earlier_seconds + time.perf_counter() - self._start_time

    @property
    def has_state(self) -> bool:
        """Whether a state of the chains is stored."""
        return self._store.has(_STATE)

    @property
    def setup(self) -> dict[str, Any] | None:
        """Numbers that were chosen before the first step; None before they are known."""
        arrays = self._store.get(_SETUP)
        return None if arrays is None else json.loads(str(arrays["json"]))

    @setup.setter
    def setup(self, values: Mapping[str, Any]) -> None:
        self._store.put(_SETUP, {"json": json.dumps(as_json(values))})

    def restore(self) -> Saved | None:
        """Return the stored state of the chains with their draws; None before the first state."""
        state = self._store.get(_STATE)
        if state is None:
            return None
        self._stored_draws = int(state["draws"])
        leaves = [state[f"leaf{index}"] for index in range(int(state["leaves"]))]
        draws = {}
        for name in state["names"]:
            with _explain_damage(path := self._draws_path(name)):
                draws[str(name)] = np.load(path)
        return Saved(int(state["done"]), leaves, draws)

    def due(self) -> bool:
        """Return whether the stored state is older than a second."""
        return time.perf_counter() - self._state_time >= _EVERY_S

    def save(self, saved: Saved, draws: int) -> None:
        """Write the new draws, and then the state that counts them."""
        for name, values in saved.rows.items():
            path = self._draws_path(name)
            if not path.exists() or not self.has_state:  # without a state the file may be incomplete
                np.lib.format.open_memmap(path, "w+", values.dtype, values.shape).flush()
            if draws > self._stored_draws:
                stored = np.load(path, mmap_mode="r+")
                stored[:, self._stored_draws:draws] = values[:, self._stored_draws:draws]
                stored.flush()
        leaves = {f"leaf{index}": leaf for index, leaf in enumerate(saved.leaves)}
        self._store.put(_STATE, {"done": saved.done, "draws": draws, "leaves": len(leaves), "names": list(saved.rows),
                                 "seconds": self.seconds, **leaves})
        self._stored_draws, self._state_time = draws, time.perf_counter()
        wait = max(_PARTIAL_S, self._partial_seconds / _PARTIAL_SHARE)
        if draws and self.write_partial is not None and self._state_time - self._partial_time >= wait:
            self.write_partial({name: values[:, :draws] for name, values in saved.rows.items()})
            self._partial_time = time.perf_counter()
            self._partial_seconds = self._partial_time - self._state_time

    def get_or_compute(self, name: str, compute: Callable[[], Mapping[str, Any]]) -> dict[str, np.ndarray]:
        """Return the stored arrays of a name; compute and store them first if necessary."""
        if not self._store.has(name):
            self._store.put(name, compute())
        arrays = self._store.get(name)
        assert arrays is not None
        return arrays

    def has(self, name: str) -> bool:
        """Return whether the arrays of a name are stored."""
        return self._store.has(name)

    def batches(self, name: str) -> Batches:
        """Return the storage of batches of results."""
        return Batches(RunStore(self._store.folder / re.sub(r"\W+", "-", name)))

    def finish(self) -> None:
        """Remove the checkpoint of a complete result."""
        self._store.remove()

    def close(self) -> None:
        """Release the lock, and remove a checkpoint without results."""
        self._store.release()
        if not any(self._store.folder.rglob("*.npz")):
            self._store.remove()

    def _draws_path(self, name: str) -> Path:
        return self._store.folder / f"draws-{name}.npy"


class Batches:
    """Batches of results by the index of their first draw; a batch is an array or a dict of arrays.

    Batches are written together, at most once a second.

    Args:
        store: the store of their files.
    """

    def __init__(self, store: RunStore) -> None:
        self._store = store
        self._pending: dict[int, Any] = {}
        self._write_time = time.perf_counter()
        self._stored: dict[int, Any] = {}
        for name in store.names():
            for key, array in (store.get(name) or {}).items():
                start, _, entry = key.partition("/")
                if entry:
                    self._stored.setdefault(int(start), {})[entry] = array
                else:
                    self._stored[int(start)] = array

    def get(self, start: int) -> Any:
        """Return the batch whose first draw is ``start``; None if it is not stored."""
        return self._stored.get(start)

    def put(self, start: int, batch: Any) -> None:
        """Store a batch, an array or a dict of arrays."""
        self._pending[start] = batch
        if time.perf_counter() - self._write_time >= _EVERY_S:
            self.flush()

    def flush(self) -> None:
        """Write the pending batches."""
        if self._pending:
            arrays: dict[str, Any] = {}
            for start, batch in self._pending.items():
                entries = batch if isinstance(batch, Mapping) else {"": batch}
                arrays |= {f"{start}/{name}".rstrip("/"): np.asarray(value) for name, value in entries.items()}
            self._store.put(f"{min(self._pending):09d}", arrays)
            self._pending = {}
        self._write_time = time.perf_counter()


@contextlib.contextmanager
def _explain_damage(path: Path) -> Iterator[None]:
    """Name the file of an error in the block, which reads it."""
    try:
        yield
    except (OSError, EOFError, TypeError, ValueError) as error:
        raise DamagedFileError(f"{path} is damaged ({type(error).__name__}: {error}). Start the run anew with "
                               "overwrite=True (--overwrite), or in another folder.") from error


def check_folder(folder: str | Path, resume: bool, overwrite: bool) -> None:
    """Raise an error if a run in this folder would replace something, or cannot be resumed.

    Raises:
        FileExistsError: the folder holds a result or a run, which is neither resumed nor replaced.
        FileNotFoundError: the folder holds other files, and no run to resume.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder} is a file; expected the name of a folder for the run.")
    is_stored = has_run(folder)
    if resume and not is_stored and not (folder / POSTERIOR).is_file() and folder.is_dir() and any(folder.iterdir()):
        raise FileNotFoundError(f"{folder} holds files, but no run to resume. Name the folder of the run.")
    if not resume and not overwrite and (is_stored or (folder / POSTERIOR).is_file()):
        raise FileExistsError(f"{folder} holds {'an unfinished run' if is_stored else 'a result'}. "
                              + ("Resume it with resume=True (--resume), name" if is_stored else "Name")
                              + " another folder, or replace it with overwrite=True (--overwrite).")


def has_run(folder: str | Path) -> bool:
    """Return whether a folder holds an unfinished run."""
    return (Path(folder) / CHECKPOINT / _RUN).is_file()


def is_finished(folder: str | Path) -> bool:
    """Return whether a folder holds a result and no unfinished run."""
    return (Path(folder) / POSTERIOR).is_file() and not has_run(folder)


def remove_run(folder: str | Path) -> None:
    """Remove the checkpoint of a folder, and the folder if it is empty."""
    shutil.rmtree(Path(folder) / CHECKPOINT, ignore_errors=True)
    with contextlib.suppress(OSError):  # the folder is not empty
        Path(folder).rmdir()


def finished_result(folder: str | Path, record: Mapping[str, Any]) -> Any:
    """Return the result of a finished run; None for an unfinished one.

    Raises:
        ValueError: it is the result of another run; the message lists the differences.
    """
    path = Path(folder) / POSTERIOR
    if not is_finished(folder):
        return None
    result = arviz_data.load(path)
    run = result.attrs.get("run")
    if not isinstance(run, Mapping):
        raise ValueError(f"{path} has no record of its run, which cannot be resumed. Start a new run in another "
                         "folder.")
    check_same(folder, run, record)
    return result


def begin_or_resume(folder: str | Path, record: Mapping[str, Any], resume: bool) -> Checkpoint:
    """Resume the run in a folder if requested and possible; begin a run otherwise."""
    if resume and has_run(folder):
        return Checkpoint.resume(folder, record)
    return Checkpoint.begin(folder, record)
