"""How often strengths of head-to-heads err, in invented studies, with arms and without, whose truth is known.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.head_to_head --studies 1000

Writes docs/results/head_to_head.csv and .md. Everything is computed by the functions that the page of results uses.
"""

import argparse
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages
from worker.analysis.study.bradley_terry import comparisons, fits, strengths
from worker.domain.type_aliases import FloatArray

RESULTS = Path("docs/results")
METHODS, ROUNDS, TIE = 3, 3, 0.3
PEOPLE, SPREADS, EFFECTS = (4, 8, 16, 24), (0.0, 1.0), (0.0, 1.0, 3.0, 5.0)
Arms = tuple[tuple[int, ...], ...]
ARMS: tuple[Arms, ...] = (((0, 1), (1, 2)), ((0, 1), (1, 2), (0, 2)), ((0, 1, 2), (1, 2)))
IN_EACH_ARM, SPREADS_IN_ARMS = (4, 5, 8, 16), (0.0, 1.2)
TRUTH_PEOPLE = 200_000
ALPHA = 0.05


def invented(people: int, spread: float, effect: float, rng: np.random.Generator, arms: Arms) -> FloatArray:
    """Wins (people of all arms, methods, methods). Latent: what each method is to a person, with logistic noise."""
    worth = rng.normal(0.0, spread, (people * len(arms), METHODS)) + np.array([0.0, 0.0, effect])
    wins = np.zeros((len(worth), METHODS, METHODS))
    for first, second in combinations(range(METHODS), 2):
        felt = (worth[:, first] - worth[:, second])[:, None] + rng.logistic(size=(len(worth), ROUNDS))
        share = np.where(np.abs(felt) < TIE, 0.5, felt > 0).sum(axis=1)
        met = np.repeat([first in arm and second in arm for arm in arms], people)
        wins[:, first, second], wins[:, second, first] = met * share, met * (ROUNDS - share)
    return wins


def row(arms: Arms, people: int, spread: float, effect: float, studies: int) -> dict[str, Any]:
    """Misses and findings of one truth; what is not computed finds nothing. ``people``: in each arm."""
    design = ARMS.index(arms) + 1 if arms in ARMS else 0
    rng = np.random.default_rng([people, int(10 * spread), int(10 * effect), design])
    truth = strengths(invented(TRUTH_PEOPLE, spread, effect, rng, arms).sum(axis=0))
    pairs = list(combinations(range(METHODS), 2))
    same = [pair for pair in pairs if not effect or METHODS - 1 not in pair]
    offered, missed, naive_missed, hit = (dict.fromkeys(pairs, 0) for _ in range(4))
    tested, families, fitted = 0, 0, 0
    for _ in range(studies):
        wins = invented(people, spread, effect, rng, arms)
        told = dict(zip(pairs, comparisons(wins), strict=True))
        tested += sum(each["p"] is not None for each in told.values())
        families += any(told[pair]["p"] is not None and told[pair]["p_holm"] < ALPHA for pair in same)
        fitted += fits(wins)
        naive = naive_covariance(wins.sum(axis=0)) if fits(wins) else None
        for pair, each in told.items():
            hit[pair] += each["p"] is not None and each["p"] < ALPHA
            if naive is None or each["low"] is None:
                continue
            true = truth[pair[1]] - truth[pair[0]]
            contrast = np.zeros(METHODS)
            contrast[list(pair)] = -1, 1
            offered[pair] += 1
            missed[pair] += not each["low"] <= true <= each["high"]
            error = float(contrast @ naive @ contrast) ** 0.5
            naive_missed[pair] += abs(each["difference"] - true) > 1.96 * error
    alarms = [100 * hit[pair] / studies for pair in same]
    different = [pair for pair in pairs if pair not in same]
    shown = max(sum(offered.values()), 1)
    return {
        "arms": ", ".join("".join("ABC"[method] for method in arm) for arm in arms),
        "people": people,
        "spread": spread,
        "effect": effect,
        "studies": studies,
        "strengths_percent": round(100 * fitted / studies, 1),
        "tested_percent": round(100 * tested / studies / len(pairs), 1),
        "misses_percent": round(100 * sum(missed.values()) / shown, 1),
        "misses_if_answers_counted_percent": round(100 * sum(naive_missed.values()) / shown, 1),
        "false_alarms_percent": round(sum(alarms) / len(same), 1),
        "false_alarms_of_worst_pair_percent": round(max(alarms), 1),
        "false_alarms_of_family_percent": round(100 * families / studies, 1),
        "power_percent": round(100 * sum(hit[pair] for pair in different) / studies / len(different), 1)
        if different
        else "",
    }


def naive_covariance(wins: FloatArray) -> FloatArray:
    """Of the strengths, as if each answer came from another person. ``wins`` (methods, methods)."""
    found = strengths(wins)
    chances = 1 / (1 + np.exp(found[None, :] - found[:, None]))
    weights = (wins + wins.T) * chances * (1 - chances)
    return np.asarray(np.linalg.pinv(np.diag(weights.sum(axis=1)) - weights), np.float64)


TITLE = "# Error rates of head-to-heads"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure everything and write both files."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--studies", type=int, default=1000, help="of each truth")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder to write to")
    options = parser.parse_args(arguments)
    everybody = ((0, 1, 2),)
    rows = [
        row(arms, people, spread, effect, options.studies)
        for arms, numbers, spreads in ((everybody, PEOPLE, SPREADS), *((a, IN_EACH_ARM, SPREADS_IN_ARMS) for a in ARMS))
        for effect in EFFECTS
        for spread in spreads
        for people in numbers
    ]
    result_tables.write(options.to / "head_to_head.csv", rows)
    lines = ["| " + " | ".join(name.replace("_percent", ", %").replace("_", " ") for name in rows[0]) + " |"]
    lines += ["|---" * len(rows[0]) + "|", *("| " + " | ".join(map(str, each.values())) + " |" for each in rows)]
    page = options.to / "head_to_head.md"
    page.write_text(result_pages.page(page, TITLE, "\n".join(lines)))


if __name__ == "__main__":
    main()
