"""The pages that people read: links lead somewhere, paths and names are there, and nothing is left out of a list."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import pytest

from app.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
WRITTEN = ("data", "build")
"""Folders that programs write, which are there or not."""
LONGEST_LINE = 400
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
NAMED = re.compile(r"`([\w.-]+(?:/[\w.-]+)*/?)(?:::(\w+))?`")
"""A path, and after two colons something that is defined in the file."""


def prose(page: Path) -> str:
    """Without pieces of code that span lines."""
    return CODE.sub("", page.read_text())


def headings(page: Path) -> set[str]:
    """As a link names them after its #."""
    found = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in found}


def links() -> Iterator[tuple[Path, str]]:
    """Page and target of every link that stays in the repository."""
    for page in PAGES:
        for target in LINK.findall(prose(page)):
            if not re.match(r"[a-z]+:", target):
                yield page, unquote(target)


def test_links_lead_to_files_and_headings_that_are_there() -> None:
    broken = []
    for page, target in links():
        path, _, heading = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (heading and heading not in headings(file)):
            broken.append(f"{page.relative_to(ROOT)}: {target}")
    assert not broken, "\n".join(broken)


def test_lines_are_not_too_long_to_read() -> None:
    """Wider lines and cells of tables are not read."""
    long = [
        f"{page.relative_to(ROOT)}:{number}"
        for page in PAGES
        for number, line in enumerate(page.read_text().splitlines(), 1)
        if len(line) > LONGEST_LINE
    ]
    assert not long, "\n".join(long)


def named() -> Iterator[tuple[Path, str, str]]:
    """Page, path and name of everything in the repository that a page speaks of as it is now."""
    for page in PAGES:
        for path, name in NAMED.findall(prose(page)) if page.name != "CHANGELOG.md" else ():
            folder = path.partition("/")[0]
            if name or (folder != path and folder not in WRITTEN and (ROOT / folder).is_dir()):
                yield page, path, name


def defined(file: Path) -> set[str]:
    """Functions, methods and classes of a module or a script."""
    if file.suffix == ".js":
        return set(
            re.findall(r"^\s*(?:export |async |function |class )*(\w+)[ (].*\{$", file.read_text(), re.MULTILINE)
        )
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    return {node.name for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, kinds)}


def test_every_path_and_name_of_the_code_is_there() -> None:
    programs = [each for folder in ("app", "worker", "static") for each in (ROOT / folder).rglob("*.*")]
    sources = [each for each in programs if each.suffix in (".py", ".js")]
    wrong = []
    for page, path, name in named():
        if not (ROOT / path).exists() or (name and name not in defined(ROOT / path)):
            now = [str(each.relative_to(ROOT)) for each in sources if name and name in defined(each)]
            wrong.append(f"{page.name}: {path}::{name}" + (f" is in {', '.join(now)}" if now else ""))
    assert not wrong, "\n".join(wrong)


def test_the_way_of_an_answer_names_files_and_functions() -> None:
    assert sum(bool(name) for page, _, name in named() if page.name == "CONTRIBUTING.md") > 15


def test_the_index_names_every_page() -> None:
    named = {target for page, target in links() if page == DOCS / "README.md"}
    assert {each.name for each in DOCS.glob("*.md")} - {"README.md"} <= named


def test_the_index_of_decisions_names_each_once_and_as_it_is_called() -> None:
    text = (DOCS / "decisions.md").read_text()
    named, written = (
        re.findall(start, text, re.MULTILINE) for start in (r"^\* \*\*(\d+)\*\* (.*)$", r"^## (\d+)\. (.*)$")
    )
    assert sorted(named) == sorted(written)


@pytest.mark.parametrize("name", Settings.model_fields)
def test_the_table_of_settings_has_all_of_them_with_their_defaults(name: str) -> None:
    rows = re.findall(r"^\| `(\w+)` \| (.+?) \|", (DOCS / "operating.md").read_text(), re.MULTILINE)
    default = Settings.model_fields[name].default
    told = dict(rows)[name.upper()]
    if default:
        assert told == f"`{str(default).lower()}`"
    else:
        assert told == "`false`" if default is False else "`" not in told.replace("`DATA_DIR`", "")
