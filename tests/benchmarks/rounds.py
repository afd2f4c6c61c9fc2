"""Prints what a look at the database costs a worker, by the number of participants who have finished.

    python -m tests.benchmarks.rounds 1 10 60

Nothing is left to do for them, so this is what a studio pays for its past: milliseconds of processor time for a round
(reconcile), which follows every change of the database, and for finding out that nothing has changed (Database.watch).
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

from app.__main__ import migrate
from app.db import Database
from app.domain.models import Run, RunKind, RunStatus
from app.domain.studies import Participant
from app.domain.study_settings import PAPER_PROTOCOL
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from worker.jobs import reconcile
from worker.jobs.runtime import records
from worker.jobs.upkeep import erasure

CLIPS = 24
REPEATS = 20


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("people", type=int, nargs="*", default=[1, 10, 60], help="numbers of them")
    for people in parser.parse_args().people:
        with tempfile.TemporaryDirectory() as directory:
            database = _finished_study(Path(directory), people)
            with closing(database.watch()) as watch:
                looking = _milliseconds(watch.changed)
            whole = _milliseconds(partial(_round, database))
            database.dispose()
        sys.stdout.write(f"{people:4d} participants: a round {whole:.1f} ms, nothing changed {looking:.3f} ms\n")


def _finished_study(directory: Path, people: int) -> Database:
    """Everybody has answered 201 pairs of the paper's protocol, and every job for them has been done."""
    settings = Settings(_env_file=None, data_dir=directory)
    migrate(settings)
    database, store = Database(settings.sqlalchemy_url), ArtefactStore(directory / "artefacts")
    with database.writing() as session:
        study = factories.make_study(session, **PAPER_PROTOCOL.model_dump())
        clips = [factories.make_clip(session, store, study) for _ in range(CLIPS)]
        for _ in range(people):
            participant, _ = factories.make_participant(session, study)
            for number in range(PAPER_PROTOCOL.practice_pairs + PAPER_PROTOCOL.question_count):
                pair = clips[number % (CLIPS - 1)], clips[number % (CLIPS - 1) + 1]
                factories.make_label(session, factories.make_query(session, participant, *pair))
        while jobs := [job for job, _ in reconcile.due(session) if job.participant_id is not None]:
            for job in jobs:
                run = session.get_one(Run, records.begin_run(session, job, seed=1))
                run.status = RunStatus.SUCCEEDED
                if job.kind == RunKind.REWARD:
                    for _ in range(19):  # after every tenth answer before the last
                        factories.make_run(session, study, session.get_one(Participant, job.participant))
            session.flush()
    return database


def _round(database: Database) -> None:
    with database.reading() as session:
        list(reconcile.due(session))
        reconcile.short_of_queries(session)
        reconcile.abandoned(session, ())
        reconcile.studies_with_answers(session)
        erasure.unfinished(session)


def _milliseconds(work: Callable[[], object]) -> float:
    work()
    started = time.process_time()
    for _ in range(REPEATS):
        work()
    return 1000 * (time.process_time() - started) / REPEATS


if __name__ == "__main__":
    main()
