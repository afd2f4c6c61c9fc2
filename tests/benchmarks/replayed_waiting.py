"""Prints how long people wait for their first robot when the worker orders its work, without the work itself.

The worker is the real one: database, rounds, durable engine, queues, lanes of compute processes. Its tasks only occupy
one of two processors for as long as such tasks took on two quiet cores (docs/results/rehearsal.md, retraining.md), in
slices of a tenth of a second, so that lanes share processors as they would. A study that nobody has opened is short of
clips all the time. Run it on a machine of any load; copied into an older tree it measures that one.

    python -m tests.benchmarks.replayed_waiting
"""

import argparse
import fcntl
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

from sqlalchemy import select

from app.__main__ import migrate
from app.db import Database, now
from app.domain.clips import Rollout
from app.domain.models import ModelKind, Run, RunKind, RunStatus
from app.domain.protocol import PAPER_METHODS, EvaluationSettings
from app.domain.studies import Participant, Study
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.services.studies import studies
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from worker.compute import learning as lessons
from worker.compute import simulation
from worker.compute.pools import Lane
from worker.jobs import service, workflows
from worker.jobs.learning import reference_rollouts
from worker.jobs.runtime import records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job

LABELS, TRIALS, BEHAVIOURS = 12, 3, 6
SLICE_S = 0.1
ORDERED = hasattr(Participant, "waiting_for")
"""False for trees that knew nothing of who waits."""
CLIP_S, FILM_S = 3.0, 5.0
STAGES = ((2, 27, 0.5), (3, 17, 0.5), (3, 1, 4.0), (1, 27, 0.5), (1, 34, 0.5))
"""Of a filter, 37 s on two quiet cores: how often, how many tasks at a time, seconds of each."""
PREFFT_S = 20.0
"""At 2000 steps."""


def busy(seconds: float) -> None:
    """Occupy one of two processors for so long."""
    cores = [(Path(os.environ["DATA_DIR"]) / f"core-{index}").open("w") for index in range(2)]
    while seconds > 0:
        for core in cores:
            with suppress(BlockingIOError):
                fcntl.flock(core, fcntl.LOCK_EX | fcntl.LOCK_NB)
                time.sleep(SLICE_S)
                fcntl.flock(core, fcntl.LOCK_UN)
                seconds -= SLICE_S
                break
        else:
            time.sleep(0.01)


def nothing(*_arguments: Any) -> None:
    """What is made ready beforehand."""


def clips(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    scenario = job.number
    for first in range(0, BEHAVIOURS, 2):
        context.report(run_id, "filming", first / BEHAVIOURS)
        context.compute.run_all(Lane.CLIPS, context.beat(run_id), busy, [(CLIP_S,)] * 2)
        with context.database.writing() as session:
            for behaviour in (first, first + 1):
                files = {"width": 1, "height": 1, "fps": 15, "duration_ms": 1, "byte_count": 1}
                hashes = dict.fromkeys(("video_sha256", "poster_sha256"), f"{scenario:060d}{behaviour:04d}")
                steps = session.get_one(Study, job.study_id).settings.clip_steps
                rollout = {"scenario": scenario, "behaviour": behaviour, "mode": {}, "success": True}
                clip = {"first_step": 0, "step_count": steps, **files, **hashes}
                records.save_clip(session, job.study_id, {**rollout, "trajectory_sha256": "0" * 64}, clip)


def learning(lane: Lane, stages: tuple[tuple[int, int, float], ...]) -> Callable[..., None]:
    def work(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
        total, done = sum(often * tasks * each for often, tasks, each in stages), 0.0
        for often, tasks, each in stages:
            for _ in range(often):
                context.report(run_id, "at work", done / total)
                context.compute.run_all(lane, context.beat(run_id), busy, [(each,)] * tasks)
                done += tasks * each
        with context.database.writing() as session:
            records.set_labels(session, run_id, LABELS, "hash")
            records.save_model(session, run_id, ModelKind(str(job.kind)), "0" * 64, {"method": "prefft"})

    return work


def films(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    count = 3 * TRIALS if job.about.subject == "trials" else 4
    for first in range(0, count, 2):
        context.report(run_id, "filming", first / count)
        context.compute.run_all(Lane.CLIPS, context.beat(run_id), busy, [(FILM_S,)] * min(2, count - first))


def quick(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    context.compute.run(Lane.LEARNING, context.beat(run_id), busy, 2.0)


def serve() -> None:
    """The worker, with tasks that only take their time."""
    workflows.BODIES.update(
        {
            RunKind.CLIPS: clips,
            RunKind.REWARD: learning(Lane.REWARDS, ((1, 1, 1.0),)),
            RunKind.FILTER: learning(Lane.LEARNING, STAGES),
            RunKind.METHOD: learning(Lane.PATIENT, ((20, 1, PREFFT_S / 20),)),
            RunKind.FILMS: films,
            RunKind.REPORT: quick,
        }
    )
    for module, name in ((simulation, "warm_up"), (lessons, "warm_up"), (reference_rollouts, "make_ready")):
        setattr(module, name, nothing)
    service.run(Settings())


class Lab:
    """A studio without pages: people are rows, and looking at a waiting page is a write."""

    def __init__(self, directory: Path) -> None:
        self.settings = Settings(_env_file=None, data_dir=directory, database_url=None)
        migrate(self.settings)
        self.database = Database(self.settings.sqlalchemy_url)
        self.store = ArtefactStore(directory / "artefacts")
        small = {
            "labels_per_participant": LABELS,
            "introduction_pairs": 0,
            "practice_pairs": 0,
            "filter_milestones": (),
            "pool_scenarios": 1,
            "evaluation": EvaluationSettings(methods=PAPER_METHODS, fine_tuning_steps=2_000, trials=TRIALS),
        }
        with self.database.writing() as session:
            studies.create_study(session, "Nobody's", StudySettings(pool_scenarios=500), seed=1)
            settings = StudySettings(**{**PAPER_PROTOCOL.model_dump(), **small})
            self.study = studies.create_study(session, "Somebody's", settings, seed=2)

    def finishes(self) -> Participant:
        """Somebody gives the last answer."""
        with self.database.writing() as session:
            study = session.get_one(Study, self.study.id)
            person, _ = factories.make_participant(session, study)
            factories.answer_everything(session, self.store, study, person)
        return person

    def looks(self, person: Participant, since: Any) -> None:
        """They have a waiting page before them."""
        with self.database.writing() as session:
            present = session.get_one(Participant, person.id)
            present.last_seen_at = now()
            if ORDERED:
                present.waiting_for, present.waiting_since = "robots", since

    def leaves(self, person: Participant) -> None:
        """Their page was closed a while ago."""
        with self.database.writing() as session:
            session.get_one(Participant, person.id).last_seen_at = now() - timedelta(minutes=10)

    def wait(self, person: Participant) -> tuple[float, list[tuple[float, int | None]]]:
        """Seconds to the first robot, and what was foretold meanwhile: (when, seconds left)."""
        since, began, told = now(), time.monotonic(), list[tuple[float, int | None]]()
        while not self._has_robot(person):
            self.looks(person, since)
            if ORDERED:
                told.append((time.monotonic() - began, self._foretold(person)))
            time.sleep(2.0)
        return time.monotonic() - began, told

    def _has_robot(self, person: Participant) -> bool:
        """Today the first films are enough; before, all of them were needed."""
        with self.database.reading() as session:
            filming = select(Run).where(Run.participant_id == person.id, Run.workflow_id.contains("/trials/"))
            run = session.scalar(filming)
        return run is not None and (run.status == RunStatus.SUCCEEDED or (ORDERED and run.progress > 0))

    def _foretold(self, person: Participant) -> int | None:
        from app.services.evaluation import robot_preparation  # not in older trees

        with self.database.reading() as session:
            whole = session.get_one(Participant, person.id)
            whole.study = session.get_one(Study, whole.study_id)
            return robot_preparation.preparation(session, whole).seconds_left


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="?", choices=["serve"], help="the worker alone, as this program starts it")
    if parser.parse_args().part == "serve":
        serve()
        return
    with tempfile.TemporaryDirectory() as directory:
        lab = Lab(Path(directory))
        environment = {**os.environ, "DATA_DIR": directory}
        worker = subprocess.Popen(
            [sys.executable, "-m", "tests.benchmarks.replayed_waiting", "serve"],
            env=environment,
            stderr=subprocess.DEVNULL,
        )
        try:
            time.sleep(20.0)  # the idle study's clips are under way
            for number in (1, 2, 3):
                _say(f"alone, {number}", *lab.wait(lab.finishes()))
            for number in (1, 2):
                lab.leaves(lab.finishes())
                time.sleep(4.0)
                _say(f"after one more who has left, {number}", *lab.wait(lab.finishes()))
            with lab.database.reading() as session:
                made = len(session.scalars(select(Rollout.id).where(Rollout.study_id == 1)).all())
            sys.stdout.write(f"clips made for nobody meanwhile: {made}\n")
        finally:
            worker.terminate()
            worker.wait()


def _say(who: str, waited_s: float, told: list[tuple[float, int | None]]) -> None:
    sys.stdout.write(f"{who}: first robot after {waited_s:.0f} s\n")
    known = [(at_s, left_s) for at_s, left_s in told if left_s is not None]
    for share in (0.05, 0.35, 0.65):
        late = [each for each in known if each[0] >= share * waited_s]
        if late:
            at_s, left_s = late[0]
            sys.stdout.write(f"    at {at_s:.0f} s it said {left_s} s to go; it took {waited_s - at_s:.0f} s\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
