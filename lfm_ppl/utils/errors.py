"""The base class of errors of runs, without imports, so that the command line starts fast."""

from __future__ import annotations


class RunError(RuntimeError):
    """A run cannot start or continue; the message is one line."""


class FolderInUseError(RunError):
    """Another run writes to the folder."""
