"""What a killed worker has stored and never written down does not fill the disk for ever; nothing else is lost."""

import os
import time
from pathlib import Path
from typing import cast

import pytest

from app.db import Database
from app.domain.models import ModelKind
from app.domain.studies import Participant, Study
from app.files import lost
from app.storage import ArtefactStore
from tests import factories
from worker.compute.pools import Compute
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.upkeep import unused_files

DAY_S = 24 * 3600


def age(path: Path | None, days: int = 2) -> None:
    assert path is not None, "on this machine"
    long_ago = time.time() - days * DAY_S
    os.utime(path, (long_ago, long_ago))


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, cast("Compute", None))


def stored(context: WorkerContext, content: bytes) -> str:
    """An artefact that was stored two days ago."""
    sha256 = context.store.put(content)
    age(context.store.files.local(lost.place(sha256)))
    return sha256


@pytest.mark.directory("a bucket's clock cannot be set back")
def test_old_files_that_nobody_refers_to_go_and_all_others_stay(
    context: WorkerContext, participant: Participant
) -> None:
    lost, promised, wanted_again = (stored(context, name) for name in (b"lost", b"promised", b"wanted again"))
    fresh = context.store.put(b"just stored")
    context.store.put(b"wanted again")
    with context.database.writing() as session:
        study = session.get_one(Study, participant.study_id)
        model = factories.make_model(session, study, participant, ModelKind.REWARD, factories.reward_metrics())
        model.artefact_sha256 = used = stored(context, b"a model")
    assert unused_files.clear_away(context, {promised}) == 1
    assert not context.store.has(lost)
    assert all(context.store.has(each) for each in (promised, wanted_again, fresh, used))
    assert unused_files.clear_away(context, {promised}) == 0


@pytest.mark.directory("the server clears away what was never uploaded to its end")
def test_what_was_never_written_to_its_end_goes_as_well(context: WorkerContext) -> None:
    path = context.store.files.local(lost.place(context.store.put(b"whole")))
    assert path is not None
    folder = path.parent
    old, young = folder / ".writing-old", folder / ".writing-young"
    for path in (old, young):
        path.write_bytes(b"half")
    age(old)
    unused_files.clear_away(context, ())
    assert (old.exists(), young.exists()) == (False, True)


def test_what_was_made_ahead_for_somebody_who_does_not_come_back_goes_after_two_weeks(context: WorkerContext) -> None:
    unfinished = context.store.unfinished
    left, present = unfinished.folder(1) / "ahead-0123", unfinished.folder(2) / "ahead-4567"
    for folder, days in ((left, 15), (present, 2)):
        folder.mkdir(parents=True)
        (folder / "state.safetensors").write_bytes(b"half way")
        age(folder, days)
    unused_files.clear_away(context, ())
    assert (left.exists(), present.exists()) == (False, True)
