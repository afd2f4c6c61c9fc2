"""Another key, exchanged before anything is filmed or packed, leaves no other trace than what it decides."""

import hashlib
import json
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete, inspect, select

from app.db import Database
from app.domain.clips import Clip
from app.domain.evaluation import Assignment, Controller, Film, Trial
from app.domain.models import ModelKind, Run, RunKind
from app.domain.preferences import Query, Response
from app.domain.protocol import EvaluationMode, EvaluationSettings
from app.domain.run_keys import CONTROLLERS, TRIALS
from app.domain.studies import Participant, Study
from app.services.archives import archive
from app.services.evaluation import evaluation_plan, unblinding
from app.services.studies import locking
from app.storage import ArtefactStore
from tests import factories
from tests.worker.at_hand import AtHand
from tests.worker.invented import job_of
from tests.worker.jobs.test_evaluation_films import done, due, learn, settle
from worker.jobs.clips import evaluation_films
from worker.jobs.clips.evaluation_films import make_films
from worker.jobs.publishing import export_files
from worker.jobs.runtime.context import WorkerContext

METHODS = ("reference", "pbarl")
MOMENT = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?(\+00:00)?")
COMMITMENT = re.compile(rb"Locked document \(JSON\): SHA-256 `[0-9a-f]{64}`")


@dataclass(frozen=True)
class Told(WorkerContext):
    """A workplace that remembers what it said about its progress."""

    said: list[str] = field(default_factory=list)

    def report(self, run_id: int, stage: str, progress: float) -> None:
        """See WorkerContext."""
        self.said.append(f"{stage} {progress:.2f}")
        super().report(run_id, stage, progress)


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> Told:
    return Told(database, store, AtHand())


@pytest.fixture
def all_said(add_clips: Callable[[int], list[Clip]], answer: Callable[[Clip, Clip, Response], Query]) -> None:
    clips = [clip for scenario in range(3) for clip in add_clips(scenario)]
    for index in range(10):
        answer(clips[index], clips[index + 1], Response.LEFT)


def _keys() -> tuple[str, str]:
    """Two secrets that give the first participant other letters."""
    methods = EvaluationSettings(methods=METHODS).methods
    by_order = {
        tuple(evaluation_plan.order_of_methods(f"{each:064x}", methods, 1)): f"{each:064x}" for each in range(20)
    }
    one, other = by_order.values()
    return one, other


@pytest.mark.slow
@pytest.mark.usefixtures("all_said")
@pytest.mark.parametrize("mode", [pytest.param(EvaluationMode.VIDEO, marks=pytest.mark.long), EvaluationMode.PHYSICAL])
def test_rows_times_progress_and_archives_say_the_same_whichever_method_a_letter_hides(
    context: Told, database: Database, study: Study, participant: Participant, mode: EvaluationMode, tmp_path: Path
) -> None:
    settle(database, study, mode=mode, methods=METHODS, trials=1)
    learn(context)
    seen = [_prepared_under(context, study, participant, key, tmp_path) for key in _keys()]
    (one, letters), (other, exchanged) = seen
    assert letters == {letter: {"A": exchanged["B"], "B": exchanged["A"]}[letter] for letter in letters}
    assert one == other


def _prepared_under(
    context: Told, study: Study, participant: Participant, key: str, folder: Path
) -> tuple[dict[str, Any], dict[str, str]]:
    """Everything but the key itself that its robots leave behind, and the key."""
    with context.database.writing() as session:
        for table in (Trial, Film, Controller, Assignment):
            session.execute(delete(table))
        session.execute(delete(Run).where(Run.kind == RunKind.FILMS))
        session.get_one(Study, study.id).key_secret = key
    context.said.clear()
    job = due(context.database, RunKind.FILMS)[0]
    done(context, job, make_films)
    with context.database.reading() as session:
        here = session.get_one(Study, study.id)
        assert unblinding.is_blinded(here)
        archive.write(session, context.store, here, folder / "study.zip")
        export_files.write_data(session, context, here, folder / "data.zip")
        left = {
            "films": _rows(session.scalars(select(Film).order_by(Film.method)).all()),
            "controllers": _rows(session.scalars(select(Controller).order_by(Controller.method)).all()),
            "progress": list(context.said),
            "archive": _from_outside(folder / "study.zip"),
            "data": _inside(folder / "data.zip"),
        }
        letters = {each.letter: each.method for each in evaluation_plan.assignments_of(session, participant.id)}
    return left, letters


def _rows(rows: Any) -> list[dict[str, Any]]:
    """What was made, whenever it was made. A controller holds its letter."""
    left_out = {"id", "created_at", "artefact_sha256"}
    names = [column.key for row in rows for column in inspect(row).mapper.column_attrs if column.key not in left_out]
    return [{name: getattr(row, name) for name in names} for row in rows]


def _from_outside(path: Path) -> list[tuple[str, int]]:
    """What can be known of an archive without its seal key."""
    with zipfile.ZipFile(path) as file:
        said = json.loads(file.read("manifest.json"))
        return [*((each.filename, each.file_size) for each in file.infolist()), *((name, 0) for name in said)]


def _inside(path: Path) -> dict[str, bytes]:
    """The texts of an export, without moments, and without the hash that commits a plan to its secret."""
    with zipfile.ZipFile(path) as file:
        names = [name for name in file.namelist() if name.endswith((".csv", ".jsonl", ".md", ".json"))]
        texts = {name: MOMENT.sub(b"", file.read(name)) for name in names}
    texts["preregistration.md"], commitments = COMMITMENT.subn(b"", texts["preregistration.md"])
    assert commitments == 1
    return texts


@pytest.mark.usefixtures("all_said")
@pytest.mark.parametrize("what", [TRIALS, CONTROLLERS])
def test_the_order_in_which_robots_are_made_tells_no_method(
    context: Told, database: Database, study: Study, participant: Participant, what: str
) -> None:
    """Or the times of files would. Films are made as they are shown, whatever the key; controllers in any order."""
    settle(database, study, methods=("reference", "pbarl", "prefft"), trials=1)
    with database.writing() as session:
        factories.make_model(session, study, participant, ModelKind.FILTER, factories.filter_metrics())
        factories.make_model(session, study, participant, ModelKind.METHOD, {"method": "prefft"})
    job = job_of(f"films/participant-{participant.id}/{what}/labels-10", study.id)
    by_method, by_letter = set(), set()
    for number in range(20):
        with database.writing() as session:
            for table in (Trial, Assignment):
                session.execute(delete(table))
            session.get_one(Study, study.id).key_secret = f"{number:064x}"
        made = [method for method, *_ in evaluation_films._plan(context, job, what)]
        with database.reading() as session:
            letters = {each.method: each.letter for each in evaluation_plan.assignments_of(session, participant.id)}
        by_method.add(tuple(made))
        by_letter.add("".join(letters[method] for method in made))
    assert len(by_method) > 3
    assert by_letter == {"ABC"} if what == TRIALS else len(by_letter) > 3


def test_the_seed_that_everybody_sees_does_not_tell_the_letters(database: Database, study: Study) -> None:
    methods = EvaluationSettings().methods
    with database.writing() as session:
        stored = session.get_one(Study, study.id)
        stored.key_secret = "f" * 64
        drawn = [evaluation_plan.order_of_methods(stored.key_secret, methods, number) for number in range(1, 13)]
        from_seed = [evaluation_plan.order_of_methods(str(stored.seed), methods, number) for number in range(1, 13)]
        assert drawn != from_seed
        locked = json.dumps(locking.document(stored))
    assert "f" * 64 not in locked
    assert hashlib.sha256(b"f" * 64).hexdigest() in locked, "who sees the secret later can tell that it is the same"
