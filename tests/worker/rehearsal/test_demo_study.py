"""The demo study that ships with the studio: whoever opens the printed link goes on where it ends, at once.

A change after which this fails needs the archive anew: python -m worker demo-study.
"""

import json
import zipfile
from pathlib import Path

import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.evaluation import Film
from app.domain.models import Report, RunKind
from app.domain.preferences import Query
from app.domain.studies import Participant, Study
from app.services.archives import demo_archive
from app.storage import ArtefactStore
from tests.worker.at_hand import AtHand
from worker.analysis.study import figures
from worker.jobs import reconcile
from worker.jobs.learning import query_selection
from worker.jobs.publishing import export_files, report_files
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.rehearsal import demo_study


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


@pytest.fixture
def visitor(database: Database, store: ArtefactStore) -> Participant:
    """Whose link is printed at the first start."""
    with database.writing() as session:
        demo_archive.import_finished(session, store)
        return session.scalars(select(Participant).order_by(Participant.id)).all()[-1]


def test_nothing_is_made_again_but_the_report(visitor: Participant, database: Database) -> None:
    with database.reading() as session:
        assert {job.kind for job, _ in reconcile.due(session)} == {RunKind.REPORT}


def test_its_settings_are_those_with_which_it_would_be_made_now(visitor: Participant, database: Database) -> None:
    with database.reading() as session:
        study = session.get_one(Study, visitor.study_id)
    assert (study.name, study.settings) == (demo_study.NAME, demo_study.SETTINGS)


def test_the_visitor_has_pairs_as_soon_as_the_worker_runs(visitor: Participant, context: WorkerContext) -> None:
    query_selection.refill_queries(context, visitor.id)
    with context.database.reading() as session:
        queries = session.scalars(select(Query).where(Query.participant_id == visitor.id)).all()
    assert queries


def test_each_scripted_person_has_their_robot_filmed_before_and_after(visitor: Participant, database: Database) -> None:
    with database.reading() as session:
        people = session.scalars(select(Participant).where(Participant.id != visitor.id)).all()
        films = {
            person.code: set(session.scalars(select(Film.method).where(Film.participant_id == person.id)))
            for person in people
        }
    assert films == {code: {"reference", "pbarl"} for code in ("P01", "P02", "P03")}


def test_its_report_compares_the_methods(
    visitor: Participant, context: WorkerContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "DPI", 30)
    with context.database.reading() as session:
        (job,) = report_files.due(session, session.get_one(Study, visitor.study_id))
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
    report_files.make(context, job, run_id, lambda _name, function, *arguments: function(*arguments))
    with context.database.reading() as session:
        contents = session.scalars(select(Report)).one().contents
    assert not contents["blinded"]
    for scale in contents["ratings"]["scales"].values():
        assert {each["group"] for each in scale["means"]} == {"reference", "pbarl"}
        assert [each["participants"] for each in scale["means"]] == [3, 3]
    assert sum(each["foresight"] == "better" for each in contents["answers"]["participants"]) >= 2
    assert len(contents["change"]["participants"]) == 3


def test_its_data_for_analysis_say_who_is_no_person(
    visitor: Participant, context: WorkerContext, tmp_path: Path
) -> None:
    path = tmp_path / "data.zip"
    with context.database.reading() as session:
        export_files.write_data(session, context, session.get_one(Study, visitor.study_id), path)
    with zipfile.ZipFile(path) as data:
        played = "P01 (neutral), P02 (cautious), P03 (impatient)"
        assert f"These participants are not people: {played}." in data.read("README.md").decode()
        assert json.loads(data.read("provenance.json"))["scripted"].keys() == {"P01", "P02", "P03"}
