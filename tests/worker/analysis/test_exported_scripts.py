"""The scripts that are exported compute the report from the CSV files: every number of it, and none otherwise."""

import io
import math
import runpy
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.clips import Clip
from app.domain.preferences import Exclusion, LabelEvent, Purpose, Query, Response
from app.domain.protocol import EvaluatedMethod
from app.domain.studies import Participant, Study
from app.paths import ANALYSIS, DOCS
from app.services.exports import export_tables
from app.storage import ArtefactStore
from tests import factories
from tests.finished_study import make_finished_study
from worker.analysis.study.bradley_terry import head_to_head_report
from worker.analysis.study.guesses import guess_report
from worker.analysis.study.report import make_report
from worker.analysis.study.statistics import rating_report
from worker.compute.pools import Compute
from worker.jobs.publishing import export_files, report_files
from worker.jobs.runtime.context import WorkerContext

Rows = Sequence[Mapping[str, Any]]
Tables = dict[str, Rows]
Exported = Callable[..., tuple[Path, Mapping[str, Any]]]
SAME = 1e-6


def tables_of(contents: Mapping[str, Any]) -> Tables:
    """The numbers of a report as the scripts write them; of what could not be computed the names alone."""
    answers, change = contents["answers"], contents["change"]
    return {
        **ratings_tables(contents["ratings"]),
        **head_to_head_tables(contents["head_to_heads"]),
        "answers": [_answers_of(each) for each in answers["participants"]],
        "answers_pooled": [answers["pooled"]],
        "curves": [
            {"participant": each["participant"], "scored": scored, "accuracy": value}
            for each in answers["participants"]
            for scored, value in each["curve"]
        ],
        "change": [
            {"participant": each["participant"], "measure": name, **measured}
            for each in change["participants"]
            for name, measured in each["measures"].items()
        ],
        "change_pooled": [{"measure": name, **each} for name, each in change["pooled"].items()],
        "guesses": [contents["guesses"]] if contents["guesses"] else [],
        **scales_tables(contents["instruments"]),
    }


def ratings_tables(ratings: Mapping[str, Any]) -> Tables:
    scales = ratings["scales"].items()
    return {
        "means": [{"scale": scale, **each} for scale, found in scales for each in found["means"]],
        "people": [
            {"scale": scale, "participant": each["participant"], "group": group, "mean": mean}
            for scale, found in scales
            for each in found["people"]
            for group, mean in each["means"].items()
        ],
        "comparisons": [
            {"scale": scale, **each} for scale, found in scales for each in _comparisons(found["comparisons"])
        ],
        "order_effects": [
            {"scale": scale, **each} for scale, found in scales if found["order"] for each in _order(found["order"])
        ],
    }


def head_to_head_tables(found: Mapping[str, Any] | None) -> Tables:
    if found is None:
        return {"wins": [], "strengths": []}
    groups = found["groups"]
    return {
        "wins": [
            {"group": row, "against": column, "wins": found["wins"][i][j]}
            for i, row in enumerate(groups)
            for j, column in enumerate(groups)
        ],
        "strengths": [*found.get("strengths", []), *found.get("comparisons", [])],
    }


def _comparisons(comparisons: Rows) -> Iterator[Mapping[str, Any]]:
    for each in comparisons:
        for test, result in each.items():
            if isinstance(result, dict):
                words = {"not_computable", "star", "corrected_over"}
                numbers = {name: value for name, value in result.items() if name not in words}
                yield {"first": each["first"], "second": each["second"], "test": test, **numbers}


def _order(order: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    for name in ("period", "carryover"):
        effect = order[name]
        if "F" in effect:
            df, df_error = effect["degrees_of_freedom"]
            yield {"effect": name, "F": effect["F"], "df": df, "df_error": df_error, "p": effect["p"]}
    for each in order["by_period"]:
        numbers = {name: each[name] for name in ("difference", "low", "high")}
        yield {"effect": f"period_{each['period']}", **numbers}


def _answers_of(each: Mapping[str, Any]) -> Mapping[str, Any]:
    flat = {name: value for name, value in each.items() if name not in ("accuracy", "curve", "test_retest")}
    for part, prefix in (("accuracy", "accuracy"), ("test_retest", "share")):
        flat |= {f"{prefix}_{name}" if name in ("low", "high") else name: v for name, v in each[part].items()}
    return flat


def scales_tables(instruments: Rows) -> Tables:
    means, comparisons, agreement = [], [], []
    for instrument in instruments:
        for score in (score for part in instrument["parts"] for score in part["scores"]):
            of = {"instrument": instrument["name"], "score": score["name"]}
            means += [{**of, **each} for each in score["means"]]
            comparisons += [{**of, **each} for each in _comparisons(score["comparisons"])]
            agreement += [{**of, **each} for each in score["reliability"]]
    return {"scale_means": means, "scale_comparisons": comparisons, "scale_reliability": agreement}


def assert_same(reported: Rows, computed: Rows, name: str, within: float = SAME) -> None:
    """The same rows, by their words, with the same numbers; what one has not, the other has not either."""
    found = {words_of(each): numbers_of(each) for each in computed}
    wanted = {words_of(each): numbers_of(each) for each in reported}
    assert found.keys() == wanted.keys(), name
    for words, numbers in wanted.items():
        assert found[words].keys() == numbers.keys(), (name, words)
        for column, value in numbers.items():
            assert found[words][column] == pytest.approx(value, rel=within, abs=within), (name, words, column)


KEYS = {
    "scale",
    "first",
    "second",
    "test",
    "group",
    "against",
    "participant",
    "measure",
    "instrument",
    "score",
    "effect",
}


def words_of(row: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    kept = {name: value for name, value in row.items() if name in {*KEYS, "foresight"} and not _missing(value)}
    if {"participant", "scored"} == row.keys() - {"accuracy"}:  # a point of a curve
        kept["scored"] = row["scored"]
    return tuple(sorted((name, str(value)) for name, value in kept.items() if value != ""))


def numbers_of(row: Mapping[str, Any]) -> dict[str, float]:
    words = {*KEYS, "foresight", "not_computable"}
    return {name: float(value) for name, value in row.items() if name not in words and not _missing(value)}


def _missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def read(folder: Path, name: str) -> Rows:
    text = (folder / f"{name}.csv").read_text().strip()
    return [] if not text else pd.read_csv(io.StringIO(text)).to_dict("records")


@pytest.fixture
def exported(database: Database, store: ArtefactStore, tmp_path: Path) -> Exported:
    """Unpacks the export of a finished study; with the tables that its report is made from."""

    def make(*, unblinded: bool = True) -> tuple[Path, Mapping[str, Any]]:
        with database.writing() as session:
            study = make_finished_study(session, store, people=6, labels=30, unblinded=unblinded)
            for number, person in enumerate(session.scalars(select(Participant).order_by(Participant.number))):
                _ask_again(session, person, number)
        with database.reading() as session:
            there = session.get_one(Study, study.id)
            contents, _ = make_report(report_files.tables_of(session, there))
            export_files.write_data(session, WorkerContext(database, store, Compute(1)), there, tmp_path / "data.zip")
        with zipfile.ZipFile(tmp_path / "data.zip") as packed:
            packed.extractall(tmp_path / "data")
        return tmp_path / "data", contents

    return make


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers are compared here."""
    monkeypatch.setattr("worker.analysis.study.figures.all_figures", lambda _contents: {})
    monkeypatch.setattr("worker.jobs.publishing.preference_arrays.arrays_of", lambda *_: None)


def _ask_again(session: Session, person: Participant, number: int) -> None:
    """Six pairs twice, with the sides exchanged in half of them, two obvious pairs, and an answer that is left out."""
    queries = session.scalars(select(Query).where(Query.participant_id == person.id).order_by(Query.ordinal)).all()
    for place, earlier in enumerate(queries[5:11]):
        sides = (
            (earlier.right_clip_id, earlier.left_clip_id)
            if place % 2
            else (earlier.left_clip_id, earlier.right_clip_id)
        )
        left, right = (session.get_one(Clip, clip) for clip in sides)
        again = factories.make_query(session, person, left, right)
        again.purpose, again.repeats_query_id = Purpose.REPEAT, earlier.id
        factories.make_label(session, again, list(Response)[(place + number) % 4], response_time_ms=2000 + place)
    for expected in (Response.LEFT, Response.RIGHT):
        query = factories.make_query(session, person, left, right)
        query.purpose, query.expected = Purpose.CATCH, expected
        factories.make_label(session, query, Response.RIGHT, response_time_ms=1500)
    event = session.scalars(select(LabelEvent).where(LabelEvent.query_id == queries[4].id)).one()
    session.add(Exclusion(label_event_id=event.id, excluded=True, reason="looked away", actor="Ada"))
    session.flush()


def run(*command: str | Path) -> None:
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_the_python_script_computes_every_number_of_the_report(exported: Exported) -> None:
    folder, contents = exported()
    run(sys.executable, "-W", "error::RuntimeWarning", folder / "analysis.py")
    for name, reported in tables_of(contents).items():
        assert_same(reported, read(folder / "analysis", name), name)
        assert reported or name == "guesses", f"{name}: nothing was compared"
    figures = {path.stem for path in (folder / "analysis").glob("*.pdf")}
    assert figures == {*_drawn(contents)}
    assert read(folder / "analysis", "catch_pairs")[0] == {"answered": 12, "wrong": 6}
    assert read(folder / "analysis", "recruitment")[0]["consented"] == 6


@pytest.mark.skipif(shutil.which("Rscript") is None, reason="R is not installed")
def test_the_r_script_computes_every_number_of_the_report(exported: Exported) -> None:
    folder, contents = exported()
    run("Rscript", folder / "analysis.R")
    for name, reported in tables_of(contents).items():
        assert_same(reported, read(folder / "analysis", name), name)


@pytest.mark.parametrize("script", ["analysis.R", "analysis.py"])
def test_the_scripts_are_those_that_real_r_was_last_seen_to_agree_on(script: str) -> None:
    """Where there is no R, the two tests that run it are skipped; the page says of which scripts they held."""
    found = sha256((ANALYSIS / script).read_bytes()).hexdigest()
    page = (DOCS / "results/in_r.md").read_text()
    assert found in page, "Run python -m tests.benchmarks.in_r where R is, and commit what it writes."


def _drawn(contents: Mapping[str, Any]) -> Iterator[str]:
    from worker.analysis.study import figures

    return (name for name, draw in figures._FIGURES.items() if draw(contents) is not None)


def test_until_a_study_is_unblinded_the_script_has_means_by_letter_alone(exported: Exported, tmp_path: Path) -> None:
    folder, contents = exported(unblinded=False)
    script = runpy.run_path(str(folder / "analysis.py"))
    study = script["Study"](folder / "csv")
    for name, reported in tables_of(contents).items():
        assert_same(reported, script[name](study), name)
    assert script["comparisons"](study) == script["strengths"](study) == script["scale_comparisons"](study) == []


# --- designs that the finished study does not have ---


@pytest.fixture
def script() -> dict[str, Any]:
    return runpy.run_path(str(ANALYSIS / "analysis.py"))


def invented(script: dict[str, Any], folder: Path, **tables: pd.DataFrame) -> Any:
    """A study of these tables; the others are there and empty."""
    empty = {table.name: [column.name for column in table.columns] for table in export_tables.TABLES}
    empty |= {"methods": ["method", "equivalence_bound"], "scoring_key": ["instrument", "score"]}
    for name, columns in empty.items():
        pd.DataFrame(tables.get(name, pd.DataFrame()), columns=columns).to_csv(folder / f"{name}.csv", index=False)
    return script["Study"](folder)


def bounded(methods: Sequence[str]) -> pd.DataFrame:
    return pd.DataFrame({"method": methods, "equivalence_bound": 0.4})


def ratings_of(people: int, arms: Sequence[Sequence[str]], seed: int) -> pd.DataFrame:
    """Ratings in blocks of one to three, by people of arms in turn; some leave a method out."""
    random, rows = np.random.default_rng(seed), []
    for number in range(people):
        met = list(random.permutation(arms[number % len(arms)]))
        order = 0
        for letter, method in zip("ABC", met[: len(met) - (number % 5 == 4)], strict=False):
            for repetition in range(1, int(random.integers(1, 4)) + 1):
                order += 1
                scores = random.integers(1, 6, 2)
                row = {"participant": f"P{number:02d}", "letter": letter, "method": method, "order": order}
                row |= {"satisfaction": scores[0], "personalisation": scores[1], "counts": True}
                rows.append(row | {"repetition": repetition})
    return pd.DataFrame(rows)


@pytest.mark.parametrize(
    ("people", "arms"),
    [
        (12, [("reference", "prefft", "pbarl")]),
        (14, [("reference",), ("pbarl",)]),
        (15, [("reference", "prefft"), ("prefft", "pbarl"), ("pbarl",)]),
        (34, [("pbarl",), ("reference",)]),
        (3, [("reference", "pbarl")]),
        (2, [("reference", "pbarl")]),
    ],
)
def test_arms_and_missing_ratings_are_computed_alike(
    script: dict[str, Any], tmp_path: Path, people: int, arms: Sequence[Sequence[str]]
) -> None:
    methods = [each.value for each in EvaluatedMethod if any(each.value in arm for arm in arms)]
    ratings, between = ratings_of(people, arms, seed=people), len(arms) > 1
    who = pd.DataFrame({"participant": ratings["participant"].unique()})
    who["arm"] = [str(number % len(arms)) if between else None for number in range(len(who))]
    study = invented(
        script,
        tmp_path,
        ratings=ratings,
        participants=who,
        methods=bounded(methods),
    )
    for name, reported in ratings_tables(rating_report(ratings, methods, between=between, bound=0.4)).items():
        assert_same(reported, script[name](study), name)


@pytest.mark.skipif(shutil.which("Rscript") is None, reason="R is not installed")
def test_the_r_script_computes_arms_alike(script: dict[str, Any], tmp_path: Path) -> None:
    """Few enough people that the permutation test counts all ways."""
    methods, arms = ["reference", "pbarl"], [("reference",), ("reference", "pbarl"), ("pbarl",)]
    ratings = ratings_of(15, arms, seed=1)
    who = pd.DataFrame({"participant": ratings["participant"].unique(), "arm": "one"})
    (tmp_path / "csv").mkdir()
    invented(script, tmp_path / "csv", ratings=ratings, participants=who, methods=bounded(methods))
    call = (
        "source(commandArgs(TRUE)[1]); write.csv(comparisons(read_study(commandArgs(TRUE)[2])), commandArgs(TRUE)[3])"
    )
    run("Rscript", "-e", call, ANALYSIS / "analysis.R", tmp_path / "csv", tmp_path / "comparisons.csv")
    reported = ratings_tables(rating_report(ratings, methods, between=True, bound=0.4))["comparisons"]
    assert {"cumulative_link_between", "equivalence_between"} <= {each["test"] for each in reported if "p" in each}
    computed = pd.read_csv(tmp_path / "comparisons.csv", index_col=0).to_dict("records")
    assert_same(reported, computed, "comparisons")


@pytest.mark.parametrize("people", [3, 4, 9])
def test_head_to_heads_with_equal_answers_are_computed_alike(
    script: dict[str, Any], tmp_path: Path, people: int
) -> None:
    random, methods = np.random.default_rng(people), ["reference", "prefft", "pbarl"]
    rows = [
        {"participant": f"P{number}", "left_method": left, "right_method": right, "counts": True}
        | {"response": random.choice(["left", "equal", "right"], p=[0.5, 0.2, 0.3])}
        for number in range(people)
        for left, right in (random.permutation(methods)[:2] for _ in range(int(random.integers(2, 5))))
    ]
    study = invented(
        script,
        tmp_path,
        headtoheads=pd.DataFrame(rows),
        methods=pd.DataFrame({"method": methods}),
    )
    report = head_to_head_report(
        [{**each, "left": each["left_method"], "right": each["right_method"]} for each in rows], methods
    )
    for name, reported in head_to_head_tables(report).items():
        assert_same(reported, script[name](study), name)


@pytest.mark.parametrize(("alone", "always"), [(1, False), (2, False), (4, False), (2, True), (5, True)])
def test_head_to_heads_in_arms_are_computed_alike(
    script: dict[str, Any], tmp_path: Path, alone: int, always: bool
) -> None:
    """``alone`` people compare the first two methods, where one or two are too few to tell; ``always``: the last one
    is always preferred, so that no strength fits.
    """
    random, methods = np.random.default_rng(alone), ["reference", "prefft", "pbarl"]
    rows = [
        {"participant": f"P{number}", "left_method": left, "right_method": right, "counts": True}
        | {"response": "left" if answer == 0 else "right" if answer == 1 else random.choice(["left", "equal", "right"])}
        | ({"response": "right"} if always and number >= alone else {})
        for number in range(alone + 6)
        for left, right in [methods[:2] if number < alone else methods[1:]]
        for answer in range(4 + number % 2)
    ]
    (tmp_path / "csv").mkdir()
    study = invented(
        script,
        tmp_path / "csv",
        headtoheads=pd.DataFrame(rows),
        methods=pd.DataFrame({"method": methods}),
    )
    report = head_to_head_report(
        [{**each, "left": each["left_method"], "right": each["right_method"]} for each in rows], methods
    )
    reported = head_to_head_tables(report)["strengths"]
    assert_same(reported, script["strengths"](study), "strengths")
    assert (script["head_to_heads_figure"](study) is None) == always
    if shutil.which("Rscript"):
        call = (
            "source(commandArgs(TRUE)[1]); study <- read_study(commandArgs(TRUE)[2]); pdf(NULL); "
            f"stopifnot(head_to_heads_figure(study) == {'FALSE' if always else 'TRUE'}); "
            "write.csv(strengths(study), commandArgs(TRUE)[3])"
        )
        run("Rscript", "-e", call, ANALYSIS / "analysis.R", tmp_path / "csv", tmp_path / "strengths.csv")
        assert_same(reported, pd.read_csv(tmp_path / "strengths.csv", index_col=0).to_dict("records"), "strengths")


def test_guesses_are_computed_alike(script: dict[str, Any], tmp_path: Path) -> None:
    methods, said = ["reference", "somebody_else", "pbarl"], "CCCCABCB"
    ratings = pd.DataFrame(
        [
            {"participant": f"P{number}", "letter": letter, "method": method, "counts": False}
            for number in range(len(said))
            for letter, method in zip("ABC", methods, strict=True)
        ]
    )
    forms = pd.DataFrame({"participant": [f"P{number}" for number in range(len(said))], "value": list(said)})
    forms = forms.assign(form="questionnaire", item="made_for_you", superseded=False)
    study = invented(
        script,
        tmp_path,
        ratings=ratings,
        forms=forms,
        methods=pd.DataFrame({"method": methods}),
    )
    report = guess_report([{"right": letter == "C"} for letter in said], len(methods))
    assert_same([report], script["guesses"](study), "guesses")
