"""The site is whole: what its navigation, its reference and its messages name exists. MkDocs is not needed for it."""

import ast
import functools
import re
from pathlib import Path

import pytest

import lfm_ppl as lfm

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
NAVIGATION = re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text("utf-8"), re.MULTILINE)
REFERENCE = [name for page in sorted((DOCS / "api").glob("*.md"))
             for name in re.findall(r"^::: lfm_ppl\.(\S+)$", page.read_text("utf-8"), re.MULTILINE)]
NOTEBOOKS = {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")}
MESSAGES = [" ".join(quoted.replace("\n> ", " ").removeprefix("> ").split())
            for quoted in re.findall(r"(?:^> .+\n)+", (DOCS / "errors.md").read_text("utf-8"), re.MULTILINE)]


def page_exists(name: str) -> bool:
    """Pages of notebooks are made from these when the site is built."""
    return (DOCS / name).is_file() or name.startswith("gallery/") and Path(name).stem in NOTEBOOKS


def test_every_page_of_the_navigation_exists_and_every_page_is_in_it():
    assert [name for name in NAVIGATION if not page_exists(name)] == []
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert pages | {f"gallery/{name}.md" for name in NOTEBOOKS} == set(NAVIGATION)
    assert len(NAVIGATION) == len(set(NAVIGATION))


def test_every_public_name_stands_in_the_reference_once():
    of_modules = {f"{module}.{name}" for module in ("forces", "orbits") for name in getattr(lfm, module).__all__
                  if name not in lfm.__all__}
    wanted = {*lfm.__all__, *of_modules} - {"data", "forces", "orbits"}
    missing = [f"::: lfm_ppl.{name}" for name in sorted(wanted - set(REFERENCE))]
    assert not missing, f"add to a page of docs/api: {missing}"
    assert len(REFERENCE) == len(set(REFERENCE))


def test_the_overview_of_the_reference_names_every_page_of_it_once():
    """The names on each page are added when the site is built, by docs/_build/overview.py."""
    overview = (DOCS / "api" / "index.md").read_text("utf-8")
    pages = re.findall(r"^\*\*\[.+\]\((\w+\.md)\)\*\*$", overview, re.MULTILINE)
    assert sorted(pages) == sorted({path.name for path in (DOCS / "api").glob("*.md")} - {"index.md"})


@pytest.mark.parametrize("name", [name for name in REFERENCE if name not in lfm.__all__])
def test_what_else_stands_in_the_reference_exists(name):
    *modules, last = name.split(".")
    assert (ROOT / "lfm_ppl").joinpath(*modules).with_suffix(".py").is_file() or hasattr(getattr(lfm, modules[0]), last)


def test_local_links_and_included_files_exist():
    for page in DOCS.rglob("*.md"):
        whole = page.read_text("utf-8")
        text = re.sub(r"^```.*?^```$|`[^`]+`", "", whole, flags=re.MULTILINE | re.DOTALL)
        snippets = re.findall(r'--8<-- "([^:"]+)', whole)
        assert all((DOCS / name).is_file() or (ROOT / name).is_file() for name in snippets), page
        linked = [page.parent / link for link in re.findall(r"\]\(([^)#:]+)[^):]*\)", text)]
        for path in linked:
            name = path.resolve().relative_to(DOCS).as_posix()
            made = re.fullmatch(r"gallery/(.+?)(_\d+\.png|\.md)", name)
            assert path.is_file() or made and made[1] in NOTEBOOKS, f"{page}: {name}"


@functools.cache
def literals() -> str:
    """Return all texts in the library's source, one a line, with a mark for what a message puts in."""
    result = []
    for path in (ROOT / "lfm_ppl").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [part.value if isinstance(part, ast.Constant) else "\0" for part in node.values]
                result.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                result.append(node.value)
    return "\n".join(result)


def test_messages_are_found():
    assert len(MESSAGES) > 20


@pytest.mark.parametrize("message", MESSAGES)
def test_a_message_of_the_page_of_errors_is_the_code_s(message):
    parts = [part.strip() for part in message.split("…")]
    assert any(parts)
    for part in filter(None, parts):
        assert part in literals(), part
