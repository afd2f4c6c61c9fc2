"""How often whole studies find an effect that was planted in what scripted people say, and one that is not there.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.planted --studies 40

Every person goes from the personal link to the end through the pages of a web server: consent, instructions, blinded
trials, ratings, head-to-heads. The answered pairs and the films, which make the robots, are put in place: the effect is
planted in what people say, not in robots. Then the study is unblinded on its page, and the report computed from its
tables as the worker does. The promise is that of the page "How many people", asked of the same study. Adds a row per
study to docs/results/planted.csv, where it goes on after an interruption, and draws planted.svg and the tables of
planted.md from all rows; ``--studies 0`` only draws.
"""

import argparse
import csv
import hashlib
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from fastapi import FastAPI
from sqlalchemy import select
from sqlalchemy.orm import joinedload

from app.db import Database
from app.domain.evaluation import HeadToHead, Trial
from app.domain.power_plan import PowerPlan
from app.domain.protocol import EvaluatedMethod, EvaluationSettings, PlannedTest
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.main import create_routes, make_studio, serve
from app.services.accounts import accounts
from app.services.participants import enrolment
from app.services.studies import power, studies
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.conftest import serving
from tests.databases import make_tables
from tests.worker.at_hand import AtHand, at_once
from worker.analysis.report import contents_of
from worker.jobs.publishing import power_plans, report_files
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.rehearsal import experimenter_steps
from worker.rehearsal.browser import OVER, FormBrowser, Offered

RESULTS = Path("docs/results")
TITLE = "# A planted effect, from the personal link to the p-value"
OWN, YOKED = EvaluatedMethod.PBARL, EvaluatedMethod.SOMEBODY_ELSE
PEOPLE, MOST_PEOPLE = (8, 16, 24), 32
"""The page simulates eight numbers from 4 to the most, these among them."""
TRIALS, PAIRS, NOISE, ALPHA = 3, 10, 0.8, 0.05
SCALES = ("satisfaction", "personalisation")
TIE = 0.5
"""Points of difference below which two robots side by side are called equal."""
Said = Mapping[str, Mapping[str, Sequence[int]]]
COLUMNS = ("truth", "people", "study", *SCALES, "head_to_heads", "difference", "seconds")


@dataclass(frozen=True)
class Truth:
    """What is planted. Points of the scale from 1 to 5; spread and levels are standard deviations over people."""

    name: str
    effect: float
    """Mean of own minus yoked in satisfaction; in personalisation there is never any."""
    spread: float
    """Of own minus yoked, in each of the two by itself."""
    levels: float
    in_arms: bool = False
    """Whether each person meets one of the two methods only."""

    def effect_in(self, scale: str) -> float:
        """That of one scale."""
        return self.effect if scale == SCALES[0] else 0.0


PLANTED = Truth("planted", 0.72, 0.7, 0.6)
IDENTICAL = Truth("identical people", 0.0, 0.0, 0.0)
IN_ARMS = Truth("planted, in two arms", 1.2, 0.7, 0.6, in_arms=True)
TRUTHS = {each.name: each for each in (PLANTED, IDENTICAL, IN_ARMS)}


def settings_of(truth: Truth) -> StudySettings:
    """Own against yoked, three trials of each; one planned test; as few pairs as a study can have."""
    arms = [{"name": "own", "methods": [OWN]}, {"name": "yoked", "methods": [YOKED]}]
    return StudySettings.model_validate(
        {
            "labels_per_participant": PAIRS,
            "pool_scenarios": 4,
            "behaviours_per_scenario": 4,
            "strategy": "uniform",
            "filter_milestones": (),
            "answer_after_first_play": False,
            "evaluation": EvaluationSettings(
                methods=(YOKED, OWN), trials=TRIALS, head_to_heads=0 if truth.in_arms else TRIALS
            ),
            "arms": arms if truth.in_arms else [],
            "planned_tests": [PlannedTest.WELCH_T if truth.in_arms else PlannedTest.PAIRED_T],
        }
    )


@dataclass
class PlantedPerson:
    """Somebody whose ratings follow from what each method is to them, and from nothing that a film shows."""

    database: Database
    truth: Truth
    rng: np.random.Generator
    said: dict[str, dict[str, list[int]]] = field(
        default_factory=lambda: {scale: {OWN.value: [], YOKED.value: []} for scale in SCALES}
    )
    """by scale, and by the method that it was about in truth"""

    def __post_init__(self) -> None:
        self._worth = {scale: self._drawn(self.truth.effect_in(scale)) for scale in SCALES}

    def _drawn(self, effect: float) -> dict[str, float]:
        """What each method is to them."""
        level = 3.0 + float(self.rng.normal(0.0, self.truth.levels))
        own, yoked = self.rng.normal(0.0, self.truth.spread / 2**0.5, 2)
        return {OWN.value: level + effect / 2 + float(own), YOKED.value: level - effect / 2 + float(yoked)}

    def answer(self, query_id: int) -> str:
        """Nobody is asked to: the pairs have been answered."""
        raise NotImplementedError(query_id)

    def rate(self, trial_id: int) -> tuple[int, int]:
        """What the method is to them, and the noise of each rating."""
        method, points = self._method(trial_id), []
        for scale in SCALES:
            felt = self._worth[scale][method] + self.rng.normal(0.0, NOISE)
            points.append(int(np.clip(np.rint(felt), 1, 5)))
            self.said[scale][method].append(points[-1])
        return points[0], points[1]

    def prefer(self, head_to_head_id: int) -> str:
        """By how satisfying the two methods are to them, with the noise of two ratings."""
        with self.database.reading() as session:
            asked = session.get_one(HeadToHead, head_to_head_id)
            sides = asked.left_trial_id, asked.right_trial_id
        left, right = (self._worth[SCALES[0]][self._method(trial_id)] for trial_id in sides)
        felt = left - right + float(self.rng.normal(0.0, NOISE * 2**0.5))
        return "equal" if abs(felt) < TIE else "left" if felt > 0 else "right"

    def set_robot(self) -> Mapping[str, int]:
        """Nobody is asked to."""
        return {}

    def describe(self, instrument: str, letter: str | None) -> Mapping[str, str]:
        """Nobody is asked to."""
        return {}

    def reply(self, questions: Mapping[str, Offered]) -> Mapping[str, str]:
        """Nobody is asked to."""
        return {}

    def _method(self, trial_id: int) -> str:
        with self.database.reading() as session:
            trial = session.scalars(select(Trial).where(Trial.id == trial_id).options(joinedload(Trial.film))).one()
        if trial.film is None:
            raise ValueError(f"Trial {trial_id} has no film.")
        return trial.film.method


@dataclass
class Studio:
    """A web server with a database of its own, and an experimenter who is logged in."""

    address: str
    database: Database
    store: ArtefactStore
    experimenter: FormBrowser


@cache
def _routes() -> FastAPI:
    return create_routes(https=False)


@contextmanager
def studio() -> Iterator[Studio]:
    """An empty one, gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="planted-") as directory:
        settings = Settings(_env_file=None, data_dir=Path(directory), public_url=None)
        made = make_studio(settings)
        make_tables(made.database)
        serve(_routes(), made)
        with made.database.writing() as session:
            password = accounts.create_first_experimenter(session) or ""
        with serving(_routes()) as address, FormBrowser(address, "/login") as experimenter:
            experimenter.log_in(accounts.FIRST_EXPERIMENTER, password)
            yield Studio(address, made.database, made.store, experimenter)
        made.database.dispose()


def make_study(there: Studio, truth: Truth, seed: int) -> Study:
    """Locked, nobody in it."""
    with there.database.writing() as session:
        study = studies.create_study(session, "Planted", settings_of(truth), seed=seed)
        study.key_secret = hashlib.sha256(f"planted/{seed}".encode()).hexdigest()  # the same letters for the same seed
    experimenter_steps.lock(there.experimenter, study)
    return study


def run_study(there: Studio, truth: Truth, people: int, number: int) -> dict[str, Any]:
    """One study of so many people, from their links to its p-values; a row of COLUMNS."""
    began = time.perf_counter()
    study = make_study(there, truth, seed=1000 * people + number)
    with there.database.writing() as session:
        here = session.get_one(Study, study.id)
        clips = [factories.make_clip(session, there.store, here) for _ in range(2)]
        invited = [enrolment.add_participant(session, here, scripted_as=truth.name) for _ in range(people)]
        for participant, _ in invited:
            for _ in range(PAIRS):
                factories.make_label(session, factories.make_query(session, participant, *clips))
    said = []
    for place, (participant, token) in enumerate(invited):
        rng = np.random.default_rng([list(TRUTHS).index(truth.name), people, number, place])
        person = PlantedPerson(there.database, truth, rng)
        _walk(there, f"/p/{token}", person, participant.id)
        said.append(person.said)
    there.experimenter.fill_in(f"/studies/{study.slug}/unblind", typed=study.slug)
    with there.database.reading() as session:
        report = contents_of(report_files.tables_of(session, session.get_one(Study, study.id)))
    return {
        "truth": truth.name,
        "people": people,
        "study": number,
        **_p_values(report, said),
        "seconds": round(time.perf_counter() - began, 2),
    }


def _walk(there: Studio, link: str, person: PlantedPerson, participant_id: int) -> None:
    """To the end; when the robots are waited for, they are put in place."""
    with FormBrowser(there.address, link) as visitor:
        while visitor.page not in OVER:
            if visitor.page == "evaluation-waiting":
                with there.database.writing() as session:
                    whose = session.get_one(Participant, participant_id)
                    study = session.get_one(Study, whose.study_id)
                    factories.make_robots(session, there.store, study, whose, picture=0)
            visitor.act(person)


def _p_values(report: dict[str, Any], said: Sequence[Said]) -> dict[str, Any]:
    """Of the planned test and of head-to-heads, corrected. Raises ValueError if the report is not about what was said.

    Whatever blinding, storage, unblinding or tables confuse, the difference would not be the one that people meant.
    """
    (planned,) = report["plan"]["planned"]
    if report["plan"]["standing"] != "before_data":
        raise ValueError(f"The plan counts as {report['plan']['standing']}.")
    found: dict[str, Any] = {}
    for scale in SCALES:
        (comparison,) = report["ratings"]["scales"][scale]["comparisons"]
        if (comparison["first"], comparison["second"]) != (YOKED, OWN):
            raise ValueError("Own minus yoked is what is planned.")
        test = comparison[planned]
        found[scale] = test.get("p_holm")
        own, yoked = (
            np.mean([np.mean(each[scale][method]) for each in said if each[scale][method]])
            for method in (OWN.value, YOKED.value)
        )
        if "difference" in test and abs(test["difference"] - (own - yoked)) > 1e-9:
            raise ValueError(f"The report has {test['difference']} in {scale}, but {own - yoked} was meant.")
        found.setdefault("difference", round(float(own - yoked), 4))
    pairs = (report["head_to_heads"] or {}).get("comparisons")
    return {**found, "head_to_heads": pairs[0]["p_holm"] if pairs else None}


def promise(there: Studio, truth: Truth, effect: float) -> dict[int, dict[str, Any]]:
    """What the page "How many people" says of this design with such an effect, by the number of people."""
    study = make_study(there, truth, seed=1)
    supposed = {"effect": effect, "spread": truth.spread, "levels": truth.levels, "noise": NOISE, "dropout_percent": 0}
    typed = {name: str(value) for name, value in {**supposed, "most_people": MOST_PEOPLE}.items()}
    there.experimenter.fill_in(f"/studies/{study.slug}/power", better=OWN, compared=YOKED, **typed)
    with there.database.writing() as session:
        (job,) = power_plans.due(session, session.get_one(Study, study.id))
        run_id = records.begin_run(session, job, seed=1)
    power_plans.make(WorkerContext(there.database, there.store, AtHand()), job, run_id, at_once)
    with there.database.reading() as session:
        (plan,) = power.of_study(session, session.get_one(Study, study.id))
    return {row["people"]: row for row in _contents(plan)["rows"]}


def _contents(plan: PowerPlan) -> dict[str, Any]:
    if plan.contents is None:
        raise ValueError("The plan was not simulated.")
    return plan.contents


def read(path: Path) -> list[dict[str, str]]:
    """Rows that are there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def run_missing(path: Path, wanted: int, truths: Sequence[Truth], say: Callable[[str], object]) -> None:
    """Every study that has no row yet, the first ones of every truth before the second ones."""
    known = {(row["truth"], int(row["people"]), int(row["study"])) for row in read(path)}
    if not path.exists():
        path.write_text(",".join(COLUMNS) + "\n")
    for number in range(wanted):
        keys = [(truth, people) for people in PEOPLE for truth in truths]
        missing = [key for key in keys if (key[0].name, key[1], number) not in known]
        if missing:
            with studio() as there:
                for truth, people in missing:
                    row = run_study(there, truth, people, number)
                    with path.open("a", newline="") as file:
                        csv.DictWriter(file, COLUMNS, lineterminator="\n").writerow(row)
                    say(f"study {number + 1} of {wanted}: {truth.name}, {people} people, {row['seconds']} s\n")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, then draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--studies", type=int, default=40, help="of each truth and number of people; 0: only draw")
    parser.add_argument("--truths", nargs="+", choices=list(TRUTHS), default=list(TRUTHS)[:2])
    parser.add_argument("--to", type=Path, default=RESULTS)
    said = parser.parse_args(arguments)
    run_missing(said.to / "planted.csv", said.studies, [TRUTHS[name] for name in said.truths], sys.stdout.write)


if __name__ == "__main__":
    main()
