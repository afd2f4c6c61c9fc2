"""Which test of Likert ratings keeps its promise when people differ in what a method is to them: invented studies.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.likert --studies 500

Writes docs/results/likert.csv and .md. Tests are computed by the functions that the pages use; beside them the two
models with a random intercept alone, which are not offered.
"""

import argparse
import sys
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize, stats
from tqdm import tqdm

from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages
from worker.analysis.study.cumulative_link import Fit, fit_two, tested
from worker.analysis.study.hypothesis_tests import equivalence, mixed_model, paired_t, two_sample_t, wilcoxon
from worker.analysis.study.statistics import BOUND
from worker.analysis.wilson import wilson_interval
from worker.domain.type_aliases import FloatArray

RESULTS = Path("docs/results")
ALPHA = 0.05
NOISE, LEVELS = 0.8, 0.6
"""Standard deviations: of a rating around what a person thinks of a method; over people of how high they rate."""
SIZES = (8, 16, 24)
NAMES = {
    "paired_t": "paired t (means of people)",
    "mixed_model": "linear, random slope",
    "random_intercept": "linear, random intercept alone",
    "cumulative_link": "cumulative link, sandwich",
    "cumulative_link_usual": "cumulative link, usual errors",
    "wilcoxon": "Wilcoxon",
    "two_sample_t": "two-sample t",
    "equivalence": "shown to be equal",
}
Groups = tuple[list[FloatArray], list[FloatArray]]


@dataclass(frozen=True)
class Truth:
    """What is so in an invented study of two methods. Ratings are whole, from 1 to 5."""

    name: str
    people: int = 8
    trials: int = 3
    middle: float = 3.0
    """What the first method is to people on average, before rounding and cutting."""
    better: float = 0.0
    """By how many points the mean rating of the second is higher, as it is given."""
    spread: float = 0.7
    """Standard deviation over people of the difference of the two, before rounding."""
    missing: float = 0.0
    """Chance that a trial was not rated."""

    @property
    def second(self) -> float:
        """What the second method is to people on average, before rounding and cutting."""
        scatter = (LEVELS**2 + self.spread**2 / 2 + NOISE**2) ** 0.5

        def mean(middle: float) -> float:
            return 1 + float(stats.norm.cdf((middle - np.arange(1.5, 5)) / scatter).sum())

        wanted = mean(self.middle) + self.better
        return float(optimize.brentq(lambda middle: mean(middle) - wanted, -5, 12))


ALIKE = Truth("the same to everybody", spread=0.0)
DIFFERENT = Truth("differs between people")
VERY = Truth("differs much between people", spread=1.4)
AT_AN_END = Truth("differs between people, near an end of the scale", middle=4.5)
MISSING = Truth("differs between people, 30 % of trials missing", missing=0.3)
NOTHING = (ALIKE, DIFFERENT, VERY, AT_AN_END, MISSING)
EFFECT = Truth("differs between people, half a point better", better=BOUND)
EFFECT_AT_AN_END = Truth("the same near an end of the scale", middle=3.8, better=BOUND)
EFFECTS = (EFFECT, EFFECT_AT_AN_END)
TRUTHS = tuple(replace(truth, people=people) for truth in (*NOTHING, *EFFECTS) for people in SIZES)


def invented(truth: Truth, rng: np.random.Generator) -> Groups:
    """By person: the ratings of each method; at least one of each."""
    levels = rng.normal(0.0, LEVELS, truth.people)
    groups: Groups = ([], [])
    for group, mean in zip(groups, (truth.middle, truth.second), strict=True):
        for level in levels:
            worth = mean + level + rng.normal(0.0, truth.spread / 2**0.5)
            ratings = np.clip(np.rint(worth + rng.normal(0.0, NOISE, truth.trials)), 1, 5)
            kept = rng.random(truth.trials) >= truth.missing
            group.append(ratings[kept] if kept.any() else ratings[:1])
    return groups


def p_values(groups: Groups) -> dict[str, float | None]:
    """By test; None where it cannot be computed."""
    first, second = groups
    differences = np.array([b.mean() - a.mean() for a, b in zip(first, second, strict=True)]).round(12)
    fitted = fit_two(first, second)
    link = tested(fitted, sum(map(len, (*first, *second))))
    return {
        "paired_t": paired_t(differences).get("p"),
        "mixed_model": mixed_model(first, second).get("p"),
        "random_intercept": random_intercept(first, second),
        "cumulative_link": link.get("p"),
        "cumulative_link_usual": _usual(fitted) if "p" in link else None,
        "wilcoxon": wilcoxon(differences).get("p"),
        "two_sample_t": two_sample_t(np.concatenate(first), np.concatenate(second)).get("p"),
        "equivalence": equivalence(differences, BOUND).get("p"),
    }


def random_intercept(first: Sequence[FloatArray], second: Sequence[FloatArray]) -> float | None:
    """p of the linear model with a level for every person, and one difference for all: within people, t test."""
    ratings, x = [], []
    for before, after in zip(first, second, strict=True):
        both, which = np.concatenate([before, after]), np.repeat([0.0, 1.0], [len(before), len(after)])
        ratings.append(both - both.mean())
        x.append(which - which.mean())
    r, of = np.concatenate(ratings), np.concatenate(x)
    slope, freedom = float(of @ r / (of @ of)), len(r) - len(first) - 1
    rest = float(((r - slope * of) ** 2).sum())
    if rest < 1e-12:
        return None
    return float(2 * stats.t.sf(abs(slope) / (rest / freedom / (of @ of)) ** 0.5, freedom))


def _usual(found: Fit) -> float:
    """p of the cumulative link mixed model as software prints it: normal, errors from the observed information."""
    place = len(found.thresholds)
    return float(2 * stats.norm.sf(abs(found.effects[0]) / found.covariance()[place, place] ** 0.5))


def rates(truth: Truth, studies: int, seed: int = 0) -> list[dict[str, Any]]:
    """A row per test: in how many studies it was below 5 %, with Wilson's interval; what has no p was not."""
    rng = np.random.default_rng([seed, truth.people, zlib.crc32(truth.name.encode())])
    found, unknown = dict.fromkeys(NAMES, 0), dict.fromkeys(NAMES, 0)
    for _ in range(studies):
        for test, p in p_values(invented(truth, rng)).items():
            found[test] += p is not None and p <= ALPHA
            unknown[test] += p is None
    rows = []
    for test in NAMES:
        low, high = wilson_interval(found[test], studies)
        shares = {"below_5_percent": found[test] / studies, "low": low, "high": high}
        rows.append(
            {"truth": truth.name, "people": truth.people, "better": truth.better, "studies": studies, "test": test}
            | {name: round(100 * share, 1) for name, share in shares.items()}
            | {"not_computable_percent": round(100 * unknown[test] / studies, 1)}
        )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure everything and write both files."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--studies", type=int, default=500, help="of each truth")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder to write to")
    options = parser.parse_args(arguments)
    rows = [row for truth in tqdm(TRUTHS, file=sys.stderr) for row in rates(truth, options.studies)]
    result_tables.write(options.to / "likert.csv", rows)
    page = options.to / "likert.md"
    page.write_text(result_pages.page(page, TITLE, tables(rows)))


TITLE = "# Tests of Likert ratings when people differ"


def tables(rows: Sequence[Mapping[str, Any]]) -> str:
    """What stands on the page."""
    found, shown = [each for each in NAMES if each != "equivalence"], ["equivalence"]
    return "\n\n".join(
        [
            "## The methods are rated alike: found to differ all the same, % of studies",
            f"{rows[0]['studies']} studies of each; in brackets Wilson's 95 % interval. Every test promises 5 %.",
            "\n".join(_table(rows, found, [each.name for each in NOTHING])),
            "## One is rated half a point higher: found to differ, % of studies",
            "\n".join(_table(rows, found, [each.name for each in EFFECTS])),
            f"## Shown to differ by less than {BOUND:g} points, % of studies",
            "True where they are rated alike; where one is half a point better it is a false alarm, of which 5 % are "
            "promised.",
            "\n".join(_table(rows, shown, [each.name for each in (*NOTHING, *EFFECTS)])),
        ]
    )


def _table(rows: Sequence[Mapping[str, Any]], tests: Sequence[str], truths: Sequence[str]) -> Iterator[str]:
    yield "| what a method is to people | people | " + " | ".join(NAMES[test] for test in tests) + " |"
    yield "|---" * (2 + len(tests)) + "|"
    of = {(row["truth"], row["people"], row["test"]): row for row in rows}
    for truth in truths:
        for people in SIZES:
            cells = [of[truth, people, test] for test in tests]
            shown = [f"{each['below_5_percent']} [{each['low']}, {each['high']}]" for each in cells]
            yield f"| {truth} | {people} | {' | '.join(shown)} |"


if __name__ == "__main__":
    main()
