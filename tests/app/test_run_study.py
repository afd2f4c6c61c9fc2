"""The experimenter's side: making studies, inviting people, watching, retrying, downloading."""

import re
from collections.abc import Callable
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app import falls
from app.db import Database, now
from app.domain.models import ModelKind, Run, RunKind, RunStatus, WorkerPresence
from app.domain.people import AuditEvent
from app.domain.preferences import Response
from app.domain.studies import Participant, Study
from app.services.participants import enrolment
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories, stored_files
from tests.app.conftest import agree
from tests.app.study_pages import typed


def test_the_defaults_make_a_study(experimenter: TestClient, database: Database) -> None:
    answer = experimenter.post("/studies/new", data=typed(experimenter))
    assert answer.headers["location"] == "/studies/pilot"
    with database.reading() as session:
        study = session.scalars(select(Study)).one()
    assert study.settings == type(study.settings)()
    assert "Pilot" in experimenter.get("/studies").text


def test_what_is_typed_is_what_is_stored(experimenter: TestClient, database: Database) -> None:
    form = typed(
        experimenter,
        labels_per_participant="60",
        filter_milestones="20, 40",
        success_tolerance="5 %",
        method="printed",
        harm_share="2.5 %",
        harm_force_n="3",
    )
    experimenter.post("/studies/new", data=form)
    with database.reading() as session:
        settings = session.scalars(select(Study)).one().settings
    assert (settings.labels_per_participant, settings.milestones) == (60, (20, 40, 60))
    assert (settings.success_tolerance, settings.method) == (0.05, "printed")
    assert (settings.harm_share, settings.harm_force_n) == (0.025, 3)


def test_two_studies_of_one_name_have_two_addresses(experimenter: TestClient) -> None:
    answers = [
        experimenter.post("/studies/new", data=typed(experimenter, name="New", same_name="yes")) for _ in range(2)
    ]
    assert [answer.headers["location"] for answer in answers] == ["/studies/new-2", "/studies/new-3"]


@pytest.mark.parametrize(
    ("field", "text", "complaint"),
    [
        ("name", " ", "Give the study a name"),
        ("labels_per_participant", "3", "Enter at least 10."),
        ("labels_per_participant", "many", "Enter a whole number."),
        ("labels_per_participant", "1" * 400, "Enter a whole number."),
        ("success_tolerance", "80", "Enter at most 50 %."),
        ("filter_milestones", "20; x", "Enter a whole number."),
        ("method", "magic", "studio"),
        ("question", "", "at least 1"),
        ("pool_scenarios", "2", "fewer than the"),
        ("task", "dressing", "Choose one of the tasks."),
        ("clip_steps", "120", "has 100 steps"),
    ],
)
def test_a_mistake_is_explained_and_what_was_typed_is_kept(
    experimenter: TestClient, database: Database, field: str, text: str, complaint: str
) -> None:
    answer = experimenter.post(
        "/studies/new", data=typed(experimenter, **{field: text, "name": text if field == "name" else "Kept"})
    )
    assert answer.status_code == 422
    assert complaint in answer.text
    assert field == "name" or 'value="Kept"' in answer.text
    with database.reading() as session:
        assert session.scalars(select(Study)).all() == []


@pytest.mark.parametrize(("task", "steps"), [("feeding", 60), ("drinking", 70), ("scratching", 60)])
def test_each_task_has_its_usual_length_of_clips_and_its_own_instructions(
    experimenter: TestClient, database: Database, new_browser: Callable[[], TestClient], task: str, steps: int
) -> None:
    experimenter.post("/studies/new", data=typed(experimenter, task=task))
    with database.writing() as session:
        study = session.scalars(select(Study)).one()
        assert (study.task, study.settings.clip_steps) == (task, steps)
        _, token = enrolment.add_participant(session, study)
    browser = new_browser()
    browser.get(f"/p/{token}")
    agree(browser)
    words = {"feeding": "being fed", "drinking": "cup of water", "scratching": "reddish spot"}
    assert words[task] in browser.get("/p/instructions").text


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        return factories.make_study(session, "Pilot")


def links_on(page: str) -> list[str]:
    return re.findall(r'value="http://testserver(/p/[\w-]+)"', page)


class TestPersonalLinks:
    """Made on the page of the study."""

    def test_new_participants_get_links_that_work(
        self, experimenter: TestClient, study: Study, new_browser: Callable[[], TestClient]
    ) -> None:
        answer = experimenter.post("/studies/pilot/participants", data={"count": "3"})
        assert answer.status_code == 303
        links = links_on(experimenter.get(answer.headers["location"]).text)
        assert len(set(links)) == 3
        assert [new_browser().get(link).headers["location"] for link in links] == ["/p/next"] * 3

    def test_reloading_the_page_of_links_makes_no_more_participants(
        self, experimenter: TestClient, study: Study, database: Database
    ) -> None:
        location = experimenter.post("/studies/pilot/participants", data={"count": "1"}).headers["location"]
        pages = [experimenter.get(location).text for _ in range(2)]
        assert links_on(pages[0]) == links_on(pages[1])
        with database.reading() as session:
            assert len(session.scalars(select(Participant)).all()) == 1

    def test_the_links_are_for_nobody_else(
        self, experimenter: TestClient, study: Study, new_browser: Callable[[], TestClient]
    ) -> None:
        location = experimenter.post("/studies/pilot/participants", data={"count": "1"}).headers["location"]
        assert new_browser().get(location).headers["location"].startswith("/login")

    def test_a_new_link_shuts_the_old_one_and_its_browsers_out(
        self, experimenter: TestClient, study: Study, database: Database, new_browser: Callable[[], TestClient]
    ) -> None:
        with database.writing() as session:
            _, old = factories.make_participant(session, study)
        browser = new_browser()
        browser.get(f"/p/{old}")
        answer = experimenter.post("/studies/pilot/participants/P01/link")
        (link,) = links_on(experimenter.get(answer.headers["location"]).text)
        assert new_browser().get(f"/p/{old}").status_code == 404
        assert browser.get("/p/next").status_code == 401
        assert new_browser().get(link).status_code == 303

    @pytest.mark.parametrize("count", ["0", "51", "-1", "x", ""])
    def test_a_senseless_number_makes_nobody(
        self, experimenter: TestClient, study: Study, database: Database, count: str
    ) -> None:
        assert experimenter.post("/studies/pilot/participants", data={"count": count}).status_code == 422
        with database.reading() as session:
            assert session.scalars(select(Participant)).all() == []


class TestWatching:
    """What the pages of a study and of a participant show."""

    @pytest.fixture
    def participant(self, study: Study, database: Database, store: ArtefactStore) -> Participant:
        with database.writing() as session:
            participant, _ = factories.make_participant(session, study)
            left, right = (factories.make_clip(session, store, study) for _ in range(2))
            for number in range(8):
                query = factories.make_query(
                    session, participant, left, right, predicted_right=0.9 if number < 6 else 0.1
                )
                factories.make_label(session, query, Response.RIGHT, response_time_ms=1000 * (number + 1))
            for response in (Response.EQUAL, Response.SKIP):
                factories.make_label(session, factories.make_query(session, participant, left, right, 0.9), response)
        return participant

    def test_the_share_of_foreseen_preferences_counts_decided_answers_only(
        self, experimenter: TestClient, participant: Participant
    ) -> None:
        page = experimenter.get("/studies/pilot/participants/P01").text
        assert "6 of 8, 75" in page
        assert "guessing" in page

    def test_answers_are_counted_by_kind(self, experimenter: TestClient, participant: Participant) -> None:
        page = " ".join(experimenter.get("/studies/pilot/participants/P01").text.split())
        for kind, count in (("Left", 0), ("Right", 8), ("Equal", 1), ("Can\u2019t tell", 1)):
            assert f"<dt>{kind}</dt><dd>{count}</dd>" in page

    def test_the_study_shows_progress_and_stage(self, experimenter: TestClient, participant: Participant) -> None:
        page = experimenter.get("/studies/pilot").text
        assert "finished" in page
        assert '<progress class="bar" value="10" max="10" aria-label="Answers of P01">' in page
        assert "2</strong> of 16 clips" in page

    def test_before_and_after_are_shown_with_intervals(
        self, experimenter: TestClient, participant: Participant, study: Study, database: Database, store: ArtefactStore
    ) -> None:
        with database.writing() as session:
            model = factories.make_model(session, study, participant, ModelKind.FILTER, factories.filter_metrics())
            factories.make_bundle(session, store, model)
            factories.make_model(session, study, participant, ModelKind.REWARD, factories.reward_metrics())
        page = experimenter.get("/studies/pilot/participants/P01").text
        assert page.count('<svg class="interval ') == 8 + 5
        assert all(
            words in page
            for words in ("Speed of the spoon", "\u22123.4", "[\u22124.2, \u22122.7]", "speed squared (m²/s²)")
        )
        assert 'interval-worse" viewBox' in page
        assert "With 95 % confidence, in at most 5 % of scenarios it is worse." in page
        assert "bundles/1.zip" in experimenter.get("/studies/pilot").text

    @pytest.mark.parametrize(
        "metrics",
        [
            {},
            {"evaluation": None},
            {"evaluation": {"success": 1}},
            {"promise": {"sentence": 3}},
            {"evaluation": {"costs": {"C_d": {}}}, "gate": "high"},
        ],
    )
    def test_numbers_that_are_missing_are_left_out(
        self,
        experimenter: TestClient,
        participant: Participant,
        study: Study,
        database: Database,
        metrics: dict[str, object],
    ) -> None:
        with database.writing() as session:
            factories.make_model(session, study, participant, ModelKind.FILTER, metrics)
            factories.make_model(session, study, participant, ModelKind.REWARD, {"weights": {"a": {"mean": None}}})
        assert "Not evaluated yet" in experimenter.get("/studies/pilot/participants/P01").text
        assert experimenter.get("/studies/pilot").status_code == 200

    def test_a_running_job_shows_where_it_is(
        self, experimenter: TestClient, participant: Participant, study: Study, database: Database
    ) -> None:
        with database.writing() as session:
            factories.make_run(
                session, study, participant, status=RunStatus.RUNNING, stage="fitting <it>", progress=0.4
            )
        page = experimenter.get("/studies/pilot").text
        assert "fitting &lt;it&gt;" in page
        assert 'value="40" max="100"' in page

    def test_a_failure_that_was_made_good_is_not_news(
        self, experimenter: TestClient, participant: Participant, study: Study, database: Database
    ) -> None:
        with database.writing() as session:
            factories.make_run(session, study, participant, status=RunStatus.FAILED, error="no memory")
        assert "failed" in experimenter.get("/studies/pilot").text
        with database.writing() as session:
            factories.make_run(session, study, participant)
        assert "failed" not in experimenter.get("/studies/pilot").text
        assert "no memory" in experimenter.get("/studies/pilot/participants/P01").text

    def test_a_silent_worker_is_noticed(self, experimenter: TestClient, study: Study, database: Database) -> None:
        assert "No worker is running" in experimenter.get("/studies").text
        with database.writing() as session:
            session.add(WorkerPresence(name="worker-1"))
        assert "No worker is running" not in experimenter.get("/studies").text
        with database.writing() as session:
            session.get_one(WorkerPresence, "worker-1").last_seen_at = now() - timedelta(seconds=16)
        assert "No worker is running" in experimenter.get("/studies/pilot").text

    def test_a_worker_that_keeps_falling_is_noticed_with_its_last_words(
        self, experimenter: TestClient, participant: Participant, settings: Settings
    ) -> None:
        since = now() - timedelta(minutes=3)
        falls.note(settings.data_dir, [falls.Falls("worker", 4, since, "MemoryError: <b>no</b> room")])
        page = experimenter.get("/studies/pilot").text
        assert "The worker has stopped 4 times</strong>, first 3 min ago. Its last words:" in page
        assert "<q>MemoryError: &lt;b&gt;no&lt;/b&gt; room</q>." in page
        falls.note(settings.data_dir, [falls.Falls("web", 1, since, "")])
        page = experimenter.get("/studies/pilot").text
        assert "The web server has stopped once</strong>, 3 min ago." in page
        assert "last words" not in page
        falls.note(settings.data_dir, [])
        assert "has stopped" not in experimenter.get("/studies/pilot").text

    def test_falls_that_cannot_be_read_are_no_falls(
        self, experimenter: TestClient, participant: Participant, settings: Settings
    ) -> None:
        for damaged in ("", "[", "[{}]", "{}", '[{"program": "worker"}]', "[1]", "\x00\xff"):
            (settings.data_dir / "falls.json").write_text(damaged)
            assert experimenter.get("/studies/pilot").status_code == 200

    def test_a_full_disk_is_noticed(
        self, experimenter: TestClient, study: Study, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("app.services.monitoring.dashboard.DISK_LOW_BYTES", 2**62)
        assert "disk is nearly full" in experimenter.get("/studies/pilot").text

    @pytest.mark.parametrize(
        "path", ["nothing", "pilot/participants/P99", "pilot/participants/P1", "pilot/links/" + "x" * 20]
    )
    def test_what_does_not_exist_is_not_found(self, experimenter: TestClient, study: Study, path: str) -> None:
        answer = experimenter.get(f"/studies/{path}")
        assert answer.status_code == (200 if "links" in path else 404)
        assert "<h1>" in answer.text


class TestRetry:
    """Asking for failed work again."""

    @pytest.fixture
    def failed(self, study: Study, database: Database) -> Run:
        with database.writing() as session:
            return factories.make_run(session, study, kind=RunKind.CLIPS, status=RunStatus.FAILED, error="no memory")

    def status_of(self, run: Run, database: Database) -> str:
        with database.reading() as session:
            return session.get_one(Run, run.id).status

    def test_a_failed_run_is_asked_for_again_once(
        self, experimenter: TestClient, failed: Run, database: Database
    ) -> None:
        for _ in range(2):
            assert experimenter.post(f"/studies/pilot/runs/{failed.id}/retry").status_code == 303
        assert self.status_of(failed, database) == RunStatus.RETRY
        with database.reading() as session:
            assert session.scalars(select(AuditEvent.action)).all().count("run retried") == 1

    def test_a_run_of_another_study_is_not_touched(
        self, experimenter: TestClient, failed: Run, database: Database
    ) -> None:
        with database.writing() as session:
            factories.make_study(session, "Other")
        assert experimenter.post(f"/studies/other/runs/{failed.id}/retry").status_code == 404
        assert self.status_of(failed, database) == RunStatus.FAILED


class TestDownload:
    """The bundle of a participant."""

    @pytest.fixture
    def path(self, study: Study, database: Database, store: ArtefactStore) -> str:
        with database.writing() as session:
            participant, _ = factories.make_participant(session, study)
            model = factories.make_model(session, study, participant, ModelKind.FILTER, factories.filter_metrics())
            factories.make_bundle(session, store, model, b"PK the bundle")
        return "/studies/pilot/participants/P01/bundles/1.zip"

    def test_it_arrives_whole_under_a_telling_name(
        self, experimenter: TestClient, path: str, database: Database
    ) -> None:
        answer = experimenter.get(path)
        assert (answer.content, answer.headers["content-type"]) == (b"PK the bundle", "application/zip")
        assert 'filename="pilot-P01-v1.zip"' in answer.headers["content-disposition"]
        with database.reading() as session:
            assert "bundle downloaded" in session.scalars(select(AuditEvent.action)).all()

    @pytest.mark.parametrize("version", ["2", "0", "99999999999999999999", "x"])
    def test_other_versions_do_not_exist(self, experimenter: TestClient, path: str, version: str) -> None:
        assert experimenter.get(path.replace("1.zip", f"{version}.zip")).status_code == 404

    def test_it_is_for_experimenters_only(self, client: TestClient, path: str) -> None:
        assert client.get(path).headers["location"].startswith("/login")

    def test_a_lost_file_is_said_to_be_missing(self, experimenter: TestClient, path: str, store: ArtefactStore) -> None:
        for name in stored_files.names(store):
            stored_files.lose(store, name)
        answer = experimenter.get(path)
        assert answer.status_code == 404
        assert "missing from the data directory" in answer.text
