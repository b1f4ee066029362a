"""Names of the files of a result."""

from __future__ import annotations

from pathlib import Path

POSTERIOR = "posterior.nc"
"""The result in a folder that `lfm-ppl fit` wrote."""

CHECKPOINT = "checkpoint"
"""Folder of an unfinished run beside it: state of the chains, and draws."""


def locate(path: str | Path) -> Path:
    """Return the file of a result: ``path``, or ``posterior.nc`` in the folder ``path``.

    Raises:
        FileNotFoundError: no such file or folder, or no result in the folder.
    """
    path = Path(path)
    if path.is_dir():
        if not (path / POSTERIOR).is_file():
            if (path / CHECKPOINT).is_dir():
                raise FileNotFoundError(f"{path} holds an unfinished run without draws; resume it: repeat its command "
                                        "with --resume.")
            raise FileNotFoundError(f"{path} holds no {POSTERIOR}; expected a folder that `lfm-ppl fit` wrote, or a "
                                    "netCDF file.")
        return path / POSTERIOR
    if not path.is_file():
        raise FileNotFoundError(f"there is no result {path}; expected a results folder, or a netCDF file such as "
                                f"{POSTERIOR}.")
    return path
