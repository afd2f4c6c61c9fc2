"""Damaged and missing files: nobody is shown them, everybody goes on, and the experimenter is told."""

import re
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from app.__main__ import main
from app.db import Database
from app.domain.clips import Clip, Rollout
from app.domain.models import ModelKind
from app.domain.studies import Study
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories, stored_files
from tests.app.conftest import TakingPart
from tests.waiting import until


@pytest.fixture
def clip(taking_part: TakingPart) -> Clip:
    with taking_part.database.reading() as session:
        return session.get_one(Clip, taking_part.queries[0].left_clip_id)


def text_of(page: str) -> str:
    """What a page says."""
    return " ".join(re.sub("<[^>]+>", " ", page).split())


def test_a_damaged_clip_is_never_served_and_never_kept(
    taking_part: TakingPart, clip: Clip, store: ArtefactStore
) -> None:
    for sha256, kind in ((clip.video_sha256, "mp4"), (clip.poster_sha256, "jpg")):
        assert taking_part.browser.get(f"/media/{sha256}.{kind}").status_code == 200
        stored_files.damage(store, sha256)
        answer = taking_part.browser.get(f"/media/{sha256}.{kind}")
        assert (answer.status_code, answer.headers["cache-control"]) == (404, "no-store")


def test_a_participant_goes_on_with_the_next_pair_and_loses_no_answer(
    taking_part: TakingPart, clip: Clip, store: ArtefactStore
) -> None:
    first, second, third = taking_part.queries[:3]
    assert taking_part.turn().json()["pair"]["query_id"] == first.id
    stored_files.damage(store, clip.video_sha256)
    assert taking_part.browser.get(f"/media/{clip.video_sha256}.mp4").status_code == 404
    assert taking_part.turn().json()["pair"]["query_id"] == second.id
    assert taking_part.answer(first).status_code == 200, "whoever had seen it may still say so"
    assert taking_part.answer(second).json()["pair"]["query_id"] == third.id
    assert [len(taking_part.events(query)) for query in (first, second)] == [1, 1]


def test_an_experimenter_reads_what_is_damaged_and_what_to_do(
    experimenter: TestClient, taking_part: TakingPart, clip: Clip, store: ArtefactStore, study_bundle: str
) -> None:
    slug = taking_part.study.slug
    assert "damaged" not in experimenter.get(f"/studies/{slug}").text
    stored_files.damage(store, clip.video_sha256)
    taking_part.browser.get(f"/media/{clip.video_sha256}.mp4")
    told = text_of(experimenter.get(f"/studies/{slug}").text)
    assert "1 stored file is damaged or missing. The worker makes it again by itself" in told
    stored_files.damage(store, study_bundle)
    answer = experimenter.get(f"/studies/{slug}/participants/P01/bundles/1.zip")
    assert answer.status_code == 404
    told = text_of(experimenter.get("/studies").text)
    assert f"bundle v1 of P01, file in {slug}: restore it from a backup" in told


def test_the_banner_goes_when_the_file_is_back(
    experimenter: TestClient, taking_part: TakingPart, clip: Clip, store: ArtefactStore
) -> None:
    content = store.read(clip.video_sha256)
    stored_files.lose(store, clip.video_sha256)
    taking_part.browser.get(f"/media/{clip.video_sha256}.mp4")
    assert "damaged or missing" in experimenter.get("/studies").text
    stored_files.overwrite(store, clip.video_sha256, content)
    assert until(lambda: "damaged or missing" not in experimenter.get("/studies").text)
    assert taking_part.turn().json()["pair"]["query_id"] == taking_part.queries[0].id


@pytest.fixture
def study_bundle(taking_part: TakingPart, database: Database, store: ArtefactStore) -> str:
    """The file of a bundle of the participant."""
    with database.writing() as session:
        study = session.get_one(Study, taking_part.study.id)
        person = taking_part.participant
        model = factories.make_model(session, study, person, ModelKind.FILTER, factories.filter_metrics())
        model.artefact_sha256 = store.put(b"a filter")
        return factories.make_bundle(session, store, model).artefact_sha256


@pytest.fixture
def data_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The data directory as commands find it."""
    monkeypatch.setenv("DATA_DIR", str(tmp_path))
    return tmp_path


def test_a_scrub_reads_everything_and_says_what_is_wrong(
    data_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    main(["migrate"])
    settings = Settings(_env_file=None)
    database, store = Database(settings.sqlalchemy_url), ArtefactStore.of(settings)
    with database.writing() as session:
        study = factories.make_study(session, "Pilot")
        person, _ = factories.make_participant(session, study)
        clips = [factories.make_clip(session, store, study) for _ in range(3)]
        for clip in clips:
            session.get_one(Rollout, clip.rollout_id).trajectory_sha256 = store.put(f"trajectory of {clip.id}".encode())
        model = factories.make_model(session, study, person, ModelKind.FILTER, factories.filter_metrics())
        model.artefact_sha256 = store.put(b"a filter")
        bundle = factories.make_bundle(session, store, model)
    assert main(["scrub"]) == 0
    assert "All files are whole." in capsys.readouterr().out
    stored_files.damage(store, clips[0].video_sha256)
    stored_files.lose(store, clips[1].poster_sha256)
    stored_files.damage(store, bundle.artefact_sha256)
    for _ in range(2):  # a second scrub says the same
        assert main(["scrub"]) == 1
        said = capsys.readouterr().out
        assert said.splitlines()[0] == "pilot:"
        assert f"clip 1, video ({clips[0].video_sha256[:12]}): the worker makes it again" in said
        assert f"clip 2, first picture ({clips[1].poster_sha256[:12]}): the worker makes it again" in said
        assert f"bundle v1 of P01, file ({bundle.artefact_sha256[:12]}): restore it from a backup" in said
        assert "3 stored files are damaged or missing." in said
    broken = {clips[0].video_sha256, clips[1].poster_sha256, bundle.artefact_sha256}
    assert until(lambda: store.lost().keys() == broken)
    database.dispose()
