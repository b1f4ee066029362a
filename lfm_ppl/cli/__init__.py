"""The command line, ``lfm-ppl``: one module for the arguments, one for each command."""

from __future__ import annotations

import inspect
import linecache
import re
import sys
import warnings
from collections.abc import Sequence

from lfm_ppl.cli.arguments import parsed
from lfm_ppl.cli.interruption import INTERRUPTED, watched
from lfm_ppl.engine.errors import EngineError
from lfm_ppl.io import loading
from lfm_ppl.utils import checks


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: the arguments without the program's name; None: those of the process.

    Returns:
        0 after success, 1 where results were saved and a figure or the page could not be made, 2 after an
        error, which is one line on standard error unless ``--debug`` is given, 130 after Ctrl-C.
    """
    line = list(sys.argv[1:] if argv is None else argv)
    try:
        arguments = parsed(argv)
    except ValueError as error:  # the options of a study are those of its settings, for which JAX is started
        if "--debug" in line:
            raise
        print(f"lfm-ppl: error: {_one_line(error)}", file=sys.stderr)
        return 2
    arguments.line = line
    warnings.showwarning = _Warnings()
    try:
        # A library that swallows KeyboardInterrupt, as some do while they are imported, does not keep us; nor do
        # workers that are slow to end, which end when this process is gone.
        with watched(lambda: "what was written before is kept"):
            return int(arguments.run(arguments))
    except KeyboardInterrupt as error:
        print(f"lfm-ppl: {str(error) or 'interrupted'}", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of a pipe, such as `head`, has seen enough
        sys.stderr.close()
        return 0
    except Exception as error:
        if arguments.debug:
            raise
        print(f"lfm-ppl: error: {_one_line(error)}", file=sys.stderr)
        return 2


def _one_line(error: Exception) -> str:
    """Return what is wrong, and where, if it comes from a model file."""
    text = (" ".join(str(error).split()) or type(error).__name__) + _remedy(error)
    place = loading.place_in_model(error)
    if isinstance(error, KeyError) and place is not None and (known := loading.known_inputs(error)) is not None:
        return (f"{place.file}, line {place.line}: the model reads the known input {text}, and "
                + (f"has {', '.join(known)}. Correct the name, or add it to INPUTS." if known else
                   "has none. Name it in INPUTS, with the way it is read between rows."))
    if place is not None and place.file not in text and not (isinstance(error, ValueError) and place.shipped):
        kind = "" if isinstance(error, (ValueError, TypeError)) else f"{type(error).__name__}: "
        return f"{place.file}, line {place.line}: {kind}{text}" + (" (--debug shows more)" if kind else "")
    if isinstance(error, FileNotFoundError) and error.filename:
        return f"there is no file {error.filename}."
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}."
    if isinstance(error, (ValueError, TypeError, OSError, EngineError)):
        return text
    return f"{type(error).__name__}: {text} (--debug shows where)"


_UNEXPECTED = re.compile(r"(\w+)\.__init__\(\) got an unexpected keyword argument '(\w+)'")
_INVALID = re.compile(r"distribution got invalid (\w+) parameter")


def _remedy(error: Exception) -> str:
    """Return what to write instead, for errors that Python and NumPyro raise; empty for others."""
    if isinstance(error, TypeError) and (called := _UNEXPECTED.search(str(error))) is not None:
        import lfm_ppl

        known = getattr(lfm_ppl, called[1], None)
        if known is None:
            return ""
        names = list(inspect.signature(known).parameters)
        return f".{checks.nearest(called[2], names)} It takes {', '.join(names)}."
    if isinstance(error, ValueError) and (wrong := _INVALID.search(str(error))) is not None:
        place = loading.place_in_model(error)
        line = "" if place is None else linecache.getline(str(place.file), place.line).strip()
        return f" A {wrong[1]} outside of its range stands in: {line}" if line else ""
    return ""


class _Warnings:
    """Shows each warning once: Python forgets those it has shown where a library changes its filters."""

    def __init__(self) -> None:
        self._said: set[str] = set()

    def __call__(self, message, category, filename, lineno, file=None, line=None) -> None:
        """Print a warning in one line."""
        text = " ".join(str(message).split())
        if text not in self._said:
            self._said.add(text)
            print(f"lfm-ppl: warning: {text}", file=sys.stderr)
