"""Figures of the pages as links to their files, so that a reader can open them in full."""

from __future__ import annotations

import re
from typing import Any

_FIGURE = re.compile(r'<p>(<img alt="[^"]*" src="([^"]+)" ?/>)</p>')


def on_page_content(content: str, **_: Any) -> str:
    """Make each picture that is a paragraph a link to its file; called by MkDocs for each page."""
    return _FIGURE.sub(r'<p><a class="figure" href="\2" title="open the figure">\1</a></p>', content)
