"""Docstrings as pages take them: examples as code, and names of the library as links."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import griffe

_EXAMPLE = re.compile(r"^(\s*)Example:[ \t]*$", re.MULTILINE)
_NAME = re.compile(r"(?<!`)`(?:lfm_ppl|lfm)\.([\w.]+)`(?!`)")
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

    def _link(self, found: re.Match[str]) -> str:
        name = found[1]
        return f"[`lfm.{name}`][lfm_ppl.{name}]" if name in self._known else found[0]
