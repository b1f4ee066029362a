"""Folders at the top of the checkout that a wheel has inside the package."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent.parent


def shipped_folder(name: str) -> Path:
    """Return the folder ``name`` of the checkout, ``models`` or ``studies``; in a wheel, ``_name`` in the package."""
    packaged_folder = _PACKAGE / f"_{name}"
    return packaged_folder if packaged_folder.is_dir() else _PACKAGE.parent / name
