"""Geometry of the small charts; the templates draw it as inline SVG, so that it needs no script and prints well."""

from collections.abc import Sequence
from dataclasses import dataclass

from app.services.answers.accuracy import Curve

LEFT, RIGHT, TOP, BOTTOM = 44.0, 14.0, 12.0, 44.0
"""Margins around the plot, in SVG units."""
SPARKLINE_POINTS = 48
"""More cannot be told apart on 96 pixels, and a page has a hundred of these lines."""


@dataclass(frozen=True)
class Tick:
    """A mark on an axis."""

    at: float
    text: str


@dataclass(frozen=True)
class AccuracyChart:
    """The accuracy curve with its interval, in SVG units."""

    width: float
    height: float
    line: str
    band: str
    last: tuple[float, float] | None
    chance_y: float
    x_ticks: Sequence[Tick]
    y_ticks: Sequence[Tick]
    plot_left: float
    plot_right: float
    plot_bottom: float


@dataclass(frozen=True)
class IntervalMark:
    """A dot with its interval on a scale that is symmetric about zero, in SVG units."""

    width: float
    zero: float
    dot: float
    low: float
    high: float


def accuracy_chart(curve: Curve, wanted: int, width: float = 760.0, height: float = 260.0) -> AccuracyChart:
    """The running accuracy from 0 to 100 % against the number of scored answers; ``wanted`` is the right end."""
    right_end = max(wanted, curve.points[-1].scored if curve.points else 0)

    def x(scored: float) -> float:
        return round(LEFT + (width - LEFT - RIGHT) * scored / right_end, 1)

    def y(share: float) -> float:
        return round(height - BOTTOM - (height - TOP - BOTTOM) * share, 1)

    over = [(x(point.scored), y(point.recent.high)) for point in curve.points]
    under = [(x(point.scored), y(point.recent.low)) for point in reversed(curve.points)]
    line = [(x(point.scored), y(point.recent.value)) for point in curve.points]
    return AccuracyChart(
        width=width,
        height=height,
        line=_points(line),
        band=_points(over + under),
        last=line[-1] if line else None,
        chance_y=y(0.5),
        x_ticks=[Tick(x(count), str(count)) for count in _round_counts(right_end)],
        y_ticks=[Tick(y(share / 100), f"{share} %") for share in (0, 25, 50, 75, 100)],
        plot_left=LEFT,
        plot_right=width - RIGHT,
        plot_bottom=height - BOTTOM,
    )


def sparkline(curve: Curve, width: float = 96.0, height: float = 28.0) -> str:
    """The running accuracy between 0 and 100 % as polyline points; empty while there are too few answers."""
    last = len(curve.points) - 1
    if last < 1:
        return ""
    stride = -(-last // SPARKLINE_POINTS)  # the last one is always there
    line = [
        (round(2 + (width - 4) * index / last, 1), round(height - 2 - (height - 4) * point.recent.value, 1))
        for index in range(last, -1, -stride)
        for point in [curve.points[index]]
    ]
    line.reverse()
    return _points(line)


def interval(middle: float, low: float, high: float, reach: float | None = None, width: float = 160.0) -> IntervalMark:
    """A value with its interval; ``reach`` is the value at the right edge, by default what just fits."""
    reach = reach or 1.15 * max(abs(low), abs(high), abs(middle)) or 1.0

    def x(value: float) -> float:
        inside = max(-1.0, min(1.0, value / reach))
        return round(width / 2 + inside * (width / 2 - 5), 1)

    return IntervalMark(width, width / 2, x(middle), x(low), x(high))


def _points(pairs: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x},{y}" for x, y in pairs)


def _round_counts(right_end: int) -> Sequence[int]:
    step = next(step for step in (2, 5, 10, 20, 25, 50, 100, 200, 500, 1000) if right_end / step <= 8)
    return range(0, right_end + 1, step)
