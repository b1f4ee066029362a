"""Where results go: a fresh numbered folder, or the one that the user names."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path("lfm-results")
SUMMARY = "summary.csv"

_REMEDY = "Nothing was computed; name a folder that you may write with --out."


@contextlib.contextmanager
def folder(name: str, out: str | None, overwrite: bool, resume: bool = False) -> Iterator[Path]:
    """Make the folder of the results; remove a new folder that stays empty.

    Args:
        name: name of the model.
        out: --out; None: the next of ``lfm-results/NAME-001``, ...
        overwrite: whether ``out`` may hold files.
        resume: whether ``out`` holds a run to resume.

    Yields:
        The folder, which exists.

    Raises:
        FileExistsError: if ``out`` holds files and ``overwrite`` is False.
        OSError: the folder cannot be made or written.
    """
    with _emptied(FOLDER if out is None else Path(out)) as new:
        result_folder = _fresh(name) if out is None else _named(Path(out), overwrite or resume)
        if out is None:
            new.insert(0, result_folder)
        writable(result_folder)
        yield result_folder


@contextlib.contextmanager
def lasting(default: Path, out: str | None) -> Iterator[Path]:
    """Make the folder of resumable tasks, the same for the same command; it may hold results.

    Args:
        default: the folder without --out.
        out: --out.

    Yields:
        The folder; a new folder that stays empty is removed.

    Raises:
        FileExistsError: a file has its name.
        OSError: it cannot be made or written.
    """
    folder = default if out is None else Path(out)
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder} is a file; expected the name of a folder for the results.")
    with _emptied(folder):
        writable(folder)
        yield folder


@contextlib.contextmanager
def _emptied(folder: Path) -> Iterator[list[Path]]:
    """Remove a folder and its parents that did not exist before, if they are empty afterwards."""
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        yield new
    finally:
        with contextlib.suppress(OSError):  # raised by the first that is not empty
            for path in new:
                path.rmdir()


def writable(folder: Path) -> None:
    """Raise OSError if files cannot be written into a folder, which is made if necessary.

    The command line calls it before anything is computed: a file is written there and removed again.
    """
    above = next((path for path in (folder, *folder.parents) if path.is_file()), None)
    if above is not None:
        raise NotADirectoryError(f"cannot write results into {folder}: {above} is a file. {_REMEDY}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise type(error)(f"cannot write results into {folder}: {error.strerror or error}. {_REMEDY}") from error


def _fresh(name: str) -> Path:
    number = 1
    while True:
        path = FOLDER / f"{name}-{number:03d}"
        try:
            path.mkdir(parents=True)  # fails where another run has just made it
        except FileExistsError:
            if not path.exists():  # a file stands where one of the folders above should be
                raise NotADirectoryError(f"cannot make the folder {path}: {FOLDER} is no folder. {_REMEDY}") from None
            number += 1
        except OSError as error:
            raise type(error)(f"cannot make the folder {path}: {error.strerror or error}. {_REMEDY}") from error
        else:
            return path


def _named(path: Path, overwrite: bool) -> Path:
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; expected the name of a folder for the results.")
    if path.is_dir() and not overwrite and any(path.iterdir()):
        raise FileExistsError(
            f"the folder {path} exists and holds files. Name another folder with "
            "--out, or replace them with --overwrite."
        )
    return path
