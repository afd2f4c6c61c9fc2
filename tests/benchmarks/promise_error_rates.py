"""How often a promise about harm is made although it is wrong, and how often it is earned: simulated people.

    python -m tests.benchmarks.promise_error_rates --output docs/results/promise_error_rates

Every simulated person has three filters, tested as the worker tests them: strength after strength, batch after batch,
until the promise is earned. How often a scenario is harmed is known here. Nothing is rolled out; minutes.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from tqdm import tqdm

from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages
from worker.analysis.filters.promise import Outcome, Promise
from worker.compute.harm_tests import STRENGTHS, weakened_until_promised
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft

TITLE = "# How often a promise about harm is made wrongly"
VERSIONS = (1, 2, 3)
CALM, PRESSED = Outcome(2.0, 0.0, True), Outcome(99.0, 0.0, True)
CASES = (
    ("at every strength as often as promised", (1.0,) * 4),
    ("a tenth more often", (1.1,) * 4),
    ("twice, at 90 % and 80 % as often as promised, at 50 % half as often", (2.0, 1.0, 1.0, 0.5)),
    ("half as often", (0.5,) * 4),
    ("two fifths as often", (0.4,) * 4),
    ("a fifth as often", (0.2,) * 4),
    ("a tenth as often", (0.1,) * 4),
    ("never", (0.0,) * 4),
)
"""How often truly harmed, in promised shares, at each strength."""


def main() -> None:
    """Simulate every case."""
    options = _options()
    rows = [
        _row(promise, words, rates, options.people)
        for promise in tqdm([Promise(share=share) for share in (0.05, 0.1)], unit="share")
        for words, rates in CASES
    ]
    page = options.output.with_suffix(".md")
    page.write_text(result_pages.page(page, TITLE, _table(rows, options.people)))
    result_tables.write(options.output.with_suffix(".csv"), rows)


def _row(promise: Promise, words: str, rates: Sequence[float], people: int) -> dict[str, Any]:
    rng = np.random.default_rng(7)
    truly = [rate * promise.share for rate in rates]
    wrong, whole, scenarios = 0, 0, []
    for _ in range(people):
        kept = [_tested(promise, version, truly, rng) for version in VERSIONS]
        strengths = [each.weights.gate for each in kept]
        risks = [truly[STRENGTHS.index(each)] if each else 0.0 for each in strengths]
        wrong += any(risk >= promise.share for risk in risks)
        whole += strengths[-1] == 1.0
        scenarios.append(sum(test["scenarios"] for test in kept[-1].promise["tests"]))
    return {
        "share": promise.share,
        "truly_harmed": words,
        "people": people,
        "wrong_promise": round(wrong / people, 4),
        "third_filter_whole": round(whole / people, 4),
        "scenarios_of_third": round(float(np.mean(scenarios)), 1),
    }


def _tested(promise: Promise, version: int, truly: Sequence[float], rng: np.random.Generator) -> FilterDraft:
    rate_of = dict(zip(STRENGTHS, truly, strict=True))
    return weakened_until_promised(
        FilterDraft(FilterWeights(mode={"speed_far": 0.5})),
        promise,
        version,
        STRENGTHS,
        range(4_000),
        partial(_driven, rate_of, rng),
        lambda some: [CALM] * len(some),
    )


def _driven(
    rate_of: dict[float, float], rng: np.random.Generator, weights: FilterWeights, scenarios: range
) -> list[Outcome]:
    return [PRESSED if harmed else CALM for harmed in rng.random(len(scenarios)) < rate_of[weights.gate]]


def _table(rows: Sequence[dict[str, Any]], people: int) -> str:
    lines = [
        f"{people} people a row, three filters each, 95 % confidence,"
        f" strengths {', '.join(f'{strength:.0%}' for strength in STRENGTHS)}.",
        "",
        "| promised share | scenarios are harmed | somebody's promise is wrong | third filter stays whole |"
        " scenarios for the third, mean |",
        "|---" * 5 + "|",
    ]
    lines += [
        f"| {row['share']:.0%} | {row['truly_harmed']} | {row['wrong_promise']:.1%} | {row['third_filter_whole']:.1%}"
        f" | {row['scenarios_of_third']:.0f} |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=1000)
    parser.add_argument(
        "--output", type=result_tables.stem, required=True, help="path without ending of the page and the table"
    )
    return parser.parse_args()


if __name__ == "__main__":
    main()
