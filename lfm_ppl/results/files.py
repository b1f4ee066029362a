"""Files that are there whole or not at all, and where a result is."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

POSTERIOR = "posterior.nc"
"""The result in a folder that `lfm-ppl fit` wrote."""

CHECKPOINT = "checkpoint"
"""Beside it, the folder of a run that is not finished: the state of the chains and their draws."""


def locate(path: str | Path) -> Path:
    """Return the file of a result: ``path`` itself, or the ``posterior.nc`` in it where it is a folder.

    Raises:
        FileNotFoundError: there is no such file or folder, or the folder holds no result.
    """
    path = Path(path)
    if path.is_dir():
        if not (path / POSTERIOR).is_file():
            if (path / CHECKPOINT).is_dir():
                raise FileNotFoundError(f"{path} holds a run that is not finished and has no draws yet; go on with it: "
                                        "the command that began it, with --resume.")
            raise FileNotFoundError(f"{path} holds no {POSTERIOR}; expected a folder that `lfm-ppl fit` wrote, or a "
                                    "netCDF file.")
        return path / POSTERIOR
    if not path.is_file():
        raise FileNotFoundError(f"there is no result {path}; expected a results folder, or a netCDF file such as "
                                f"{POSTERIOR}.")
    return path


def refuse_existing(path: str | Path, overwrite: bool) -> Path:
    """Return ``path`` as a Path; raise FileExistsError where it exists and may not be replaced."""
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder, expected the name of a file to write.")
    if path.exists() and not overwrite:
        raise FileExistsError(
            f"{path} exists already and is kept. Choose another name, or pass overwrite=True "
            "(--overwrite on the command line)."
        )
    return path


@contextlib.contextmanager
def writing(path: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary name beside ``path``, and rename it to ``path`` when the block ends well.

    A rename within one folder is atomic, so a killed run leaves either the old file or the new one
    under ``path``. The suffix is kept, because writers choose a format by it.

    Args:
        path: the file to write; its folder is made where it does not exist.
        overwrite: replace a file that exists.

    Yields:
        The temporary path to write to.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is False.
    """
    path = refuse_existing(path, overwrite)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}-{uuid.uuid4().hex[:12]}.part{path.suffix}")
    try:
        yield temporary
        refuse_existing(path, overwrite)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
