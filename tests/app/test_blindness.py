"""A blinded study keeps its key: whatever can be seen or downloaded is the same, whichever method a letter hides."""

import io
import re
import shutil
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database, now
from app.domain.clips import Rollout
from app.domain.evaluation import Assignment, Trial
from app.domain.models import Model, Report
from app.domain.people import Experimenter
from app.domain.studies import Participant, Study
from app.services.accounts import api_tokens
from app.services.archives import archive
from app.services.evaluation import evaluation_plan
from app.services.exports import export_tables
from app.storage import ArtefactStore
from tests import factories
from tests.finished_study import make_finished_study
from worker.analysis.study import figures
from worker.analysis.study.report import make_report
from worker.compute.pools import Compute
from worker.jobs.publishing import export_files, preference_arrays, report_files
from worker.jobs.runtime.context import WorkerContext

WHEN = re.compile(
    rb"just now|\d+ (s|min|h|days) ago|\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?( UTC|Z|\+00:00)?|svg\?\d+"
)
PARAMETER = re.compile(r"{(\w+)(?::\w+)?}")
METHODS = "reference|pre-trained|prefft|pbarl"
ROBOT_AND_METHOD = re.compile(
    rf"\b(robot|letter|controller)s?\W{{1,3}}[A-E]\b.{{0,60}}\b({METHODS})\b", re.IGNORECASE | re.DOTALL
)
LETTER_AND_METHOD = re.compile(rf"[\",][A-E](?=[\",]).{{0,40}}[\",]({METHODS})")

Answers = dict[str, bytes]


@pytest.fixture
def study(database: Database, store: ArtefactStore) -> Study:
    """Finished and blinded, with films of every trial and of before and after; no file of it is missing."""
    with database.writing() as session:
        study = make_finished_study(session, store, people=3, labels=6, unblinded=False)
        for person in session.scalars(select(Participant).where(Participant.study_id == study.id)):
            methods = {each.letter: each.method for each in evaluation_plan.assignments_of(session, person.id)}
            for trial in evaluation_plan.trials_of(session, person.id):
                method = methods[trial.letter]
                trial.film = factories.make_film(session, store, person, method, scenario=trial.scenario)
            for method in ("reference", "pbarl"):
                factories.make_film(session, store, person, method)
        for model in session.scalars(select(Model)):
            model.artefact_sha256 = store.put(f"model {model.id}".encode())
        for rollout in session.scalars(select(Rollout)):
            rollout.trajectory_sha256 = store.put(f"trajectory {rollout.id}".encode())
        return study


@pytest.fixture
def token(database: Database, experimenter: TestClient) -> str:
    with database.writing() as session:
        return api_tokens.create(session, session.scalars(select(Experimenter)).one(), "a notebook")[1]


@pytest.fixture
def everything(
    studio_app: FastAPI,
    experimenter: TestClient,
    token: str,
    database: Database,
    store: ArtefactStore,
    study: Study,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> Callable[[], Answers]:
    """Makes a report, and gathers every page, answer of the API, figure and file, all at the same moment."""
    _stop_the_clock(monkeypatch)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)  # pages say how much is free; others write meanwhile
    monkeypatch.setattr(figures, "DPI", 40)
    monkeypatch.setattr(preference_arrays, "arrays_of", lambda *_: None)  # nobody has moved in this study

    def gather() -> Answers:
        with database.writing() as session:
            _report(session, store, session.get_one(Study, study.id))
        found: Answers = {}
        for path in _addresses(studio_app, "/studies", study.slug):
            found[path] = experimenter.get(path).content
        headers = {"Authorization": f"Bearer {token}"}
        for path in _addresses(studio_app.state.api, "/studies", study.slug):
            answer = experimenter.get(f"/api/v1{path}", headers=headers)
            found[f"api {path}"] = answer.content
        with database.reading() as session:
            there = session.get_one(Study, study.id)
            place = WorkerContext(database, store, Compute(1))
            for name, write in (
                ("data", lambda file: export_files.write_data(session, place, there, file)),
                ("archive", lambda file: archive.write(session, store, there, file)),
            ):
                found |= _unpacked(name, write, tmp_path / "file.zip")
        return {path: WHEN.sub(b"", content) for path, content in found.items()}

    return gather


def test_everything_is_the_same_under_another_key_and_no_method_is_named_beside_a_letter(
    everything: Callable[[], Answers], database: Database, study: Study
) -> None:
    before = everything()
    seen = " ".join(before)
    for part in (
        "/results",
        "/lock",
        "/unblind",
        "ratings.csv",
        "ratings.svg",
        "api ",
        "report.json",
        "archive sealed",
        "/results/methods_and_results.md",
        "/preregistration.md",
        "data methods_and_results.md",
        "data analysis.py",
    ):
        assert part in seen, part
    _exchange(database, study)
    after = everything()
    assert before.keys() == after.keys()
    assert [path for path in before if before[path] != after[path]] == []
    _require_no_method_beside_a_letter(before, study)


def _require_no_method_beside_a_letter(found: Answers, study: Study) -> None:
    about_methods = (f"/studies/{study.slug}/settings", "/studies/new")  # forms that say what can be evaluated
    for path, content in found.items():
        if path in about_methods or path.endswith(".md"):
            continue
        text = content.decode(errors="replace")
        words = re.sub(r"<[^>]*>", " ", text)
        assert ROBOT_AND_METHOD.search(words) is None, path
        assert LETTER_AND_METHOD.search(text) is None, path


@pytest.mark.long
def test_the_same_look_finds_the_key_once_the_study_is_unblinded(
    everything: Callable[[], Answers], database: Database, study: Study
) -> None:
    """Or the tests above could not fail."""
    with database.writing() as session:
        session.get_one(Study, study.id).unblinded_at = now()
    before = everything()
    assert LETTER_AND_METHOD.search(before["data csv/ratings.csv"].decode())
    assert LETTER_AND_METHOD.search(before["archive rows/assignment.jsonl"].decode())
    assert "# Results" in before["data methods_and_results.md"].decode()
    _exchange(database, study)
    after = everything()
    changed = {path for path in before if before[path] != after[path]}
    assert {f"/studies/{study.slug}/unblind", "data csv/ratings.csv", "data report/report.json"} <= changed
    assert {f"/studies/{study.slug}/results/methods_and_results.md", "data methods_and_results.md"} <= changed


def _stop_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages say how long ago something was, who is active and how long the rest takes: from now on always the same."""
    moment = now()
    for module in [each for each in sys.modules.values() if getattr(each, "now", None) is now]:
        monkeypatch.setattr(module, "now", lambda: moment)


def _addresses(application: FastAPI, prefix: str, slug: str) -> Iterator[str]:
    """Every address that can be looked at or downloaded; endless streams and what does not exist yet left out."""
    tables = [{"table": table.name, "kind": kind} for table in export_tables.TABLES for kind in ("csv", "jsonl")]
    drawn = [{"name": name, "kind": kind} for name in ("ratings", "ratings_of_each_person") for kind in ("svg", "png")]
    single = {"slug": slug, "code": "P01", "version": "1", "letter": "A", "query_id": "1", "script": "analysis.py"}
    for route in iter_route_contexts(application.routes):
        path = route.path or ""
        left_out = ("/live", "/links/", "/export/files/", "/exports/{", "/controllers/")
        if "GET" not in (route.methods or ()) or not path.startswith(prefix) or any(each in path for each in left_out):
            continue
        for more in tables if "{table}" in path else drawn if "{name}" in path else [{}]:
            yield PARAMETER.sub(lambda name, more=more: {**single, **more}[name[1]], path)  # type: ignore[misc]


def _report(session: Session, store: ArtefactStore, study: Study) -> None:
    contents, files = make_report(report_files.tables_of(session, study))
    stored = {name: {kind: store.put(file) for kind, file in each.items()} for name, each in files.items()}
    for older in session.scalars(select(Report)):
        older.contents, older.figures = contents, stored
        return
    run = factories.make_run(session, study, kind="report")
    session.add(Report(study_id=study.id, run_id=run.id, basis="", contents=contents, figures=stored))


def _unpacked(name: str, write: Callable[[Path], object], path: Path) -> Answers:
    write(path)
    with zipfile.ZipFile(path) as packed:
        order = " ".join(packed.namelist()).encode()
        return {
            f"{name} order of files": order,
            **{f"{name} {each}": _readable(each, packed.read(each)) for each in packed.namelist()},
        }


def _readable(name: str, content: bytes) -> bytes:
    """Parquet as text: it is compressed, and every row says when it was exported. Of what is encrypted the length."""
    if name == "sealed":
        return str(len(content)).encode()
    if not name.endswith(".parquet"):
        return content
    frame = pd.read_parquet(io.BytesIO(content)).drop(columns="exported_at")
    return str(frame.to_csv()).encode()


def _exchange(database: Database, study: Study) -> None:
    """Another key: for everybody the methods behind A and C change places, with their films, and nothing else does."""
    with database.writing() as session:
        for person in session.scalars(select(Participant.id).where(Participant.study_id == study.id)).all():
            theirs = select(Assignment).where(Assignment.participant_id == person).order_by(Assignment.letter)
            first, _, last = session.scalars(theirs).all()
            methods = first.method, last.method
            for assignment, method in ((first, "in between"), (last, methods[0]), (first, methods[1])):
                assignment.method = method
                session.flush()
            trials = session.scalars(select(Trial).where(Trial.participant_id == person).order_by(Trial.ordinal)).all()
            for one, other in zip(trials[:3], trials[6:], strict=True):
                one.film_id, other.film_id = other.film_id, one.film_id
