"""Pages of results: prose by a person above a mark, tables by a command below it."""

from pathlib import Path

MARK = "<!-- Written by a command from here on; what stands above this line is kept. -->"


def page(file: Path, head: str, tables: str) -> str:
    """The page with new tables. ``head``: what begins a page that nobody has written to yet, at least a title."""
    text = file.read_text() if file.exists() else ""
    above = text.partition(MARK)[0].rstrip() if MARK in text else head.rstrip()
    return f"{above}\n\n{MARK}\n\n{tables.strip()}\n"
