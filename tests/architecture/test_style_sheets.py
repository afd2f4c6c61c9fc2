"""Style sheets and templates: every rule in one place and for some page, every page with the sheets that it needs."""

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TEMPLATES, STATIC = ROOT / "templates", ROOT / "static"
TASK_PICTURES = "".join(each.read_text(encoding="utf-8") for each in ROOT.glob("worker/tasks/*/picture.svg"))
SHEETS = sorted(path.relative_to(STATIC).as_posix() for path in STATIC.rglob("*.css"))
TOKENS = "base/tokens.css"
SIDES = ("participant", "experimenter")

EXPRESSION = re.compile(r"\{\{.*?\}\}|\{%.*?%\}", re.DOTALL)
CLASS_ATTRIBUTE = re.compile(r'class="((?:[^"{]|\{\{.*?\}\}|\{%.*?%\}|\{(?![{%]))*)"', re.DOTALL)
CLASS_BLOCK = re.compile(r"{% block (?:body_class|sheet_class|width) %}(.*?){% endblock %}", re.DOTALL)
MACRO = re.compile(r"{%-? macro (\w+)\(.*?%}(.*?){%-? endmacro -?%}", re.DOTALL)
IMPORT = re.compile(r'{% from "([^"]+)" import ([\w, ]+?)(?: with context)? %}')
PARENT_OR_PART = re.compile(r'{% (?:extends|include) "([^"]+)"')
LINKED_SHEET = re.compile(r'path="([\w/]+\.css)"')


@dataclass(frozen=True)
class Rule:
    """Selectors with what they say, and under which conditions (media, supports) they say it."""

    conditions: tuple[str, ...]
    selectors: tuple[str, ...]
    declarations: str


@cache
def rules_of(sheet: str) -> tuple[Rule, ...]:
    """The rules of a sheet in their order; key frames are none."""
    return tuple(_rules((STATIC / sheet).read_text(encoding="utf-8")))


def _rules(text: str) -> Iterator[Rule]:
    heads: list[str] = []
    before = ""
    for piece in re.split(r"([{}])", re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)):
        if piece == "{":
            heads.append(" ".join(before.split()))
        elif piece == "}":
            head = heads.pop()
            if not head.startswith("@") and not any(each.startswith("@keyframes") for each in heads):
                yield Rule(tuple(heads), tuple(_selectors(head)), before)
        before = piece


def _selectors(head: str) -> Iterator[str]:
    """The selectors of a list; commas within brackets part nothing."""
    for each in re.split(r",(?![^(]*\))", head):
        yield each.strip()


def classes_of(selector: str) -> set[str]:
    """The classes that a selector names."""
    return set(re.findall(r"\.([A-Za-z][\w-]*)", re.sub(r'"[^"]*"', "", selector)))


def styled_by(sheet: str) -> set[str]:
    """All classes that a sheet names."""
    return {name for rule in rules_of(sheet) for each in rule.selectors for name in classes_of(each)}


@dataclass
class Markup:
    """What one template, or one macro of it, writes by itself and what it brings in."""

    classes: set[str] = field(default_factory=set)
    sheets: set[str] = field(default_factory=set)
    templates: set[str] = field(default_factory=set)
    called: set[str] = field(default_factory=set)


def _markup(text: str, name: str = "") -> Markup:
    written = [*CLASS_ATTRIBUTE.findall(text), *CLASS_BLOCK.findall(text)]
    if name.endswith("_class"):  # a macro that gives nothing but a class
        written.append(text)
    classes = {word for each in written for word in _class_words(each)}
    calls = {each for expression in EXPRESSION.findall(text) for each in re.findall(r"\b(\w+)\(", expression)}
    return Markup(classes, set(LINKED_SHEET.findall(text)), set(PARENT_OR_PART.findall(text)), calls)


def _class_words(written: str) -> Iterator[str]:
    """The classes of an attribute; "verdict-*" where an expression completes one."""
    for expression in EXPRESSION.findall(written):
        for literal in re.findall(r'"([^"]*)"', expression):
            yield from literal.split()
    for word in EXPRESSION.sub("\0", written).split():
        yield from {word.replace("\0", ""), word.replace("\0", "*")} - {"", "*"}


@cache
def template(name: str) -> tuple[Markup, Mapping[str, Markup], Mapping[str, str]]:
    """A template's own markup, its macros, and from where it imports others."""
    text = re.sub(r"{#.*?#}", "", (TEMPLATES / name).read_text(encoding="utf-8"), flags=re.DOTALL)
    imported = {macro.strip(): path for path, macros in IMPORT.findall(text) for macro in macros.split(",")}
    macros = {macro: _markup(body, macro) for macro, body in MACRO.findall(text)}
    if "task_picture" in macros:
        macros["task_picture"].classes.update(_markup(TASK_PICTURES).classes)
    return _markup(MACRO.sub("", text)), macros, imported


@cache
def shown_by(page: str) -> Markup:
    """Everything that a page can show: with its base, its pieces, and the macros that are called."""
    whole = Markup()
    done: set[str] = set()

    def add(part: Markup, scope: dict[str, tuple[str, Markup]]) -> None:
        whole.classes.update(part.classes)
        whole.sheets.update(part.sheets)
        whole.templates.update(part.templates)
        for each in sorted(part.templates):
            visit(each, scope)
        for macro in sorted(part.called & scope.keys()):
            home, body = scope[macro]
            if f"{home} {macro}" not in done:
                done.add(f"{home} {macro}")
                whole.templates.add(home)
                add(body, scope | scope_of(home))

    def visit(name: str, scope: dict[str, tuple[str, Markup]]) -> None:
        if name not in done:
            done.add(name)
            add(template(name)[0], scope | scope_of(name))

    visit(page, {})
    return whole


def scope_of(name: str) -> dict[str, tuple[str, Markup]]:
    """The macros that a template can call, those of its base included, each with the template it is written in."""
    _, macros, imported = template(name)
    bases = re.findall(r'{% extends "([^"]+)"', (TEMPLATES / name).read_text(encoding="utf-8"))
    scope = {macro: found for base in bases for macro, found in scope_of(base).items()}
    scope |= {macro: (home, template(home)[1][macro]) for macro, home in imported.items() if macro in template(home)[1]}
    return scope | {macro: (name, body) for macro, body in macros.items()}


PAGES = [
    path.relative_to(TEMPLATES).as_posix()
    for path in sorted(
        [*TEMPLATES.glob("*.html"), *(each for side in SIDES for each in (TEMPLATES / side).glob("*.html"))]
    )
    if path.name != "base.html"
]
PARTS = sorted(
    path.relative_to(TEMPLATES).as_posix()
    for path in TEMPLATES.rglob("*.html")
    if path.parent.name == "pieces" or len(path.relative_to(TEMPLATES).parts) > 2
)
OCCASIONAL = {"participant/preview.css", "participant/no_script.css"}
"""Of previews, and of pages without scripts."""
SCRIPTS = "\n".join(path.read_text(encoding="utf-8") for path in STATIC.rglob("*.js"))
MARKUP = "\n".join(path.read_text(encoding="utf-8") for path in TEMPLATES.rglob("*.html"))
WORDS = {
    word
    for text in (MARKUP, *(path.read_text(encoding="utf-8") for path in (ROOT / "app").rglob("*.py")))
    for word in re.findall(r'"([a-z_]+)"', text)
}
"""What may complete a class such as "verdict-*"."""


@pytest.mark.parametrize("sheet", SHEETS)
def test_a_sheet_says_first_what_it_styles(sheet: str) -> None:
    assert re.match(r"/\* [A-Z][^*]+\. ?\*/\n", (STATIC / sheet).read_text(encoding="utf-8"))


def test_no_selector_stands_in_two_sheets() -> None:
    homes: dict[str, set[str]] = defaultdict(set)
    for sheet in set(SHEETS) - {TOKENS}:
        for rule in rules_of(sheet):
            for selector in rule.selectors:
                homes[selector].add(sheet)
    assert {selector: found for selector, found in homes.items() if len(found) > 1} == {}


@pytest.mark.parametrize("sheet", sorted(set(SHEETS) - {TOKENS}))
def test_no_selector_stands_twice_under_the_same_conditions(sheet: str) -> None:
    """Once in a list with others, for what they share, and once alone, for what is its own."""
    places = Counter(
        (rule.conditions, selector, len(rule.selectors) > 1) for rule in rules_of(sheet) for selector in rule.selectors
    )
    assert [place for place, count in places.items() if count > 1] == []


@pytest.mark.parametrize("sheet", sorted(set(SHEETS) - {TOKENS}))
def test_raw_colours_stand_among_the_tokens_only(sheet: str) -> None:
    said = " ".join(rule.declarations for rule in rules_of(sheet))
    assert (
        re.findall(r"#[0-9a-f]{3,8}\b|\b(?:rgb|hsl|oklch|color-mix)a?\(|(?<![\w-])(?:white|black)(?![\w-])", said) == []
    )


def test_tokens_are_defined_once_for_each_theme_and_all_of_them_are_used() -> None:
    defined: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for rule in rules_of(TOKENS):
        assert rule.selectors == (":root",)
        defined[rule.conditions] += re.findall(r"^\s*(--[\w-]+):", rule.declarations, re.MULTILINE)
    light, dark = defined[()], defined[("@media (prefers-color-scheme: dark)",)]
    assert len(defined) == 2
    assert max(Counter(light).values()) == max(Counter(dark).values()) == 1
    assert set(dark) < set(light)
    said = "\n".join((STATIC / sheet).read_text(encoding="utf-8") for sheet in SHEETS)
    local = set(re.findall(r"(--[\w-]+):", said))
    assert set(light) <= set(re.findall(r"var\((--[\w-]+)\)", said)) <= local


@pytest.mark.parametrize("sheet", SHEETS)
def test_every_rule_is_for_something_that_a_page_has(sheet: str) -> None:
    parts = [shown_by(page) for page in PAGES]
    loaded = [part for part in parts if sheet in part.sheets]
    classes = {name for part in loaded for name in part.classes}
    unused = [selector for rule in rules_of(sheet) for selector in rule.selectors if not _may_match(selector, classes)]
    assert unused == []


def _may_match(selector: str, classes: set[str]) -> bool:
    """Whether the pages have what a selector names: classes, attributes with their values, elements."""
    completed = {name[:-1] for name in classes if name.endswith("*")}
    return (
        all(
            name in classes or any(name.startswith(each) and name.removeprefix(each) in WORDS for each in completed)
            for name in classes_of(selector)
        )
        and all(_is_written(*each) for each in re.findall(r"""\[([\w-]+)(?:="([^"]*)")?""", selector))
        and all(f"<{tag}" in MARKUP for tag in _elements(selector))
    )


def _is_written(attribute: str, value: str) -> bool:
    """Whether a template or a script gives an element the attribute, and somebody names the value."""
    in_scripts = re.sub(r"-(\w)", lambda letter: letter[1].upper(), attribute.removeprefix("data-"))
    known = re.search(rf"\b({attribute}|dataset\.{in_scripts})\b", MARKUP + SCRIPTS)
    return known is not None and value in MARKUP + SCRIPTS


def _elements(selector: str) -> list[str]:
    without = re.sub(r"\[[^\]]*\]|::?[\w-]+(?:\(\d\))?", " ", selector)
    return re.findall(r"(?:^|[\s>+~(])([a-z][a-z0-9]*)", without)


@pytest.mark.parametrize("page", PAGES)
def test_a_page_loads_the_sheets_of_what_it_shows_and_no_others(page: str) -> None:
    shown = shown_by(page)
    reachable = {sheet for sheet in SHEETS if sheet.split("/")[0] in ("base", page.split("/")[0])}
    assert shown.sheets - OCCASIONAL <= reachable, "a side takes no sheet of the other"
    styled = {name: sheet for sheet in reachable for name in styled_by(sheet)}
    assert {name: styled[name] for name in shown.classes & styled.keys() if not _styles(name, shown.sheets)} == {}
    idle = {sheet for sheet in shown.sheets if styled_by(sheet) and not styled_by(sheet) & shown.classes}
    assert idle == set()


def _styles(name: str, sheets: set[str]) -> bool:
    return any(name in styled_by(sheet) for sheet in sheets)


@pytest.mark.parametrize("sheet", sorted(set(SHEETS) - OCCASIONAL))
def test_a_sheet_has_the_name_of_its_page_or_is_for_several(sheet: str) -> None:
    loading = [page for page in PAGES if sheet in shown_by(page).sheets]
    assert len(loading) > 1 or loading == [sheet.replace(".css", ".html")]


@pytest.mark.parametrize("piece", PARTS)
def test_a_piece_lies_in_the_folder_of_its_page_or_is_for_several(piece: str) -> None:
    showing = [page for page in PAGES if piece in shown_by(page).templates]
    folder = piece.rpartition("/")[0]
    if folder.endswith("pieces"):
        assert len(showing) > 1
    else:
        assert showing != []
        assert all(page.startswith(folder) for page in showing)


def test_no_page_gives_a_class_that_no_sheet_styles() -> None:
    """Scripts find their elements by attributes, tests by role and label."""
    styled = {name for sheet in SHEETS for name in styled_by(sheet)}
    written = {
        word
        for attribute in CLASS_ATTRIBUTE.findall(MARKUP)
        for word in EXPRESSION.sub("\0", attribute).split()
        if "\0" not in word
    }
    assert written - styled == set()


def test_no_page_waits_for_many_sheets() -> None:
    assert max(len(shown_by(page).sheets - OCCASIONAL) for page in PAGES) <= 6
