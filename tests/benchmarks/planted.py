"""How often whole studies find an effect that was planted in what scripted people say, and one that is not there.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.planted --studies 25

Every person goes from the personal link to the end through the pages of a web server: consent, instructions, blinded
trials, ratings, head-to-heads. The answered pairs and the films, which make the robots, are put in place: the effect is
planted in what people say, not in robots. Then the study is unblinded on its page, and the report computed from its
tables as the worker does. Its p-values must be those of what its people meant to say, computed without any page; this
alone is done with hundreds of studies more. The promise is that of the page "How many people", asked of the same
study. Adds a row per study to docs/results/planted.csv, where it goes on after an interruption; writes promises and
rates without pages once, to planted_rates.csv; and draws planted.svg and the tables of planted.md from both.
``--studies 0`` only draws.
"""

import argparse
import csv
import hashlib
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from fastapi import FastAPI
from sqlalchemy import select

from app.db import Database
from app.domain.evaluation import Film, HeadToHead, Trial
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
from tests.benchmarks import planted_report, result_tables
from tests.benchmarks.planted_report import found_in
from tests.conftest import serving
from tests.databases import make_tables
from tests.worker.at_hand import AtHand, at_once
from worker.analysis.study.bradley_terry import head_to_head_report
from worker.analysis.study.hypothesis_tests import paired_t
from worker.analysis.study.report import contents_of
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
MEASURES = (*SCALES, "head_to_heads")
COLUMNS = ("truth", "people", "study", *MEASURES, "seconds")


@dataclass(frozen=True)
class Truth:
    """What is planted. Points of the scale from 1 to 5; spread and levels are standard deviations over people."""

    name: str
    effect: float
    """Mean of own minus yoked in satisfaction; in personalisation there is never any."""
    spread: float
    """Of own minus yoked, in each of the two by itself."""
    levels: float


PLANTED = Truth("planted", 0.72, 0.7, 0.6)
IDENTICAL = Truth("identical people", 0.0, 0.0, 0.0)
TRUTHS = {each.name: each for each in (PLANTED, IDENTICAL)}
SETTINGS = StudySettings(
    labels_per_participant=PAIRS,
    pool_scenarios=4,
    behaviours_per_scenario=4,
    filter_milestones=(),
    evaluation=EvaluationSettings(methods=(YOKED, OWN), trials=TRIALS, head_to_heads=TRIALS),
    planned_tests=(PlannedTest.PAIRED_T,),
)


@dataclass(frozen=True)
class Opinions:
    """What one person will say."""

    ratings: Mapping[str, Mapping[str, Sequence[int]]]
    """by scale and method, a point for each trial"""
    preferred: Sequence[str]
    """for each head-to-head the method, or "equal"; by satisfaction"""


def opinions_of(truth: Truth, people: int, number: int) -> list[Opinions]:
    """Of everybody in one study."""
    place = list(TRUTHS).index(truth.name)
    return [_opinions(truth, np.random.default_rng([place, people, number, person])) for person in range(people)]


def _opinions(truth: Truth, rng: np.random.Generator) -> Opinions:
    worth, ratings = {}, {}
    for scale, effect in zip(SCALES, (truth.effect, 0.0), strict=True):
        level = 3.0 + rng.normal(0.0, truth.levels)
        own, yoked = level + rng.normal(0.0, truth.spread / 2**0.5, 2) + (effect / 2, -effect / 2)
        worth[scale] = {OWN.value: float(own), YOKED.value: float(yoked)}
        felt = {method: value + rng.normal(0.0, NOISE, TRIALS) for method, value in worth[scale].items()}
        ratings[scale] = {method: np.clip(np.rint(each), 1, 5).astype(int).tolist() for method, each in felt.items()}
    liked = worth[SCALES[0]][OWN] - worth[SCALES[0]][YOKED] + rng.normal(0.0, NOISE * 2**0.5, TRIALS)
    return Opinions(ratings, ["equal" if abs(each) < TIE else (OWN if each > 0 else YOKED).value for each in liked])


def p_without_pages(people: Sequence[Opinions]) -> dict[str, float | None]:
    """Of the paired t-test in each scale, and of the head-to-heads. With two methods nothing is to be corrected."""
    found = {}
    for scale in SCALES:
        means = [[np.mean(each.ratings[scale][method]) for method in (YOKED, OWN)] for each in people]
        found[scale] = paired_t(np.diff(means, axis=1)[:, 0].round(12)).get("p")
    rows = [
        {"participant": place, "left": OWN.value, "right": YOKED.value, "response": response}
        for place, each in enumerate(people)
        for response in ({OWN.value: "left", YOKED.value: "right"}.get(said, said) for said in each.preferred)
    ]
    compared = head_to_head_report(rows, (YOKED.value, OWN.value)).get("comparisons")
    return {**found, "head_to_heads": compared[0]["p"] if compared else None}


@dataclass
class PlantedPerson:
    """Says what they mean to say, of whatever method a film shows in truth; only a program can know which."""

    database: Database
    opinions: Opinions
    watched: Counter[str] = field(default_factory=Counter)
    compared: int = 0

    def answer(self, query_id: int) -> str:
        """Nobody is asked to: the pairs have been answered."""
        raise AssertionError(f"Pair {query_id} is asked although all pairs had been answered.")

    def rate(self, trial_id: int) -> tuple[int, int]:
        """Satisfaction and personalisation of this method's next trial."""
        method = self._method(trial_id)
        satisfaction, personalisation = (self.opinions.ratings[scale][method][self.watched[method]] for scale in SCALES)
        self.watched[method] += 1
        return satisfaction, personalisation

    def prefer(self, head_to_head_id: int) -> str:
        """The side of the one that is preferred."""
        with self.database.reading() as session:
            asked = session.get_one(HeadToHead, head_to_head_id)
            sides = {"left": asked.left_trial_id, "right": asked.right_trial_id}
        said = self.opinions.preferred[self.compared]
        self.compared += 1
        return next((side for side, trial_id in sides.items() if self._method(trial_id) == said), "equal")

    def hint(self, names: Sequence[str]) -> Sequence[str]:
        """None."""
        return ()

    def name_quality(self, query_id: int, answer: str) -> str:
        """Nobody asks them."""
        return ""

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
            shown = select(Film.method).join(Trial, Trial.film_id == Film.id).where(Trial.id == trial_id)
            return session.scalars(shown).one()


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


def make_study(there: Studio, seed: int) -> Study:
    """Locked, nobody in it."""
    with there.database.writing() as session:
        study = studies.create_study(session, "Planted", SETTINGS, seed=seed)
        study.key_secret = hashlib.sha256(f"planted/{seed}".encode()).hexdigest()  # the same letters for the same seed
    experimenter_steps.lock(there.experimenter, study)
    return study


def run_study(there: Studio, truth: Truth, people: int, number: int) -> dict[str, Any]:
    """One study of so many people, from their links to its p-values; a row of COLUMNS."""
    began = time.perf_counter()
    study = make_study(there, seed=1000 * people + number)
    with there.database.writing() as session:
        here = session.get_one(Study, study.id)
        left, right = (factories.make_clip(session, there.store, here) for _ in range(2))
        invited = [enrolment.add_participant(session, here, scripted_as=truth.name) for _ in range(people)]
        for participant, _ in invited:
            for _ in range(PAIRS):
                factories.make_label(session, factories.make_query(session, participant, left, right))
    opinions = opinions_of(truth, people, number)
    for (participant, token), theirs in zip(invited, opinions, strict=True):
        _walk(there, f"/p/{token}", PlantedPerson(there.database, theirs), participant.id)
    there.experimenter.fill_in(f"/studies/{study.slug}/unblind", typed=study.slug)
    with there.database.reading() as session:
        report = contents_of(report_files.tables_of(session, session.get_one(Study, study.id)))
    return {
        "truth": truth.name,
        "people": people,
        "study": number,
        **_p_values(report, p_without_pages(opinions)),
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


def _p_values(report: dict[str, Any], meant: Mapping[str, float | None]) -> dict[str, float | None]:
    """Of the planned test and of head-to-heads, corrected. Raises ValueError if they are not those of what was meant.

    Whatever blinding, storage, unblinding or tables confuse, they would be others.
    """
    plan = report["plan"]
    if (plan["standing"], plan["planned"]) != ("before_data", [PlannedTest.PAIRED_T.value]):
        raise ValueError(f"The plan is {plan}.")
    found: dict[str, float | None] = {}
    for scale in SCALES:
        (comparison,) = report["ratings"]["scales"][scale]["comparisons"]
        found[scale] = comparison[plan["planned"][0]].get("p_holm")
    pairs = report["head_to_heads"].get("comparisons")
    found["head_to_heads"] = pairs[0]["p_holm"] if pairs else None
    for name, p in found.items():
        if not np.isclose(p or 2.0, meant[name] or 2.0, rtol=1e-6):
            raise ValueError(f"{name}: the report has p = {p}, but what people meant to say has {meant[name]}.")
    return found


def promise(there: Studio, truth: Truth, effect: float) -> dict[int, dict[str, Any]]:
    """What the page "How many people" says of this design with such an effect, by the number of people."""
    study = make_study(there, seed=1)
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


def run_missing(path: Path, wanted: int, say: Callable[[str], object]) -> None:
    """Every study that has no row yet, the first ones of every truth before the second ones."""
    known = {(row["truth"], int(row["people"]), int(row["study"])) for row in planted_report.read(path)}
    if not path.exists():
        path.write_text(",".join(COLUMNS) + "\n")
    for number in range(wanted):
        keys = [(truth, count) for count in PEOPLE for truth in TRUTHS.values()]
        missing = [key for key in keys if (key[0].name, key[1], number) not in known]
        if missing:
            with studio() as there:
                for truth, count in missing:
                    row = run_study(there, truth, count, number)
                    with path.open("a", newline="") as file:
                        csv.DictWriter(file, COLUMNS, lineterminator="\n").writerow(row)
                    say(f"study {number + 1} of {wanted}: {truth.name}, {count} people, {row['seconds']} s\n")


def rates(path: Path, invented: int, say: Callable[[str], object]) -> list[dict[str, str]]:
    """What is promised, and what ``invented`` studies find without pages; computed once, then read."""
    if path.exists():
        return planted_report.read(path)
    rows = []
    with studio() as there:
        for truth in TRUTHS.values():
            promised = {effect: promise(there, truth, effect) for effect in {truth.effect, 0.0}}
            for people in PEOPLE:
                without = [p_without_pages(opinions_of(truth, people, number)) for number in range(invented)]
                say(f"{truth.name}, {people} people: {invented} studies without pages\n")
                for measure in MEASURES:
                    effect = 0.0 if measure == SCALES[1] else truth.effect
                    plan = promised[effect][people]["head_to_heads" if measure == "head_to_heads" else "ratings"]
                    found, studies = found_in([each[measure] for each in without])
                    rows.append(
                        {
                            "truth": truth.name,
                            "measure": measure,
                            "people": people,
                            "effect": effect,
                            "promised": round(plan["power"] * power_plans.STUDIES),
                            "of_promised": power_plans.STUDIES,
                            "found_without_pages": found,
                            "of_without_pages": studies,
                        }
                    )
    rows.sort(key=lambda row: (list(TRUTHS).index(row["truth"]), MEASURES.index(row["measure"]), row["people"]))
    result_tables.write(path, rows)
    return planted_report.read(path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, then draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--studies", type=int, default=25, help="of each truth and number of people; 0: only draw")
    parser.add_argument("--invented", type=int, default=500, help="studies without pages, of each")
    parser.add_argument("--to", type=Path, default=RESULTS)
    said = parser.parse_args(arguments)
    run_missing(said.to / "planted.csv", said.studies, sys.stdout.write)
    promised = rates(said.to / "planted_rates.csv", said.invented, sys.stdout.write)
    planted_report.write(said.to, planted_report.cells(promised, planted_report.read(said.to / "planted.csv")))


if __name__ == "__main__":
    main()
