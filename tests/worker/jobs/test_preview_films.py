"""Films that follow sliders, and the robot that is made of what somebody has set."""

from collections.abc import Callable
from uuid import uuid4

import numpy as np
import pytest
from sqlalchemy import select

from app.db import Database, now
from app.domain.clips import Clip
from app.domain.models import Model, ModelKind, RunKind
from app.domain.participation import StageRecord
from app.domain.preferences import Query, Response
from app.domain.protocol import EvaluatedMethod, Stage
from app.domain.self_setting import PreviewFilm, SelfSetting
from app.domain.studies import Participant, Study
from app.services.evaluation import evaluation_plan, self_setting
from app.storage import ArtefactStore
from tests.worker.at_hand import AtHand
from tests.worker.jobs.test_evaluation_films import LABELS, done, due, learn, names, settle
from worker.compute import baseline_fitting, preview_plan, simulation
from worker.compute.behaviours import DIFFERENT_ENOUGH
from worker.domain.scenarios import of_preview
from worker.jobs.clips import preview_films
from worker.jobs.clips.evaluation_films import make_films
from worker.jobs.clips.pool_clips import build_clips
from worker.jobs.learning.baselines import train_method
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.ml.export.run_controller import Controller
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.tasks import registry

MODE = {"speed_far": 0.3, "speed_near": -0.6, "from_below": 0.0, "to_side": 0.6, "press": 0.0}


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


@pytest.fixture
def all_said(add_clips: Callable[[int], list[Clip]], answer: Callable[[Clip, Clip, Response], Query]) -> None:
    """The participant has given the last label."""
    clips = [clip for scenario in range(3) for clip in add_clips(scenario)]
    for index in range(LABELS):
        answer(clips[index], clips[index + 1], Response.LEFT if index % 3 else Response.RIGHT)


def set_robot(database: Database, participant: Participant, mode: dict[str, float], *, finished: bool) -> SelfSetting:
    """Somebody has let a slider go, or (``finished``) gone on."""
    with database.writing() as session:
        known = session.scalars(select(StageRecord).where(StageRecord.participant_id == participant.id)).first()
        record = known or StageRecord(participant_id=participant.id, stage=Stage.SELF_SETTING)
        record.finished_at = now() if finished else None
        before = self_setting.newest(session, participant.id)
        setting = SelfSetting(
            participant_id=participant.id,
            revision=before.revision + 1 if before else 1,
            mode=mode,
            filmed=False,
            client_uuid=str(uuid4()),
            by_script=True,
        )
        session.add_all([record, setting])
    return setting


def settings_due(database: Database) -> list[str]:
    return [job.key for job in due(database, RunKind.CLIPS) if job.about.subject == "setting"]


@pytest.mark.parametrize("task", ["feeding", "drinking", "scratching"])
def test_films_ahead_show_every_slider_alone_and_fill_the_space_between(task: str) -> None:
    family = registry.task(task).modes
    modes = preview_plan.modes(family)
    low, high = (np.array([getattr(axis, end) for axis in family.axes]) for end in ("low", "high"))
    assert modes.shape == (preview_plan.COUNT, len(family.axes))
    assert len({tuple(each) for each in modes}) == len(modes)
    assert (modes >= low).all()
    assert (modes <= high).all()
    for index in range(len(low)):
        alone = {float(mode[index]) for mode in modes if not np.delete(mode, index).any()}
        assert {float(low[index]), float(high[index]), 0.0} <= alone
    somewhere = np.random.default_rng(1).uniform(low, high, (300, len(low)))
    apart = (np.abs(somewhere[:, None] - modes) / (high - low)).max(axis=2).min(axis=1)
    assert np.median(apart) < DIFFERENT_ENOUGH, "a person could see that most films show another setting"


@pytest.mark.slow
def test_films_are_made_ahead_once_with_the_axes_of_the_task(
    context: WorkerContext, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preview_plan, "COUNT", 2)
    with context.database.reading() as session:
        assert preview_films.due_ahead(session, study) == [], "nobody sets a robot"
    settle(context.database, study, methods=("pbarl", "self_set"))
    with context.database.reading() as session:
        (job,) = preview_films.due_ahead(session, session.get_one(Study, study.id))
    assert job.key == f"clips/study-{study.id}/preview-0"
    done(context, job, build_clips)
    done(context, job, build_clips)
    with context.database.reading() as session:
        known = session.get_one(Study, study.id)
        films = session.scalars(select(PreviewFilm).order_by(PreviewFilm.number)).all()
        assert preview_films.due_ahead(session, known) == []
    assert [each.name for each in self_setting.sliders_of(known)] == list(registry.task("feeding").modes.names)
    assert [set(film.mode.values()) for film in films] == [{0.0}, {0.0, -0.5}]
    assert all(context.store.has(film.video_sha256) for film in films)


@pytest.mark.slow
@pytest.mark.usefixtures("all_said")
def test_the_newest_setting_of_whoever_is_at_the_sliders_is_filmed(
    context: WorkerContext, study: Study, participant: Participant
) -> None:
    settle(context.database, study, methods=("pbarl", "self_set"))
    assert settings_due(context.database) == []
    with context.database.writing() as session:
        axes = {axis.name: [axis.low, axis.high] for axis in registry.task("feeding").modes.axes}
        session.get_one(Study, study.id).mode_axes = axes
    set_robot(context.database, participant, {**MODE, "press": 0.4}, finished=False)
    setting = set_robot(context.database, participant, MODE, finished=False)
    assert settings_due(context.database) == [f"clips/participant-{participant.id}/setting-{setting.id}"]
    (job,) = (job for job in due(context.database, RunKind.CLIPS) if job.about.subject == "setting")
    with context.database.writing() as session:
        records.begin_run(session, job, seed=1)
    later = set_robot(context.database, participant, {**MODE, "press": 0.4}, finished=False)
    assert settings_due(context.database) == [], "one at a time, so that the next one is the newest"
    with context.database.writing() as session:
        session.delete(session.get_one(SelfSetting, later.id))
    done(context, job, build_clips)
    assert settings_due(context.database) == []
    with context.database.reading() as session:
        film = session.scalars(select(PreviewFilm)).one()
    assert (film.self_setting_id, film.mode) == (setting.id, MODE)
    set_robot(context.database, participant, {**MODE, "press": 0.2}, finished=True)
    assert settings_due(context.database) == [], "they have gone on"


@pytest.mark.usefixtures("all_said")
def test_the_robot_is_what_was_set_and_nothing_learned(
    context: WorkerContext, study: Study, participant: Participant
) -> None:
    settle(context.database, study, trials=1, methods=("reference", "self_set"))
    learn(context)
    set_robot(context.database, participant, {**MODE, "press": 0.4}, finished=False)
    assert due(context.database, RunKind.METHOD) == [], "they are still at the sliders"
    assert names(due(context.database, RunKind.FILMS)) == [f"films/participant-{participant.id}/before-after"]
    set_robot(context.database, participant, MODE, finished=True)
    (job,) = due(context.database, RunKind.METHOD)
    assert names([job]) == [f"method/participant-{participant.id}/self_set"]
    done(context, job, train_method)
    with context.database.reading() as session:
        model = session.scalars(select(Model).where(Model.kind == ModelKind.METHOD)).one()
    stored = context.store.read(model.artefact_sha256)
    assert stored == baseline_fitting.controller_of_filter("feeding", FilterWeights(mode=MODE).to_bytes())
    assert "no promise" in model.metrics["notes"][0]
    assert model.metrics["evaluation"]["scenarios"] == 10
    shown = simulation.act_in_mode("feeding", list(MODE.values()))
    seen = simulation.run_episode("feeding", shown, of_preview(study.seed)).observations[:-1]
    filmed = np.clip([shown(each) for each in seen], -1.0, 1.0)
    assert np.abs(filmed - Controller(stored).batch(seen)).max() < 1e-4, "they get what they were shown"


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("all_said")
def test_it_is_filmed_in_the_same_scenarios_as_the_others(
    context: WorkerContext, study: Study, participant: Participant
) -> None:
    settle(context.database, study, trials=1, methods=("reference", "self_set"))
    learn(context)
    set_robot(context.database, participant, MODE, finished=True)
    for job in due(context.database, RunKind.METHOD):
        done(context, job, train_method)
    for job in due(context.database, RunKind.FILMS):
        done(context, job, make_films)
    with context.database.reading() as session:
        trials = evaluation_plan.trials_of(session, participant.id)
        films = [trial.film for trial in trials if trial.film is not None]
    assert {film.method for film in films} == {EvaluatedMethod.REFERENCE, EvaluatedMethod.SELF_SET}
    assert len({film.scenario for film in films}) == 1
    assert len({film.video_sha256 for film in films}) == len(films) == 2


def test_a_film_of_somebody_who_has_withdrawn_is_not_made(context: WorkerContext, study: Study) -> None:
    preview_films._film_setting(context, 1, study.id, 12345)
    with context.database.reading() as session:
        assert session.scalars(select(PreviewFilm)).all() == []
