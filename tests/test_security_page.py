"""docs/security.md has every item of ASVS 5.0.0 of levels 1 and 2, and the tests that it names are there."""

import re
from collections import Counter
from collections.abc import Iterator

import pytest

from app.paths import DOCS

PAGE = (DOCS / "security.md").read_text()
ROOT = DOCS.parent
# How many items of levels 1 and 2 each section has; those of level 3 come after them.
SECTIONS = {
    "1": (2, 9, 11, 3, 2),
    "2": (3, 3, 4, 1),
    "3": (0, 2, 4, 6, 5, 0, 2),
    "4": (3, 1, 2, 4),
    "5": (1, 3, 2, 3),
    "6": (3, 12, 4, 4, 5, 3, 0, 4),
    "7": (3, 4, 2, 5, 2, 2),
    "8": (2, 3, 1, 1),
    "9": (3, 4),
    "10": (2, 2, 4, 11, 5, 2, 3),
    "11": (2, 3, 3, 4, 1, 1),
    "12": (3, 2, 4),
    "13": (1, 5, 2, 5),
    "14": (2, 4, 3),
    "15": (3, 3, 7),
    "16": (1, 5, 4, 3, 3),
    "17": (1, 4, 2),
}
ITEMS = {
    f"{chapter}.{section}.{number}"
    for chapter, sections in SECTIONS.items()
    for section, count in enumerate(sections, 1)
    for number in range(1, count + 1)
}


def answered() -> Iterator[str]:
    """The items of the tables' first columns, ranges written out."""
    for cell in re.findall(r"^\| (\d[\d., -]*) \|", PAGE, re.MULTILINE):
        for part in cell.split(", "):
            section, first, last = re.fullmatch(r"(\d+\.\d+)\.(\d+)(?:-(\d+))?", part).groups()  # type: ignore[union-attr]
            for number in range(int(first), int(last or first) + 1):
                yield f"{section}.{number}"


def test_every_item_is_answered_once() -> None:
    assert len(ITEMS) == 253
    assert Counter(answered()) == Counter(ITEMS)


@pytest.mark.parametrize("named", sorted(set(re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", PAGE))))
def test_the_tests_that_are_named_are_there(named: tuple[str, str]) -> None:
    path, name = named
    text = (ROOT / path).read_text()
    assert not name or f"def {name}(" in text


def test_rows_say_something_of_every_item() -> None:
    rows = [line.split(" | ") for line in PAGE.splitlines() if re.match(r"\| \d", line)]
    assert all(len(row) == 3 and len(row[2].strip(" |")) > 1 for row in rows)
