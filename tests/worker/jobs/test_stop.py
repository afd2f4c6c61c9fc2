"""A worker that is told to stop has stopped ten seconds later, whatever it is doing."""

import os
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing

import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.models import Run, RunStatus, WorkerPresence
from app.domain.study_settings import StudySettings
from app.services.studies import studies
from app.settings import Settings
from tests import databases
from tests.processes import compute_processes, fork_servers
from tests.waiting import PATIENCE_S, gone, hear_hangups, until

pytestmark = pytest.mark.slow

AT_MOST_S = 10.0
"""As promised. After seven seconds a thread that does nothing else ends the worker, so a busy machine adds little."""

Worker = subprocess.Popen[bytes]


@pytest.fixture
def worker(settings: Settings, database: Database) -> Iterator[Worker]:
    """A worker that has only just been started, with work at hand."""
    with database.writing() as session:
        studies.create_study(session, "Study", StudySettings(labels_per_participant=20, pool_scenarios=2))
    environment = databases.environment(settings.data_dir, COMPUTE_PROCESSES="1")
    process = subprocess.Popen([sys.executable, "-m", "worker", "run"], env=environment, preexec_fn=hear_hangups)
    yield process
    for pid in (*compute_processes(process.pid), *fork_servers(process.pid), process.pid):
        if not gone(pid):
            os.kill(pid, signal.SIGKILL)
    process.wait()


def is_filming(database: Database) -> bool:
    with database.reading() as session:
        return session.scalar(select(Run.id).where(Run.status == RunStatus.RUNNING)) is not None


def is_present(database: Database) -> bool:
    with database.reading() as session:
        return session.scalar(select(WorkerPresence.name)) is not None


def stops(process: Worker, number: int = signal.SIGTERM) -> bool:
    """Whether it has ended in time, its compute processes and what forks them as well."""
    computing = [*fork_servers(process.pid), *compute_processes(process.pid)]
    process.send_signal(number)
    try:
        process.wait(AT_MOST_S)
    except subprocess.TimeoutExpired:
        return False
    return until(lambda: all(gone(pid) for pid in computing))


@pytest.mark.long
def test_while_it_starts(worker: Worker, settings: Settings) -> None:
    assert until((settings.data_dir / "worker-1.lock").exists)  # and now it loads what it needs
    assert stops(worker)


OTHER_SIGNALS = [pytest.param(number, marks=pytest.mark.long) for number in (signal.SIGINT, signal.SIGHUP)]


@pytest.mark.parametrize("number", [signal.SIGTERM, *OTHER_SIGNALS])
def test_while_it_films(worker: Worker, database: Database, number: int) -> None:
    assert until(lambda: is_filming(database))
    assert stops(worker, number)
    assert worker.returncode == 0, "in good order"


@pytest.mark.long
def test_while_its_compute_processes_are_stopped(worker: Worker, database: Database) -> None:
    assert until(lambda: is_filming(database) and len(compute_processes(worker.pid)) > 0)
    for pid in compute_processes(worker.pid):
        os.kill(pid, signal.SIGSTOP)
    assert stops(worker)


@pytest.mark.long
def test_while_its_compute_processes_are_killed(worker: Worker, database: Database) -> None:
    assert until(lambda: is_filming(database) and len(compute_processes(worker.pid)) > 0)
    for pid in compute_processes(worker.pid):
        os.kill(pid, signal.SIGKILL)
    assert stops(worker)


@pytest.mark.long
def test_while_what_forks_its_compute_processes_is_killed(worker: Worker, database: Database) -> None:
    assert until(lambda: is_filming(database) and len(compute_processes(worker.pid)) > 0)
    (server,) = fork_servers(worker.pid)
    orphans = compute_processes(worker.pid)
    os.kill(server, signal.SIGKILL)
    assert until(lambda: all(gone(pid) for pid in orphans))
    assert until(lambda: len(compute_processes(worker.pid)) > 0), "there is another, and it goes on"
    assert stops(worker)


@pytest.mark.parametrize("file", ["studio.sqlite3", pytest.param("engine.sqlite3", marks=pytest.mark.long)])
def test_while_somebody_else_has_locked_its_files(
    worker: Worker, database: Database, settings: Settings, file: str
) -> None:
    assert until(lambda: is_present(database))
    with closing(sqlite3.connect(settings.data_dir / file, timeout=PATIENCE_S, isolation_level=None)) as connection:
        connection.execute("BEGIN IMMEDIATE" if file == "studio.sqlite3" else "BEGIN EXCLUSIVE")
        threading.Event().wait(2.0)  # longer than between two signs of its life; a wait for nothing tests less
        assert stops(worker)
