"""Prints whether PostgreSQL goes back to any moment as docs/backups.md says: base backup, archived log, recovery.

    python -m tests.benchmarks.point_in_time --trials 5

A studio's server of its own archives its log while answers are saved. Somebody drops the table of answers. Then the
server is brought back to moments between two answers, drawn at random, and what is there is compared with what was.
"""

import argparse
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import psycopg
from sqlalchemy import select, text

from app.__main__ import migrate
from app.db import Database
from app.domain.clips import Clip
from app.domain.preferences import LabelEvent, Query
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories, on_postgresql
from tests.waiting import until

ANSWERS = 60
BEFORE_BASE = 20
"""Answers that are in the base backup already."""
PAUSE_S = 0.05
ARCHIVE_TIMEOUT_S = 60


def main() -> int:
    """One disaster, and as many ways back as wanted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=5, help="moments to go back to")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    programs = on_postgresql.find_programs()
    if programs is None:
        sys.stderr.write("This needs PostgreSQL: install your system's package 'postgresql'.\n")
        return 1
    with tempfile.TemporaryDirectory(prefix="point-in-time-") as name:
        folder = Path(name)
        if os.geteuid() == 0:
            shutil.chown(folder, on_postgresql.SERVER_USER)
        base, archive = folder / "base", folder / "archive"
        on_postgresql.run(["mkdir", str(archive)], name)
        moments = _live(programs, folder, base, archive)
        rng = random.Random(options.seed)  # noqa: S311  (no secret)
        for kept in sorted(rng.sample(range(BEFORE_BASE, ANSWERS), options.trials)):
            _go_back(programs, folder, base, archive, moments, kept)
    return 0


def _live(programs: Path, folder: Path, base: Path, archive: Path) -> Sequence[datetime]:
    """Save answers, make the base backup meanwhile, lose them all. Returns the moments after each of them."""
    configuration = {
        "wal_level": "replica",
        "archive_mode": "on",
        "archive_command": f"test ! -f {archive}/%f && cp %p {archive}/%f",
        "archive_timeout": str(ARCHIVE_TIMEOUT_S),
    }
    moments = []
    with on_postgresql.serving(programs, configuration) as url:
        host = on_postgresql.folder_of(url)
        migrate(_settings(folder, url))
        with _opened(url) as database:
            queries = _studio(database, folder)
            for number, query in enumerate(queries):
                if number == BEFORE_BASE:
                    began = time.monotonic()
                    making = [
                        f"{programs}/pg_basebackup",
                        "--checkpoint=fast",
                        "-h",
                        host,
                        "-U",
                        "studio",
                        "-D",
                        str(base),
                    ]
                    on_postgresql.run(making, str(folder))
                    _say(f"base backup: {time.monotonic() - began:.1f} s")
                with database.writing() as session:
                    factories.make_label(session, session.get_one(Query, query))
                time.sleep(PAUSE_S)
                with database.reading() as session:
                    moments.append(session.scalar(text("SELECT clock_timestamp()")))
                time.sleep(PAUSE_S)
            with database.writing() as session:
                session.execute(text("DROP TABLE label_event CASCADE"))
        archived = _count(archive)
        _say(f"segments archived when the table was dropped: {archived}")
        began = time.monotonic()
        until(lambda: _count(archive) > archived)
        _say(f"the last answers are in the archive {time.monotonic() - began:.0f} s later")
    return moments


def _go_back(programs: Path, folder: Path, base: Path, archive: Path, moments: Sequence[datetime], kept: int) -> None:
    """To the moment after so many answers."""
    data = folder / f"back-to-{kept}"
    on_postgresql.run(["cp", "-a", str(base), str(data)], str(folder))
    on_postgresql.run(["touch", f"{data}/recovery.signal"], str(folder))
    recovery = {
        "restore_command": f"cp {archive}/%f %p",
        "recovery_target_time": moments[kept - 1].isoformat(),
        "recovery_target_action": "promote",
    }
    began = time.monotonic()
    with on_postgresql.running(programs, data, recovery) as url:
        until(lambda: not _is_recovering(url))
        took_s = time.monotonic() - began
        migrate(_settings(folder, url))  # as every start does
        with _opened(url) as database, database.writing() as session:
            answered = len(session.scalars(select(LabelEvent.id)).all())
            files = session.scalars(select(Clip.video_sha256)).all()
            whole = sum(map(ArtefactStore.of(_settings(folder, url)).has, files))
            factories.make_label(session, session.scalars(select(Query).order_by(Query.id.desc()).limit(1)).one())
    _say(f"back after {took_s:.1f} s to {kept} answers: {answered} are there, {whole} of {len(files)} files")


@contextmanager
def _opened(url: str) -> Iterator[Database]:
    database = Database(url)
    try:
        yield database
    finally:
        database.dispose()


def _settings(folder: Path, url: str) -> Settings:
    return Settings(_env_file=None, data_dir=folder / "studio", database_url=url)


def _studio(database: Database, folder: Path) -> Sequence[int]:
    """The ids of the pairs of one participant."""
    store = ArtefactStore(folder / "studio" / "artefacts")
    with database.writing() as session:
        study = factories.make_study(session)
        person, _ = factories.make_participant(session, study)
        clips = [factories.make_clip(session, store, study) for _ in range(4)]
        return [factories.make_query(session, person, clips[0], clips[1]).id for _ in range(ANSWERS + 1)][:ANSWERS]


def _count(archive: Path) -> int:
    return len(list(archive.iterdir()))


def _is_recovering(url: str) -> bool:
    with psycopg.connect(host=on_postgresql.folder_of(url), user="studio", dbname="postgres") as connection:
        row = connection.execute("SELECT pg_is_in_recovery()").fetchone()
    return row is None or bool(row[0])


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
