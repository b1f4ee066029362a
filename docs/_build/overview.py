"""Parts of the site that are made when it is built: the version, and the names on each page of the reference."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

_PAGE = re.compile(r"^\*\*\[.+\]\((\w+\.md)\)\*\*$", re.MULTILINE)
_DIRECTIVE = re.compile(r"^::: lfm_ppl\.(\S+)$", re.MULTILINE)


def on_config(config: Any) -> Any:
    """Write the version of the library in the footer; called by MkDocs once."""
    package = Path(config["config_file_path"]).parent / "lfm_ppl" / "__init__.py"
    version = re.search(r'__version__ = "(.+)"', package.read_text("utf-8"))[1]
    config["copyright"] = config["copyright"].replace("VERSION", version)
    return config


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """List the names on each page of the reference; called by MkDocs for each page."""
    if page.file.src_uri != "api/index.md":
        return markdown
    folder = Path(page.file.abs_src_path).parent

    def with_names(match: re.Match[str]) -> str:
        names = _DIRECTIVE.findall((folder / match[1]).read_text("utf-8"))
        return f"{match[0]}. " + ", ".join(f"[`{name}`]({match[1]}#lfm_ppl.{name})" for name in names)

    return _PAGE.sub(with_names, markdown)
