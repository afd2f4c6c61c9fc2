"""How level completed arms stay when people come at random, several at a time, and many drop out.

    python -m tests.benchmarks.arms --arrivals 10000

Writes docs/results/arms.csv and .md. Every arm is chosen by the function that the study uses.
"""

import argparse
import heapq
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from app.domain.protocol import EvaluatedMethod, EvaluationSettings
from app.domain.study_settings import StudySettings
from app.services.participants.arms import SILENT_AFTER, Load, choose, is_open
from tests.benchmarks import result_tables
from worker.analysis.comparison import result_pages

RESULTS = Path("docs/results")
DROPOUTS, AT_ONCE, ARMS, QUOTA = (0.1, 0.3, 0.5), (0.0, 2.0, 10.0, 50.0), (2, 4), 100
SILENT = SILENT_AFTER.total_seconds() / 3600
AWAY = 1.0
"""Hours without a sign after which somebody counts as dropped out; a whole study takes as long."""
METHODS = tuple(EvaluatedMethod)
LEVEL = 2
TITLE = "# Arms of studies between subjects"


def settings_of(arms: int, quota: int) -> StudySettings:
    """A study of so many arms, one method each."""
    evaluation = EvaluationSettings(methods=METHODS[:arms])
    named = [{"name": f"arm_{place}", "methods": [METHODS[place]]} for place in range(arms)]
    return StudySettings.model_validate({"evaluation": evaluation, "arms": named, "arm_quota": quota})


def simulate(
    settings: StudySettings, arrivals: int, at_once: float, dropout: float, rng: np.random.Generator
) -> dict[str, Any]:
    """One study: people come at random, so many at once on average, and stay between half an hour and a whole one.

    Who drops out gives the last sign at a random moment of that time, and counts on for AWAY. ``at_once`` 0: the next
    one comes when it is known what has become of the one before.
    """
    names = [each.name for each in settings.arms]
    completed, turned_away = Counter[str](), 0
    last_signs: dict[str, dict[int, float]] = {name: {} for name in names}
    over: list[tuple[float, int, str, bool]] = []
    moment, largest = 0.0, 0
    apart: list[int] = []

    def let_go(until: float) -> None:
        nonlocal largest
        while over and over[0][0] <= until:
            _, person, arm, done = heapq.heappop(over)
            del last_signs[arm][person]
            completed[arm] += done
            apart.append(max(completed[name] for name in names) - min(completed[name] for name in names))

    for number in range(arrivals):
        moment = moment + rng.exponential(0.75 / at_once) if at_once else np.inf
        let_go(moment)
        if not at_once:
            moment = 0.0
        loads = {}
        for name, signs in last_signs.items():
            silent = sum(sign < moment - SILENT for sign in signs.values())
            opened = is_open(settings, name, completed[name] + len(signs))
            loads[name] = Load(completed[name], len(signs), opened, silent)
        arm = choose(loads, float(rng.random()))
        if arm is None:
            turned_away += 1
            continue
        drops = bool(rng.random() < dropout)
        stays = float(rng.uniform(0.5, 1.0))
        last_signs[arm][number] = moment + (stays * float(rng.random()) if drops else stays)
        known = last_signs[arm][number] + (AWAY if drops else 0.0)
        heapq.heappush(over, (known, number, arm, not drops))
    let_go(np.inf)
    within = 100.0 * float(np.mean(np.array(apart) <= LEVEL)) if apart else 100.0
    return {
        "completed": sum(completed.values()),
        "turned_away": turned_away,
        "apart_at_end": apart[-1] if apart else 0,
        "most_apart": max(apart, default=0),
        "within_percent": within,
    }


def row(arms: int, at_once: float, dropout: float, arrivals: int, studies: int, quota: int) -> dict[str, Any]:
    """Several studies of one kind: the worst of each figure."""
    rng = np.random.default_rng([arms, int(10 * at_once), int(100 * dropout), quota])
    found = [simulate(settings_of(arms, quota), arrivals, at_once, dropout, rng) for _ in range(studies)]
    return {
        "arms": arms,
        "quota": quota or "none",
        "at_once": at_once or "one by one",
        "dropout_percent": round(100 * dropout),
        "arrivals": arrivals,
        "studies": studies,
        "apart_at_end": max(each["apart_at_end"] for each in found),
        "most_apart": max(each["most_apart"] for each in found),
        "within_percent": round(min(each["within_percent"] for each in found), 1),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arrivals", type=int, default=10_000)
    parser.add_argument("--studies", type=int, default=5)
    parser.add_argument("--to", type=Path, default=RESULTS)
    typed = parser.parse_args(arguments)
    rows = []
    for arms in ARMS:
        for dropout in DROPOUTS:
            rows += [row(arms, each, dropout, typed.arrivals, typed.studies, 0) for each in AT_ONCE]
            rows += [row(arms, each, dropout, typed.arrivals, typed.studies, QUOTA) for each in AT_ONCE[1:]]
    typed.to.mkdir(parents=True, exist_ok=True)
    result_tables.write(typed.to / "arms.csv", rows)
    shown = [name for name in rows[0] if name not in ("arrivals", "studies")]
    lines = ["| " + " | ".join(name.replace("_percent", ", %").replace("_", " ") for name in shown) + " |"]
    lines += [
        "|---" * len(shown) + "|",
        *("| " + " | ".join(str(each[name]) for name in shown) + " |" for each in rows),
    ]
    page = typed.to / "arms.md"
    page.write_text(result_pages.page(page, TITLE, "\n".join(lines)))


if __name__ == "__main__":
    main()
