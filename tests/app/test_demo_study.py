"""What is there at the first start: a finished study of scripted people, or an empty one, and a link either way."""

import io
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.__main__ import _first_start, main
from app.db import Database
from app.domain.clips import Clip
from app.domain.studies import Participant, Study
from app.installed_tasks import catalogue
from app.installed_tasks.by_name import usual_clip_steps
from app.services.archives import demo_archive
from app.settings import Settings
from app.storage import ArtefactStore
from tests.databases import make_tables

MOST_BYTES = 6_000_000
"""Everybody who clones the repository loads every version of it."""


@pytest.fixture
def minute_one(database: Database, store: ArtefactStore) -> str:
    """An empty studio right after its first start; the token of the participant's link."""
    with database.writing() as session:
        return demo_archive.import_finished(session, store)


def the_study(database: Database) -> Study:
    with database.reading() as session:
        return session.scalars(select(Study)).one()


def test_the_archive_that_is_shipped_is_small() -> None:
    assert demo_archive.ARCHIVE.stat().st_size < MOST_BYTES


def test_a_program_is_not_suspected_of_answering_without_the_page_s_script(
    minute_one: str, database: Database, experimenter: TestClient
) -> None:
    study = f"/studies/{the_study(database).slug}"
    page = experimenter.get(study).text
    assert "3 scripted participants are not people" in page
    assert "<strong>0</strong> needing attention" in page
    for with_their_answers in (page, experimenter.get(f"{study}/participants/P02").text):
        assert "plain form, because" not in with_their_answers
    listed = experimenter.get(f"{study}/answers").text
    assert '<span class="flag">without the page' not in listed


def test_everybody_but_the_visitor_is_scripted_and_through(minute_one: str, database: Database) -> None:
    with database.reading() as session:
        *scripted, visitor = session.scalars(select(Participant).order_by(Participant.number)).all()
    assert [each.scripted_as for each in scripted] == ["neutral", "cautious", "impatient"]
    assert all(each.completed_at for each in scripted)
    assert (visitor.scripted_as, visitor.consented_at) == (None, None)


def test_the_pool_is_whole_so_that_nothing_is_waited_for(
    minute_one: str, database: Database, store: ArtefactStore
) -> None:
    study = the_study(database)
    with database.reading() as session:
        clips = session.scalars(select(Clip)).all()
    assert len(clips) == study.settings.pool_scenarios * study.settings.behaviours_per_scenario
    assert all(store.has(clip.video_sha256) and store.has(clip.poster_sha256) for clip in clips)


def test_the_visitor_may_come_in(minute_one: str, client: TestClient) -> None:
    assert client.get(f"/p/{minute_one}").headers["location"].endswith("/p/next")
    assert "This study is not" not in client.get("/p/consent").text
    assert client.get("/p/consent").status_code == 200


@pytest.mark.parametrize("page", ["", "/results", "/answers", "/export"])
def test_every_page_with_their_numbers_says_that_they_are_not_people(
    minute_one: str, experimenter: TestClient, database: Database, page: str
) -> None:
    assert (
        "3 scripted participants are not people" in experimenter.get(f"/studies/{the_study(database).slug}{page}").text
    )


def test_the_list_of_studies_says_so_too(minute_one: str, experimenter: TestClient) -> None:
    text = experimenter.get("/studies").text
    assert "3 scripted, not people" in text
    assert "(3 finished)" in text


def test_the_page_of_each_says_so_and_has_a_bundle_that_says_so_as_well(
    minute_one: str, experimenter: TestClient, database: Database
) -> None:
    person = f"/studies/{the_study(database).slug}/participants/P02"
    page = experimenter.get(person).text
    assert "Not a person." in page
    assert f"{person}/bundles/1.zip" in page
    with zipfile.ZipFile(io.BytesIO(experimenter.get(f"{person}/bundles/1.zip").content)) as bundle:
        (card,) = (name for name in bundle.namelist() if name.endswith("MODEL_CARD.md"))
        assert "a program gave the answers" in bundle.read(card).decode()


def test_the_table_of_participants_says_who_plays_them(
    minute_one: str, experimenter: TestClient, database: Database
) -> None:
    rows = experimenter.get(f"/studies/{the_study(database).slug}/export/participants.csv").text.splitlines()
    place = rows[0].split(",").index("scripted_as")
    assert [row.split(",")[place] for row in rows[1:]] == ["neutral", "cautious", "impatient", ""]


@pytest.fixture
def first_start(tmp_path: Path) -> Iterator[Callable[[], str]]:
    """Greets as at a start of the studio in one directory."""
    settings = Settings(_env_file=None, data_dir=tmp_path / "data", public_url=None)
    database = Database(settings.sqlalchemy_url)
    make_tables(database)

    def greet() -> str:
        with database.writing() as session:
            return _first_start(session, settings)

    yield greet
    database.dispose()


@pytest.fixture
def names(tmp_path: Path) -> Callable[[], list[str]]:
    def look() -> list[str]:
        database = Database(Settings(_env_file=None, data_dir=tmp_path / "data").sqlalchemy_url)
        with database.reading() as session:
            found = list(session.scalars(select(Study.name)))
        database.dispose()
        return found

    return look


def test_the_first_start_imports_it_and_the_second_nothing(
    first_start: Callable[[], str], names: Callable[[], list[str]]
) -> None:
    assert "Participant link  http" in first_start()
    assert names() == ["Demo: feeding, with scripted participants"]
    assert "/p/" not in first_start()
    assert len(names()) == 1


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (lambda path: path.unlink(), "is not there"),
        (lambda path: path.write_bytes(path.read_bytes()[:100_000]), "damaged"),
        (lambda path: path.write_bytes(b"no archive"), "damaged"),
    ],
)
def test_a_file_that_is_missing_or_damaged_does_not_keep_the_studio_from_starting(
    broken: Callable[[Path], object],
    said: str,
    first_start: Callable[[], str],
    names: Callable[[], list[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    copy = tmp_path / "copy.zip"
    copy.write_bytes(demo_archive.ARCHIVE.read_bytes())
    broken(copy)
    monkeypatch.setattr(demo_archive, "ARCHIVE", copy)
    greeting = first_start()
    assert "Participant link  http" in greeting
    assert said in greeting
    assert "An empty demo study was made instead" in greeting
    assert names() == ["Demo: feeding"]
    assert [path for path in (tmp_path / "data" / "artefacts").rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("task", catalogue.names())
def test_a_demo_study_has_one_participant_whose_link_is_printed(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DATA_DIR", str(tmp_path))
    assert main(["demo", "--task", task]) == 0
    assert "/p/" in capsys.readouterr().out.splitlines()[-1]
    database = Database(Settings(_env_file=None, data_dir=tmp_path).sqlalchemy_url)
    with database.reading() as session:
        study = session.scalars(select(Study)).one()
        assert (study.task, study.settings.clip_steps) == (task, usual_clip_steps(task))
        assert session.scalars(select(Participant.study_id)).all() == [study.id]
    database.dispose()


def test_a_task_that_does_not_exist_is_refused_with_the_ones_that_do(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["demo", "--task", "dressing"])
    assert "feeding, drinking, scratching" in capsys.readouterr().err
