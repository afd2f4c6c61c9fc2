"""The whole loop with real parts: pages, database, simulation, learning, bundle, and a worker that is killed twice."""

import io
import json
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import func, select

from app.db import Database
from app.domain.choices import ClipQuality
from app.domain.clips import Clip, Rollout
from app.domain.models import Model, ModelKind, Run, RunKind, RunStatus
from app.domain.preferences import LabelEvent
from app.domain.study_settings import StudySettings
from app.storage import ArtefactStore
from tests.waiting import until
from worker.jobs.learning import dataset
from worker.ml.export import bundle
from worker.ml.teachers import TASTES, Manner
from worker.rehearsal.rehearsal import Rehearsal, RehearsedPerson
from worker.rehearsal.server import OwnStudio

LABELS = 12
SCENARIOS, BEHAVIOURS = 2, 4

pytestmark = [pytest.mark.slow, pytest.mark.long]


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OwnStudio]:
    with OwnStudio(tmp_path_factory.mktemp("studio")) as studio:
        yield studio


@pytest.fixture(scope="module")
def database(studio: OwnStudio) -> Iterator[Database]:
    database = Database(studio.settings.sqlalchemy_url)
    yield database
    database.dispose()


@pytest.fixture(scope="module")
def outcome(studio: OwnStudio, database: Database) -> RehearsedPerson:
    """One cautious participant, with mistakes and indifference; the worker dies while filming and while training."""
    settings = StudySettings(
        labels_per_participant=LABELS,
        retrain_every_labels=5,
        filter_milestones=(),
        pool_scenarios=SCENARIOS,
        behaviours_per_scenario=BEHAVIOURS,
        evaluation_scenarios=10,
        harm_share=0.5,
        clip_quality=ClipQuality.QUICK,
    )
    killers = [_Killer(studio, database, RunKind.CLIPS), _Killer(studio, database, RunKind.FILTER)]
    for killer in killers:
        killer.start()
    store = ArtefactStore.of(studio.settings)
    rehearsal = Rehearsal(database, store, studio.settings.base_url)
    manner = Manner(mistakes=0.1, equal_share=0.1, skip_share=0.1)
    (outcome,) = rehearsal.run("feeding", [TASTES["cautious"]], settings, manner, seed=1).outcomes
    assert until(lambda: _has_films(database)), "nobody was filmed before and after"
    for killer in killers:
        killer.rehearsal_is_over.set()
        killer.join()
        assert killer.killed, f"the worker was never caught in the middle of {killer.kind}"
    return outcome


def _has_films(database: Database) -> bool:
    with database.reading() as session:
        done = select(Run.id).where(Run.kind == RunKind.FILMS, Run.status == RunStatus.SUCCEEDED)
        return session.scalar(done) is not None


class _Killer(threading.Thread):
    """Kills the worker outright in the middle of its first run of a kind, and starts it again."""

    def __init__(self, studio: OwnStudio, database: Database, kind: RunKind) -> None:
        super().__init__(daemon=True)
        self.studio, self.database, self.kind = studio, database, kind
        self.killed = False
        self.rehearsal_is_over = threading.Event()

    def run(self) -> None:
        while not self.rehearsal_is_over.wait(0.05):
            if self._in_the_middle():
                self.studio.kill("worker")
                self.studio.start_worker()
                self.killed = True
                return

    def _in_the_middle(self) -> bool:
        running = select(Run.id).where(Run.kind == self.kind, Run.status == RunStatus.RUNNING, Run.progress > 0.1)
        with self.database.reading() as session:
            return session.scalar(running) is not None


def test_every_answer_is_stored_exactly_once(outcome: RehearsedPerson, database: Database) -> None:
    with database.reading() as session:
        assert session.scalar(select(func.count(LabelEvent.id))) == LABELS
        assert len(dataset.labels_with_clips(session, outcome.participant_id)) == LABELS


def test_the_pool_is_complete_and_without_doubles_although_the_worker_was_killed(
    outcome: RehearsedPerson, database: Database
) -> None:
    with database.reading() as session:
        assert session.scalar(select(func.count(Clip.id))) == SCENARIOS * BEHAVIOURS
        assert session.scalar(select(func.count(Rollout.id))) == SCENARIOS * BEHAVIOURS


def test_every_run_succeeded_at_its_first_attempt_although_the_worker_was_killed(
    outcome: RehearsedPerson, database: Database
) -> None:
    with database.reading() as session:
        runs = session.scalars(select(Run).where(Run.kind != RunKind.REPORT)).all()  # there is always a newer one
    assert {run.kind for run in runs} == {RunKind.CLIPS, RunKind.REWARD, RunKind.FILTER, RunKind.FILMS}
    assert [(run.workflow_id, run.error) for run in runs if run.status != RunStatus.SUCCEEDED] == []
    assert {run.attempt for run in runs} == {1}


def test_the_last_model_has_seen_every_label(outcome: RehearsedPerson, database: Database, studio: OwnStudio) -> None:
    store = ArtefactStore.of(studio.settings)
    with database.reading() as session:
        said = dataset.load_preferences(session, store, outcome.participant_id)
        newest = session.scalars(select(Model).where(Model.kind == ModelKind.FILTER).order_by(Model.id.desc())).first()
    assert newest is not None
    assert (newest.label_count, newest.label_hash) == (LABELS, said.label_hash)


def test_labels_after_the_first_model_were_predicted_before_they_were_given(
    outcome: RehearsedPerson, database: Database
) -> None:
    with database.reading() as session:
        labels = dataset.labels_with_clips(session, outcome.participant_id)
        models = {model.id: model for model in session.scalars(select(Model)).all()}
    predicted = [label for label in labels if label.query.predicted_by_model_id is not None]
    assert predicted
    for label in predicted:
        model = models[label.query.predicted_by_model_id or 0]
        assert model.created_at <= label.event.created_at
        assert model.label_count < label.query.ordinal


def test_the_downloaded_bundle_is_whole_and_runs_outside_the_project(outcome: RehearsedPerson, tmp_path: Path) -> None:
    manifest = bundle.verify(outcome.bundle)
    assert manifest["labels"]["count"] == LABELS
    assert manifest["evaluation"]["scenarios"] == 10
    with zipfile.ZipFile(io.BytesIO(outcome.bundle)) as archive:
        archive.extractall(tmp_path)
    ran = subprocess.run(
        [sys.executable, "-I", "run_filter.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert json.loads((tmp_path / "manifest.json").read_text())["participant"] == outcome.code
