"""Numbers, lists and tables as papers print them, in Markdown."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

MINUS = "\N{MINUS SIGN}"
NOT_RECORDED = "**not recorded in the studio; add it**"
_SPECIAL = str.maketrans({each: f"\\{each}" for each in "\\`*_[]<>|#"})


def count(number: int, one: str, many: str = "") -> str:
    """So many of something: “1 pair”, “3 pairs”."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def number(value: float | None, digits: int = 2) -> str:
    """With so many decimals, without a sign on zero; unknown is a dash."""
    if value is None:
        return "\N{EN DASH}"
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0 else text.replace("-", MINUS)


def interval(low: float | None, high: float | None, digits: int = 2) -> str:
    """A 95 % interval in brackets; nothing where there is none."""
    return "" if low is None or high is None else f" [{number(low, digits)}, {number(high, digits)}]"


def percent(share: float | None, digits: int = 1) -> str:
    """A share in percent."""
    return "\N{EN DASH}" if share is None else f"{number(100 * share, digits)} %"


def share_interval(low: float | None, high: float | None) -> str:
    """A 95 % interval of a share, in percent."""
    return "" if low is None or high is None else f" [{percent(low)}, {percent(high)}]"


def p_value(value: float | None, name: str = "p") -> str:
    """Without the zero before the point: “p = .012”, “p < .001”; in a table, without a name, “.012”."""
    if value is None:
        return f"{name} not computable".strip()
    if value < 0.001:
        return f"{name} < .001".strip()
    return f"{name}{' = ' if name else ''}{f'{value:.3f}'.removeprefix('0')}"


def day(moment: datetime | None) -> str:
    """A date; times of day are in the export."""
    return "an unknown day" if moment is None else f"{moment:%Y-%m-%d}"


def listed(words: Iterable[str], last: str = "and") -> str:
    """In a sentence: “a, b and c”."""
    *others, final = list(words) or [""]
    return f"{', '.join(others)} {last} {final}" if others else final


def quoted(text: str) -> str:
    """What somebody typed, on one line, so that it is no Markdown."""
    return " ".join(text.split()).translate(_SPECIAL)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table with its lines."""
    lines = [f"| {' | '.join(cells)} |" for cells in rows]
    return "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *lines])


def paragraph(*sentences: str) -> str:
    """Sentences that are there, one after the other."""
    return " ".join(each for each in sentences if each)


def has_number(result: Mapping[str, Any]) -> bool:
    """Whether a result has its numbers, and not a reason why there are none."""
    return "not_computable" not in result
