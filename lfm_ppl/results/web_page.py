"""One HTML page without network access or scripts; style and pictures are part of it.

1. It is readable in light and dark mode, on a phone, on a desktop and on paper.
2. Text of users is escaped here: callers pass plain text. Only `Section.body` is HTML, made by the functions below and
   by `lfm_ppl.results.tables`.
"""

from __future__ import annotations

import base64
import contextlib
import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from urllib.parse import quote

from lfm_ppl.utils.atomic_files import atomic_write, refuse_existing

_GENERATOR = '<meta name="generator" content="lfm_ppl">'

# The policy holds the browser to the promise: nothing is loaded, whatever stands in the page.
_HEAD = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
{_GENERATOR}
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
"""

_STYLE = """<style>
:root { color-scheme: light dark; --text: #1b1f24; --soft: #57606a; --page: #ffffff; --box: #f4f6f8; --line: #d5dae0;
  --link: #0b5cad; --warn: #8a4b00; --warn-box: #fff3dc; }
@media (prefers-color-scheme: dark) { :root { --text: #e4e8ed; --soft: #a3adb8; --page: #14181d; --box: #1e242b;
  --line: #3a434d; --link: #79b8ff; --warn: #ffcf8a; --warn-box: #3a2a10; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 1rem 1rem 4rem; background: var(--page); color: var(--text);
  font: 1rem/1.5 system-ui, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: .5rem 0 .25rem; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; padding-top: .6rem; border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; }
p { margin: .5rem 0; }
.lead, figcaption, .note { color: var(--soft); }
nav { display: flex; flex-wrap: wrap; gap: .25rem 1rem; margin: .8rem 0; font-size: .95rem; }
a { color: var(--link); }
pre { background: var(--box); border: 1px solid var(--line); border-radius: 6px; padding: .7rem .9rem;
  white-space: pre-wrap; overflow-wrap: anywhere; font: .85rem/1.45 ui-monospace, monospace; margin: .6rem 0; }
pre.equation { white-space: pre; overflow-x: auto; overflow-wrap: normal; }
dl { display: grid; grid-template-columns: minmax(7rem, max-content) minmax(0, 1fr); gap: .2rem 1rem; margin: .6rem 0; }
dt { color: var(--soft); }
dd { margin: 0; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; margin: .6rem 0; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .7rem; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line); }
td { white-space: nowrap; }
td.t { white-space: normal; min-width: 18rem; }
thead th { color: var(--soft); font-weight: 600; vertical-align: bottom; overflow-wrap: normal; }
tbody th { font-weight: 600; white-space: nowrap; }
.n { text-align: right; }
.warning { background: var(--warn-box); color: var(--warn); border-radius: 6px; padding: .6rem .9rem; margin: .6rem 0; }
.warning ul { margin: 0; padding-left: 1.2rem; }
figure { margin: 1rem 0; overflow-x: auto; }
figure img { display: block; max-width: 100%; height: auto; background: #ffffff; border-radius: 6px; padding: 4px; }
@media (max-width: 34rem) { dl { grid-template-columns: minmax(0, 1fr); gap: 0; } dd { margin-bottom: .4rem; }
  figure img { max-width: none; width: 36rem; } }
@media print { nav { display: none; } .scroll { overflow: visible; } figure { break-inside: avoid; } }
</style>
"""


@dataclass(frozen=True)
class Section:
    """A part of a page: its anchor, its title, and its HTML."""

    anchor: str
    title: str
    body: str


def render(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return a page as text.

    Args:
        title: of the page.
        lead: a line below it; empty for none.
        sections: in their order; one without a body is left out.

    Example:
        >>> page = render("spring", "A mass & a spring", [Section("data", "Data", paragraph("3 rows"))])
        >>> "<h1>spring</h1>" in page, "A mass &amp; a spring" in page, "http://" in page
        (True, True, False)
    """
    shown_sections = [section for section in sections if section.body]
    head = f"{_HEAD}<title>{escape(title)}</title>\n{_STYLE}</head>\n<body>\n<header>\n<h1>{escape(title)}</h1>\n"
    head += paragraph(lead, "lead") if lead else ""
    links = "\n".join(f'<a href="#{escape(section.anchor)}">{escape(section.title)}</a>' for section in shown_sections)
    body = "\n".join(f'<section id="{escape(section.anchor)}">\n<h2>{escape(section.title)}</h2>\n'
                     f"{section.body}\n</section>" for section in shown_sections)
    return f"{head}\n<nav>\n{links}\n</nav>\n</header>\n<main>\n{body}\n</main>\n</body>\n</html>\n"


def write(page: str, path: str | Path, overwrite: bool = False) -> Path:
    """Write a page to a file, through a temporary name.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is False.
    """
    with atomic_write(path, overwrite) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return Path(path)


def refuse_foreign(path: str | Path, overwrite: bool) -> None:
    """Raise FileExistsError where a page would replace a file that is none of ours, and may not."""
    path = Path(path)
    is_generated = False
    if path.is_file():
        with contextlib.suppress(OSError), path.open(encoding="utf-8", errors="replace") as file:
            is_generated = _GENERATOR in file.read(len(_HEAD))
    refuse_existing(path, overwrite or is_generated)


def paragraph(text: str, kind: str = "") -> str:
    """Return a paragraph, of a class such as "note" where one is given."""
    named = f' class="{kind}"' if kind else ""
    return f"<p{named}>{escape(text)}</p>"


def heading(text: str) -> str:
    """Return the title of a part of a section."""
    return f"<h3>{escape(text)}</h3>"


def preformatted(text: str) -> str:
    """Return text with its own line breaks, such as a command; long lines are broken."""
    return f"<pre>{escape(text)}</pre>"


def prose(text: str) -> str:
    r"""Return a docstring: its paragraphs, and what is indented in it, such as equations, as it stands.

    Example:
        >>> print(prose("A spring\nand a mass.\n\n    dx/dt = v"))
        <p>A spring and a mass.</p>
        <pre class="equation">dx/dt = v</pre>
    """
    blocks = []
    for block in re.split(r"\n(?:[ \t]*\n)+", text.strip("\n")):
        if any(line[:1].isspace() for line in block.splitlines()):
            blocks.append(f'<pre class="equation">{escape(textwrap.dedent(block).rstrip())}</pre>')
        else:
            blocks.append(paragraph(" ".join(block.split())))
    return "\n".join(blocks)


def warnings(messages: Iterable[str]) -> str:
    """Return a box of warnings; empty where there are none."""
    items = "".join(f"<li>{escape(message)}</li>" for message in messages)
    return f'<div class="warning" role="note"><ul>{items}</ul></div>' if items else ""


def facts(pairs: Iterable[tuple[str, str]]) -> str:
    """Return labels with what stands for each; empty where there are none."""
    items = "".join(f"<dt>{escape(label)}</dt><dd>{escape(text)}</dd>\n" for label, text in pairs)
    return f"<dl>\n{items}</dl>" if items else ""


def picture(png: bytes, caption: str) -> str:
    """Return a PNG picture, held in the page itself."""
    data = base64.b64encode(png).decode("ascii")
    text = escape(caption)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'


def file_list(names: Iterable[str]) -> str:
    """Return links to files beside the page, by their paths relative to it; empty where there are none."""
    items = "".join(f'<li><a href="{escape(quote(f"./{name}"))}">{escape(name)}</a></li>\n' for name in names)
    return f"<ul>\n{items}</ul>" if items else ""
