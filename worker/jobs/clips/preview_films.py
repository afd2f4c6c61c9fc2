"""Films that follow the sliders of people who set a robot themselves: some ahead, and one of each setting they try."""

from collections.abc import Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.models import RunKind
from app.domain.participation import StageRecord
from app.domain.protocol import Stage
from app.domain.run_keys import PREVIEW, SETTING, RunKey
from app.domain.self_setting import PreviewFilm, SelfSetting
from app.domain.studies import Participant, Study
from app.services.evaluation import self_setting
from worker.compute import preview_plan, simulation
from worker.compute.behaviours import Behaviour
from worker.compute.pools import Lane
from worker.domain.scenarios import of_preview
from worker.jobs.clips.stored_video import video_columns
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job
from worker.tasks import registry

BATCH = 8
"""Films of one job; filmed AT_A_TIME, so that somebody's own setting need not wait for all."""
AT_A_TIME = 2
QUALITY = "quick"
"""Of every preview, whatever that of the study's clips: it follows a slider, and is seen small beside it."""
_NAMES = (PREVIEW, SETTING)


def due_ahead(session: Session, study: Study) -> list[Job]:
    """The next films that are made ahead; none where nobody sets a robot."""
    if not self_setting.is_set(study):
        return []
    made = select(PreviewFilm.number).where(PreviewFilm.study_id == study.id, PreviewFilm.self_setting_id.is_(None))
    missing = sorted(set(range(preview_plan.COUNT)) - set(session.scalars(made)))
    batches = dict.fromkeys(number // BATCH for number in missing)
    return [Job(RunKey(RunKind.CLIPS, study.id, subject=PREVIEW, number=each), study.id) for each in [*batches][:1]]


def due_now(session: Session, study: Study) -> list[Job]:
    """A film of the newest setting of everybody who is at the sliders, where there is none."""
    if not self_setting.is_set(study):
        return []
    here = select(StageRecord.participant_id).join(Participant, Participant.id == StageRecord.participant_id)
    here = here.where(Participant.study_id == study.id, Participant.withdrawn_at.is_(None))
    here = here.where(StageRecord.stage == Stage.SELF_SETTING, StageRecord.finished_at.is_(None))
    jobs, sliders = [], self_setting.sliders_of(study)
    for participant_id in session.scalars(here.order_by(StageRecord.participant_id)):
        newest = self_setting.newest(session, participant_id)
        if newest is not None and not _is_filmed(session, study.id, sliders, newest):
            key = RunKey(RunKind.CLIPS, participant_id=participant_id, subject=SETTING, number=newest.id)
            jobs.append(Job(key, study.id))
    return jobs


def is_about(job: Job) -> bool:
    """Whether the job films previews."""
    return job.about.subject in _NAMES


def make(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Film what the job names."""
    if job.about.subject == SETTING:
        context.report(run_id, "filming a setting", 0.0)
        step("film", _film_setting, context, run_id, job.study_id, job.number)
        return
    batch = range(BATCH * job.number, min(BATCH * (job.number + 1), preview_plan.COUNT))
    for first in batch[::AT_A_TIME]:
        done = (first - batch.start) / len(batch)
        context.report(run_id, f"filming previews {first + 1} to {first + AT_A_TIME} of {preview_plan.COUNT}", done)
        numbers = [each for each in range(first, first + AT_A_TIME) if each in batch]
        step(f"film-{first}", _film_ahead, context, run_id, job.study_id, numbers)


def _film_ahead(context: WorkerContext, run_id: int, study_id: int, numbers: list[int]) -> None:
    with context.database.reading() as session:
        study = session.get_one(Study, study_id)
    family = registry.task(study.task).modes
    planned = preview_plan.modes(family)
    wanted = [(number, family.named(planned[number])) for number in numbers]
    films = _filmed(context, run_id, study, [mode for _, mode in wanted])
    with context.database.writing() as session:
        session.get_one(Study, study_id).mode_axes = {axis.name: [axis.low, axis.high] for axis in family.axes}
        for (number, mode), columns in zip(wanted, films, strict=True):
            _save(session, study_id, None, number, mode, columns)


def _film_setting(context: WorkerContext, run_id: int, study_id: int, setting_id: int) -> None:
    with context.database.reading() as session:
        study, setting = session.get_one(Study, study_id), session.get(SelfSetting, setting_id)
        if setting is None or _is_filmed(session, study_id, self_setting.sliders_of(study), setting):
            return  # its person has withdrawn, or it was made meanwhile
    mode = dict(setting.mode)
    (columns,) = _filmed(context, run_id, study, [mode])
    with context.database.writing() as session:
        if session.get(SelfSetting, setting_id) is not None:
            _save(session, study_id, setting_id, 0, mode, columns)


def _filmed(
    context: WorkerContext, run_id: int, study: Study, modes: Sequence[dict[str, float]]
) -> list[dict[str, Any]]:
    """The stored videos of some modes in the preview's scenario."""
    scenario, steps = of_preview(study.seed), study.settings.clip_steps
    shots = [(study.task, QUALITY, scenario, Behaviour(mode), 0, steps) for mode in modes]
    recorded = context.compute.run_all(Lane.CLIPS, context.beat(run_id), simulation.record_clip, shots)
    return [video_columns(context.store, each.clip) for each in recorded]


def _save(
    session: Session,
    study_id: int,
    setting_id: int | None,
    number: int,
    mode: dict[str, float],
    columns: dict[str, Any],
) -> None:
    """Record a film; doing it twice changes nothing."""
    known = select(PreviewFilm.id).where(PreviewFilm.study_id == study_id, PreviewFilm.number == number)
    if setting_id is None:
        known = known.where(PreviewFilm.self_setting_id.is_(None))
    else:
        known = known.where(PreviewFilm.self_setting_id == setting_id)
    if session.scalar(known) is None:
        session.add(PreviewFilm(study_id=study_id, self_setting_id=setting_id, number=number, mode=mode, **columns))


def _is_filmed(session: Session, study_id: int, sliders: Sequence[self_setting.Slider], setting: SelfSetting) -> bool:
    """Whether the person can be shown exactly this setting."""
    mine = select(SelfSetting.id).where(SelfSetting.participant_id == setting.participant_id)
    films = select(PreviewFilm).where(PreviewFilm.study_id == study_id)
    films = films.where(PreviewFilm.self_setting_id.is_(None) | PreviewFilm.self_setting_id.in_(mine))
    return any(self_setting.are_same(sliders, film.mode, setting.mode) for film in session.scalars(films))
