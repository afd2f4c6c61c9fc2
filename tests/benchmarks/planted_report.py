"""Tables and picture of planted studies: what was found, beside what the page "How many people" promises."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from worker.analysis.comparison import result_pages
from worker.analysis.study.figures import GREY, LINE_COLOURS, MARKERS, STYLE, rendered
from worker.analysis.wilson import wilson_interval

TITLE = "# A planted effect, from the personal link to the p-value"
ALPHA = 0.05
NAMES = {"satisfaction": "satisfaction", "personalisation": "personalisation", "head_to_heads": "head-to-heads"}


@dataclass(frozen=True)
class Cell:
    """One measure in studies of one truth with so many people. Rates: studies that found something, and how many."""

    truth: str
    measure: str
    people: int
    is_there: bool
    """Whether there is something to find."""
    promised: tuple[int, int]
    through_pages: tuple[int, int]
    without_pages: tuple[int, int]

    @property
    def row(self) -> dict[str, str]:
        """As it stands in the table. The p-value: Fisher's, of promise and studies without pages being one rate."""
        counts = [(found, studies - found) for found, studies in (self.promised, self.without_pages)]
        return {
            "truth": self.truth,
            "measure": NAMES[self.measure],
            "people": str(self.people),
            "to find": "yes" if self.is_there else "nothing",
            "promised, %": _in_words(*self.promised),
            "through the pages, %": _in_words(*self.through_pages),
            "studies": str(self.through_pages[1]),
            "the same without pages, %": _in_words(*self.without_pages),
            "p of promise": f"{stats.fisher_exact(counts).pvalue:.2f}",
        }


def read(path: Path) -> list[dict[str, str]]:
    """Rows that are there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def found_in(p_values: Sequence[float | None]) -> tuple[int, int]:
    """Studies that found something, and studies; one that could not be tested found nothing."""
    return sum(p is not None and p < ALPHA for p in p_values), len(p_values)


def cells(rates: Sequence[Mapping[str, str]], studies: Sequence[Mapping[str, str]]) -> list[Cell]:
    """Of planted_rates.csv and planted.csv."""
    return [
        Cell(
            truth=rate["truth"],
            measure=rate["measure"],
            people=int(rate["people"]),
            is_there=float(rate["effect"]) > 0,
            promised=(int(rate["promised"]), int(rate["of_promised"])),
            through_pages=found_in(
                [
                    float(row[rate["measure"]] or "nan")
                    for row in studies
                    if (row["truth"], row["people"]) == (rate["truth"], rate["people"])
                ]
            ),
            without_pages=(int(rate["found_without_pages"]), int(rate["of_without_pages"])),
        )
        for rate in rates
    ]


def write(folder: Path, cells: Sequence[Cell]) -> None:
    """planted.svg and the tables of planted.md."""
    (folder / "planted.svg").write_bytes(rendered(_picture(cells))["svg"])
    rows = [cell.row for cell in cells]
    page = folder / "planted.md"
    page.write_text(result_pages.page(page, TITLE, f"{_table(rows)}\n\n{_table(_together(cells))}"))


def _together(cells: Sequence[Cell]) -> list[dict[str, str]]:
    """All numbers of people: what went through the pages against what the same design finds without them."""
    rows = []
    for truth, measure in dict.fromkeys((cell.truth, cell.measure) for cell in cells):
        mine = [cell for cell in cells if (cell.truth, cell.measure) == (truth, measure)]
        found, studies = (sum(cell.through_pages[place] for cell in mine) for place in range(2))
        promised, without = (
            sum(_percent(rate(cell)) / 100 * cell.through_pages[1] for cell in mine)
            for rate in (attrgetter("promised"), attrgetter("without_pages"))
        )
        rows.append(
            {
                "truth": truth,
                "measure": NAMES[measure],
                "studies through the pages": str(studies),
                "found": str(found),
                "promised": f"{promised:.1f}",
                "expected without pages": f"{without:.1f}",
            }
        )
    return rows


def _in_words(found: int, studies: int) -> str:
    if not studies:
        return ""
    low, high = wilson_interval(found, studies)
    return f"{100 * found / studies:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    lines = ["| " + " | ".join(rows[0]) + " |", "|---" * len(rows[0]) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row.values()) + " |" for row in rows)])


def _picture(cells: Sequence[Cell]) -> Figure:
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        power, alarms = figure.subplots(1, 2)
        _panel(power, [cell for cell in cells if cell.is_there], "Power: own is better by 0.75 SD")
        _panel(alarms, [cell for cell in cells if not cell.is_there], "False alarms: nothing to find")
        power.set_ylabel("Studies that find it, %")
        alarms.axhline(100 * ALPHA, color=GREY, linewidth=0.8, linestyle="--")
        power.set_ylim(0, 100)
        alarms.set_ylim(0, 60)
        for axes in (power, alarms):
            axes.set_xlabel("People")
            axes.legend(loc="upper left" if axes is alarms else "lower right", fontsize=7)
    return figure


def _panel(axes: Axes, cells: Sequence[Cell], title: str) -> None:
    """Promise as a line, studies without pages as crosses on it, studies through the pages as points with intervals."""
    axes.set_title(title)
    axes.set_xticks(sorted({cell.people for cell in cells}))
    kinds = list(dict.fromkeys((cell.truth, cell.measure) for cell in cells))
    for place, (truth, measure) in enumerate(kinds):
        mine = [cell for cell in cells if (cell.truth, cell.measure) == (truth, measure)]
        at = [cell.people + 0.5 * (place - (len(kinds) - 1) / 2) for cell in mine]
        colour = LINE_COLOURS[1 + place % (len(LINE_COLOURS) - 1)]
        axes.plot(at, [_percent(cell.promised) for cell in mine], color=colour, linewidth=1)
        axes.plot(at, [_percent(cell.without_pages) for cell in mine], "x", color=colour, markersize=5)
        rates = [_percent(cell.through_pages) for cell in mine]
        ends = [wilson_interval(*cell.through_pages) for cell in mine]
        below = [max(rate - 100 * low, 0.0) for rate, (low, _) in zip(rates, ends, strict=True)]
        above = [max(100 * high - rate, 0.0) for rate, (_, high) in zip(rates, ends, strict=True)]
        name = f"{NAMES[measure]}, {truth}" if not mine[0].is_there else NAMES[measure]
        marks: dict[str, Any] = {"fmt": MARKERS[place], "color": colour, "markersize": 4, "elinewidth": 0.8}
        axes.errorbar(at, rates, yerr=[below, above], label=name, **marks)


def _percent(rate: tuple[int, int]) -> float:
    return 100 * rate[0] / max(rate[1], 1)
