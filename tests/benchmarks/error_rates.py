"""How often the tests and intervals that the studio shows are wrong, in invented studies whose truth is known.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.error_rates --studies 4000

Writes docs/results/error_rates.csv and .md. Everything is computed by the functions that the pages use.
"""

import argparse
import sys
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from tests.benchmarks import error_rates_of_intervals, result_tables
from worker.analysis.comparison import result_pages
from worker.analysis.study.effect_sizes import holm
from worker.analysis.study.hypothesis_tests import mixed_model, paired_t, two_sample_t, wilcoxon
from worker.domain.type_aliases import FloatArray

Cells = list[list[FloatArray]]
"""By person and group: ratings; empty where somebody was gone by then."""

RESULTS = Path("docs/results")
ALPHA = 0.05
NOISE = 0.8
"""Standard deviation of a rating around what a person thinks of a method."""
LEVELS = 0.6
"""Of the people: some rate everything higher."""


@dataclass(frozen=True)
class Truth:
    """What is so in an invented study. Ratings are on the scale of 1 to 5."""

    name: str
    people: int = 8
    trials: int = 3
    spreads: tuple[float, ...] = (0.5, 0.5, 0.5)
    """Of each method: standard deviation over people of what it is to them, beyond its mean."""
    means: tuple[float, ...] = (3.0, 3.0, 3.0)
    whole: bool = False
    """Ratings are rounded and cut to 1, 2, 3, 4, 5, as people give them."""
    missing: float = 0.0
    """Chance that a trial was not rated."""
    dropouts: float = 0.0
    """Chance that somebody leaves after each method; methods come in a random order."""


NOTHING = Truth("no spread", spreads=(0.0, 0.0, 0.0))
SPREAD = Truth("spread .5")
UNEQUAL = Truth("unequal spreads .1, .5, 1", spreads=(0.1, 0.5, 1.0))
WHOLE = Truth("spread .5, ratings 1 to 5", whole=True)
FLOOR = Truth("spread .5, ratings 1 to 5 near the lower end", whole=True, means=(1.5, 1.5, 1.5))
MISSING = Truth("spread .5, ratings 1 to 5, 30 % of trials missing", whole=True, missing=0.3)
DROPOUTS = Truth("spread .5, ratings 1 to 5, dropouts", whole=True, dropouts=0.15, missing=0.1)
EFFECT = Truth("spread .5, ratings 1 to 5, third better by .8", whole=True, means=(2.8, 2.8, 3.6))
EFFECT_MISSING = replace(EFFECT, name=EFFECT.name + ", 30 % of trials missing", missing=0.3)

TRUTHS = tuple(
    replace(truth, people=people)
    for truth in (NOTHING, SPREAD, UNEQUAL, WHOLE, FLOOR, MISSING, DROPOUTS, EFFECT, EFFECT_MISSING)
    for people in (4, 8, 20)
)


def invented(truth: Truth, rng: np.random.Generator) -> Cells:
    """The ratings of one study."""
    cells = []
    for _ in range(truth.people):
        level = rng.normal(0.0, LEVELS)
        stays = _met(truth, rng)
        of_person = []
        for group, (mean, spread) in enumerate(zip(truth.means, truth.spreads, strict=True)):
            ratings = mean + level + rng.normal(0.0, spread) + rng.normal(0.0, NOISE, truth.trials)
            if truth.whole:
                ratings = np.clip(np.rint(ratings), 1, 5)
            of_person.append(ratings[rng.random(truth.trials) >= truth.missing] if stays[group] else np.empty(0))
        cells.append(of_person)
    return cells


def _met(truth: Truth, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """Which methods somebody still met."""
    groups = len(truth.means)
    left_after = 1 + int(np.argmax(np.append(rng.random(groups - 1) < truth.dropouts, True)))
    met = np.zeros(groups, bool)
    met[rng.permutation(groups)[:left_after]] = True
    return met


def p_values(cells: Cells) -> dict[str, list[float | None]]:
    """By test: p of every comparison, as a report would have them; None where it cannot be computed."""
    found: dict[str, list[float | None]] = {test: [] for test in NAMES}
    for first, second in combinations(range(len(cells[0])), 2):
        every = [np.concatenate([person[group] for person in cells]) for group in (first, second)]
        both = [person for person in cells if len(person[first]) and len(person[second])]
        means = [np.array([person[group].mean() for person in both]) for group in (first, second)]
        differences = (means[1] - means[0]).round(12)
        results = {
            "two_sample_t": two_sample_t(*every),
            "paired_t": paired_t(differences),
            "wilcoxon": wilcoxon(differences),
            "mixed_model": mixed_model(*([person[group] for person in both] for group in (first, second))),
        }
        for test, result in results.items():
            found[test].append(result.get("p"))
    return found


def rates(truth: Truth, studies: int, seed: int = 0) -> list[dict[str, Any]]:
    """A row per test: how often it found something that is there, something that is not, and could say nothing."""
    rng = np.random.default_rng([seed, truth.people, zlib.crc32(truth.name.encode())])
    differ = [truth.means[first] != truth.means[second] for first, second in combinations(range(len(truth.means)), 2)]
    tallies = {test: np.zeros(5) for test in NAMES}
    for _ in range(studies):
        for test, found in p_values(invented(truth, rng)).items():
            corrected = holm(found)
            below = [p is not None and p <= ALPHA for p in found]
            family = [p is not None and p <= ALPHA for p in corrected]
            tallies[test] += (
                sum(hit for hit, true in zip(below, differ, strict=True) if not true),
                sum(hit for hit, true in zip(below, differ, strict=True) if true),
                any(hit for hit, true in zip(family, differ, strict=True) if not true),
                sum(hit for hit, true in zip(family, differ, strict=True) if true),
                sum(p is None for p in found),
            )
    return [_row(truth, studies, test, tally, sum(differ), len(differ)) for test, tally in tallies.items()]


def _row(truth: Truth, studies: int, test: str, tally: FloatArray, differing: int, comparisons: int) -> dict[str, Any]:
    errors, found, family, found_after, unknown = (float(each) for each in tally)
    same = comparisons - differing
    return {
        "truth": truth.name,
        "people": truth.people,
        "studies": studies,
        "test": test,
        "false_alarms_percent": round(100 * errors / studies / same, 1),
        "false_alarms_of_family_percent": round(100 * family / studies, 1),
        "power_percent": round(100 * found / studies / differing, 1) if differing else "",
        "power_after_holm_percent": round(100 * found_after / studies / differing, 1) if differing else "",
        "not_computable_percent": round(100 * unknown / studies / comparisons, 1),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure everything and write both files."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--studies", type=int, default=4000, help="of each truth")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder to write to")
    options = parser.parse_args(arguments)
    rows = [row for truth in tqdm(TRUTHS, file=sys.stderr) for row in rates(truth, options.studies)]
    intervals = error_rates_of_intervals.rows(options.studies)
    result_tables.write(options.to / "error_rates.csv", rows)
    result_tables.write(options.to / "error_rates_of_intervals.csv", intervals)
    page = options.to / "error_rates.md"
    page.write_text(result_pages.page(page, TITLE, tables(rows, intervals)))


TITLE = "# Error rates of the tests and intervals that the studio shows"
NAMES = {"two_sample_t": "two-sample t", "paired_t": "paired t", "wilcoxon": "Wilcoxon", "mixed_model": "mixed model"}


def tables(rows: Sequence[Mapping[str, Any]], intervals: Sequence[Mapping[str, Any]]) -> str:
    """What stands on the page; what was found after Holm's correction and what has no result is in the CSV only."""
    studies = int(rows[0]["studies"])
    error = 100 * (ALPHA * (1 - ALPHA) / studies) ** 0.5
    parts = [
        "## Nothing differs: found all the same, % of comparisons",
        f"{studies} studies of each truth; the standard error of 5 % is {error:.1f} points.",
        "\n".join(_table(rows, "false_alarms_percent", "")),
        "## One method is better by .8: found, % of the comparisons that differ",
        "\n".join(_table(rows, "power_percent", "better")),
        error_rates_of_intervals.page(intervals),
    ]
    return "\n\n".join(parts)


def _table(rows: Sequence[Mapping[str, Any]], column: str, about: str) -> Iterator[str]:
    yield "| truth | people | " + " | ".join(NAMES.values()) + " |"
    yield "|---" * (2 + len(NAMES)) + "|"
    for truth, people in dict.fromkeys((row["truth"], row["people"]) for row in rows):
        differs = "better" in truth
        if differs == bool(about):
            of = {row["test"]: row[column] for row in rows if (row["truth"], row["people"]) == (truth, people)}
            yield f"| {truth} | {people} | " + " | ".join(str(of[test]) for test in NAMES) + " |"


if __name__ == "__main__":
    main()
