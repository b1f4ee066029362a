"""Formulas of the pages as MathML, which browsers draw by themselves: no script and no font is fetched."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>([,.;:)]*)', re.DOTALL)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Replace the formulas that pymdownx.arithmatex has marked; called by MkDocs for each page."""
    content = _BLOCK.sub(_block, content)
    return _INLINE.sub(_inline, content)


def _inline(match: re.Match[str]) -> str:
    """Return a formula within a line, with the punctuation after it, before which a browser may break the line."""
    formula = _mathml(match[1], "inline")
    return f'<span class="word">{formula}{match[2]}</span>' if match[2] else formula


def _block(match: re.Match[str]) -> str:
    """Return a displayed formula; the equations between ``\\qquad`` may stand in lines of their own."""
    equations = "".join(_mathml(equation, "block") for equation in match[1].split(r"\qquad"))
    return f'<div class="formula">{equations}</div>'


def _mathml(latex: str, display: str) -> str:
    return convert(html.unescape(latex).strip(), display=display)
