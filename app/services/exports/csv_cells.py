r"""Texts that somebody else wrote, as cells of CSV and lines of JSON that no reader takes for anything but a text.

A cell must not become a formula in a spreadsheet, wherever that thinks it begins: after a semicolon or a tab, which end
a cell where a comma is the decimal mark, after a line break inside the text, or behind blanks that nobody sees. A lone
carriage return ends a row for some readers and not for others, so there is none: every line break is \n.
"""

import csv
import io
import json
import re
from collections.abc import Iterable
from datetime import datetime
from functools import lru_cache
from typing import Any

_UNSEEN = r"\s\x00-\x1f\x7f-\x9f\xad\u180e\u200b-\u200f\u2028-\u202e\u2060-\u2064\ufeff"
_SIGNS = r"=+@\uff1d\uff0b\uff0d\uff20\ufe66\ufe62\ufe63\ufe6b-"
"""The wide and small ones count in Japanese and Chinese spreadsheets."""
_FORMULA = re.compile(rf"(\A|[\n;\t])([{_UNSEEN}]*)(?=[{_SIGNS}])")
_FORMULA_IN_JSON = re.compile(rf"(;[{_UNSEEN}]*)([{_SIGNS}])")
_LINE_BREAK = re.compile(r"\r\n?")
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
_BEYOND_JSON = re.compile(r"[\x7f-\x9f\u2028\u2029\ud800-\udfff]")


def csv_line(values: Iterable[Any]) -> str:
    r"""One row of a CSV file with its line break, \n. None is empty."""
    target = io.StringIO()
    csv.writer(target, lineterminator="\n").writerow([cell(value) for value in values])
    return target.getvalue()


def cell(value: Any) -> str:
    """A value as the text of its cell."""
    if value is None:
        return ""
    if isinstance(value, str):
        return defused(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict | list):
        return _FORMULA_IN_JSON.sub(lambda found: found[1] + _escaped(found[2]), json_text(value))
    return moment(value) if isinstance(value, datetime) else str(value)


@lru_cache(maxsize=64)  # some columns say the same in every row of a table
def defused(text: str) -> str:
    """The text with an apostrophe wherever a spreadsheet would begin a formula, and without control characters."""
    plain = _CONTROL.sub("\N{REPLACEMENT CHARACTER}", _LINE_BREAK.sub("\n", text))
    return _FORMULA.sub(r"\1\2'", plain)


def json_text(value: Any) -> str:
    """JSON on one line, whatever the reader takes for the end of a line; half characters can be written as well."""
    return _BEYOND_JSON.sub(lambda found: _escaped(found[0]), json.dumps(value, ensure_ascii=False))


def moment(value: datetime) -> str:
    """A time as all files have it."""
    return value.isoformat(timespec="milliseconds")


def _escaped(character: str) -> str:
    return f"\\u{ord(character):04x}"
