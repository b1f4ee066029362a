"""Where results go: a new numbered folder, or the folder that the user names."""

from __future__ import annotations

import contextlib
import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path("lfm-results")
SUMMARY = "summary.csv"

_REMEDY = "Nothing was computed; name a folder that you may write with --out."


@contextlib.contextmanager
def folder(name: str, out: str | None, overwrite: bool) -> Iterator[Path]:
    """Make the folder of the results; a new folder that stays empty is removed.

    Args:
        name: name of the model.
        out: --out; None: the next of ``lfm-results/NAME-001``, ...
        overwrite: whether ``out`` may hold files.

    Raises:
        FileExistsError: a file has its name, or ``out`` holds files and ``overwrite`` is False.
        OSError: the folder cannot be made or written.
    """
    if out is not None:
        path = Path(out)
        if path.is_dir() and not overwrite and any(path.iterdir()):
            raise FileExistsError(f"the folder {path} exists and holds files. Name another folder with --out, or "
                                  "replace them with --overwrite.")
        with open_folder(path):
            yield path
        return
    with _empty_folders_removed(FOLDER) as new_folders:
        new_folders.insert(0, path := _numbered(name))
        check_writable(path)
        yield path


@contextlib.contextmanager
def open_folder(path: Path) -> Iterator[Path]:
    """Make a folder that may hold results; a new folder that stays empty is removed.

    Raises:
        FileExistsError: a file has its name.
        OSError: it cannot be made or written.
    """
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; expected the name of a folder for the results.")
    with _empty_folders_removed(path):
        check_writable(path)
        yield path


@contextlib.contextmanager
def _empty_folders_removed(path: Path) -> Iterator[list[Path]]:
    """Remove a folder and its parents that did not exist before, if they are empty afterwards."""
    new_folders = [member for member in (path, *path.parents) if not member.exists()]
    try:
        yield new_folders
    finally:
        with contextlib.suppress(OSError):  # raised by the first that is not empty
            for member in new_folders:
                member.rmdir()


def check_writable(path: Path) -> None:
    """Raise OSError if files cannot be written into a folder, which is made if necessary."""
    file_above = next((member for member in (path, *path.parents) if member.is_file()), None)
    if file_above is not None:
        raise NotADirectoryError(f"cannot write results into {path}: {file_above} is a file. {_REMEDY}")
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise type(error)(f"cannot write results into {path}: {error.strerror or error}. {_REMEDY}") from error


def _numbered(name: str) -> Path:
    """Make the next of the folders ``lfm-results/NAME-001``, ..."""
    for number in itertools.count(1):
        path = FOLDER / f"{name}-{number:03d}"
        try:
            path.mkdir(parents=True)  # fails where another run has just made it
            return path
        except OSError as error:
            if not path.exists():  # a file stands where a folder should be, or there is no permission
                raise type(error)(f"cannot make the folder {path}: {error.strerror or error}. {_REMEDY}") from error
    raise AssertionError("unreachable")
