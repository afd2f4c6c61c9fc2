"""The exported R script in real R, and R's own packages, beside the numbers of the report, on invented studies.

    python -m tests.benchmarks.in_r

Needs R 4.1 or newer with the packages ordinal and lmerTest (Debian: r-base-core, r-cran-ordinal, r-cran-lmertest).
Three studies: people who meet all methods, in arms, and one where nothing differs; ratings are missing, people leave,
levels have heavy tails. ``analysis.R`` must write every number of the report; what ``by_hand.R`` computes with clmm,
lmer, t.test, lm and glm stands beside it. Writes docs/results/in_r.csv and the tables of in_r.md, with the hash of the
scripts: a test asks for a new run when one of them has changed.
"""

import argparse
import hashlib
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from app.paths import ANALYSIS
from app.services.exports import export_tables
from tests.benchmarks import result_tables
from tests.worker.analysis.test_exported_scripts import (
    Rows,
    Tables,
    head_to_head_tables,
    numbers_of,
    ratings_tables,
    read,
    scales_tables,
    words_of,
)
from worker.analysis.study.bradley_terry import head_to_head_report
from worker.analysis.study.scales import scale_reports
from worker.analysis.study.statistics import rating_report

RESULTS, BY_HAND = Path("docs/results"), Path(__file__).with_name("by_hand.R")
SCRIPT, SCRIPTS = "analysis.R", ("analysis.R", "analysis.py")
"""What R runs; and what must be as it was when the two agreed."""
CUTS = np.array([-2.3, -0.9, 0.3, 1.8])
"""Log odds between the points 1 to 5."""
BOUND, ITEMS, TRIALS = 0.6, 5, 3
METHODS = ("reference", "pbarl", "somebody_else")


@dataclass(frozen=True)
class Invented:
    """A study whose truth is known. Log odds of a higher rating; spreads are standard deviations over people."""

    name: str
    people: int
    means: Sequence[float]
    spreads: Sequence[float]
    drift: float
    arms: Sequence[Sequence[str]] = (METHODS,)


STUDIES = (
    Invented("everybody meets all", 16, (-0.9, 1.1, 0.0), (0.4, 1.3, 0.9), 0.3),
    Invented("arms", 24, (0.2, 0.9, -1.0), (0.7, 0.7, 0.7), -0.2, (METHODS[:2], METHODS[2:], METHODS[1:])),
    Invented("nothing differs", 9, (0.4, 0.4, 0.4), (0.6, 0.6, 0.6), 0.0),
)


def invent(study: Invented, seed: int) -> dict[str, pd.DataFrame]:
    """The tables of an export that the tests of methods are computed from."""
    rng = np.random.default_rng(seed)
    tables: dict[str, list[dict[str, Any]]] = {
        name: [] for name in ("participants", "ratings", "headtoheads", "scores")
    }
    tables["forms"] = []
    for number in range(study.people):
        who, arm = {"participant": f"P{number + 1:02d}"}, number % len(study.arms)
        tables["participants"].append(
            {**who, "arm": "abc"[arm] if len(study.arms) > 1 else None, "status": "completed"}
        )
        worth = dict(zip(METHODS, rng.normal(study.means, study.spreads) + 1.1 * rng.standard_t(5), strict=True))
        met = list(rng.permutation(study.arms[arm]))[: None if rng.random() < 0.8 else -1]
        for name, rows in _said(who, met, worth, study.drift, rng):
            tables[name].append(rows)
    tables["methods"] = [{"method": method, "equivalence_bound": BOUND} for method in METHODS]
    item = {"instrument": "scale", "score": "mean", "answer_lowest": 1, "answer_highest": 5}
    tables["scoring_key"] = [{**item, "item": f"item_{n}", "reversed": n == ITEMS} for n in range(1, ITEMS + 1)]
    return {name: pd.DataFrame(rows) for name, rows in tables.items()}


def _said(
    who: Mapping[str, Any], met: Sequence[str], worth: Mapping[str, float], drift: float, rng: np.random.Generator
) -> Iterator[tuple[str, dict[str, Any]]]:
    """(table, row) of everything one person says of the methods that they meet, in this order."""
    for block, method in enumerate(met):
        about = {**who, "letter": "ABC"[block], "method": method}
        for trial in range(TRIALS):
            if rng.random() < 0.9:
                felt = worth[method] + drift * block + rng.logistic(0, 0.6, 2)
                points = 1 + (felt[:, None] > CUTS).sum(axis=1)
                said = {"satisfaction": points[0], "personalisation": points[1], "counts": True}
                yield "ratings", {**about, "order": TRIALS * block + trial + 1, "repetition": trial + 1, **said}
        items = np.clip(np.rint(3 + 0.6 * worth[method] + rng.normal(0, 0.8, ITEMS)), 1, 5)
        score = {"instrument": "scale", "score": "mean", "value": items.mean(), "lowest": 1, "highest": 5}
        yield "scores", {**about, **score}
        for n, points in enumerate(items, 1):
            given = {"form": "scale", "item": f"item_{n}", "superseded": False}
            yield "forms", {**who, "letter": about["letter"], **given, "value": 6 - points if n == ITEMS else points}
    for left, right in ((a, b) for place, a in enumerate(met) for b in met[place + 1 :] for _ in range(2)):
        better = worth[left] - worth[right] + 0.2 + rng.logistic(0, 0.9)
        answer = "equal" if abs(better) < 0.3 else "left" if better > 0 else "right"
        yield "headtoheads", {**who, "left_method": left, "right_method": right, "response": answer, "counts": True}


def write(tables: Mapping[str, pd.DataFrame], folder: Path) -> None:
    """As an export has them, the others empty."""
    empty = {table.name: [column.name for column in table.columns] for table in export_tables.TABLES}
    for name, columns in {**empty, "methods": [], "scoring_key": []}.items():
        tables.get(name, pd.DataFrame(columns=columns)).to_csv(folder / f"{name}.csv", index=False)


def reported(tables: Mapping[str, pd.DataFrame], *, between: bool) -> Tables:
    """What the report says of these."""
    ratings = rating_report(tables["ratings"], METHODS, between=between, bound=BOUND)
    answers = tables["headtoheads"].rename(columns={"left_method": "left", "right_method": "right"})
    key = tables["scoring_key"].set_index("item")["reversed"]
    score = {"name": "mean", "title": "Mean", "lowest": 1, "highest": 5, "items": list(key.index)}
    scale = {"name": "scale", "title": "Scale", "measures": "", "scores": [score], "filled_in": _filled_in(tables, key)}
    return {
        **ratings_tables(ratings),
        **head_to_head_tables(head_to_head_report(answers.to_dict("records"), METHODS)),
        **scales_tables(scale_reports([scale], METHODS, compare=True, between=between)),
    }


def _filled_in(tables: Mapping[str, pd.DataFrame], reverse: "pd.Series[bool]") -> list[dict[str, Any]]:
    given = tables["forms"]
    keyed = given.assign(value=given["value"].where(~given["item"].map(reverse), 6 - given["value"]))
    items = {
        place: dict(zip(rows["item"], rows["value"], strict=True))
        for place, rows in keyed.groupby(["participant", "letter"])
    }
    return [
        {"participant": row.participant, "group": row.method, "scores": {"mean": row.value}}
        | {"items": items[row.participant, row.letter]}
        for row in tables["scores"].itertuples()
    ]


def apart(mine: float, theirs: float) -> float:
    """Relative to the larger, absolute below 1."""
    return abs(mine - theirs) / max(1.0, abs(mine), abs(theirs))


def against_script(study: Invented, tables: Tables, folder: Path) -> Iterator[dict[str, Any]]:
    """A row for each table: how many numbers, and the largest difference. Drawn permutations are others in R."""
    for name, rows in tables.items():
        computed = {words_of(each): numbers_of(each) for each in read(folder, name)}
        wanted = {words_of(each): numbers_of(each) for each in rows if each.get("exact") is not False}
        if not wanted.keys() <= computed.keys():
            raise ValueError(f"{study.name}, {name}: the script has no {sorted(wanted.keys() - computed.keys())[:3]}.")
        found = [
            apart(value, computed[words].get(column, np.inf))
            for words, numbers in wanted.items()
            for column, value in numbers.items()
        ]
        yield {"study": study.name, "what": name, "numbers": len(found), "largest": max(found, default=0.0)}


SAME = {
    "paired_t": ("paired_t", "statistic", "p"),
    "equivalence": ("equivalence", "p"),
    "welch_t": ("welch_t", "statistic", "p"),
    "oneway.test": ("welch_t", "p"),
    "equivalence_between": ("equivalence_between", "p"),
    "clmm": ("cumulative_link", "difference", "sd_between_people", "standard_error", "p"),
    "clmm between": ("cumulative_link_between", "difference", "sd_between_people", "standard_error", "p"),
    "lmer": ("mixed_model", "difference", "standard_error", "p"),
}
"""By what R calls it: the test of the report, and quantities that mean the same."""


def by_hand(study: Invented, tables: Tables, rows: Rows) -> Iterator[dict[str, Any]]:
    """Every number of by_hand.R with the report's."""
    tests = {(each["scale"], each["first"], each["second"], each["test"]): each for each in tables["comparisons"]}
    orders = {(each["scale"], each["effect"]): each for each in tables["order_effects"]}
    strengths = {each["group"]: each for each in tables["strengths"] if "group" in each}
    for row in rows:
        kind, quantity = row["analysis"], row["quantity"]
        mine: float | None = None
        if kind in SAME and quantity in SAME[kind][1:]:
            mine = tests[row["scale"], row["first"], row["second"], SAME[kind][0]].get(quantity)
        elif kind in ("period", "carryover"):
            mine = orders[row["scale"], kind].get(quantity)
        elif kind == "Bradley-Terry":
            mine = strengths[row["first"]]["strength"]
        elif kind == "jackknife":
            found = strengths[row["first"]]
            mine = (found["high"] - found["strength"]) / stats.t.ppf(0.975, found["degrees_of_freedom"])
        if mine is not None:
            yield {"study": study.name, "analysis": kind, "quantity": quantity, "r": row["value"], "report": mine}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run R, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, default=RESULTS)
    parser.add_argument("--seed", type=int, default=1)
    said = parser.parse_args(arguments)
    if shutil.which("Rscript") is None:
        sys.stdout.write(
            "R is not installed: nothing was compared. Debian: apt install r-base-core r-cran-ordinal r-cran-lmertest\n"
        )
        return 0
    scripted: list[dict[str, Any]] = []
    compared: list[dict[str, Any]] = []
    for study in STUDIES:
        tables = invent(study, said.seed)
        contents = reported(tables, between=len(study.arms) > 1)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "csv").mkdir()
            write(tables, folder / "csv")
            _run(ANALYSIS / SCRIPT, folder / "csv", folder / "analysis")
            scripted += against_script(study, contents, folder / "analysis")
            _run(BY_HAND, folder / "csv", folder / "by_hand.csv")
            hand = pd.read_csv(folder / "by_hand.csv", keep_default_na=False, na_values=["NA"])
            compared += by_hand(study, contents, hand.to_dict("records"))
        sys.stdout.write(f"{study.name}\n")
    save(said.to, scripted, compared)
    return 0


def _run(script: Path, *arguments: Path) -> None:
    done = subprocess.run(["Rscript", script, *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr)


def save(target: Path, scripted: Sequence[Mapping[str, Any]], compared: Sequence[Mapping[str, Any]]) -> None:
    """in_r.csv, every number that was compared by hand; and the tables of in_r.md."""
    short = [{**row, "r": f"{row['r']:.9g}", "report": f"{row['report']:.9g}"} for row in compared]
    result_tables.write(target / "in_r.csv", short)
    page = target / "in_r.md"
    kept = page.read_text().partition(MARK)[0] if page.exists() else ""
    version = subprocess.run(["R", "--version"], capture_output=True, text=True, check=True).stdout.split("\n")[0]
    lines = [
        f"{version}. What was run, by its SHA-256:",
        "",
        *(f"* `{name}` `{hash_of(name)}`" for name in SCRIPTS),
        "",
        "| study | table of analysis.R | numbers | largest difference |",
        "|---|---|---|---|",
        *(f"| {row['study']} | {row['what']} | {row['numbers']} | {row['largest']:.0e} |" for row in scripted),
        "",
        "| by R's packages | quantity | numbers | largest difference | median |",
        "|---|---|---|---|---|",
        *_by_analysis(compared),
    ]
    page.write_text(kept + MARK + "\n\n" + "\n".join(lines) + "\n")


MARK = "<!-- Written by a command from here on; what stands above this line is kept. -->"


def _by_analysis(compared: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    for analysis, quantity in dict.fromkeys((row["analysis"], row["quantity"]) for row in compared):
        found = [
            apart(row["report"], row["r"])
            for row in compared
            if (row["analysis"], row["quantity"]) == (analysis, quantity)
        ]
        yield f"| {analysis} | {quantity} | {len(found)} | {max(found):.0e} | {float(np.median(found)):.0e} |"


def hash_of(script: str) -> str:
    """SHA-256 of a script that is exported."""
    return hashlib.sha256((ANALYSIS / script).read_bytes()).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
