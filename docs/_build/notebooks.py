"""Pages of the executed notebooks, made when the site is built: the repository holds each of them once.

A page has the notebook's text, its code, its output with warnings, its tables and its pictures. The page of the gallery
has a card for each line ``[[NAME]] description``.
"""

from __future__ import annotations

import base64
import html
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
_CARD = re.compile(r"^\[\[(\w+)\]\] (.+)$", re.MULTILINE)
_CARDS = re.compile(r"(?:^\[\[\w+\]\] .+\n?)+", re.MULTILINE)
_HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
_STYLE_OF_PANDAS = ' border="1" class="dataframe"'
_TABLE = re.compile(r"<table.*</table>", re.DOTALL)


def on_files(files: Any, config: Any) -> Any:
    """Add a page and its pictures for each notebook; called by MkDocs."""
    titles = {}
    for path in sorted((Path(config["config_file_path"]).parent / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        pictures: list[bytes] = []
        text = "\n\n".join(_page_parts(cells, path.stem, pictures))
        title = _HEADING.search(text)
        assert title is not None and pictures, f"{path} has no title, or no picture: run notebooks/execute.py"
        source = f"\n\n---\n\nThis page is `notebooks/{path.name}`, written as `notebooks/{path.stem}.py`.\n"
        files.append(File.generated(config, f"{FOLDER}/{path.stem}.md", content=text + source))
        for number, picture in enumerate(pictures, 1):
            files.append(File.generated(config, f"{FOLDER}/{path.stem}_{number}.png", content=picture))
        titles[path.stem] = title[1]
    index = files.get_file_from_path(f"{FOLDER}/index.md")
    text = index.content_string
    missing = set(titles) ^ {name for name, _ in _CARD.findall(text)}
    assert not missing, f"docs/{FOLDER}/index.md needs a line `[[NAME]] description` for each notebook: {missing}"
    files.remove(index)
    text = _CARDS.sub(lambda match: _with_cards(match[0], titles), text)
    files.append(File.generated(config, f"{FOLDER}/index.md", content=text))
    return files


def _with_cards(lines: str, titles: dict[str, str]) -> str:
    """Return the cards of lines ``[[NAME]] description``."""
    cards = [f"[![{_plain(titles[name])}]({name}_1.png)<br>**{titles[name]}**]({name}.md)<br>{description}\n{{ .card }}"
             for name, description in _CARD.findall(lines)]
    return '<div class="cards" markdown>\n\n' + "\n\n".join(cards) + "\n\n</div>\n"


def _page_parts(cells: list[dict[str, Any]], name: str, pictures: list[bytes]) -> Iterator[str]:
    """Yield the parts of a page, and add its pictures to the list; the heading above a picture describes it."""
    heading = name
    for cell in cells:
        if cell["cell_type"] == "markdown":
            heading = ([heading] + _HEADING.findall(_joined(cell["source"])))[-1]
        yield from _cell_parts(cell, name, heading, pictures)


def _cell_parts(cell: dict[str, Any], name: str, heading: str, pictures: list[bytes]) -> Iterator[str]:
    source = _joined(cell["source"])
    if cell["cell_type"] == "markdown":
        yield source
        return
    yield _fenced(source, "python")
    for output in _merged_streams(cell["outputs"]):
        data = output.get("data", {})
        if "image/png" in data:
            pictures.append(base64.b64decode(_joined(data["image/png"])))
            yield f"![{_plain(heading)}, figure {len(pictures)}]({name}_{len(pictures)}.png)"
        elif table := _TABLE.search(_joined(data.get("text/html", ""))):
            yield "<div>\n" + table[0].replace(_STYLE_OF_PANDAS, "") + "\n</div>"
        elif text := _joined(output.get("text", data.get("text/plain", ""))).strip("\n"):
            text = _ESCAPES.sub("", text)
            yield _fenced(_KERNEL_FILE.sub("", text) if output.get("name") == "stderr" else text, "text")


def _merged_streams(outputs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the outputs of a cell with what was printed in pieces, one after the other, as one output."""
    merged: list[dict[str, Any]] = []
    for output in outputs:
        if merged and output["output_type"] == "stream" and output["name"] == merged[-1].get("name"):
            merged[-1] = output | {"text": _joined(merged[-1]["text"]) + _joined(output["text"])}
        else:
            merged.append(output)
    return merged


def _plain(heading: str) -> str:
    """Return a heading as the text of an image, without formulas and marks."""
    return html.escape(re.sub(r"[\[\]$`*\\]", "", heading))


def _joined(source: str | list[str]) -> str:
    return source if isinstance(source, str) else "".join(source)


def _fenced(text: str, language: str) -> str:
    return f"````{language}\n{text}\n````"
