"""The overview of the reference, made when the site is built: the names on each of its pages."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

_PAGE = re.compile(r"^\*\*\[.+\]\((\w+\.md)\)\*\*$", re.MULTILINE)
_DIRECTIVE = re.compile(r"^::: lfm_ppl\.(\S+)$", re.MULTILINE)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Write after each page of the reference what is on it; called by MkDocs for each page."""
    if page.file.src_uri != "api/index.md":
        return markdown
    folder = Path(page.file.abs_src_path).parent

    def listed(found: re.Match[str]) -> str:
        names = _DIRECTIVE.findall((folder / found[1]).read_text("utf-8"))
        return f"{found[0]}. " + ", ".join(f"[`{name}`]({found[1]}#lfm_ppl.{name})" for name in names)

    return _PAGE.sub(listed, markdown)
