"""A study moves to another installation: everything arrives, or nothing does."""

import base64
import csv
import hashlib
import json
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import func, select

from app.__main__ import import_study
from app.db import Base, Database
from app.domain import run_keys
from app.domain.clips import Rollout
from app.domain.models import Run, RunStatus
from app.domain.participation import ConsentRecord, FormAnswer, ParticipantEvent
from app.domain.preferences import Query
from app.domain.studies import Deviation, Participant, Study
from app.services.archives import archive, archive_reading
from app.services.archives.archive import ArchiveInvalid
from app.services.exports import export_formats, export_tables
from app.services.participants import enrolment, withdrawal
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories, stored_files
from tests.app.conftest import bring
from tests.finished_study import make_finished_study

MOMENT = datetime(2026, 1, 31, tzinfo=UTC)


@pytest.fixture
def study(database: Database, store: ArtefactStore) -> Study:
    with database.writing() as session:
        study = make_finished_study(session, store, people=3, labels=5)
        name = "reward/participant-1/labels-10/answer-2"
        factories.make_run(session, study, session.get_one(Participant, 1)).workflow_id = name
        factories.make_run(session, study, status=RunStatus.RUNNING).workflow_id = "clips/study-1/scenario-7"
        factories.make_clip(session, store, study, made_for=session.get_one(Participant, 2))
        session.flush()
        gone = session.scalars(select(Participant).where(Participant.number == 3)).one()
        withdrawal.withdraw(session, store, gone, gone.code)
        session.refresh(study)
    return study


@pytest.fixture
def packed(database: Database, store: ArtefactStore, study: Study, tmp_path: Path) -> Path:
    path = tmp_path / "study.zip"
    with database.reading() as session:
        archive.write(session, store, session.get_one(Study, study.id), path)
    return path


def exports(database: Database, slug: str) -> dict[str, str]:
    """Every table of the study as its CSV file."""
    with database.reading() as session:
        study = session.scalars(select(Study).where(Study.slug == slug)).one()
        provenance = export_formats.provenance_of(session, study, MOMENT)
        return {
            table.name: "".join(export_formats.csv_lines(table, session, study, provenance))
            for table in export_tables.TABLES
        }


def count(database: Database) -> dict[str, int]:
    with database.reading() as session:
        return {
            table.name: session.scalar(select(func.count()).select_from(table)) or 0
            for table in Base.metadata.sorted_tables
        }


def test_a_study_that_was_imported_exports_the_same(
    database: Database, elsewhere: FastAPI, study: Study, packed: Path
) -> None:
    imported = bring(elsewhere, packed)
    there = elsewhere.state.studio
    assert exports(there.database, imported.study.slug) == exports(database, study.slug)
    with zipfile.ZipFile(packed) as file:
        for sha256 in json.loads(file.read("manifest.json"))["files"]:
            assert hashlib.sha256(there.store.read(sha256)).hexdigest() == sha256


def test_a_file_that_was_not_here_before_is_no_lost_one(
    elsewhere: FastAPI, packed: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bring(elsewhere, packed)
    assert caplog.messages == []


def _contents(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def test_rows_refer_to_each_other_as_before(elsewhere: FastAPI, study: Study, packed: Path) -> None:
    imported = bring(elsewhere, packed)
    with elsewhere.state.studio.database.reading() as session:
        repeats = session.scalars(
            select(Query)
            .join(Participant)
            .where(Participant.study_id == imported.study.id, Query.repeats_query_id.is_not(None))
        ).all()
        assert len(repeats) == 2
        for repeat in repeats:
            first = session.get_one(Query, repeat.repeats_query_id)
            assert (first.participant_id, first.left_clip_id) == (repeat.participant_id, repeat.right_clip_id)


def test_what_was_made_for_somebody_is_theirs_there_too(elsewhere: FastAPI, packed: Path) -> None:
    imported = bring(elsewhere, packed)
    with elsewhere.state.studio.database.reading() as session:
        theirs = select(Participant).join(Rollout, Rollout.participant_id == Participant.id)
        made_for = session.scalars(theirs.where(Participant.study_id == imported.study.id)).one()
    assert made_for.number == 2
    clips = exports(elsewhere.state.studio.database, imported.study.slug)["clips"]
    assert Counter(row["made_for"] for row in csv.DictReader(clips.splitlines())) == {"": 6, "P02": 1}


def test_what_was_done_is_not_done_again_and_what_was_at_work_is(
    elsewhere: FastAPI, study: Study, packed: Path
) -> None:
    imported = bring(elsewhere, packed)
    with elsewhere.state.studio.database.reading() as session:
        runs = {run.workflow_id: run for run in session.scalars(select(Run).where(Run.study_id == imported.study.id))}
        person = session.scalars(
            select(Participant).where(Participant.study_id == imported.study.id, Participant.number == 1)
        ).one()
    assert person.id != 1, "else this test says nothing"
    assert any(name.startswith(f"reward/participant-{person.id}/labels-10/answer-") for name in runs)
    assert runs[f"clips/study-{imported.study.id}/scenario-7"].status == RunStatus.FAILED


def test_a_run_whose_key_is_not_ours_keeps_its_name(elsewhere: FastAPI, study: Study, packed: Path) -> None:
    with elsewhere.state.studio.database.reading() as session:
        assert session.scalars(select(Run.workflow_id)).all() == []
    imported = bring(elsewhere, packed)
    with elsewhere.state.studio.database.reading() as session:
        names = session.scalars(select(Run.workflow_id).where(Run.study_id == imported.study.id)).all()
    foreign = [name for name in names if run_keys.read(name) is None]
    assert foreign, "else this test says nothing"
    assert all(name.startswith("run/") for name in foreign), foreign


def test_no_link_works_that_worked_before_and_new_ones_do(
    database: Database, elsewhere: FastAPI, study: Study, packed: Path, settings: Settings
) -> None:
    with database.writing() as session:
        person = session.get_one(Participant, 1)
        old = enrolment.renew_link(session, study, person, "x")
        archive.write(session, ArtefactStore.of(settings), session.get_one(Study, study.id), packed)
    with zipfile.ZipFile(packed) as file:
        text = b"".join(file.read(name) for name in file.namelist() if name.startswith("rows/")).decode()
    assert "token" not in text
    assert hashlib.sha256(old.encode()).hexdigest() not in text
    imported = bring(elsewhere, packed)
    assert [code for code, _ in imported.tokens] == ["P01", "P02"], "a tombstone needs no link"
    browser = TestClient(elsewhere, follow_redirects=False)
    assert browser.get(f"/p/{old}").status_code == 404
    assert browser.get(f"/p/{imported.tokens[0][1]}").status_code == 303


def test_importing_twice_makes_two_studies(elsewhere: FastAPI, study: Study, packed: Path) -> None:
    slugs = [bring(elsewhere, packed).study.slug for _ in range(2)]
    assert slugs == [study.slug, f"{study.slug}-2"]


def test_a_study_can_be_imported_where_it_is(
    studio_app: FastAPI, database: Database, study: Study, packed: Path
) -> None:
    imported = bring(studio_app, packed)
    copy, original = (exports(database, slug) for slug in (imported.study.slug, study.slug))
    assert copy["labels"].replace(f"{study.slug}-2", study.slug) == original["labels"]


def _edited(packed: Path, edit: Callable[[str, bytes], bytes | None]) -> Path:
    target = packed.with_name("edited.zip")
    with zipfile.ZipFile(packed) as source, zipfile.ZipFile(target, "w") as copy:
        for name in source.namelist():
            content = edit(name, source.read(name))
            if content is not None:
                copy.writestr(name, content)
    return target


def _with_version_9(name: str, content: bytes) -> bytes:
    return content.replace(b'"version": 2,', b'"version": 9,') if name == "manifest.json" else content


def _with_one_wrong_letter(name: str, content: bytes) -> bytes:
    return content.replace(b"left", b"lift", 1) if name == "rows/label_event.jsonl" else content


def _with_a_damaged_file(name: str, content: bytes) -> bytes:
    return content[:-1] + b"?" if name.startswith("files/") else content


def _without_manifest(name: str, content: bytes) -> bytes | None:
    return None if name == "manifest.json" else content


def _without_clips(name: str, content: bytes) -> bytes | None:
    if name == "manifest.json":
        manifest = json.loads(content)
        del manifest["tables"]["clip"]
        return json.dumps(manifest).encode()
    return content


@pytest.mark.parametrize(
    "edit", [_with_version_9, _with_one_wrong_letter, _with_a_damaged_file, _without_manifest, _without_clips]
)
def test_what_is_damaged_leaves_nothing_behind(
    elsewhere: FastAPI, packed: Path, edit: Callable[[str, bytes], bytes | None]
) -> None:
    studio = elsewhere.state.studio
    before = count(studio.database), stored_files.names(studio.store)
    with pytest.raises(ArchiveInvalid):
        bring(elsewhere, _edited(packed, edit))
    assert (count(studio.database), stored_files.names(studio.store)) == before


def test_any_other_file_is_refused_in_words(elsewhere: FastAPI, tmp_path: Path) -> None:
    path = tmp_path / "letter.zip"
    path.write_text("Dear all")
    with pytest.raises(ArchiveInvalid, match="not an archive"):
        bring(elsewhere, path)


def test_an_archive_is_imported_on_a_page_and_leads_to_the_new_links(
    experimenter: TestClient, database: Database, study: Study, packed: Path
) -> None:
    answer = experimenter.post("/import", files={"file": ("study.zip", packed.read_bytes(), "application/zip")})
    assert answer.status_code == 303
    links = experimenter.get(answer.headers["location"]).text
    assert f"{study.slug}-2" in answer.headers["location"]
    assert links.count("/p/") >= 2


def test_a_page_says_why_a_file_was_refused(experimenter: TestClient) -> None:
    answer = experimenter.post("/import", files={"file": ("letter.zip", b"Dear all", "application/zip")})
    assert answer.status_code == 422
    assert "not an archive of a study" in answer.text


def test_a_study_is_imported_by_a_command(packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = Settings(_env_file=None, data_dir=tmp_path / "by command", storage_url=None)  # files of its own, too
    assert import_study(settings, packed) == 0
    said = capsys.readouterr().out
    assert "/studies/feeding-finished" in said
    assert "P01,http" in said


ODD_TEXTS = (
    *(f"one{end}two" for end in "\n\r\v\f\x1c\x1d\x1e\x85\u2028\u2029\0"),
    "\r\n",
    "\ufeffwith a mark \u202eand backwards",
    "\U0001f37d\ufe0f \u0301 \U0010ffff",
    '{"a": "\\u2028"}\n{}',
    "'; DROP TABLE participant; --",
    "\u2028" * 4000,
)


def test_whatever_somebody_writes_an_archive_brings_it_back(
    database: Database, store: ArtefactStore, elsewhere: FastAPI, tmp_path: Path
) -> None:
    with database.writing() as session:
        study = factories.make_study(session, "Odd\u2028texts")
        for text in ODD_TEXTS:
            person, _ = factories.make_participant(session, study)
            person.panel_id, person.panel_parameters = text[:120], {text: text}
            session.add(ConsentRecord(participant_id=person.id, version=text[:40], language="en", text=text))
            session.add(FormAnswer(participant_id=person.id, form="questionnaire", item="comments", value=text))
            session.add(ParticipantEvent(participant_id=person.id, kind="break_begun", detail={text: text}))
            factories.make_run(session, study, person, error=text)
        session.add(
            Deviation(study_id=study.id, actor="x", reason=ODD_TEXTS[8], before={"x": 1}, after={"x": ODD_TEXTS[0]})
        )
        session.flush()
        archive.write(session, store, study, tmp_path / "odd.zip")
    archive_reading.verify(tmp_path / "odd.zip", tmp_path / "work", "")
    imported = bring(elsewhere, tmp_path / "odd.zip")
    assert exports(elsewhere.state.studio.database, imported.study.slug) == exports(database, study.slug)
    with elsewhere.state.studio.database.reading() as session:
        people = select(Participant).where(Participant.study_id == imported.study.id).order_by(Participant.number)
        for person, written in zip(session.scalars(people).all(), ODD_TEXTS, strict=True):
            text = written if database.is_sqlite else written.replace("\0", "\N{REPLACEMENT CHARACTER}")
            assert person.panel_parameters == {written: written}
            theirs = FormAnswer.participant_id == person.id
            assert session.scalar(select(FormAnswer.value).where(theirs)) == text


def _as_version_1(packed: Path, sealed: tuple[str, ...] = ()) -> Path:
    """The archive as the first version wrote it: without the secret, some tables packed as text."""
    target = packed.with_name("version-1.zip")
    with zipfile.ZipFile(packed) as source, zipfile.ZipFile(target, "w") as copy:
        manifest = json.loads(source.read("manifest.json"))
        manifest |= {"version": 1, "study": "feeding-finished"}
        del manifest["missing"], manifest["sealed"]
        for name, said in manifest["tables"].items():
            rows = [json.loads(line) for line in source.read(f"rows/{name}.jsonl").split(b"\n") if line]
            for row in rows:
                row.pop("key_secret", None)
            content = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows).encode()
            said |= {"sha256": hashlib.sha256(content).hexdigest(), "sealed": name in sealed}
            packed_text = base64.b64encode(zlib.compress(content)) if name in sealed else content
            copy.writestr(f"rows/{name}.{'sealed' if name in sealed else 'jsonl'}", packed_text)
        for sha256 in manifest["files"]:
            copy.writestr(f"files/{sha256}", source.read(f"files/{sha256}"))
        copy.writestr("manifest.json", json.dumps(manifest))
    return target


@pytest.mark.parametrize("sealed", [(), ("assignment", "trial")])
def test_an_archive_of_the_first_version_is_still_read(
    database: Database, elsewhere: FastAPI, study: Study, packed: Path, sealed: tuple[str, ...]
) -> None:
    imported = bring(elsewhere, _as_version_1(packed, sealed))
    assert exports(elsewhere.state.studio.database, imported.study.slug) == exports(database, study.slug)
    with elsewhere.state.studio.database.reading() as session:
        assert len(session.get_one(Study, imported.study.id).key_secret) == 64, "drawn for who comes later"
