"""What is computed, kept on disk while it goes on: the state of chains, their draws, and what follows from them.

A folder ``checkpoint`` stands in the folder of the result until that is whole. It holds

    run.json            what the run is of: settings, versions, and digests of model and data
    setup.json          numbers that were chosen before the first step
    state.npz           steps that were taken, and the state of all chains, with adaptation and random keys
    draws-NAME.npy      (C, N, ...) draws, of which ``state.npz`` says how many are known
    NAME/000123.npz     what was computed from the draws from number 123 on

``state.npz`` is replaced as a whole, after the draws that it counts: whenever a run is killed, it goes on from the last
state, and writes the later draws again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import shutil
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.parallel import lock
from lfm_ppl.parallel.lock import FolderLock
from lfm_ppl.inference.sampling import Saved
from lfm_ppl.results import arviz_data
from lfm_ppl.results.files import CHECKPOINT, POSTERIOR, writing

_RUN, _SETUP, _STATE = "run.json", "setup.json", "state.npz"

_SHOWN = 6
"""Differences between two runs that a message names; the others are counted."""

_EVERY_S = 1.0
"""Shortest time between two states on disk."""

_LOOK_S, _LOOK_SHARE = 15.0, 0.01
"""Shortest time between two partial results on disk, and the share of the time that they may take."""


class Checkpoint:
    """Keeps a run in ``folder/checkpoint``; made by `begin` or `resume`.

    Attributes:
        folder: of the result.
        record: what the run is of.
        look: writes a partial result of draws, name -> (C, n, ...); called now and then.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.record: dict[str, Any] = {}
        self.look: Callable[[Mapping[str, np.ndarray]], None] = _no_look
        self._own = folder / CHECKPOINT
        self._lock: FolderLock | None = None
        self._written = 0
        self._saved = self._looked = time.perf_counter()
        self._look_took = 0.0
        self._earlier_s, self._began = 0.0, time.perf_counter()

    @classmethod
    def begin(cls, folder: str | Path, record: Mapping[str, Any]) -> Checkpoint:
        """Begin a run, in the place of one that was kept here before.

        Args:
            folder: of the result; it is made.
            record: what the run is of, as JSON has it.
        """
        checkpoint = cls(Path(folder))
        checkpoint._own.mkdir(parents=True, exist_ok=True)
        checkpoint._hold()
        checkpoint._forget()
        checkpoint.record = _plain(record)
        checkpoint._write(_RUN, checkpoint.record)
        return checkpoint

    @classmethod
    def resume(cls, folder: str | Path, record: Mapping[str, Any]) -> Checkpoint:
        """Go on with a run.

        Raises:
            FileNotFoundError: no run is kept here.
            ValueError: it is a run of something else; the message says in what it differs.
            FolderInUseError: another process goes on with it.
        """
        checkpoint = cls(Path(folder))
        path = checkpoint._own / _RUN
        if not path.is_file():
            raise FileNotFoundError(f"{folder} holds no run to go on with; expected a folder in which a run was begun "
                                    "and not finished.")
        checkpoint.record = _record(path)
        check_same(folder, checkpoint.record, record)
        checkpoint._earlier_s = checkpoint._of_state("seconds") or 0.0
        checkpoint._hold()
        for partial_file in Path(folder).glob(".*.part*"):  # by a process that was killed
            partial_file.unlink(missing_ok=True)
        return checkpoint

    @property
    def seconds(self) -> float:
        """Time that the run has taken, in all."""
        return self._earlier_s + time.perf_counter() - self._began

    @property
    def started(self) -> bool:
        """Whether there is a state of chains to go on from."""
        return (self._own / _STATE).is_file()

    @property
    def done(self) -> int | None:
        """Steps that the chains have taken; None before the first state."""
        return self._of_state("done")

    @property
    def setup(self) -> dict[str, Any] | None:
        """Numbers that were chosen before the first step; None where they are not known yet."""
        path = self._own / _SETUP
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None

    @setup.setter
    def setup(self, values: Mapping[str, Any]) -> None:
        self._write(_SETUP, _plain(values))

    def restore(self) -> Saved | None:
        """Return where the chains stood; None before the first state."""
        path = self._own / _STATE
        if not path.is_file():
            return None
        with _readable(path), np.load(path) as file:
            leaves = [file[f"leaf{index}"] for index in range(int(file["leaves"]))]
            done, names = int(file["done"]), [str(name) for name in file["names"]]
            self._written = int(file["draws"])
        rows = {}
        for name in names:
            with _readable(self._rows(name)):
                rows[name] = np.load(self._rows(name))
        return Saved(done, leaves, rows)

    def due(self) -> bool:
        """Whether the last state on disk is older than a second."""
        return time.perf_counter() - self._saved >= _EVERY_S

    def save(self, saved: Saved, draws: int) -> None:
        """Write the draws that are new, and then the state that counts them."""
        for name, values in saved.rows.items():
            path = self._rows(name)
            if not path.exists() or not self.started:  # before the first state a file may be cut off
                np.lib.format.open_memmap(path, "w+", values.dtype, values.shape).flush()
            if draws > self._written:
                stored = np.load(path, mmap_mode="r+")
                stored[:, self._written : draws] = values[:, self._written : draws]
                stored.flush()
        arrays: dict[str, Any] = {f"leaf{index}": leaf for index, leaf in enumerate(saved.leaves)}
        with writing(self._own / _STATE, overwrite=True) as temporary, temporary.open("wb") as file:
            np.savez(file, done=saved.done, draws=draws, leaves=len(saved.leaves), names=list(saved.rows),
                     seconds=self.seconds, **arrays)
        self._written, self._saved = draws, time.perf_counter()
        wait = max(_LOOK_S, self._look_took / _LOOK_SHARE)
        if draws and self._saved - self._looked >= wait:
            self.look({name: values[:, :draws] for name, values in saved.rows.items()})
            self._looked = time.perf_counter()
            self._look_took = self._looked - self._saved

    def once(self, name: str, compute: Callable[[], Mapping[str, Any]]) -> dict[str, np.ndarray]:
        """Return arrays that are computed once, and read from disk when the run goes on."""
        path = self._own / f"{name}.npz"
        if not path.is_file():
            with writing(path, overwrite=True) as temporary, temporary.open("wb") as file:
                np.savez(file, **dict[str, Any](compute()))
        with np.load(path) as file:
            return {key: file[key] for key in file.files}

    def holds(self, name: str) -> bool:
        """Whether what `once` computes under this name is there."""
        return (self._own / f"{name}.npz").is_file()

    def parts(self, name: str) -> Parts:
        """Return what keeps batches of what is computed from draws."""
        return Parts(self._own / re.sub(r"\W+", "-", name))

    def finish(self) -> None:
        """Remove what was kept: the result is whole."""
        self._release()
        shutil.rmtree(self._own, ignore_errors=True)

    def close(self) -> None:
        """Let another process go on; nothing is left where no chain has started."""
        self._release()
        if not self.started and not any(self._own.rglob("*.npz")):
            shutil.rmtree(self._own, ignore_errors=True)

    def _rows(self, name: str) -> Path:
        return self._own / f"draws-{name}.npy"

    def _of_state(self, name: str) -> Any:
        """Return a number that was written with the state of the chains; None before the first one."""
        path = self._own / _STATE
        if not path.is_file():
            return None
        with _readable(path), np.load(path) as file:
            return file[name].item()

    def _write(self, name: str, content: Mapping[str, Any]) -> None:
        with writing(self._own / name, overwrite=True) as temporary:
            temporary.write_text(json.dumps(content, indent=1), encoding="utf-8")

    def _forget(self) -> None:
        for path in self._own.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name not in (lock.FILE, lock.HOLDER):
                path.unlink()

    def _hold(self) -> None:
        """Keep other processes from going on with the same run."""
        self._lock = FolderLock(self._own, f"the run in {self.folder}")

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None


class Parts:
    """Keeps batches on disk: ``first draw -> pytree of dicts or an array``.

    Batches are written together, when a second has passed since the last ones were.

    Args:
        folder: of their files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._waiting = folder, {}  # type: ignore[var-annotated]
        self._written = time.perf_counter()
        self._known: dict[int, Any] = {}
        for path in sorted(folder.glob("*.npz")) if folder.is_dir() else ():
            with np.load(path) as file:
                for key in file.files:
                    start, _, name = key.partition("/")
                    if name:
                        self._known.setdefault(int(start), {})[name] = file[key]
                    else:
                        self._known[int(start)] = file[key]

    def get(self, start: int) -> Any:
        """Return the batch that begins with this draw; None where it is not known."""
        return self._known.get(start)

    def put(self, start: int, part: Any) -> None:
        """Keep a batch, an array or a dict of arrays."""
        self._waiting[start] = part
        if time.perf_counter() - self._written >= _EVERY_S:
            self.flush()

    def flush(self) -> None:
        """Write what was not yet."""
        if self._waiting:
            arrays: dict[str, Any] = {}
            for start, part in self._waiting.items():
                named = part if isinstance(part, Mapping) else {"": part}
                arrays |= {f"{start}/{name}".rstrip("/"): np.asarray(value) for name, value in named.items()}
            with writing(self._folder / f"{min(self._waiting):09d}.npz", overwrite=True) as temporary:
                with temporary.open("wb") as file:
                    np.savez(file, **arrays)
            self._waiting = {}
        self._written = time.perf_counter()


def digest(*values: Any) -> str:
    """Return a digest of arrays (shape, type and bytes) and of anything else by its repr, without addresses in it.

    Example:
        >>> digest(np.arange(3.0)) == digest(np.arange(3.0)), digest([1, 2]) == digest([2, 1])
        (True, False)
    """
    sha = hashlib.sha256()
    for value in values:
        if isinstance(value, (np.ndarray, np.generic, jax.Array)):
            array = np.asarray(value)
            sha.update(f"{array.shape}{array.dtype}".encode() + array.tobytes())
        else:
            sha.update(re.sub(r"0x[0-9a-f]+", "", repr(value)).encode())
    return _DIGEST + sha.hexdigest()


_DIGEST = "sha256:"

_OF_MODEL = ("rule", "steps", "max_step", "iterations", "tolerance", "constraints", "sites", "fixed")
"""Entries of a record that the digest of the model depends on, too."""


def versions() -> dict[str, str]:
    """Return the versions of all that numbers depend on, and their precision."""
    packages = {"python": sys.version.split()[0], "precision": str(np.dtype(jnp.result_type(float)))}
    for name in ("lfm_ppl", "jax", "jaxlib", "numpyro", "numpy", "equinox"):
        try:
            packages[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            packages[name] = "not installed"
    return packages


def check_same(folder: str | Path, stored: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Raise ValueError where two records differ, with all in which they do."""
    record = _plain(record)
    differences = list(_differences(stored, record))
    if any(part.partition(" ")[0] in _OF_MODEL for part in differences):
        # The digest of the model depends on these, too.
        differences = [part for part in differences if part != "model differs"]
    if differences:
        more = [f"and {len(differences) - _SHOWN} more"] if len(differences) > _SHOWN else []
        raise ValueError(f"cannot go on with the run in {folder}, which was another one: "
                         f"{'; '.join(differences[:_SHOWN] + more)}. Repeat what it was begun with, or begin a new run "
                         "in another folder.")


def _record(path: Path) -> dict[str, Any]:
    """Return what a run is of.

    Raises:
        ValueError: the file does not say.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(record, dict):
            raise ValueError(f"it holds {record!r:.20}, not a mapping")
    except ValueError as error:  # of JSON, or of UTF-8
        raise ValueError(f"{path} is not the record of a run ({error}), which cannot go on without it. Begin anew with "
                         "overwrite=True (--overwrite), or in another folder.") from None
    return record


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Raise ValueError where a file of arrays is damaged, which no kill can do."""
    try:
        yield
    except (OSError, KeyError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is damaged ({type(error).__name__}: {error}), and its run cannot go on. Begin anew "
                         "with overwrite=True (--overwrite), or in another folder.") from None


def _differences(stored: Mapping[str, Any], record: Mapping[str, Any]) -> Iterator[str]:
    for name in dict.fromkeys([*stored, *record]):
        old, new = stored.get(name), record.get(name)
        if old == new:
            continue
        if str(old).startswith(_DIGEST) or str(new).startswith(_DIGEST):
            yield f"{name} {'differ' if name.endswith('s') or name == 'data' else 'differs'}"
        elif isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from _differences({f"{name} {key}": value for key, value in old.items()},
                                    {f"{name} {key}": value for key, value in new.items()})
        else:
            yield f"{name} was {_said(old)} and is {_said(new)}"


def _said(value: Any) -> str:
    return "not given" if value is None else json.dumps(value) if isinstance(value, (dict, list)) else str(value)


def _plain(values: Any) -> Any:
    """Return values as JSON would give them back."""
    def other(value: Any) -> Any:
        if isinstance(value, (np.ndarray, np.generic, jax.Array)):
            return np.asarray(value).tolist()
        return re.sub(r"0x[0-9a-f]+", "", repr(value))

    return json.loads(json.dumps(values, default=other))


def _no_look(rows: Mapping[str, np.ndarray]) -> None:
    """Write nothing."""


def check_folder(folder: str | Path, resume: bool, overwrite: bool) -> None:
    """Raise where a run in this folder would replace something, or there is nothing to go on with.

    Raises:
        FileExistsError: a result or a run is there, and may neither be gone on with nor replaced.
        FileNotFoundError: the folder holds something else, and no run to go on with.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder} is a file; expected the name of a folder for the run.")
    is_stored = is_kept(folder)
    if resume and not is_stored and not (folder / POSTERIOR).is_file() and folder.is_dir() and any(folder.iterdir()):
        raise FileNotFoundError(f"{folder} holds files, but no run to go on with. Name the folder in which it was "
                                "begun.")
    if not resume and not overwrite and (is_stored or (folder / POSTERIOR).is_file()):
        raise FileExistsError(f"{folder} holds {'an unfinished run' if is_stored else 'a result'}, which is kept. "
                              + ("Go on with it with resume=True (--resume), name" if is_stored else "Name")
                              + " another folder, or replace it with overwrite=True (--overwrite).")


def is_kept(folder: str | Path) -> bool:
    """Whether there is an unfinished run in this folder."""
    return (Path(folder) / CHECKPOINT / _RUN).is_file()


def is_finished(folder: str | Path) -> bool:
    """Whether there is a result in this folder, and no unfinished run."""
    return (Path(folder) / POSTERIOR).is_file() and not is_kept(folder)


def forget(folder: str | Path) -> None:
    """Remove what is kept in a folder, and the folder where it holds nothing else."""
    shutil.rmtree(Path(folder) / CHECKPOINT, ignore_errors=True)
    with contextlib.suppress(OSError):  # raised where it is not empty
        Path(folder).rmdir()


def finished(folder: str | Path, record: Mapping[str, Any]) -> Any:
    """Return the result of a run that is finished; None where it is not.

    Raises:
        ValueError: it is the result of another run; the message says in what that differs.
    """
    path = Path(folder) / POSTERIOR
    if not is_finished(folder):
        return None
    result = arviz_data.load(path)
    run = arviz_data.attributes(result).get("run")
    if not isinstance(run, Mapping):
        raise ValueError(f"{path} does not say which run it is from: there is nothing to go on with. Begin a new run "
                         "in another folder.")
    check_same(folder, run, record)
    return result


def begin_or_resume(folder: str | Path, record: Mapping[str, Any], resume: bool) -> Checkpoint:
    """Go on with the run in a folder if asked to and there is one; begin one otherwise."""
    if resume and is_kept(folder):
        return Checkpoint.resume(folder, record)
    return Checkpoint.begin(folder, record)


@contextlib.contextmanager
def closing(checkpoint: Checkpoint | None) -> Iterator[None]:
    """Close a checkpoint, if there is one, when the block ends."""
    try:
        yield
    finally:
        if checkpoint is not None:
            checkpoint.close()
