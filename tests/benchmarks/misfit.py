"""How often the flag that a model does not fit is raised: at people whom it fits, and at people whom it does not.

    python -m tests.benchmarks.misfit

Scripted people answer 200 pairs of a pool as large as a study's, chosen by entropy with the usual random share. After
every tenth answer from the sixtieth on, and every twentieth from the hundredth on, the flag is looked at. The model
fits the paper's three types and people of a population, with 5 % and with 10 % mistakes. The others are those of
tests/benchmarks/nonlinear_people.py. The pools are kept under data/, every finished person in --output: repeat the
command to go on, with more --people to add to them.
"""

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from app.services.answers.accuracy import ENOUGH_EVIDENCE
from tests.benchmarks import answered_pool, result_tables
from tests.benchmarks.answered_pool import AnsweredPool
from tests.benchmarks.nonlinear_people import ON_TIME_S, PEOPLE, Person, as_type, of_taste
from worker.analysis.comparison import result_pages
from worker.analysis.wilson import wilson_interval
from worker.ml.rewards.beyond_sums import misfit
from worker.ml.teachers import Manner, User, random_taste

TITLE = "# Whether the studio notices that a model does not fit"
ANSWERS = 200
COUNTS = (60, 100, 200)
"""Evidence is written down after these."""
CHOSEN_ON = {(task, str(seed)) for task in ("feeding", "scratching") for seed in range(4)}
"""Tasks and seeds that were seen when the fewest answers were chosen."""
MISTAKES = (0.05, 0.10)
LOOKS = [count for count in answered_pool.COUNTS if count >= misfit.FEWEST_ANSWERS]
Row = dict[str, str]


def main() -> None:
    """See the module."""
    options = _options()
    torch.set_num_threads(1)
    table = options.output.with_suffix(".csv")
    rows: list[Row] = list(result_tables.read(table))
    done = {(row["task"], row["person"], row["mistakes"], row["seed"]) for row in rows}
    pools: dict[str, AnsweredPool] = {}
    planned = [
        (task, name, mistakes, person, seed)
        for seed in range(options.people)
        for task in options.tasks
        for name, mistakes, person in everybody(seed)
    ]
    for task, name, mistakes, person, seed in tqdm(planned, unit="person", mininterval=10):
        if (task, name, mistakes, str(seed)) in done:
            continue
        if task not in pools:
            pools[task] = AnsweredPool(task, options.work_directory / "rollouts")
        rows.append(_looked_at(pools[task], name, mistakes, person, seed))
        _write(rows, options)
    _write(rows, options)


def everybody(seed: int) -> Iterator[tuple[str, str, Person]]:
    """Name, mistakes as written in the table, and the person; of the population somebody else with every seed."""
    linear = {user.value: Person(user.value, as_type(user)) for user in User}
    somebody = random_taste(f"person-{seed}", np.random.default_rng([seed, 31]))
    linear["population"] = Person("population", of_taste(somebody))
    for name, person in linear.items():
        for mistakes in MISTAKES:
            yield name, f"{mistakes:.2f}", replace(person, manner=Manner(mistakes=mistakes))
    for name, person in PEOPLE.items():
        yield name, "", person


def _looked_at(pool: AnsweredPool, name: str, mistakes: str, person: Person, seed: int) -> Row:
    answered = pool.answered(person, ANSWERS, seed)
    looked = {count: pool.ratios(answered, count) for count in LOOKS}
    flagged = [count for count in LOOKS if misfit.evidence(looked[count]) >= ENOUGH_EVIDENCE]
    first = looked[flagged[0]] if flagged else {}
    return {
        "task": pool.task.name,
        "person": name,
        "mistakes": mistakes,
        "seed": str(seed),
        "first_flagged": str(flagged[0]) if flagged else "",
        "explained_by": max(first, key=lambda each: first[each], default=""),
        **{f"evidence_{count}": f"{misfit.evidence(looked[count]):.3g}" for count in COUNTS[1:]},
        **{f"log_{name}_{ANSWERS}": f"{ratio:.2f}" for name, ratio in looked[ANSWERS].items()},
    }


def _write(rows: Sequence[Row], options: argparse.Namespace) -> None:
    """Table and page of everybody so far."""
    page = options.output.with_suffix(".md")
    page.write_text(result_pages.page(page, TITLE, _tables(rows)))
    result_tables.write(options.output.with_suffix(".csv"), rows)


def _tables(rows: Sequence[Row]) -> str:
    """Who was flagged by when, everybody whom the model fits first; over tasks together where it does."""
    head = "flagged within " + " | ".join(f"{count} answers" for count in COUNTS)
    fits = [row for row in rows if row["mistakes"]]
    lines = [f"| the model fits | mistakes | people | {head} |", "|---" * (3 + len(COUNTS)) + "|"]
    for name, mistakes in dict.fromkeys((row["person"], row["mistakes"]) for row in fits):
        some = [row for row in fits if (row["person"], row["mistakes"]) == (name, mistakes)]
        lines.append(f"| {name} | {float(mistakes):.0%} | {_flagged(some)} |")
    chosen, tried = (
        [row for row in fits if ((row["task"], row["seed"]) in CHOSEN_ON) == seen] for seen in (True, False)
    )
    for words, some in (("the rule was chosen on these of them", chosen), ("and tried on these", tried)):
        if some:
            lines.append(f"| {words} | 5 and 10 % | {_flagged(some)} |")
    lines += ["", f"| person | task | people | {head} | explained by |", "|---" * (4 + len(COUNTS)) + "|"]
    others = [row for row in rows if not row["mistakes"]]
    for name, task in dict.fromkeys((row["person"], row["task"]) for row in others):
        some = [row for row in others if (row["person"], row["task"]) == (name, task)]
        by = Counter(row["explained_by"] for row in some if row["explained_by"])
        said = ", ".join(f"{each} {count}" for each, count in by.most_common()) or "-"
        lines.append(f"| {name} | {task} | {_flagged(some)} | {said} |")
    return "\n".join(lines) + "\n"


def _flagged(rows: Sequence[Row]) -> str:
    """How many, and who was flagged within COUNTS answers, with Wilson's interval after the last of them."""
    within = [
        sum(bool(row["first_flagged"]) and int(row["first_flagged"]) <= count for row in rows) for count in COUNTS
    ]
    low, high = wilson_interval(within[-1], len(rows))
    shares = [f"{count / len(rows):.0%}" for count in within]
    return f"{len(rows)} | " + " | ".join([*shares[:-1], f"{shares[-1]} [{100 * low:.0f}, {100 * high:.0f}]"])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=[*ON_TIME_S], default=[*ON_TIME_S])
    parser.add_argument("--people", type=int, default=8, help="of each kind and task")
    parser.add_argument("--work-directory", type=Path, default=Path("data/benchmark"), help="of the pools")
    parser.add_argument(
        "--output", type=result_tables.stem, default=Path("docs/results/misfit"), help="stem of both files"
    )
    return parser.parse_args()


if __name__ == "__main__":
    main()
