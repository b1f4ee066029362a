"""Files that are written completely or not at all."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path


def refuse_existing(path: str | Path, overwrite: bool) -> Path:
    """Return ``path`` as a Path; raise FileExistsError if it exists and must not be replaced."""
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder, expected the name of a file to write.")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} already exists. Choose another name, or pass overwrite=True (--overwrite on the "
                              "command line).")
    return path


@contextlib.contextmanager
def atomic_write(path: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary name beside ``path``, and rename it to ``path`` at the end of the block.

    A rename within a folder is atomic, so that a killed run leaves either the old file or the new one. The suffix is
    kept, because writers choose a format by it.

    Args:
        path: the file to write; its folder is made if necessary.
        overwrite: replace an existing file.

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
