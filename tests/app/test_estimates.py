"""How long somebody still waits: measured on earlier work of the same kind, and unknown when there was none."""

import sys
from collections.abc import Callable
from datetime import timedelta
from itertools import count

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.db import Database, now
from app.domain.evaluation import Rating, SharedFilter
from app.domain.models import Model, ModelKind, Run, RunKind, RunStatus
from app.domain.protocol import EvaluatedMethod, EvaluationSettings
from app.domain.studies import Awaited, Participant, Study
from app.services.evaluation import donors, robot_preparation
from app.services.runs import estimates
from app.storage import ArtefactStore
from tests import factories

METHODS = (EvaluatedMethod.REFERENCE, EvaluatedMethod.PREFFT, EvaluatedMethod.PBARL)
LABELS = 10
_numbers = count()


def took(
    session: Session,
    person: Participant,
    study: Study,
    kind: RunKind,
    seconds: float,
    what: str = "",
    labels: int = LABELS,
) -> None:
    """A finished piece of work."""
    middle = f"{what}/" if what else ""
    run = factories.make_run(session, study, person, kind=kind, started_at=now() - timedelta(seconds=seconds))
    run.workflow_id = f"{kind}/participant-{person.id}/{middle}labels-{labels}/answer-{next(_numbers)}"
    run.finished_at = run.started_at + timedelta(seconds=seconds)
    if kind in (RunKind.REWARD, RunKind.FILTER, RunKind.METHOD):
        columns = {"artefact_sha256": "0" * 64, "label_count": labels, "label_hash": "0" * 64, "seed": 1}
        metrics = {"method": what}
        model = ModelKind(kind.value)
        session.add(Model(run_id=run.id, participant_id=person.id, kind=model, metrics=metrics, **columns))
    session.flush()


def at_work(session: Session, person: Participant, study: Study, kind: RunKind, done: float, for_s: float) -> Run:
    columns = {"kind": kind, "status": RunStatus.RUNNING, "progress": done, "finished_at": None}
    run = factories.make_run(session, study, person, started_at=now() - timedelta(seconds=for_s), **columns)
    run.workflow_id = f"{kind}/participant-{person.id}/labels-{LABELS}/answer-{next(_numbers)}"
    return run


@pytest.fixture(autouse=True)
def time_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is at work since 90 s is so, too, on a machine that takes a minute for the rest of the test."""
    moment = now()
    for module in (estimates, sys.modules[__name__]):
        monkeypatch.setattr(module, "now", lambda: moment)


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        return factories.make_study(
            session,
            labels_per_participant=LABELS,
            evaluation=EvaluationSettings(methods=METHODS, trials=2, fine_tuning_steps=2000),
        )


@pytest.fixture
def person(database: Database, study: Study, store: ArtefactStore) -> tuple[Participant, str]:
    """Somebody who has given every answer, and their link."""
    with database.writing() as session:
        participant, token = factories.make_participant(session, study)
        factories.answer_everything(session, store, session.get_one(Study, study.id), participant)
    return participant, token


def somebody_before(database: Database, study: Study) -> None:
    """A participant whose robots were made: a filter in 60 s, PrefFT in 100 s, six films in 30 s."""
    with database.writing() as session:
        earlier, _ = factories.make_participant(session, study)
        took(session, earlier, study, RunKind.REWARD, 4)
        took(session, earlier, study, RunKind.FILTER, 60)
        took(session, earlier, study, RunKind.METHOD, 100, "prefft")
        took(session, earlier, study, RunKind.FILMS, 30, "trials")
        took(session, earlier, study, RunKind.FILMS, 20, "before-after")


Look = Callable[[], str]


@pytest.fixture
def look(person: tuple[Participant, str], new_browser: Callable[[], TestClient]) -> Look:
    """The waiting page as it is now."""
    browser = new_browser()
    browser.get(f"/p/{person[1]}")

    def now_shown() -> str:
        page: str = browser.get("/p/evaluation").text
        return page

    return now_shown


def test_what_was_never_done_here_is_said_to_be_unknown(look: Look) -> None:
    page = look()
    assert "cannot say yet how long this takes" in page
    assert "to go" not in page


def test_what_a_filter_on_the_way_took_says_nothing_of_the_last_which_is_sought_longer(
    database: Database, study: Study, look: Look
) -> None:
    with database.writing() as session:
        earlier, _ = factories.make_participant(session, study)
        took(session, earlier, study, RunKind.REWARD, 4)
        took(session, earlier, study, RunKind.FILTER, 20, labels=LABELS // 2)
        took(session, earlier, study, RunKind.METHOD, 10, "prefft")
        took(session, earlier, study, RunKind.FILMS, 30, "trials")
        took(session, earlier, study, RunKind.FILMS, 20, "before-after")
    assert "to go" not in look()


def test_the_first_robot_is_foretold_from_what_it_took_before(database: Database, study: Study, look: Look) -> None:
    somebody_before(database, study)
    assert "About 2 minutes to go" in look(), "PrefFT beside the filter, then two of six films: 100 + 10 s"


def test_the_first_participant_is_foretold_what_their_own_earlier_work_took(
    database: Database, study: Study, person: tuple[Participant, str], look: Look
) -> None:
    with database.writing() as session:
        here = session.get_one(Study, study.id)
        own = EvaluationSettings(methods=(EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL), trials=2)
        here.stored_settings = here.settings.model_copy(update={"evaluation": own}).model_dump(mode="json")
        took(session, person[0], here, RunKind.FILMS, 60, "ahead")
        at_work(session, person[0], here, RunKind.FILTER, 0.5, for_s=90)
    assert "About 2 minutes to go" in look(), "as long again as the filter took so far, and two of four films"


def test_a_filter_of_others_that_is_not_fitted_yet_counts_and_its_trouble_is_told(
    database: Database, study: Study, person: tuple[Participant, str], look: Look
) -> None:
    somebody_before(database, study)
    with database.writing() as session:
        lent = EvaluationSettings(methods=(EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL, EvaluatedMethod.AVERAGE))
        here = session.get_one(Study, study.id)
        here.stored_settings = here.settings.model_copy(update={"evaluation": lent}).model_dump(mode="json")
        shared = SharedFilter(study_id=study.id, stored_donors={"types": ["neutral"]})
        session.add(shared)
        session.flush()
        participant = session.get_one(Participant, person[0].id)
        donors.draw(session, here, participant, EvaluatedMethod.AVERAGE, ["neutral"])
        earlier, _ = factories.make_participant(session, study)
        took(session, earlier, here, RunKind.METHOD, 10, "average")
        took(session, earlier, here, RunKind.FILMS, 30, "trials")
        run = factories.make_run(session, study, kind=RunKind.SHARED, status=RunStatus.RUNNING, progress=0.5)
        run.workflow_id = str(donors.key_of(shared))
        run.started_at, run.finished_at = now() - timedelta(seconds=240), None
    assert "About 5 minutes to go" in look()
    with database.writing() as session:
        session.get_one(Run, run.id).status = RunStatus.FAILED
    assert "Something went wrong" in look()


def test_a_slower_machine_and_what_is_done_are_both_counted(
    database: Database, study: Study, person: tuple[Participant, str]
) -> None:
    somebody_before(database, study)
    with database.writing() as session:
        usual = estimates.usual_s(session, study, RunKind.FILTER)
        assert usual == pytest.approx(60)
        halfway = at_work(session, person[0], study, RunKind.FILTER, 0.5, for_s=30)
        slow = at_work(session, person[0], study, RunKind.FILTER, 0.5, for_s=120)
        assert estimates.left_s(halfway, usual) == pytest.approx(30, rel=0.05)
        assert 80 < (estimates.left_s(slow, usual) or 0) < 120
        assert estimates.left_s(slow, None) == pytest.approx(120, rel=0.05)
        assert estimates.left_s(at_work(session, person[0], study, RunKind.FILTER, 0.05, for_s=9), None) is None


def test_other_settings_and_given_up_trainings_say_nothing(database: Database, study: Study) -> None:
    somebody_before(database, study)
    with database.writing() as session:
        other = factories.make_study(session, evaluation_scenarios=37)
        assert estimates.usual_s(session, other, RunKind.FILTER) is None
        factories.make_run(session, study, None, kind=RunKind.FILTER, started_at=now())
        assert estimates.usual_s(session, study, RunKind.FILTER) == pytest.approx(60)


def test_a_last_filter_takes_as_long_as_other_last_filters_whatever_milestones_took(
    database: Database, study: Study
) -> None:
    with database.writing() as session:
        earlier, _ = factories.make_participant(session, study)
        for labels in (2, 4, 6):
            took(session, earlier, study, RunKind.FILTER, 30, labels=labels)
        assert estimates.usual_s(session, study, RunKind.FILTER) is None, "those are found in a minute, it is not"
        took(session, earlier, study, RunKind.FILTER, 90)
        assert estimates.usual_s(session, study, RunKind.FILTER) == pytest.approx(90)


def test_one_slow_day_does_not_spoil_the_estimate(database: Database, study: Study) -> None:
    with database.writing() as session:
        earlier, _ = factories.make_participant(session, study)
        for seconds in (60, 3000, 70):
            took(session, earlier, study, RunKind.FILTER, seconds)
        assert estimates.usual_s(session, study, RunKind.FILTER) == pytest.approx(70)


def test_the_waiting_page_says_who_waits_to_the_worker_and_the_next_page_that_nobody_does(
    database: Database, store: ArtefactStore, study: Study, person: tuple[Participant, str], look: Look
) -> None:
    look()
    with database.writing() as session:
        waiting = session.get_one(Participant, person[0].id)
        assert (waiting.waiting_for, waiting.waiting_since is not None) == (Awaited.ROBOTS, True)
        since = waiting.waiting_since
    look()
    with database.writing() as session:
        waiting = session.get_one(Participant, person[0].id)
        assert waiting.waiting_since == since, "whoever comes back has waited all the time"
        factories.make_robots(session, store, session.get_one(Study, study.id), waiting)
    assert "Robot A" in look()
    with database.reading() as session:
        assert session.get_one(Participant, person[0].id).waiting_for is None


def test_the_first_robot_is_rated_while_the_rest_is_filmed(
    database: Database, store: ArtefactStore, study: Study, person: tuple[Participant, str], look: Look
) -> None:
    with database.writing() as session:
        trials = factories.make_robots(session, store, session.get_one(Study, study.id), person[0])
        later = [(trial.id, trial.film_id) for trial in trials[1:]]
        for trial in trials[1:]:
            trial.film_id = None
    assert "Robot A" in look()
    with database.writing() as session:
        uuid = "00000000-0000-0000-0000-000000000001"
        session.add(Rating(trial_id=trials[0].id, revision=1, satisfaction=4, personalisation=4, client_uuid=uuid))
    assert "The next robot is being prepared" in look()
    assert "You have rated 1 of 6 so far" in look()
    with database.writing() as session:
        session.get_one(type(trials[0]), later[0][0]).film_id = later[0][1]
    assert "Round 2 of 2 with this robot" in look()


def test_the_debrief_is_foretold_too(database: Database, study: Study, person: tuple[Participant, str]) -> None:
    with database.reading() as session:
        participant = session.get_one(Participant, person[0].id)
        participant.study = session.get_one(Study, study.id)
        assert robot_preparation.until_debrief_s(session, participant) is None
    somebody_before(database, study)
    with database.reading() as session:
        participant = session.get_one(Participant, person[0].id)
        participant.study = session.get_one(Study, study.id)
        assert robot_preparation.until_debrief_s(session, participant) == pytest.approx(84, abs=1)


def test_the_dashboard_tells_when_somebody_can_go_on(
    database: Database, study: Study, look: Look, experimenter: TestClient
) -> None:
    somebody_before(database, study)
    look()
    assert "the first in about 2 min" in experimenter.get(f"/studies/{study.slug}").text
