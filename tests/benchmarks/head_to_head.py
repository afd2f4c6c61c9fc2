"""How often the strengths of head-to-heads err, in invented studies of people who differ and whose truth is known.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.head_to_head --studies 2000

Writes docs/results/head_to_head.csv and .md. Everything is computed by the functions that the page of results uses.
"""

import argparse
import csv
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from worker.analysis.comparison import result_pages
from worker.analysis.study.bradley_terry import covariance, strengths, why_not
from worker.analysis.study.effect_sizes import holm
from worker.domain.type_aliases import FloatArray

RESULTS = Path("docs/results")
METHODS, ROUNDS, TIE = 3, 3, 0.3
PEOPLE, SPREADS, EFFECTS = (4, 8, 16, 24), (0.0, 1.0), (0.0, 1.0)
TRUTH_PEOPLE = 200_000
ALPHA = 0.05


def invented(people: int, spread: float, effect: float, rng: np.random.Generator) -> FloatArray:
    """Wins (people, methods, methods). Latent: what each method is to a person, with logistic noise; ties if close."""
    worth = rng.normal(0.0, spread, (people, METHODS)) + np.array([0.0, 0.0, effect])
    wins = np.zeros((people, METHODS, METHODS))
    for first, second in combinations(range(METHODS), 2):
        felt = (worth[:, first] - worth[:, second])[:, None] + rng.logistic(size=(people, ROUNDS))
        share = np.where(np.abs(felt) < TIE, 0.5, felt > 0).sum(axis=1)
        wins[:, first, second], wins[:, second, first] = share, ROUNDS - share
    return wins


def row(people: int, spread: float, effect: float, studies: int) -> dict[str, Any]:
    """Misses and findings of one truth; what cannot be computed misses and finds nothing."""
    rng = np.random.default_rng([people, int(10 * spread), int(10 * effect)])
    truth = strengths(invented(TRUTH_PEOPLE, spread, effect, rng).sum(axis=0))
    pairs = list(combinations(range(METHODS), 2))
    same = [pair for pair in pairs if not effect or METHODS - 1 not in pair]
    tally = dict.fromkeys(("computed", "missed", "naive_missed", "false", "family", "found"), 0)
    for _ in range(studies):
        wins = invented(people, spread, effect, rng)
        if why_not(wins):
            continue
        tally["computed"] += 1
        found = strengths(wins.sum(axis=0))
        spreads = covariance(wins, found)
        chances = 1 / (1 + np.exp(found[None, :] - found[:, None]))
        met = wins.sum(axis=0) + wins.sum(axis=0).T
        weights = met * chances * (1 - chances)
        naive = np.linalg.pinv(np.diag(weights.sum(axis=1)) - weights)
        p_values = []
        for first, second in pairs:
            contrast = np.zeros(METHODS)
            contrast[[first, second]] = -1, 1
            error, plain_error = (max(float(contrast @ each @ contrast), 1e-18) ** 0.5 for each in (spreads, naive))
            off = contrast @ (found - truth)
            tally["missed"] += abs(off) > stats.t.ppf(0.975, people - 1) * error
            tally["naive_missed"] += abs(off) > 1.96 * plain_error
            p_values.append(float(2 * stats.t.sf(abs(contrast @ found) / error, people - 1)))
        hits = [p < ALPHA for p in p_values]
        after = [p is not None and p < ALPHA for p in holm(p_values)]
        tally["false"] += sum(hit for pair, hit in zip(pairs, hits, strict=True) if pair in same)
        tally["family"] += any(hit for pair, hit in zip(pairs, after, strict=True) if pair in same)
        tally["found"] += sum(hit for pair, hit in zip(pairs, hits, strict=True) if pair not in same)
    shown = max(tally["computed"], 1)
    differing = len(pairs) - len(same)
    return {
        "people": people,
        "spread": spread,
        "effect": effect,
        "studies": studies,
        "computed_percent": round(100 * tally["computed"] / studies, 1),
        "misses_percent": round(100 * tally["missed"] / shown / len(pairs), 1),
        "misses_if_answers_counted_percent": round(100 * tally["naive_missed"] / shown / len(pairs), 1),
        "false_alarms_percent": round(100 * tally["false"] / shown / len(same), 1),
        "false_alarms_of_family_percent": round(100 * tally["family"] / shown, 1),
        "power_percent": round(100 * tally["found"] / studies / differing, 1) if differing else "",
    }


TITLE = "# Error rates of head-to-heads"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure everything and write both files."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--studies", type=int, default=2000, help="of each truth")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder to write to")
    options = parser.parse_args(arguments)
    rows = [
        row(people, spread, effect, options.studies) for effect in EFFECTS for spread in SPREADS for people in PEOPLE
    ]
    with (options.to / "head_to_head.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    lines = ["| " + " | ".join(name.replace("_percent", ", %").replace("_", " ") for name in rows[0]) + " |"]
    lines += ["|---" * len(rows[0]) + "|", *("| " + " | ".join(map(str, each.values())) + " |" for each in rows)]
    page = options.to / "head_to_head.md"
    page.write_text(result_pages.page(page, TITLE, "\n".join(lines)))


if __name__ == "__main__":
    main()
