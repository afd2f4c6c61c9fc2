"""A study that is over: put away and taken out again, deleted for good; and one that begins where another ended."""

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select, true

from app.db import Base, Database
from app.domain.clips import Clip, Rollout
from app.domain.models import Run, RunStatus
from app.domain.participation import StageRecord
from app.domain.people import AuditEvent, Role, StudyRole
from app.domain.protocol import EvaluationSettings, Stage
from app.domain.studies import Participant, Study
from app.domain.study_settings import PAPER_PROTOCOL
from app.services.monitoring import dashboard, study_state
from app.services.monitoring.study_state import StudyState
from app.services.participants import enrolment, withdrawal
from app.storage import ArtefactStore
from tests import factories
from tests.app.study_pages import controls, typed
from tests.finished_study import make_finished_study

JSON = {"Accept": "application/json"}
MARK = b"only of the study that is deleted"


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        return factories.make_study(session, "Pilot")


def post(browser: TestClient, address: str, **form: str) -> int:
    return browser.post(f"/studies/pilot/{address}", data=form).status_code


class TestPuttingAway:
    """Out of the list; nothing is deleted."""

    def test_it_leaves_the_list_and_comes_back(self, experimenter: TestClient, study: Study) -> None:
        assert post(experimenter, "away") == 303
        assert "Pilot" not in experimenter.get("/studies").text
        assert "1 study is put away" in experimenter.get("/studies").text
        assert "Pilot" in experimenter.get("/studies?put_away=true").text
        assert experimenter.get("/studies/pilot").status_code == 200
        assert post(experimenter, "back") == 303
        assert "Pilot" in experimenter.get("/studies").text

    def test_participants_read_that_it_is_closed_and_can_still_withdraw(
        self, experimenter: TestClient, database: Database, study: Study, new_browser: Callable[[], TestClient]
    ) -> None:
        with database.writing() as session:
            _, token = factories.make_participant(session, study)
        post(experimenter, "away")
        browser = new_browser()
        browser.get(f"/p/{token}")
        answer = browser.get("/p/next")
        assert answer.status_code == 410
        assert "At the moment nobody can take part" in answer.text
        assert 'href="/p/withdraw"' in answer.text
        assert browser.get("/p/withdraw").status_code == 200
        assert browser.get("/p/instructions").headers["location"] == "/p/next", "no page goes on"
        assert browser.get("/p/next", headers=JSON).status_code == 410
        post(experimenter, "back")
        assert browser.get("/p/next").status_code == 200

    def test_an_answer_that_was_under_way_is_kept(
        self,
        experimenter: TestClient,
        database: Database,
        store: ArtefactStore,
        study: Study,
        new_browser: Callable[[], TestClient],
    ) -> None:
        with database.writing() as session:
            person, token = factories.make_participant(session, study)
            query, *_ = factories.make_queries(session, store, person, 3)
        browser = new_browser()
        browser.get(f"/p/{token}")
        browser.get("/p/next")
        post(experimenter, "away")
        form = {"response": "left", "client_uuid": "1b671a64-40d5-491e-99b0-da01ff1f3341"}
        assert browser.post(f"/p/queries/{query.id}/label", data=form, headers=JSON).status_code < 300

    def test_nobody_joins_by_the_open_address(
        self, experimenter: TestClient, database: Database, study: Study, client: TestClient
    ) -> None:
        post(experimenter, "joining/open")
        post(experimenter, "away")
        with database.reading() as session:
            token = session.get_one(Study, study.id).join_token
        assert client.get(f"/join/{token}?PROLIFIC_PID=x").status_code == 404

    def test_both_are_in_the_audit_log_once(self, experimenter: TestClient, database: Database, study: Study) -> None:
        for act in ("away", "away", "back", "back"):
            post(experimenter, act)
        with database.reading() as session:
            acts = session.scalars(select(AuditEvent.action).order_by(AuditEvent.id)).all()
        assert acts[-2:] == ["study put away", "study taken out again"]


class TestDeleting:
    """Everything goes, for everybody, for good."""

    @pytest.fixture
    def finished(self, database: Database, store: ArtefactStore) -> Study:
        with database.writing() as session:
            keep = factories.make_study(session, "Keep")
            person, _ = factories.make_participant(session, keep)
            factories.make_queries(session, store, person, 2)
            study = make_finished_study(session, store, people=3, labels=4)
            study.slug, study.name = "pilot", "Pilot"
            shared = session.scalars(select(Clip).join(Rollout).where(Rollout.study_id == keep.id)).first()
            own = session.scalars(select(Clip).join(Rollout).where(Rollout.study_id == study.id)).first()
            assert shared is not None
            assert own is not None
            own.poster_sha256 = shared.poster_sha256
            own.video_sha256 = store.put(MARK)
        return study

    def delete(self, browser: TestClient, word: str = "pilot") -> int:
        return post(browser, "delete", typed=word)

    def test_no_row_of_it_is_left_but_tombstones(
        self, experimenter: TestClient, database: Database, finished: Study
    ) -> None:
        assert self.delete(experimenter) == 303
        with database.reading() as session:
            tombstone = session.get_one(Study, finished.id)
            assert (tombstone.name, tombstone.lock_document, tombstone.join_token) == ("", None, None)
            assert tombstone.settings.wording == {}
            rows = dict(withdrawal._rows_below("study", finished.id))
            left = {
                table.name: session.scalar(select(func.count()).select_from(table).where(theirs))
                for table, theirs in rows.items()
            }
            assert {name: count for name, count in left.items() if count} == {"participant": 3}
            people = session.scalars(select(Participant).where(Participant.study_id == finished.id)).all()
            assert all(person.withdrawn_at and not person.consented_at for person in people)

    def test_files_go_unless_another_study_needs_them(
        self, experimenter: TestClient, database: Database, store: ArtefactStore, finished: Study
    ) -> None:
        with database.reading() as session:
            kept = session.scalars(select(Clip).join(Rollout).where(Rollout.study_id != finished.id)).all()
            mine = session.scalars(select(Clip).join(Rollout).where(Rollout.study_id == finished.id)).all()
        self.delete(experimenter)
        assert all(store.has(clip.video_sha256) and store.has(clip.poster_sha256) for clip in kept)
        own = {clip.video_sha256 for clip in mine} - {clip.video_sha256 for clip in kept}
        assert own
        assert not any(store.has(sha256) for sha256 in own)

    def test_other_studies_keep_every_row(self, experimenter: TestClient, database: Database, finished: Study) -> None:
        def counted() -> dict[str, int]:
            with database.reading() as session:
                rows = withdrawal._rows_below("study", 1)
                return {
                    table.name: session.scalar(select(func.count()).select_from(table).where(theirs)) or 0
                    for table, theirs in rows
                }

        before = counted()
        self.delete(experimenter)
        assert counted() == before

    def test_its_pages_are_gone_and_its_name_is_free(
        self, experimenter: TestClient, database: Database, finished: Study
    ) -> None:
        self.delete(experimenter)
        assert experimenter.get("/studies/pilot").status_code == 404
        assert experimenter.get(f"/studies/deleted-{finished.id}").status_code == 404
        assert "Pilot" not in experimenter.get("/studies").text
        answer = experimenter.post("/studies/new", data=typed(experimenter))
        assert answer.headers["location"] == "/studies/pilot"

    def test_links_lead_to_a_page_that_says_so(
        self, experimenter: TestClient, database: Database, finished: Study, new_browser: Callable[[], TestClient]
    ) -> None:
        with database.writing() as session:
            person = session.scalars(select(Participant).where(Participant.study_id == finished.id)).first()
            assert person is not None
            token = enrolment.renew_link(session, finished, person, "x")
        browser = new_browser()
        browser.get(f"/p/{token}")
        self.delete(experimenter)
        assert browser.get("/p/next").status_code == 401
        answer = browser.get(f"/p/{token}")
        assert answer.status_code == 410
        assert "has been erased" in answer.text

    def test_what_was_typed_must_be_its_short_name(
        self, experimenter: TestClient, database: Database, finished: Study
    ) -> None:
        assert self.delete(experimenter, "Pilot!") == 422
        assert experimenter.get("/studies/pilot").status_code == 200

    def test_only_owners_delete_and_it_is_in_the_audit_log(
        self, experimenter: TestClient, database: Database, finished: Study
    ) -> None:
        with database.writing() as session:
            factories.give_role(session, Role.EXPERIMENTER, StudyRole.EDITOR)
        assert self.delete(experimenter) == 403
        with database.writing() as session:
            factories.give_role(session, Role.EXPERIMENTER, StudyRole.OWNER)
        self.delete(experimenter)
        with database.reading() as session:
            gone = session.scalars(select(AuditEvent.subject).where(AuditEvent.action == "study deleted")).all()
        assert gone == [f"deleted-{finished.id}"]

    def test_every_table_with_something_of_a_study_is_reached(self) -> None:
        kept = {"experimenter", "recovery_code", "login_attempt", "audit_event", "erasure_receipt", "study"}
        kept |= {"worker_presence", "alert"}  # about the installation
        kept.add("new_links")  # sealed, and gone after ten minutes
        reached = {table.name for table, _ in withdrawal._rows_below("study", 1)}
        assert set(Base.metadata.tables) - reached == kept


class TestDuplicating:
    """A new study with the settings of another one, and nobody in it."""

    def test_settings_are_copied_and_people_name_and_seed_are_not(
        self, experimenter: TestClient, database: Database
    ) -> None:
        with database.writing() as session:
            source = factories.make_study(session, "Pilot", question="Which one?", evaluation=EvaluationSettings())
            source.seed = 77
            factories.make_participant(session, source)
        form = typed(experimenter, "/studies/new?like=pilot")
        assert form["name"] == ["Pilot, copy"]
        answer = experimenter.post("/studies/new", data=form)
        assert answer.headers["location"] == "/studies/pilot-copy"
        with database.reading() as session:
            copy = session.scalars(select(Study).where(Study.slug == "pilot-copy")).one()
            assert copy.settings == source.settings
            assert (copy.task, copy.seed != 77, copy.lock_hash) == (source.task, True, None)
            people = select(func.count(Participant.id)).where(Participant.study_id == copy.id)
            assert session.scalar(people) == 0

    def test_clips_that_were_made_elsewhere_come_along(
        self, experimenter: TestClient, database: Database, store: ArtefactStore
    ) -> None:
        with database.writing() as session:
            source = factories.make_study(session, "Pilot")
            source.task, source.material = "own_clips", {"signals": [{"name": "force_n"}]}
            clips = [factories.make_clip(session, store, source) for _ in range(3)]
        experimenter.post("/studies/new", data=typed(experimenter, "/studies/new?like=pilot"))
        with database.reading() as session:
            copy = session.scalars(select(Study).where(Study.slug == "pilot-copy")).one()
            assert (copy.task, copy.material) == ("own_clips", source.material)
            theirs = session.scalars(select(Clip).join(Rollout).where(Rollout.study_id == copy.id)).all()
        assert [clip.video_sha256 for clip in theirs] == [clip.video_sha256 for clip in clips]
        assert {clip.id for clip in theirs}.isdisjoint({clip.id for clip in clips})


class TestNames:
    """Two studies of one name are told apart by nothing that people look at."""

    def test_a_name_that_is_taken_is_refused_until_it_is_meant(self, experimenter: TestClient, study: Study) -> None:
        refused = experimenter.post("/studies/new", data=typed(experimenter, name="pilot"))
        assert refused.status_code == 422
        assert "Another study has this name" in refused.text
        assert "same_name" in refused.text
        meant = experimenter.post("/studies/new", data=typed(experimenter, name="pilot", same_name="yes"))
        assert meant.headers["location"] == "/studies/pilot-2"
        assert experimenter.get("/studies").text.count("<code>pilot") == 2

    def test_keeping_one_s_own_name_is_no_clash(self, experimenter: TestClient, study: Study) -> None:
        form = typed(experimenter, "/studies/pilot/settings", labels_per_participant="12")
        assert experimenter.post("/studies/pilot/settings", data=form).status_code == 303


class TestPresets:
    """Another start; what was typed stays."""

    def test_what_was_typed_stays_and_the_rest_follows_the_preset(self, experimenter: TestClient) -> None:
        typed_so_far = typed(
            experimenter, name="Mine", question="Which one?", repeated_pairs="7", switch_to="paper", debrief="yes"
        )
        answer = experimenter.post("/studies/new", data=typed_so_far)
        assert answer.status_code == 200
        form = controls(answer.text)
        assert (form["name"], form["question"], form["repeated_pairs"]) == (["Mine"], ["Which one?"], ["7"])
        assert form["introduction_pairs"] == [str(PAPER_PROTOCOL.introduction_pairs)]
        assert "age | number" in form["demographics"][0]
        assert form["preset"] == ["paper"]
        assert form["evaluation"] == ["yes"]

    def test_there_and_back_is_where_one_was(self, experimenter: TestClient) -> None:
        start = typed(experimenter, name="Mine", labels_per_participant="60")
        there = controls(experimenter.post("/studies/new", data=start | {"switch_to": ["paper"]}).text)
        back = controls(experimenter.post("/studies/new", data=there | {"switch_to": ["learning"]}).text)
        assert back == start


@pytest.mark.parametrize("clips", [0, 16])
def test_a_study_prepares_its_clips_and_then_waits(database: Database, store: ArtefactStore, clips: int) -> None:
    with database.writing() as session:
        study = factories.make_study(session, "Pilot")
        for _ in range(clips):
            factories.make_clip(session, store, study)
        factories.make_participant(session, study, ready=False)
    assert standing(database) is (StudyState.WAITING if clips else StudyState.PREPARING)


def test_a_study_runs_evaluates_finishes_and_asks_for_attention(database: Database, store: ArtefactStore) -> None:
    with database.writing() as session:
        study = factories.make_study(session, "Pilot", evaluation=EvaluationSettings())
        first, _ = factories.make_participant(session, study)
        second, _ = factories.make_participant(session, study)
        gone, _ = factories.make_participant(session, study)
        gone.withdrawn_at = gone.created_at
    assert standing(database) is StudyState.RUNNING
    with database.writing() as session:
        session.get_one(Participant, first.id).completed_at = first.created_at
        session.add(StageRecord(participant_id=second.id, stage=Stage.EVALUATION))
    assert standing(database) is StudyState.EVALUATING
    with database.writing() as session:
        session.get_one(Participant, second.id).completed_at = second.created_at
    assert standing(database) is StudyState.FINISHED
    with database.writing() as session:
        factories.make_run(session, study, status=RunStatus.FAILED)
        assert session.scalars(select(Run)).one().status == RunStatus.FAILED
    assert standing(database) is StudyState.ATTENTION


def standing(database: Database) -> StudyState:
    with database.reading() as session:
        lines = dashboard.study_lines(session, true())
        return study_state.standings(session, lines)[lines[0].study.id].state
