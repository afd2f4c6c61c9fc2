"""Whether the advice to stop asking can be trusted, and how many answers a study should ask for.

    python -m tests.benchmarks.advice_to_stop

Scripted users (5 % mistakes, 10 % "equal") answer 200 pairs of a pool as large as a study's, as in following_pairs.
After every tenth answer up to 100 and every twentieth after that a model is fitted and picks a mode. Told that more
answers hardly pay: whom app.services.answers.stopping_advice says it of within 100 answers. Wrong: who would have
gained more than 3 % of what they mind and like under the reference policy by going on to 200. The rule was chosen by
the first 18 chains of a task and tried on the others. The pools and every finished chain are kept under data/: repeat
the command to go on.
"""

import csv
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from app.installed_tasks import catalogue
from app.services.answers import stopping_advice
from tests.benchmarks import answering
from tests.benchmarks.answering import Bench, Chain, Variant
from worker.analysis.comparison import result_pages
from worker.analysis.wilson import wilson_interval
from worker.domain.type_aliases import FloatArray
from worker.ml.filters.fitting.mode_worth import price_of_failures
from worker.ml.filters.fitting.response_surface import CAUTION, ResponseSurface, best_mode
from worker.ml.stopping import CANDIDATES, relative_regret

COUNTS = (*range(10, 101, 10), *range(120, 201, 20))
TOLD_BY = 100
MATTERS = 3.0
"""% of the stake"""
CHOSEN_BY = [*product(answering.PEOPLE, (0, 1))]
TRIED_ON = [
    *((f"person-{number}", 0) for number in range(4, 31)),
    *product((user for user in answering.PEOPLE if not user.startswith("person")), (2, 3, 4)),
]
RULES = {
    "relative regret (the advice)": ("relative_regret", stopping_advice.SMALL_REGRET, stopping_advice.IN_A_ROW),
    "regret in deviations (before)": ("regret_in_deviations", 0.2, 3),
    "nobody is told, all stop at 100": (None, 0.0, 0),
}
TITLE = "# When more answers hardly pay"
LENGTHS = (50, 60, 80, 100, 120, 140, 160)


class Row(NamedTuple):
    """One user after so many answers."""

    task: str
    user: str
    seed: int
    labels: int
    gain_percent: float
    best_percent: float
    """what the mode of the user's true weights would gain"""
    relative_regret: float
    regret_in_deviations: float


def main() -> None:
    """See the module."""
    options = answering.parser(__doc__, "advice_to_stop", seeds=0).parse_args()
    torch.set_num_threads(1)
    kept, benches, rows = options.pools / "advice", dict[str, Bench](), list[Row]()
    kept.mkdir(parents=True, exist_ok=True)
    # User by user, so that whoever stops early has all tasks.
    planned = [Chain(task, *who, "") for who in CHOSEN_BY + TRIED_ON for task in catalogue.names()]
    for chain in tqdm(planned, unit="chain", mininterval=5):
        if chain.task not in benches:
            benches[chain.task] = Bench(chain.task, options.pools, {"": Variant()})
        rows += _measured(benches[chain.task], chain, kept / f"{chain.task}-{chain.user}-{chain.seed}.npz")
    with options.output.with_suffix(".csv").open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(Row._fields)
        writer.writerows(rows)
    page = options.output.with_suffix(".md")
    page.write_text(result_pages.page(page, TITLE, f"{table_of_rules(rows)}\n\n{table_of_lengths(rows)}"))


def _measured(bench: Bench, chain: Chain, file: Path) -> Iterator[Row]:
    if not file.exists():
        models = [each.model for each in bench.answered(chain, COUNTS)]
        members = np.array([model.signal_weights(()) for model in models])
        modes = np.array([best_mode(bench.surface, each, chain.seed) for each in members])
        unfinished = file.with_suffix(".partial.npz")
        np.savez(unfinished, allow_pickle=False, members=members, modes=modes)
        unfinished.rename(file)
    with np.load(file, allow_pickle=False) as stored:
        known = list(zip(COUNTS, stored["members"], stored["modes"], strict=True))
    for count, members, mode in known:
        gained = bench.gained(chain.user, mode)
        regrets = relative_regret(bench.surface, members), regret_in_deviations(bench.surface, members)
        who = chain.task, chain.user, chain.seed
        yield Row(*who, count, *(round(each, 4) for each in (gained["gain_percent"], gained["best_percent"], *regrets)))


def regret_in_deviations(surface: ResponseSurface, members: FloatArray) -> float:
    """What the advice went by before: each member's regret in standard deviations of its returns over all modes."""
    drawn = np.random.default_rng(0).uniform(surface.low, surface.high, (CANDIDATES, len(surface.low)))
    signals, success = surface.predict(np.concatenate([np.zeros((1, drawn.shape[1])), drawn]), CAUTION)
    lost = price_of_failures(success)
    returns = signals @ members.T
    unit = float((signals @ members.mean(axis=0)).std())
    chosen = int(np.argmax((returns.mean(axis=1) - CAUTION * returns.std(axis=1)) / unit - lost))
    own = returns / returns.std(axis=0) - lost[:, None]
    return float((own.max(axis=0) - own[chosen]).mean())


def told_after(chain: Sequence[Row], rule: str) -> int | None:
    """Answers after which somebody is first told; None: not within TOLD_BY."""
    name, small, in_a_row = RULES[rule]
    known = [(row.labels, float(getattr(row, name)) if name else 0.0) for row in chain if row.labels <= TOLD_BY]
    if name is None:
        return TOLD_BY
    first = (stopping_advice.enough_since(known[:end], small, in_a_row) for end in range(1, len(known) + 1))
    return next((since for since in first if since is not None), None)


def still_to_gain(chain: Sequence[Row], count: int) -> float:
    """What going on to the last answer gains, points of the stake."""
    return chain[-1].gain_percent - next(row for row in chain if row.labels == count).gain_percent


def _chains(rows: Sequence[Row], task: str, people: Sequence[tuple[str, int]]) -> list[list[Row]]:
    of_task = [row for row in rows if row.task == task]
    found = [[row for row in of_task if (row.user, row.seed) == who] for who in people]
    return [each for each in found if each]


def _wrong(lost: Sequence[float]) -> str:
    wrong = sum(each > MATTERS for each in lost)
    low, high = wilson_interval(wrong, len(lost))
    return f"{wrong} of {len(lost)} [{100 * max(low, 0.0):.0f}, {100 * high:.0f}]"


def table_of_rules(rows: Sequence[Row]) -> str:
    """Who is told, and how often that is wrong."""
    lines = [
        "| task | chains | rule | told | after | wrong [%] | lost, mean | at most | answers saved of 100 |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    parts = {"chose the rule": CHOSEN_BY, "tried it": TRIED_ON}
    for (part, people), task, rule in product(parts.items(), catalogue.names(), RULES):
        chains = _chains(rows, task, people)
        told = [(each, count) for each in chains if (count := told_after(each, rule)) is not None]
        lost, counts = [still_to_gain(*each) for each in told], [count for _, count in told]
        saved = sum(TOLD_BY - count for count in counts) / len(chains)
        lines.append(
            f"| {task.capitalize()} | {part} | {rule} | {len(told)} of {len(chains)} | {np.mean(counts):.0f} "
            f"| {_wrong(lost)} | {np.mean(lost):.1f} | {max(lost):.1f} | {saved:.0f} |"
        )
    return "\n".join(lines)


def table_of_lengths(rows: Sequence[Row]) -> str:
    """What everybody would still gain who stops after the same number of answers."""
    lines = [
        "| task | answers | gained so far, points | still to gain, mean | of nine in ten at most | wrong [%] |",
        "|---|---|---|---|---|---|",
    ]
    for task, count in product(catalogue.names(), LENGTHS):
        chains = _chains(rows, task, CHOSEN_BY + TRIED_ON)
        lost = [still_to_gain(each, count) for each in chains]
        gained = np.mean([row.gain_percent for each in chains for row in each if row.labels == count])
        lines.append(
            f"| {task.capitalize()} | {count} | {gained:.1f} | {np.mean(lost):.1f} | {np.quantile(lost, 0.9):.1f} "
            f"| {_wrong(lost)} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
