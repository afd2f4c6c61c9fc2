"""Prints how long a participant waits from the last answer to the first robot, and how good what they are told is.

A scripted participant takes the paper's protocol with small settings while another study, which nobody has opened, is
short of clips. From the last answer on they look at the waiting page like a browser without script.

    python -m tests.benchmarks.first_robot --steps 1000 --people 2
    python -m tests.benchmarks.first_robot --whole --labels 60 --methods reference pbarl somebody_else average
    python -m tests.benchmarks.first_robot --whole --unhurried --people 1 --at-once 2
    python -m tests.benchmarks.first_robot --whole --unhurried --labels 40 --people 1 --refine 90000
    python -m tests.benchmarks.first_robot --whole --prepared --pace 12 --labels 100 --people 1 --refine 90000
"""

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.evaluation import DonorDraw, Film, SharedFilter, Trial
from app.domain.models import Model, ModelKind, Run, RunKind, RunStatus
from app.domain.preferences import count_labels
from app.domain.protocol import FROM_OTHERS, EvaluatedMethod, EvaluationSettings
from app.domain.run_keys import AHEAD, RunKey
from app.domain.studies import Participant, Study
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.services.evaluation import donors, evaluation_plan
from app.services.monitoring import dashboard
from app.services.participants import enrolment
from app.services.studies import studies
from app.storage import ArtefactStore
from worker.ml.teachers import TASTES, Manner
from worker.rehearsal.browser import UP_TO_PAIRS, WAITING, FormBrowser
from worker.rehearsal.participant_steps import ScriptedPerson
from worker.rehearsal.server import POLL_S, OwnStudio, wait_until

PACE_S = 2.0
"""Between two answers: slow enough for a filter to be in the making when the last one comes; people are slower."""
PATIENCE_S = 3600.0
TOLD = re.compile(r"bout (a|\d+) minutes? to go")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1_000, help="of fine-tuning")
    parser.add_argument("--people", type=int, default=2, help="one after the other")
    parser.add_argument("--labels", type=int, default=12)
    parser.add_argument("--methods", type=EvaluatedMethod, nargs="+", default=list(EvaluationSettings().methods))
    parser.add_argument("--pace", type=float, default=PACE_S, help="seconds between two answers")
    parser.add_argument("--at-once", type=int, default=0, help="so many more, who give their last answers together")
    parser.add_argument("--unhurried", action="store_true", help="the last answer comes when all is made ahead")
    parser.add_argument("--prepared", action="store_true", help="people come once clips and what is lent are there")
    parser.add_argument("--refine", type=int, default=0, help="steps of the last filter's refinement")
    parser.add_argument("--whole", action="store_true", help="filters, promise and trials as studies usually have them")
    options = parser.parse_args()
    evaluation = EvaluationSettings(fine_tuning_steps=options.steps, methods=tuple(options.methods))
    small = {"labels_per_participant": options.labels, "introduction_pairs": 2, "evaluation": evaluation}
    small["refinement_steps"] = options.refine
    small["pool_scenarios"] = max(2, options.labels // 10)
    if not options.whole:
        small["evaluation"] = evaluation.model_copy(update={"trials": 1})
        small |= {"filter_milestones": (6,), "retrain_every_labels": 6, "evaluation_scenarios": 10, "harm_share": 0.5}
    with tempfile.TemporaryDirectory() as directory, OwnStudio(Path(directory)) as studio:
        database = Database(studio.settings.sqlalchemy_url)
        with database.writing() as session:
            studies.create_study(session, "Nobody's", StudySettings(pool_scenarios=200), seed=1)
            study = studies.create_study(
                session, "Somebody's", StudySettings(**{**PAPER_PROTOCOL.model_dump(), **small}), seed=2
            )
            groups = [1] * options.people + ([options.at_once] if options.at_once else [])
            tokens = [[enrolment.add_participant(session, study) for _ in range(count)] for count in groups]
        if options.prepared:
            _until("not everything is prepared", partial(_is_prepared, database, study, evaluation.methods))
        store = ArtefactStore(Path(directory) / "artefacts")
        for invited in tokens:
            with ExitStack() as browsers:
                people = [
                    Answering(
                        participant,
                        ScriptedPerson(database, store, study, TASTES["cautious"], Manner(), participant.number),
                        browsers.enter_context(FormBrowser(studio.settings.base_url, f"/p/{token}")),
                        evaluation.methods,
                    )
                    for participant, token in invited
                ]
                _answer(database, study, people, options)
                _wait(database, people)
            for person in people:
                _report_runs(database, person.participant.id)
        database.dispose()


@dataclass
class Answering:
    """Somebody at their page."""

    participant: Participant
    person: ScriptedPerson
    visitor: FormBrowser
    methods: Sequence[EvaluatedMethod]
    first_s: float | None = None
    """from the last answer to the first robot"""

    def answers(self) -> None:
        """One page."""
        self.visitor.act(self.person)


def _answer(database: Database, study: Study, people: Sequence[Answering], options: argparse.Namespace) -> None:
    """All pairs; the last answers are given one right after the other."""
    last = [each for each in people if not _go_on(database, study, each, options.labels - 1, options.pace)]
    if options.unhurried:
        for each in last:
            _until("not all is made ahead", partial(_is_made_ahead, database, each))
    for each in last:
        _go_on(database, study, each, sys.maxsize, POLL_S)


def _go_on(database: Database, study: Study, each: Answering, count: int, pace_s: float) -> bool:
    """Answer until so many labels are given; whether there are no pairs any more."""
    mine = select(Participant.id).where(Participant.id == each.participant.id)
    while each.visitor.page in UP_TO_PAIRS:
        with database.reading() as session:
            given = count_labels(session, mine).get(each.participant.id, 0)
        if given >= count:
            return False
        time.sleep(pace_s if each.visitor.query_id() else POLL_S)
        each.answers()
    return True


def _until(missing: str, seen: Callable[[], bool]) -> None:
    wait_until(PATIENCE_S, missing, lambda: seen() or None)


def _is_prepared(database: Database, study: Study, methods: Sequence[EvaluatedMethod]) -> bool:
    """The study's clips, and filters of types of users if any are lent."""
    with database.reading() as session:
        pool = dashboard.study_overview(session, study).pool
    return pool.made >= pool.wanted and _lent_are_fitted(database, methods)


def _is_made_ahead(database: Database, each: Answering) -> bool:
    """Filters of others, films of all that is not their own robot, and the larger part of a refinement."""
    ahead = RunKey(RunKind.FILMS, participant_id=each.participant.id, subject=AHEAD)
    filters = select(Run.id).where(Run.kind.in_((RunKind.FILTER, RunKind.REFINEMENT)), Run.status == RunStatus.RUNNING)
    with database.reading() as session:
        running = session.scalar(filters.where(Run.participant_id == each.participant.id).limit(1))
        drawn = session.scalars(select(DonorDraw).where(DonorDraw.participant_id == each.participant.id)).all()
        keys = [str(ahead), *(str(donors.key_of_films(loan)) for loan in drawn)]
        filmed = session.scalars(select(Run.status).where(Run.workflow_id.in_(keys))).all()
    lent = sum(method in FROM_OTHERS for method in each.methods)
    all_filmed = filmed == [RunStatus.SUCCEEDED] * (1 + lent)
    return _lent_are_fitted(database, each.methods) and all_filmed and running is None


def _lent_are_fitted(database: Database, methods: Sequence[EvaluatedMethod]) -> bool:
    with database.reading() as session:
        fitted = session.scalars(select(SharedFilter.artefact_sha256)).all()
    return bool(fitted) == any(method in FROM_OTHERS for method in methods) and None not in fitted


def _wait(database: Database, people: Sequence[Answering]) -> None:
    """Look at the waiting pages until there are robots to rate, then see when the rest is there."""
    began = time.monotonic()
    told: list[tuple[float, float]] = []

    def robots() -> bool | None:
        for each in people:
            if each.first_s is not None:
                continue
            each.visitor.look()
            words = TOLD.search(each.visitor.text)
            if each.visitor.page in WAITING and words and each is people[0]:
                told.append((time.monotonic() - began, 60.0 * (1 if words[1] == "a" else int(words[1]))))
            if each.visitor.page not in WAITING:
                each.first_s = time.monotonic() - began
                _say(f"{each.participant.code}: first robot after {each.first_s:6.0f} s")
        return all(each.first_s is not None for each in people) or None

    wait_until(PATIENCE_S, "no robot to rate", robots)
    first_s = people[0].first_s or 0.0
    for share in (0.1, 0.25, 0.5, 0.75):
        late = [each for each in told if each[0] >= share * first_s]
        if late:
            at_s, left_s = late[0]
            _say(f"  told at {at_s:4.0f} s: {left_s / 60:.0f} min to go, in truth {(first_s - at_s) / 60:.1f}")
    for each in people:
        _until("not all robots", partial(_all_films, database, each.participant.id))
        _say(f"{each.participant.code}: every robot after {time.monotonic() - began:6.0f} s")
    for each in people:
        _until("no debrief", partial(_debriefed, database, each.participant.id))
        _say(f"{each.participant.code}: before and after after {time.monotonic() - began:6.0f} s")


def _all_films(database: Database, participant_id: int) -> bool:
    with database.reading() as session:
        films = session.scalars(select(Trial.film_id).where(Trial.participant_id == participant_id)).all()
    return bool(films) and None not in films


def _debriefed(database: Database, participant_id: int) -> bool:
    with database.reading() as session:
        films = session.scalars(
            select(Film.id).where(
                Film.participant_id == participant_id, Film.scenario.in_(evaluation_plan.COMPARISON_SCENARIOS)
            )
        ).all()
    return len(films) >= 2 * evaluation_plan.COMPARED


def _report_runs(database: Database, participant_id: int) -> None:
    with database.reading() as session:
        runs = session.scalars(select(Run).where(Run.participant_id == participant_id).order_by(Run.id)).all()
        for run in runs:
            if run.finished_at and run.kind != RunKind.REWARD:
                _say(f"    {run.workflow_id}: {(run.finished_at - run.started_at).total_seconds():.0f} s")
                _say_stages(session, run)
        clips = session.scalars(select(Run).where(Run.kind == RunKind.CLIPS, Run.status == RunStatus.SUCCEEDED)).all()
    _say(f"    (runs that made clips for studies so far: {len(clips)})")


def _say_stages(session: Session, run: Run) -> None:
    for model in session.scalars(select(Model).where(Model.run_id == run.id, Model.kind == ModelKind.FILTER)):
        stages = model.metrics["seconds"].items()
        _say("      " + ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in stages))


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
