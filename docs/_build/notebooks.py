"""Pages of the executed notebooks, made when the site is built: the repository holds each of them once.

A page has the notebook's text, its code, its output with warnings, and its pictures.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

FOLDER = "gallery"
_ESCAPES = re.compile(r"\x1b\[[0-9;]*m")
_KERNEL_FILE = re.compile(r"^/\S*/ipykernel_\d+/\d+\.py:\d+: ", re.MULTILINE)
"""The temporary file of a cell, with which a warning on standard error begins."""


def on_files(files: Any, config: Any) -> Any:
    """Add a page and its pictures for each notebook; called by MkDocs."""
    cards = []
    for path in sorted((Path(config["config_file_path"]).parent / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        pictures: list[bytes] = []
        text = "\n\n".join(part for cell in cells for part in _parts(cell, path.stem, pictures))
        title = re.search(r"^# (.+)$", text, re.MULTILINE)
        assert title is not None and pictures, f"{path} has no title, or no picture: run notebooks/execute.py"
        source = f"\n\n---\n\nThis page is `notebooks/{path.name}`, written as `notebooks/{path.stem}.py`.\n"
        files.append(File.generated(config, f"{FOLDER}/{path.stem}.md", content=text + source))
        for number, picture in enumerate(pictures, 1):
            files.append(File.generated(config, f"{FOLDER}/{path.stem}_{number}.png", content=picture))
        cards.append(f"[![]({path.stem}_1.png)<br>{title[1]}]({path.stem}.md)\n{{ .card }}")
    index = files.get_file_from_path(f"{FOLDER}/index.md")
    whole = f'{index.content_string}\n\n<div class="cards" markdown>\n\n' + "\n\n".join(cards) + "\n\n</div>\n"
    files.remove(index)
    files.append(File.generated(config, f"{FOLDER}/index.md", content=whole))
    return files


def _parts(cell: dict[str, Any], name: str, pictures: list[bytes]) -> Iterator[str]:
    """Yield what a cell shows, and add its pictures to the list."""
    source = _joined(cell["source"])
    if cell["cell_type"] == "markdown":
        yield source
        return
    yield _fenced(source, "python")
    for output in cell["outputs"]:
        data = output.get("data", {})
        if "image/png" in data:
            pictures.append(base64.b64decode(_joined(data["image/png"])))
            yield f"![Figure {len(pictures)}]({name}_{len(pictures)}.png)"
        elif said := _joined(output.get("text", data.get("text/plain", ""))).strip("\n"):
            said = _ESCAPES.sub("", said)
            yield _fenced(_KERNEL_FILE.sub("", said) if output.get("name") == "stderr" else said, "text")


def _joined(source: str | list[str]) -> str:
    return source if isinstance(source, str) else "".join(source)


def _fenced(text: str, language: str) -> str:
    return f"````{language}\n{text}\n````"
