"""Success against preference as a picture: one panel per user, one mark per method, drawn as plain SVG."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

from worker.analysis.comparison.comparison_rows import Row, compared

PANEL, GAP, LEFT, TOP, BOTTOM = 300.0, 46.0, 52.0, 56.0, 58.0
SIDE_BY_SIDE = 4
ROW = PANEL + TOP + 20.0
LEGEND_WIDTH, LEGEND_LINE = 112.0, 18.0
# Okabe and Ito's colours, which people with any colour vision can tell apart.
COLOURS = ("#000000", "#0072b2", "#d55e00", "#e69f00", "#cc79a7", "#009e73", "#56b4e9", "#8a6d00", "#666666")
TICKS = 5
LARGEST_LOSS = 0.2
"""of success; marks of methods that lose more would leave no room for the others"""
FEWEST_METHODS = 3
"""the reference policy and two between which somebody can choose"""


@dataclass(frozen=True)
class _Axis:
    """From values to pixels."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Round numbers within the range, about TICKS of them."""
        rough = (self.high - self.low) / TICKS
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough)
        first, last = math.ceil(self.low / step), math.floor(self.high / step)
        return [round(number * step, 6) for number in range(first, last + 1)]


@dataclass(frozen=True)
class _Look:
    """Of one method's marks: there are more methods than colours, so the next lot are squares, then hollow."""

    colour: str
    lap: int

    @classmethod
    def of(cls, index: int) -> "_Look":
        return cls(COLOURS[index % len(COLOURS)], index // len(COLOURS))

    def drawn(self, x: float, y: float, title: str = "") -> str:
        inside = f"<title>{escape(title)}</title>" if title else ""
        if self.lap == 0:
            return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{self.colour}">{inside}</circle>'
        fill = self.colour if self.lap == 1 else "#ffffff"
        return (
            f'<rect x="{x - 5:.1f}" y="{y - 5:.1f}" width="10" height="10" fill="{fill}" stroke="{self.colour}">'
            f"{inside}</rect>"
        )


def names(rows: Sequence[Row]) -> dict[str, str]:
    """Pictures' files by task, of the tasks in which there are methods to choose between. ``rows``: of table_rows()."""
    methods: dict[str, set[str]] = {}
    for row in rows:
        methods.setdefault(row["task"], set()).add(row["method"])
    return {task: f"pareto-{task}.svg" for task, found in methods.items() if len(found) >= FEWEST_METHODS}


def pictures(rows: Sequence[Row], known: Sequence[str]) -> Iterator[tuple[str, str]]:
    """The pictures, by the names of their files. ``rows``: of table_rows(); ``known``: see pareto_svg()."""
    for task, name in names(rows).items():
        shown = compared([row for row in rows if row["task"] == task])
        yield name, pareto_svg(task, [row for row in shown if row["success_delta"] >= -LARGEST_LOSS], known)


def pareto_svg(task: str, rows: Sequence[Row], known: Sequence[str]) -> str:
    """``rows``: of comparison.table_rows() for one task. Up and to the right is better; bars are 95 % intervals.

    ``known``: every method there is, so that each has its colour in all pictures.
    """
    users = list(dict.fromkeys(row["user"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    looks = {method: _Look.of(index) for index, method in enumerate(known)}
    width = LEFT + min(len(users), SIDE_BY_SIDE) * (PANEL + GAP)
    columns = max(1, int((width - LEFT) // LEGEND_WIDTH))
    legend = TOP + (math.ceil(len(users) / SIDE_BY_SIDE) - 1) * ROW + PANEL + BOTTOM
    height = legend + LEGEND_LINE * math.ceil(len(methods) / columns)
    body = [_text(LEFT, 22, f"{task}: success, and change of the true preference", size=14)]
    for index, user in enumerate(users):
        own = [row for row in rows if row["user"] == user]
        below, beside = divmod(index, SIDE_BY_SIDE)
        body += _panel(LEFT + beside * (PANEL + GAP), TOP + below * ROW, user, own, looks)
    for index, method in enumerate(methods):
        x, y = LEFT + index % columns * LEGEND_WIDTH, legend + index // columns * LEGEND_LINE
        body.append(looks[method].drawn(x + 5, y - 4))
        body.append(_text(x + 15, y, method, size=11))
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'font-family="sans-serif"><title>{escape(task)}: success against preference</title>'
        f'<rect width="100%" height="100%" fill="#ffffff"/>'
    )
    return "\n".join([head, *body, "</svg>"]) + "\n"


def _panel(left: float, top: float, user: str, rows: Sequence[Row], looks: dict[str, _Look]) -> list[str]:
    across = _axis([100 * row[f"success{end}"] for row in rows for end in ("_low", "_high")], left, left + PANEL)
    up = _axis([row[f"true_preference_delta{end}"] for row in rows for end in ("_low", "_high")], top + PANEL, top)
    parts = [f'<rect x="{left}" y="{top}" width="{PANEL}" height="{PANEL}" fill="none" stroke="#999999"/>']
    parts.append(_text(left, top - 10, user, size=13))
    for value in across.ticks():
        parts.append(_text(across(value), top + PANEL + 16, f"{value:g}", size=10, anchor="middle"))
    for value in up.ticks():
        parts.append(_text(left - 5, up(value) + 3, f"{value:g}", size=10, anchor="end"))
    if up.low < 0 < up.high:
        parts.append(_line(left, up(0), left + PANEL, up(0), "#cccccc", "4 3"))
    parts.append(_text(left + PANEL / 2, top + PANEL + 34, "success, %", size=11, anchor="middle"))
    for row in rows:
        parts += _mark(row, across, up, looks[row["method"]])
    return parts


def _mark(row: Row, across: _Axis, up: _Axis, look: _Look) -> Iterable[str]:
    x, y = across(100 * row["success"]), up(row["true_preference_delta"])
    low, high = (across(100 * row[f"success_{end}"]) for end in ("low", "high"))
    bottom, top = (up(row[f"true_preference_delta_{end}"]) for end in ("low", "high"))
    return [
        _line(low, y, high, y, look.colour),
        _line(x, bottom, x, top, look.colour),
        look.drawn(x, y, row["method"]),
    ]


def _axis(values: Sequence[float], start: float, end: float) -> _Axis:
    margin = max(0.06 * (max(values) - min(values)), 1e-3)
    return _Axis(min(values) - margin, max(values) + margin, start, end)


def _text(x: float, y: float, text: str, *, size: int, anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="{anchor}">{escape(text)}</text>'


def _line(x: float, y: float, to_x: float, to_y: float, colour: str, dashes: str = "none") -> str:
    ends = f'x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}"'
    return f'<line {ends} stroke="{colour}" stroke-dasharray="{dashes}"/>'
