"""Prints how many of so many backups of a studio under load are whole, and what backups of a large study cost.

python -m tests.benchmarks.backups --trials 100 --people 100 --answers 200
"""

import argparse
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

from sqlalchemy import select

from app.__main__ import migrate
from app.db import Database
from app.domain.clips import Rollout
from app.domain.models import ModelKind
from app.domain.preferences import Response
from app.services.backups import making, restoring
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.backup_drill import Drill

POOL = 400
FILTERS = 4
"""Published per participant, with a reward model each."""
REWARD_MODELS = 10
FILMS = 18
"""Of each participant: three methods in six scenarios."""
SIZES = {"clip": 150_000, "poster": 27_000, "trajectory": 60_000, "model": 110_000, "bundle": 420_000}
"""Bytes; of the demo study's files, and of sharp clips (docs/results/films.md)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--people", type=int, default=100, help="0: only the trials")
    parser.add_argument("--answers", type=int, default=200, help="of each of them")
    parser.add_argument("--directory", type=Path, help="on the disk that is to be measured; default: a temporary one")
    parser.add_argument("--seed", type=int, default=0)
    said = parser.parse_args()
    os.umask(0o077)
    with tempfile.TemporaryDirectory(dir=said.directory) as name:
        _trials(Path(name) / "drill", said.trials, said.seed)
    with tempfile.TemporaryDirectory(dir=said.directory) as name:
        if said.people:
            _cost(Path(name), said.people, said.answers)


def _trials(directory: Path, count: int, seed: int) -> None:
    drill, started = Drill(directory, answers=min(1000, 30 * count + 100), pause_s=0.4, seed=seed), time.perf_counter()
    with drill.under_load() as server:
        for number in range(count):
            drill.trial(server, kill_server=number % 4 == 1, kill_backup=number % 4 == 3)
            if (number + 1) % 10 == 0:
                _say(f"{number + 1} trials after {time.perf_counter() - started:.0f} s")
    tally = drill.tally
    _say(
        f"{tally.whole} of {count} backups whole and restored; {tally.lost} of {tally.answers} acknowledged answers "
        f"lost; {tally.kills} programs killed; {time.perf_counter() - started:.0f} s"
    )


def _cost(directory: Path, people: int, answers: int) -> None:
    settings = Settings(_env_file=None, data_dir=directory / "data", database_url=None)
    _fill(settings, people, answers)
    _say(f"{people} participants with {answers} answers each: {_size(settings.data_dir)}")
    started = time.perf_counter()
    first = making.make(settings, directory / "backups")
    _say(f"first backup   {time.perf_counter() - started:6.1f} s, {_size(first.folder)}")
    alone = _used_bytes(directory / "backups")
    started = time.perf_counter()
    second = making.make(settings, directory / "backups")
    more = _used_bytes(directory / "backups") - alone
    _say(f"next backup    {time.perf_counter() - started:6.1f} s, {more / 1e6:.1f} MB more on the disk")
    started = time.perf_counter()
    restoring.verify(settings, second.folder)
    _say(f"verification   {time.perf_counter() - started:6.1f} s")
    started = time.perf_counter()
    restoring.restore(settings, second.folder, directory / "restored")
    _say(f"restoring      {time.perf_counter() - started:6.1f} s")
    started = time.perf_counter()
    shutil.copytree(settings.data_dir / "artefacts", directory / "copied")
    _say(f"plain copy     {time.perf_counter() - started:6.1f} s, for comparison: neither checked nor flushed to disk")


def _fill(settings: Settings, people: int, answers: int) -> None:
    """A study as large as a finished one, its files filled with noise of the usual sizes."""
    migrate(settings)
    database, store = Database(settings.sqlalchemy_url), ArtefactStore.of(settings)
    with database.writing() as session:
        study = factories.make_study(session, labels_per_participant=answers, pool_scenarios=500, break_every=0)
        clips = [factories.make_clip(session, store, study) for _ in range(POOL)]
        for clip in clips:
            store.delete(clip.video_sha256)
            store.delete(clip.poster_sha256)
            clip.video_sha256, clip.poster_sha256 = store.put(_noise("clip")), store.put(_noise("poster"))
        for rollout in session.scalars(select(Rollout)):
            rollout.trajectory_sha256 = store.put(_noise("trajectory"))
        for _ in range(people):
            participant, _ = factories.make_participant(session, study)
            for number in range(answers):
                pair = clips[number % POOL], clips[(number + 1) % POOL]
                query = factories.make_query(session, participant, *pair, predicted_right=0.5)
                factories.make_label(session, query, Response.LEFT, response_time_ms=4000)
            for number in range(REWARD_MODELS + FILTERS):
                kind = ModelKind.REWARD if number < REWARD_MODELS else ModelKind.FILTER
                model = factories.make_model(session, study, participant, kind, {"accuracy": 0.8})
                model.artefact_sha256 = store.put(_noise("model"))
                if kind is ModelKind.FILTER:
                    factories.make_bundle(session, store, model, _noise("bundle"))
            for scenario in range(FILMS):
                film = factories.make_film(session, store, participant, "pbarl", scenario=scenario)
                film.video_sha256, film.poster_sha256 = store.put(_noise("clip")), store.put(_noise("poster"))
                film.trajectory_sha256 = store.put(_noise("trajectory"))
    database.dispose()


def _noise(kind: str) -> bytes:
    return os.urandom(SIZES[kind])


def _size(folder: Path) -> str:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return f"{len(files)} files, {sum(path.stat().st_size for path in files) / 1e6:.0f} MB"


def _used_bytes(folder: Path) -> int:
    """On the disk, with folders, and what is shared only once."""
    found = {(stat.st_ino): stat.st_blocks * 512 for stat in (path.stat() for path in folder.rglob("*"))}
    return sum(found.values())


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
