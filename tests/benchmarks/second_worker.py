"""Prints what a second worker adds: seconds until clips are filmed and until people have filters, with one and two.

Workers are processes with a core and a data directory of their own, on one PostgreSQL server and one S3-compatible one,
as two machines with a core each would be. Clips, learning and simulation are the real ones; one and two take turns.

    python -m tests.benchmarks.second_worker --scenarios 5 --people 2 --rounds 2
"""

import argparse
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from sqlalchemy import func, select

from app.db import Database
from app.domain.clips import Clip
from app.domain.models import Bundle
from app.domain.preferences import LabelEvent, Query, Response
from app.domain.studies import Study
from tests import factories, on_postgresql, on_s3
from tests.benchmarks.cluster import PATIENCE_S, Cluster
from worker.rehearsal.server import wait_until

LABELS = 10


def main() -> int:
    """Take turns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", type=int, default=10, help="of the pool, with six behaviours each")
    parser.add_argument("--people", type=int, default=4, help="who give all their answers at once; 0: clips only")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2], help="numbers of them, one after the other")
    parser.add_argument("--rounds", type=int, default=2)
    options = parser.parse_args()
    programs = on_postgresql.find_programs()
    if programs is None:
        sys.stderr.write("This needs PostgreSQL: install your system's package 'postgresql'.\n")
        return 1
    for _ in range(options.rounds):
        for workers in options.workers:
            with ExitStack() as stack:
                url = stack.enter_context(on_postgresql.serving(programs))
                os.environ.update(stack.enter_context(on_s3.serving()))
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cluster-")))
                cluster = Cluster(folder, url, web_servers=0, worker_count=workers, pinned=True)
                stack.callback(cluster.stop)
                cluster.start()
                database = Database(cluster.settings.sqlalchemy_url)
                stack.callback(database.dispose)
                _measure(database, workers, options)
    return 0


def _measure(database: Database, workers: int, options: argparse.Namespace) -> None:
    with database.writing() as session:
        study = factories.make_study(
            session,
            pool_scenarios=options.scenarios,
            behaviours_per_scenario=6,
            labels_per_participant=LABELS,
            evaluation_scenarios=10,
            filter_milestones=(),
        )
        people = [factories.make_participant(session, study)[0].id for _ in range(options.people)]
    clips = 6 * options.scenarios
    filmed_s = _until(database, Clip, clips)
    for person in people:
        wait_until(PATIENCE_S, "pairs are missing", partial(_answer, database, study, person))
    learned_s = _until(database, Bundle, len(people))
    _say(
        f"{workers} worker(s): {clips} clips after {filmed_s:.0f} s, "
        f"{len(people)} filters {learned_s:.0f} s after the last answer"
    )


def _until(database: Database, table: type[Clip] | type[Bundle], wanted: int) -> float:
    """Say of each how many there are; returns the seconds until all are."""
    began, seen = time.monotonic(), 0
    while seen < wanted:
        count = _count(database, table)
        if count == seen:
            time.sleep(0.2)
            continue
        seen = count
        _say(f"  {seen} of {wanted} {table.__tablename__}s after {time.monotonic() - began:.1f} s")
    return time.monotonic() - began


def _answer(database: Database, study: Study, person: int) -> bool | None:
    """Give all answers once there are pairs for them."""
    with database.writing() as session:
        unanswered = select(Query).where(Query.participant_id == person).order_by(Query.ordinal).limit(LABELS)
        queries = session.scalars(unanswered).all()
        if len(queries) < study.settings.labels_per_participant:
            return None
        for number, query in enumerate(queries):
            if session.scalar(select(LabelEvent.id).where(LabelEvent.query_id == query.id)) is None:
                factories.make_label(session, query, Response.LEFT if number % 3 else Response.RIGHT)
    return True


def _count(database: Database, table: type[Clip] | type[Bundle]) -> int:
    with database.reading() as session:
        return session.scalar(select(func.count(table.id))) or 0


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
