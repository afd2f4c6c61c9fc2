"""The operator's desk: letters only, one trial after the other, repeats with a reason; and unblinding on purpose."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database, now
from app.domain.evaluation import Assignment, Controller, Rating, Trial
from app.domain.models import ModelKind
from app.domain.people import AuditEvent
from app.domain.protocol import PAPER_METHODS, EvaluationMode, EvaluationSettings
from app.domain.studies import Participant, Study
from app.services.evaluation import unblinding
from app.services.exports import export_tables
from app.storage import ArtefactStore
from tests import factories


@dataclass
class Laboratory:
    """A study with a physical robot, one participant ready for it, and an operator who is logged in."""

    study: Study
    participant: Participant
    operator: TestClient
    database: Database

    @property
    def base(self) -> str:
        """Addresses of the participant begin with this."""
        return f"/studies/{self.study.slug}/participants/{self.participant.code}"

    def desk(self) -> str:
        """The operator's page."""
        page: str = self.operator.get(f"{self.base}/operate").text
        return page

    def press(self, ordinal: int, act: str, **fields: str) -> int:
        """Press a button of a trial."""
        code: int = self.operator.post(f"{self.base}/trials/{ordinal}/{act}", data=fields).status_code
        return code

    def rate(self, ordinal: int) -> None:
        """As if the participant had rated."""
        with self.database.writing() as session:
            trial = session.scalars(select(Trial).where(Trial.ordinal == ordinal)).one()
            rating = {"revision": 1, "satisfaction": 3, "personalisation": 3, "client_uuid": f"uuid {ordinal}"}
            session.add(Rating(trial_id=trial.id, **rating))

    def trial(self, ordinal: int) -> Trial:
        """As it is stored now."""
        with self.database.reading() as session:
            return session.scalars(select(Trial).where(Trial.ordinal == ordinal)).one()

    def audit(self) -> list[str]:
        """What was logged about robots, oldest first."""
        with self.database.reading() as session:
            events = session.scalars(select(AuditEvent).order_by(AuditEvent.id)).all()
        words = ("trial started", "trial done", "trial repeated", "controller", "study unblinded")
        return [f"{each.action}: {each.subject}" for each in events if each.action.startswith(words)]


@pytest.fixture
def laboratory(
    database: Database, store: ArtefactStore, experimenter: TestClient, request: pytest.FixtureRequest
) -> Laboratory:
    with database.writing() as session:
        settings = EvaluationSettings(methods=PAPER_METHODS, mode=getattr(request, "param", EvaluationMode.PHYSICAL))
        study = factories.make_study(session, evaluation=settings)
        participant, _ = factories.make_participant(session, study)
        factories.answer_everything(session, store, study, participant)
        factories.make_robots(session, store, study, participant)
        factories.make_model(session, study, participant, ModelKind.FILTER, factories.filter_metrics())
    return Laboratory(study, participant, experimenter, database)


def test_the_desk_shows_the_next_trial_by_its_letter(laboratory: Laboratory) -> None:
    page = laboratory.desk()
    assert "Robot A" in page
    assert "Trial 1 of 9, repetition 1 of 3" in page
    assert f'action="{laboratory.base}/trials/1/start"' in page


def test_start_then_done_then_the_rating_leads_to_the_next_trial(laboratory: Laboratory) -> None:
    laboratory.press(1, "start")
    assert f'action="{laboratory.base}/trials/1/done"' in laboratory.desk()
    laboratory.press(1, "done")
    assert "is rating Robot A" in laboratory.desk()
    laboratory.rate(1)
    assert "Trial 2 of 9" in laboratory.desk()
    assert laboratory.audit() == [
        "trial started: feeding-at-home/P01/trial 1 (A)",
        "trial done: feeding-at-home/P01/trial 1 (A)",
    ]


def test_pressing_twice_is_pressing_once(laboratory: Laboratory) -> None:
    for act in ("start", "done"):
        laboratory.press(1, act)
        before = laboratory.trial(1)
        laboratory.press(1, act)
        again = laboratory.trial(1)
        assert (again.started_at, again.finished_at) == (before.started_at, before.finished_at)
    assert len(laboratory.audit()) == 2


def test_no_trial_can_be_started_before_its_turn_or_done_before_its_start(laboratory: Laboratory) -> None:
    assert laboratory.press(2, "start") == 409
    assert laboratory.press(1, "done") == 409
    assert laboratory.press(99, "start") == 409
    assert laboratory.trial(2).started_at is None


def test_a_trial_that_went_wrong_is_repeated_for_a_reason_that_is_kept(laboratory: Laboratory) -> None:
    laboratory.press(1, "start")
    assert laboratory.press(1, "repeat", reason="   ") == 422
    assert laboratory.trial(1).started_at is not None
    assert laboratory.press(1, "repeat", reason="the spoon  fell") == 303
    assert laboratory.trial(1).started_at is None
    assert laboratory.audit()[-1] == "trial repeated: feeding-at-home/P01/trial 1 (A): the spoon fell"


def test_what_has_been_rated_is_not_repeated(laboratory: Laboratory) -> None:
    laboratory.press(1, "start")
    laboratory.press(1, "done")
    laboratory.rate(1)
    assert laboratory.press(1, "repeat", reason="I would like to") == 409


def test_controllers_are_downloaded_by_letter_and_the_download_is_logged(
    laboratory: Laboratory, store: ArtefactStore
) -> None:
    answer = laboratory.operator.get(f"{laboratory.base}/controllers/B.zip")
    assert answer.headers["content-disposition"] == 'attachment; filename="feeding-at-home-P01-B.zip"'
    with laboratory.database.reading() as session:
        method = session.scalars(select(Assignment.method).where(Assignment.letter == "B")).one()
        artefact = session.scalars(select(Controller.artefact_sha256).where(Controller.method == method)).one()
    assert answer.content == store.read(artefact)
    assert laboratory.audit() == ["controller downloaded: feeding-at-home/P01/B"]
    assert answer.headers["last-modified"] == "Thu, 01 Jan 1970 00:00:00 GMT", "when it was made would tell with what"
    assert laboratory.operator.get(f"{laboratory.base}/controllers/E.zip").status_code == 404


def test_where_nobody_runs_a_robot_there_is_no_desk(database: Database, experimenter: TestClient) -> None:
    with database.writing() as session:
        study = factories.make_study(session, evaluation=EvaluationSettings())
        participant, _ = factories.make_participant(session, study)
    assert experimenter.get(f"/studies/{study.slug}/participants/{participant.code}/operate").status_code == 404


def test_the_desk_is_for_those_who_are_logged_in(laboratory: Laboratory, new_browser: Callable[[], TestClient]) -> None:
    stranger = new_browser()
    assert "/login" in stranger.get(f"{laboratory.base}/operate").headers["location"]
    assert stranger.post(f"{laboratory.base}/trials/1/start").status_code == 401
    assert stranger.get(f"{laboratory.base}/controllers/A.zip").status_code in (303, 401)


# -- blindness --------------------------------------------------------------------------------------------------------

OF_THE_MOMENT = re.compile(rb"just now|\d+ (min|h|days) ago|\d{4}-\d\d-\d\dT[\d:.]+\+00:00|[\d.]+ [kMG]?B free")
"""Times, and how much of the disk others leave free."""
PARAMETER = re.compile(r"{(\w+)(?::\w+)?}")


def addresses(application: FastAPI, laboratory: Laboratory) -> Iterator[str]:
    """Every address below /studies that can be looked at or downloaded, endless streams and letters' files excepted."""
    single = {"slug": laboratory.study.slug, "code": laboratory.participant.code, "version": "1", "letter": "A"}
    single |= {"query_id": "1", "script": "analysis.py"}
    tables = [{"table": table.name, "kind": kind} for table in export_tables.TABLES for kind in ("csv", "jsonl")]
    for route in iter_route_contexts(application.routes):
        path = route.path or ""
        if "GET" not in (route.methods or ()) or not path.startswith("/studies") or path.endswith("/live"):
            continue
        if "/controllers/" in path or "/links/" in path or "/export/files/" in path or "/figures/" in path:
            continue
        for more in tables if "{table}" in path else [{}]:
            yield PARAMETER.sub(lambda name, more=more: {**single, **more}[name[1]], path)  # type: ignore[misc]


def pages(application: FastAPI, laboratory: Laboratory) -> dict[str, bytes]:
    """What every address answers; what changes by itself is left out."""
    answers = {path: laboratory.operator.get(path).content for path in addresses(application, laboratory)}
    return {path: OF_THE_MOMENT.sub(b"", content) for path, content in answers.items()}


def exchange(laboratory: Laboratory) -> None:
    """Another key: the methods behind A and C change places, with their films, and nothing else does."""
    with laboratory.database.writing() as session:
        first, _, last = session.scalars(select(Assignment).order_by(Assignment.letter)).all()
        methods = first.method, last.method
        first.method = "in between"
        session.flush()
        last.method = methods[0]
        session.flush()
        first.method = methods[1]
        trials = session.scalars(select(Trial).order_by(Trial.ordinal)).all()
        for one, other in zip(trials[:3], trials[6:], strict=True):
            one.film_id, other.film_id = other.film_id, one.film_id


@pytest.mark.parametrize("laboratory", EvaluationMode, indirect=True)
def test_no_page_or_file_of_a_blinded_study_would_look_otherwise_under_another_key(
    studio_app: FastAPI, laboratory: Laboratory
) -> None:
    for ordinal in range(1, 10):
        laboratory.rate(ordinal)
    before = pages(studio_app, laboratory)
    assert f"{laboratory.base}/operate" in before
    assert f"/studies/{laboratory.study.slug}/export/ratings.csv" in before
    assert f"/studies/{laboratory.study.slug}/unblind" in before
    exchange(laboratory)
    after = pages(studio_app, laboratory)
    assert [path for path in before if before[path] != after[path]] == []


def test_once_unblinded_the_key_is_there_and_would_look_otherwise(studio_app: FastAPI, laboratory: Laboratory) -> None:
    with laboratory.database.writing() as session:
        session.get_one(Study, laboratory.study.id).unblinded_at = now()
    key = f"/studies/{laboratory.study.slug}/unblind"
    before = pages(studio_app, laboratory)[key]
    exchange(laboratory)
    assert pages(studio_app, laboratory)[key] != before


def test_unblinding_needs_the_studys_short_name_and_is_logged_with_what_was_rated(laboratory: Laboratory) -> None:
    path = f"/studies/{laboratory.study.slug}/unblind"
    laboratory.press(1, "start")
    laboratory.press(1, "done")
    laboratory.rate(1)
    refused = laboratory.operator.post(path, data={"typed": "yes"})
    assert refused.status_code == 422
    assert "Nothing was unblinded" in refused.text
    assert "PrefFT" not in refused.text
    with laboratory.database.reading() as session:
        assert session.get_one(Study, laboratory.study.id).unblinded_at is None
    laboratory.operator.post(path, data={"typed": laboratory.study.slug})
    laboratory.operator.post(path, data={"typed": laboratory.study.slug})
    assert laboratory.audit()[-1] == "study unblinded: feeding-at-home (1 of 9 trials rated)"
    assert len([line for line in laboratory.audit() if "unblinded" in line]) == 1
    assert "PrefFT" in laboratory.operator.get(path).text


def test_asking_for_the_key_of_a_blinded_study_is_refused(laboratory: Laboratory) -> None:
    with laboratory.database.reading() as session:
        study = session.get_one(Study, laboratory.study.id)
        for ask in (unblinding.methods_by_letter, unblinding.key_of):
            with pytest.raises(unblinding.StillBlinded):
                ask(session, study)
        assert unblinding.shown_name(study, session.scalars(select(Assignment)).all(), "B") == "B"
