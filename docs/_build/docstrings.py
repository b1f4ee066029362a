"""Docstrings as pages take them: examples as code, and names of the library as links."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe

_EXAMPLE = re.compile(r"^(\s*)Example:[ \t]*$", re.MULTILINE)
_NAME = re.compile(r"(?<!`)`(?:lfm_ppl|lfm)\.([\w.]+)`(?!`)")
_CONSTANT = re.compile(r"(?:[a-z_]+\.)?_?[A-Z][A-Z_]+")
_DIRECTIVE = re.compile(r"^::: lfm_ppl\.(\S+)$", re.MULTILINE)
_REFERENCE = Path(__file__).resolve().parent.parent / "api"


class Docstrings(griffe.Extension):
    """What mkdocstrings reads docstrings by; named in mkdocs.yml."""

    def __init__(self) -> None:
        self._known = {name for page in _REFERENCE.glob("*.md") for name in _DIRECTIVE.findall(page.read_text("utf-8"))}

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite a docstring before it is parsed; called by Griffe for each module, class, function and attribute."""
        if obj.docstring is not None:
            text = _EXAMPLE.sub(r"\1Examples:", obj.docstring.value)  # the heading that Griffe knows
            obj.docstring.value = _NAME.sub(self._link, text)

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Write the value of a default argument that is a constant by name; called by Griffe for the whole package."""
        for function in _functions(pkg):
            for parameter in function.parameters:
                if _CONSTANT.fullmatch(str(parameter.default)):
                    # What a module imports from outside of the package keeps its name.
                    with contextlib.suppress(griffe.NameResolutionError, KeyError):
                        first_name, *attributes = str(parameter.default).split(".")
                        path = ".".join([function.parent.resolve(first_name), *attributes])
                        parameter.default = pkg[path.removeprefix(f"{pkg.name}.")].value

    def _link(self, match: re.Match[str]) -> str:
        name = match[1]
        return f"[`lfm.{name}`][lfm_ppl.{name}]" if name in self._known else match[0]


def _functions(parent: griffe.Module | griffe.Class) -> Iterator[griffe.Function]:
    """Yield the functions of a module or class, and of those in it."""
    for member in parent.members.values():
        if not member.is_alias and member.is_function:
            yield member
        elif not member.is_alias and (member.is_module or member.is_class):
            yield from _functions(member)
