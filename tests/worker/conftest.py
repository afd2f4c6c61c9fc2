"""A study in a database of its own, with trajectories made of numbers instead of physics."""

import io
import itertools
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.choices import ClipQuality
from app.domain.clips import Clip, Rollout
from app.domain.preferences import LabelEvent, Query, Response
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.settings import Settings
from app.storage import ArtefactStore
from tests.databases import make_tables
from tests.worker.traced import traced_once  # noqa: F401
from worker.compute.pools import Compute
from worker.domain.trajectory import COSTS, SIGNALS, Trajectory
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.lanes import Lanes
from worker.jobs.workflows import JobRunner
from worker.sim.render.video import encode_mp4

STEPS = 20


@cache
def the_job_runner() -> JobRunner:
    """The engine knows one job runner per process; whoever borrows it gives it a context."""
    return JobRunner(cast("WorkerContext", None), Lanes(Compute(1)))


def make_trajectory(scenario: int, behaviour: int, steps: int = STEPS) -> Trajectory:
    """Random arrays of the right shapes, the same for the same arguments."""
    rng = np.random.default_rng([scenario, behaviour])

    def some(*shape: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        return rng.random(shape, np.float32)

    return Trajectory(
        observations=some(steps + 1, 28),
        actions=some(steps, 7),
        reference_actions=some(steps, 7),
        signals=some(steps, len(SIGNALS)),
        costs=some(steps, len(COSTS)),
        task_rewards=some(steps),
        joint_positions=some(steps + 1, 7),
        particles=some(steps + 1, 8, 3),
        head_quaternions=some(steps + 1, 4),
        arm_positions_rad=some(steps + 1, 2, 4),
        target_m=some(steps + 1, 3),
        contact_force_n=some(steps),
        success=True,
        scenario=scenario,
        task="feeding",
        body="slim",
        skin_tone=behaviour % 6,
    )


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(_env_file=None, data_dir=tmp_path / "data", port=0)


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    database = Database(settings.sqlalchemy_url)
    make_tables(database)
    yield database
    database.dispose()


@pytest.fixture
def store(settings: Settings) -> ArtefactStore:
    return ArtefactStore.of(settings)


@pytest.fixture
def study(database: Database) -> Study:
    wanted = StudySettings(
        labels_per_participant=20,
        retrain_every_labels=10,
        filter_milestones=(10,),
        clip_steps=STEPS,
        pool_scenarios=4,
        behaviours_per_scenario=4,
        clip_quality=ClipQuality.QUICK,
    )
    with database.writing() as session:
        study = Study(slug="study", name="Study", stored_settings=wanted.model_dump(mode="json"), seed=3)
        session.add(study)
    return study


@pytest.fixture
def participant(database: Database, study: Study) -> Participant:
    with database.writing() as session:
        participant = Participant(study_id=study.id, number=1, token_sha256="0" * 64, seed=5)
        session.add(participant)
    return participant


@pytest.fixture
def add_clips(database: Database, store: ArtefactStore, study: Study) -> Callable[[int, int], list[Clip]]:
    """Put behaviours 0 .. count - 1 of a scenario into the pool."""

    def add(scenario: int, count: int = 4) -> list[Clip]:
        with database.writing() as session:
            clips = [_clip(session, store, study.id, scenario, behaviour) for behaviour in range(count)]
        return clips

    return add


def filmed(session: Session, store: ArtefactStore) -> None:
    """Give every clip of the pool a real film, five pictures a second, that is no other's."""
    for number, clip in enumerate(session.scalars(select(Clip).order_by(Clip.id))):
        pictures = (np.full((48, 64, 3), 20 * number + step, np.uint8) for step in range(STEPS // 2))
        clip.video_sha256 = store.put(encode_mp4(pictures, 64, 48, 5))
        clip.width, clip.height, clip.fps = 64, 48, 5


def _clip(session: Session, store: ArtefactStore, study_id: int, scenario: int, behaviour: int) -> Clip:
    target = io.BytesIO()
    make_trajectory(scenario, behaviour).save(target)
    rollout = Rollout(
        study_id=study_id,
        scenario=scenario,
        behaviour=behaviour,
        mode={},
        trajectory_sha256=store.put(target.getvalue()),
        success=True,
    )
    session.add(rollout)
    session.flush()
    clip = Clip(
        rollout_id=rollout.id,
        first_step=0,
        step_count=STEPS,
        video_sha256=f"{scenario:032x}{behaviour:032x}",
        poster_sha256=f"{scenario:032x}{behaviour:032x}",
        width=640,
        height=480,
        fps=15,
        duration_ms=2000,
        byte_count=1,
    )
    session.add(clip)
    session.flush()
    return clip


@pytest.fixture
def answer(database: Database, participant: Participant) -> Callable[[Clip, Clip, Response], Query]:
    """Make the participant's next query and answer it."""
    ordinals, uuids = itertools.count(1), itertools.count()

    def say(left: Clip, right: Clip, response: Response) -> Query:
        with database.writing() as session:
            query = Query(
                participant_id=participant.id,
                ordinal=next(ordinals),
                left_clip_id=left.id,
                right_clip_id=right.id,
                strategy="uniform",
                propensity=0.1,
            )
            session.add(query)
            session.flush()
            session.add(LabelEvent(query_id=query.id, revision=1, response=response, client_uuid=f"{next(uuids)}"))
        return query

    return say
