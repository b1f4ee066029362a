"""Where results go: a fresh numbered folder, or the one that the user names."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path("lfm-results")
POSTERIOR = "posterior.nc"
SUMMARY = "summary.csv"


@contextlib.contextmanager
def folder(name: str, out: str | None, overwrite: bool) -> Iterator[Path]:
    """Make the folder for the results, and remove it again where nothing was put into it.

    Args:
        name: of the model.
        out: the folder that the user wants; None: the next of ``lfm-results/NAME-001``, ...
        overwrite: whether ``out`` may hold files already.

    Yields:
        The folder, which exists.

    Raises:
        FileExistsError: if ``out`` holds files and ``overwrite`` is False.
    """
    chosen = _fresh(name) if out is None else _named(Path(out), overwrite)
    try:
        yield chosen
    finally:
        with contextlib.suppress(OSError):  # raised where it is not empty
            chosen.rmdir()


def locate(result: str) -> Path:
    """Return the posterior that ``result`` stands for: a netCDF file, or a folder with one."""
    path = Path(result)
    if path.is_dir():
        if not (path / POSTERIOR).is_file():
            raise ValueError(f"{path} holds no {POSTERIOR}; expected a folder that `fit` wrote.")
        return path / POSTERIOR
    if not path.is_file():
        raise ValueError(f"there is no result {path}; expected a results folder or a .nc file.")
    return path


def _fresh(name: str) -> Path:
    number = 1
    while True:
        path = FOLDER / f"{name}-{number:03d}"
        try:
            path.mkdir(parents=True)  # fails where another run has just made it
        except FileExistsError:
            number += 1
        else:
            return path


def _named(path: Path, overwrite: bool) -> Path:
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; expected the name of a folder for the results.")
    if path.is_dir() and any(path.iterdir()) and not overwrite:
        raise FileExistsError(
            f"the folder {path} exists and holds files, which are kept. Name another one with "
            "--out, or replace them with --overwrite."
        )
    path.mkdir(parents=True, exist_ok=True)
    return path
