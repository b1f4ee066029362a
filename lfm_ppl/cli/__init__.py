"""The command line, ``lfm-ppl``: `commands` and their `options`, and a module for the work of each command."""

from __future__ import annotations

import inspect
import linecache
import re
import sys
import warnings
from collections.abc import Sequence

from lfm_ppl.cli import commands
from lfm_ppl.utils.errors import RunError
from lfm_ppl.utils.interruption import INTERRUPTED, interruptible


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: the arguments without the program's name; None: the arguments of the process.

    Returns:
        0 after success; 1 if results were saved but a figure or the report failed; 2 after an error, which is one line
        on standard error without ``--debug``; 130 after Ctrl-C.
    """
    line = list(sys.argv[1:] if argv is None else argv)
    warnings.showwarning = _Warnings()
    try:
        with interruptible():
            command, arguments = commands.parse(line)
            return command(*arguments.args, **arguments.kwargs) or 0
    except KeyboardInterrupt as error:
        print(f"\nlfm-ppl: {str(error) or 'interrupted; what was written before is kept'}", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of the pipe, such as `head`, has closed it
        sys.stderr.close()
        return 0
    except Exception as error:
        if "--debug" in line:
            raise
        print(f"lfm-ppl: error: {_one_line(error)}", file=sys.stderr)
        return 2


def _one_line(error: Exception) -> str:
    """Return the error in one line, with the line of the model file that caused it."""
    from cyclopts import CycloptsError

    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, CycloptsError):
        return f"{text} (see `{' '.join(['lfm-ppl', *(error.command_chain or ())])} --help`)"
    from lfm_ppl.io import loading

    text, location = text + _remedy(error), loading.location_in_model(error)
    if isinstance(error, KeyError) and location is not None and (names := loading.known_inputs(error)) is not None:
        return (f"{location.file}, line {location.line}: the model reads the known input {text}, and "
                + (f"has {', '.join(names)}. Correct the name, or add it to INPUTS." if names else
                   "has none. Name it in INPUTS, with the way it is read between rows."))
    if location is not None and location.file not in text and not (isinstance(error, ValueError) and location.shipped):
        kind = "" if isinstance(error, (ValueError, TypeError)) else f"{type(error).__name__}: "
        return f"{location.file}, line {location.line}: {kind}{text}" + (" (--debug shows more)" if kind else "")
    if isinstance(error, FileNotFoundError) and error.filename:
        return f"there is no file {error.filename}."
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}."
    if isinstance(error, (ValueError, TypeError, OSError, RunError)):
        return text
    return f"{type(error).__name__}: {text} (--debug shows where)"


_UNEXPECTED = re.compile(r"(\w+)\.__init__\(\) got an unexpected keyword argument '(\w+)'")
_INVALID = re.compile(r"distribution got invalid (\w+) parameter")


def _remedy(error: Exception) -> str:
    """Return the remedy of some errors of Python and NumPyro; empty for others."""
    import lfm_ppl
    from lfm_ppl.io import loading
    from lfm_ppl.utils import checks

    unexpected, invalid = _UNEXPECTED.search(str(error)), _INVALID.search(str(error))
    if unexpected and hasattr(lfm_ppl, unexpected[1]):
        names = list(inspect.signature(getattr(lfm_ppl, unexpected[1])).parameters)
        return f".{checks.nearest(unexpected[2], names)} It takes {', '.join(names)}."
    if invalid and (location := loading.location_in_model(error)) is not None:
        source = linecache.getline(str(location.file), location.line).strip()
        return f" A {invalid[1]} outside of its range stands in: {source}"
    return ""


class _Warnings:
    """Shows each warning once: Python forgets shown warnings when a library changes its filters."""

    def __init__(self) -> None:
        self._shown: set[str] = set()

    def __call__(self, message, category, filename, lineno, file=None, line=None) -> None:
        """Print a warning in one line."""
        text = " ".join(str(message).split())
        if text not in self._shown:
            self._shown.add(text)
            print(f"lfm-ppl: warning: {text}", file=sys.stderr)
