"""The drill: people answer and files come and go while a backup is made, programs are killed, and it is restored."""

import os
import random
import shutil
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.request import urlopen

from sqlalchemy import select

from app.db import Database
from app.domain.clips import Clip, Rollout
from app.domain.preferences import LabelEvent, Query
from app.domain.studies import Study
from app.main import create_app
from app.services.backups import layout, making, restoring
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.answering import Labeller, Server
from tests.conftest import serving
from tests.databases import make_tables
from tests.waiting import PATIENCE_S, free_port

PEOPLE = 4
POOL = 20


@dataclass
class Tally:
    """What the trials came to."""

    whole: int = 0
    lost: int = 0
    """Answers that were acknowledged before a backup began and are not in the restored studio."""
    kills: int = 0
    answers: int = 0


class Drill:
    """A studio under load, and trials with it."""

    def __init__(self, directory: Path, answers: int, pause_s: float, seed: int) -> None:
        self.directory, self.backups = directory, directory / "backups"
        self.settings = Settings(_env_file=None, data_dir=directory / "data", database_url=None, port=free_port())
        self.random = random.Random(seed)  # noqa: S311  (no secret)
        self.acknowledged: Counter[str] = Counter()
        self.tally = Tally()
        self._tokens = self._fill(answers)
        self._pause_s = pause_s
        self._given = threading.Semaphore(0)

    def _fill(self, answers: int) -> list[str]:
        database, store = Database(self.settings.sqlalchemy_url), ArtefactStore.of(self.settings)
        make_tables(database)
        tokens = []
        with database.writing() as session:
            study = factories.make_study(session, labels_per_participant=answers, pool_scenarios=500, break_every=0)
            clips = [factories.make_clip(session, store, study) for _ in range(POOL)]
            for rollout in session.scalars(select(Rollout)):
                rollout.trajectory_sha256 = store.put(f"trajectory {rollout.id}".encode())
            for _ in range(PEOPLE):
                participant, token = factories.make_participant(session, study)
                tokens.append(token)
                session.add_all(
                    Query(
                        participant_id=participant.id,
                        ordinal=number + 1,
                        left_clip_id=clips[number % POOL].id,
                        right_clip_id=clips[(number + 1) % POOL].id,
                        strategy="uniform",
                        propensity=1.0,
                    )
                    for number in range(answers)
                )
        database.dispose()
        return tokens

    @contextmanager
    def under_load(self) -> Iterator[Server]:
        """People answer, and clips that nobody is asked about are made and removed again."""
        server, stop = Server(self.settings), threading.Event()
        labellers = [
            Labeller(server.address, token, self.acknowledged, self._given, self._pause_s) for token in self._tokens
        ]
        remaking = threading.Thread(target=self._remake, args=(stop,))
        threads = [*labellers, remaking]
        for thread in threads:
            thread.start()
        try:
            yield server
        finally:
            stop.set()
            for labeller in labellers:
                labeller.enough.set()
            for thread in threads:
                thread.join()
            server.kill()
            self.tally.answers = len(self.acknowledged)

    def _remake(self, stop: threading.Event) -> None:
        database, store = Database(self.settings.sqlalchemy_url), ArtefactStore.of(self.settings)
        while not stop.wait(0.5):
            with database.writing() as session:
                clip = factories.make_clip(session, store, session.get_one(Study, 1))
                rollout = session.get_one(Rollout, clip.rollout_id)
                rollout.trajectory_sha256 = store.put(f"trajectory {rollout.id} again".encode())
            if stop.wait(0.5):
                break
            with database.writing() as session:
                clip, rollout = session.get_one(Clip, clip.id), session.get_one(Rollout, rollout.id)
                names = clip.video_sha256, clip.poster_sha256, rollout.trajectory_sha256
                session.delete(clip)
                session.flush()
                session.delete(rollout)
                for sha256 in names:
                    store.delete(sha256)
        database.dispose()

    def trial(self, server: Server, *, kill_server: bool, kill_backup: bool) -> None:
        """One backup, restored elsewhere. Raises when it is not whole; counts what is lost."""
        while self._given.acquire(blocking=False):
            pass
        assert self._given.acquire(timeout=PATIENCE_S), "people answer at this moment, also after a kill"
        before = set(self.acknowledged)
        killer = threading.Timer(self.random.uniform(0.0, 0.3), server.kill) if kill_server else None
        if killer is not None:
            killer.start()
        if kill_backup:
            self._kill_a_backup()
        folder = making.make(self.settings, self.backups).folder
        if killer is not None:
            killer.join()
            server.start()
            self.tally.kills += 1
        restored = self.settings.model_copy(update={"data_dir": self.directory / "restored"})
        manifest = restoring.verify(restored, folder).manifest
        assert manifest.missing == []
        restoring.restore(restored, folder)
        with serving(create_app(restored)) as address, urlopen(f"{address}/health") as answer:  # noqa: S310
            assert answer.read() == b"ok"
        database = Database(restored.sqlalchemy_url)
        with database.reading() as session:
            there = list(session.scalars(select(LabelEvent.client_uuid)))
        database.dispose()
        assert len(set(there)) == len(there)
        self.tally.lost += len(before - set(there))
        self.tally.whole += 1
        shutil.rmtree(restored.data_dir)
        for old in layout.folders_in(self.backups)[:-2]:
            making.erase(old)

    def _kill_a_backup(self) -> None:
        """Begin one in a process of its own and kill it outright; it is there as a whole or not at all."""
        known = set(layout.folders_in(self.backups))
        command = [sys.executable, "-m", "app", "backup", str(self.backups)]
        environment = {**os.environ, "DATA_DIR": str(self.settings.data_dir)}
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
        deadline = self.random.uniform(0.0, 0.3)
        while process.poll() is None and not list(self.backups.glob(".making-*")):
            threading.Event().wait(0.005)
        threading.Event().wait(deadline)
        process.kill()
        process.wait()
        self.tally.kills += 1
        for folder in set(layout.folders_in(self.backups)) - known:
            restoring.verify(self.settings, folder)
