"""Clips: every behaviour of one scenario of a study's pool, rolled out and filmed."""

from app.domain.run_keys import WHOLE
from app.domain.studies import Study
from worker.compute import simulation
from worker.compute.pools import Lane
from worker.jobs.clips import made_pairs, preview_films, repairs
from worker.jobs.clips.stored_video import rows_of_clip, video_columns
from worker.jobs.runtime import records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job

AT_A_TIME = 2
"""Two clips already make a pair that can be labelled."""


def build_clips(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Film what is still missing of the scenario that the job names: clips, or whole episodes; or something else."""
    if repairs.is_about(job):
        repairs.make_again(context, job, run_id, step)
        return
    if made_pairs.is_about(job):
        made_pairs.make(context, job, run_id, step)
        return
    if preview_films.is_about(job):
        preview_films.make(context, job, run_id, step)
        return
    film = _film_whole if job.about.subject == WHOLE else _film
    with context.database.reading() as session:
        count = session.get_one(Study, job.study_id).settings.behaviours_per_scenario
    for first in range(0, count, AT_A_TIME):
        which = list(range(first, min(first + AT_A_TIME, count)))
        shown = f"scenario {job.number + 1}, behaviours {which[0] + 1} to {which[-1] + 1} of {count}"
        context.report(run_id, f"filming {shown}", first / count)
        step(f"film-{first}", film, context, run_id, job.study_id, job.number, which)


def _film(context: WorkerContext, run_id: int, study_id: int, scenario: int, which: list[int]) -> None:
    with context.database.reading() as session:
        study = session.get_one(Study, study_id)
        task, settings = study.task, study.settings
    behaviours = simulation.behaviours(task, scenario, settings.behaviours_per_scenario)
    quality = settings.clip_quality.value
    shots = [(task, quality, scenario, behaviours[index], 0, settings.clip_steps) for index in which]
    recorded = context.compute.run_all(Lane.CLIPS, context.beat(run_id), simulation.record_clip, shots)
    for index, each in zip(which, recorded, strict=True):
        rollout, clip = rows_of_clip(context.store, each, scenario, index, behaviours[index], settings.clip_steps)
        with context.database.writing() as session:
            records.save_clip(session, study_id, rollout, clip)


def _film_whole(context: WorkerContext, run_id: int, study_id: int, scenario: int, which: list[int]) -> None:
    """The same rollouts again, from beginning to end."""
    with context.database.reading() as session:
        study = session.get_one(Study, study_id)
        steps, quality = study.whole_clip_steps or 0, study.settings.clip_quality.value
        rollouts = records.rollouts_of(session, study_id, scenario, which)
    shots = [(quality, context.store.read(rollout.trajectory_sha256), 0, steps) for rollout in rollouts]
    filmed = context.compute.run_all(Lane.CLIPS, context.beat(run_id), simulation.film_again, shots)
    for rollout, each in zip(rollouts, filmed, strict=True):
        clip = {"first_step": 0, "step_count": steps, **video_columns(context.store, each)}
        with context.database.writing() as session:
            records.save_clip(session, study_id, {"scenario": scenario, "behaviour": rollout.behaviour}, clip)
