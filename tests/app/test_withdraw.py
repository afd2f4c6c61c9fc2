"""Withdrawing: everything about a person is gone, down to the bytes; a tombstone stays."""

from collections.abc import Callable
from pathlib import Path
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select

from app.db import Base, Database, now
from app.domain.clips import Clip, Rollout
from app.domain.evaluation import (
    Assignment,
    Controller,
    DonorDraw,
    Film,
    HeadToHead,
    HeadToHeadAnswer,
    Rating,
    Trial,
)
from app.domain.hints import HintEvent
from app.domain.models import Export, Model, ModelKind, Report, RunKind
from app.domain.participation import Allocation, ConsentRecord, FormAnswer, ParticipantEvent, StageRecord
from app.domain.people import AuditEvent
from app.domain.preferences import Exclusion, LabelEvent
from app.domain.self_setting import PreviewFilm, SelfSetting
from app.domain.studies import Participant, Study
from app.services.participants import withdrawal
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import TakingPart

MARK = "ERASE-ME-"
"""What everything about the person contains."""


def marked(what: str) -> str:
    return f"{MARK}{what}-" + uuid4().hex


def leave_traces(database: Database, store: ArtefactStore, participant_id: int) -> None:
    """Something recognisable in every table and kind of file."""
    with database.writing() as session:
        person = session.get_one(Participant, participant_id)
        study = session.get_one(Study, person.study_id)
        person.panel_id, person.panel_parameters = marked("panel"), {"SESSION_ID": marked("session")}
        left, right = (factories.make_clip(session, store, study) for _ in range(2))
        query = factories.make_query(session, person, left, right)
        label = factories.make_label(session, query, reason=marked("reason")[:40])
        session.add(Exclusion(label_event_id=label.id, excluded=True, reason=marked("exclusion"), actor="pat"))
        factories.make_run(session, study, person, error=marked("error"), stage=marked("stage"))
        model = factories.make_model(session, study, person, ModelKind.FILTER, {"notes": [marked("metrics")]})
        model.artefact_sha256 = store.put(marked("model").encode())
        query.predicted_by_model_id = model.id
        factories.make_bundle(session, store, model, marked("bundle").encode())
        stored_donors = {"types": [marked("type")]}
        session.add(DonorDraw(participant_id=person.id, method="average", rule="by_lot", stored_donors=stored_donors))
        film = Film(
            participant_id=person.id,
            method="pbarl",
            model_id=model.id,
            scenario=1,
            success=True,
            trajectory_sha256=store.put(marked("trajectory").encode()),
            video_sha256=store.put(marked("film").encode()),
            poster_sha256=store.put(marked("poster").encode()),
            width=4,
            height=3,
            fps=10,
            duration_ms=1000,
            byte_count=9,
        )
        session.add(film)
        session.add(
            Controller(
                participant_id=person.id,
                method="pbarl",
                model_id=model.id,
                artefact_sha256=store.put(marked("controller").encode()),
                byte_count=9,
            )
        )
        session.flush()
        trial = Trial(participant_id=person.id, ordinal=1, letter="A", repetition=1, scenario=1, film_id=film.id)
        session.add_all([trial, Assignment(participant_id=person.id, letter="A", method=marked("method")[:40])])
        session.flush()
        session.add(
            Rating(trial_id=trial.id, revision=1, satisfaction=5, personalisation=5, client_uuid=marked("rating")[:36])
        )
        compared = HeadToHead(participant_id=person.id, ordinal=1, left_trial_id=trial.id, right_trial_id=trial.id)
        session.add(compared)
        session.flush()
        session.add(
            HeadToHeadAnswer(
                head_to_head_id=compared.id,
                revision=1,
                response="left",
                reason=marked("why"),
                client_uuid=marked("head-to-head")[:36],
                by_script=True,
            )
        )
        hinted = {"hints": marked("hint"), "offered": marked("offered"), "client_uuid": marked("hinting")[:36]}
        session.add(HintEvent(participant_id=person.id, revision=1, answered=3, **hinted))
        factories.make_previews(session, store, study, [{}])
        made = factories.make_clip(session, store, study, made_for=person)
        made.video_sha256 = store.put(marked("made").encode())
        session.get_one(Rollout, made.rollout_id).mode = {marked("axis"): 0.2}
        chosen = SelfSetting(
            participant_id=person.id,
            revision=1,
            mode={marked("axis"): 0.1},
            filmed=False,
            client_uuid=marked("setting")[:36],
            by_script=True,
        )
        session.add(chosen)
        session.flush()
        session.add(
            PreviewFilm(
                study_id=study.id,
                self_setting_id=chosen.id,
                number=0,
                mode=chosen.mode,
                video_sha256=store.put(marked("preview").encode()),
                poster_sha256=store.put(marked("preview-poster").encode()),
                width=1,
                height=1,
                fps=1,
                duration_ms=1,
                byte_count=1,
            )
        )
        report_run = factories.make_run(session, study, kind=RunKind.REPORT, stage=marked("report-run"))
        session.add_all(
            [
                ConsentRecord(participant_id=person.id, version="1", language="en", text=marked("consent")),
                FormAnswer(participant_id=person.id, form="demographics", item="gender", value=marked("form")),
                ParticipantEvent(participant_id=person.id, kind=marked("kind")[:40], detail={"x": marked("event")}),
                StageRecord(participant_id=person.id, stage=marked("stage")[:20]),
                Allocation(participant_id=person.id, place=1, lot=0.5, considered={marked("arm"): {}}),
                Report(
                    study_id=study.id,
                    run_id=report_run.id,
                    basis="b",
                    contents={"rows": [marked("contents")]},
                    figures={"ratings": {"svg": store.put(marked("figure").encode())}},
                ),
                Export(
                    study_id=study.id,
                    kind="data",
                    requested_by="pat",
                    finished_at=now(),
                    artefact_sha256=store.put(marked("export").encode()),
                    byte_count=9,
                ),
            ]
        )
        unfinished = store.unfinished.folder(person.id)
        unfinished.mkdir(parents=True)
        (unfinished / "checkpoint").write_text(marked("checkpoint"))


def files_with_traces(folder: Path) -> list[str]:
    """Every file of the data directory that holds the mark, read raw."""
    return [
        str(path.relative_to(folder))
        for path in sorted(folder.rglob("*"))
        if path.is_file() and MARK.encode() in path.read_bytes()
    ]


@pytest.fixture
def traced(taking_part: TakingPart, store: ArtefactStore) -> TakingPart:
    """A participant who has left traces everywhere."""
    leave_traces(taking_part.database, store, taking_part.participant.id)
    return taking_part


@pytest.mark.directory("tests/app/test_bucket.py has the same of a bucket")
def test_not_a_byte_about_the_person_is_left_in_any_file(traced: TakingPart, settings: Settings) -> None:
    assert len(files_with_traces(settings.data_dir)) > 8
    traced.browser.post("/p/withdraw")
    assert files_with_traces(settings.data_dir) == []


def test_every_table_that_knows_of_people_is_emptied_of_this_one(traced: TakingPart, database: Database) -> None:
    with database.reading() as session:
        tables = dict(withdrawal.personal_rows(traced.participant.id))
        before = {
            table.name: session.scalar(select(func.count()).select_from(table).where(theirs))
            for table, theirs in tables.items()
        }
    unused = {"report"}  # belongs to whole studies; it is erased for what is inside
    assert {name for name, count in before.items() if not count} == unused, "a table without a trace to erase"
    traced.browser.post("/p/withdraw")
    with database.reading() as session:
        for table, theirs in withdrawal.personal_rows(traced.participant.id):
            assert session.scalar(select(func.count()).select_from(table).where(theirs)) == 0, table.name


def test_a_new_column_that_names_a_file_must_be_known_to_withdrawal() -> None:
    """A column that is forgotten here leaves files behind: add it to ARTEFACT_COLUMNS, or say why it names none."""
    no_files = {"participant.token_sha256", "browser_session.cookie_sha256", "api_token.token_sha256"}
    no_files |= {"new_links.key_sha256"} | {
        f"login_attempt.{name}_sha256" for name in ("address", "account", "browser")
    }
    no_files.add("recovery_code.code_sha256")
    found = {
        f"{table.name}.{column.name}"
        for table in Base.metadata.tables.values()
        for column in table.columns
        if column.name.endswith("_sha256")
    }
    assert found - no_files == {f"{column.class_.__tablename__}.{column.key}" for column in withdrawal.ARTEFACT_COLUMNS}


def test_a_tombstone_stays_and_says_that_but_not_what(traced: TakingPart, database: Database) -> None:
    code = traced.participant.code
    traced.browser.post("/p/withdraw")
    with database.reading() as session:
        person = session.get_one(Participant, traced.participant.id)
        events = session.scalars(select(AuditEvent).where(AuditEvent.action == "participant withdrew")).all()
    assert person.code == code
    assert person.withdrawn_at is not None
    forgotten = (person.panel_id, person.panel_parameters, person.consented_at, person.language, person.last_seen_at)
    assert forgotten == (None,) * 5
    assert [(event.actor, event.subject) for event in events] == [("participant", traced.study.slug)]


def test_what_others_still_need_is_kept(traced: TakingPart, database: Database, store: ArtefactStore) -> None:
    with database.writing() as session:
        other, _ = factories.make_participant(session, traced.study)
        shared = session.scalars(select(Model.artefact_sha256)).first()
        assert shared is not None
        factories.make_model(session, traced.study, other, ModelKind.FILTER, {}).artefact_sha256 = shared
    traced.browser.post("/p/withdraw")
    assert store.has(shared)
    with database.reading() as session:
        assert session.scalars(select(Model.participant_id)).all() == [other.id]
        assert all(store.has(sha256) for sha256 in session.scalars(select(Clip.video_sha256)))


def test_the_answers_of_others_are_untouched(traced: TakingPart, database: Database, store: ArtefactStore) -> None:
    with database.writing() as session:
        other, _ = factories.make_participant(session, traced.study)
        factories.make_label(session, factories.make_queries(session, store, other, 1)[0])
    traced.browser.post("/p/withdraw")
    with database.reading() as session:
        assert len(session.scalars(select(LabelEvent)).all()) == 1


def test_the_page_says_what_will_happen_before_it_does(taking_part: TakingPart, database: Database) -> None:
    page = taking_part.browser.get("/p/withdraw").text
    assert "cannot be undone" in page
    with database.reading() as session:
        assert session.get_one(Participant, taking_part.participant.id).withdrawn_at is None


def test_afterwards_browser_and_link_find_only_the_page_that_is_left(
    traced: TakingPart, new_browser: Callable[[], TestClient]
) -> None:
    answer = traced.browser.post("/p/withdraw")
    assert "Your data have been erased" in traced.browser.get(answer.headers["location"]).text
    assert traced.browser.get("/p/next").status_code == 401
    link = new_browser().get(f"/p/{traced.token}")
    assert (link.status_code, link.headers["location"]) == (303, "/p/withdrawn")
    assert "set-cookie" not in link.headers


def test_withdrawing_is_offered_on_every_page_in_the_persons_language(taking_part: TakingPart) -> None:
    taking_part.browser.post("/p/language", data={"language": "de"})
    page = taking_part.browser.get("/p/instructions").text
    assert 'href="/p/withdraw"' in page
    assert "Teilnahme widerrufen" in page
    left = taking_part.browser.post("/p/withdraw")
    assert "Ihre Daten sind gelöscht" in taking_part.browser.get(left.headers["location"]).text


def test_an_experimenter_can_erase_at_somebodys_request(traced: TakingPart, store: ArtefactStore) -> None:
    with traced.database.writing() as session:
        withdrawal.withdraw(session, store, session.get_one(Participant, traced.participant.id), actor="pat")
    with traced.database.reading() as session:
        event = session.scalars(select(AuditEvent).where(AuditEvent.action == "participant withdrew")).one()
        assert event.actor == "pat"
    assert traced.browser.get("/p/next").status_code == 401


def test_what_comes_in_late_is_erased_when_asked_again(traced: TakingPart, store: ArtefactStore) -> None:
    traced.browser.post("/p/withdraw")
    late = store.put(b"late")
    with traced.database.writing() as session:
        person = session.get_one(Participant, traced.participant.id)
        first_time = person.withdrawn_at
        factories.make_model(session, traced.study, person, ModelKind.REWARD, {}).artefact_sha256 = late
    with traced.database.writing() as session:
        person = session.get_one(Participant, traced.participant.id)
        withdrawal.withdraw(session, store, person, actor="studio")
    assert not store.has(late)
    with traced.database.reading() as session:
        assert session.get_one(Participant, traced.participant.id).withdrawn_at == first_time
