"""Clips: every behaviour of one scenario of a study's pool, rolled out and filmed."""

from app.domain.studies import Study
from worker import laboratory, records
from worker.compute import Lane
from worker.records import Job
from worker.workplace import Step, Workplace

AT_A_TIME = 2
"""Two clips already make a pair that can be labelled."""


def build_clips(place: Workplace, job: Job, run_id: int, step: Step) -> None:
    """Film what is still missing of the scenario that the job names."""
    scenario = int(job.finding.rsplit("-", 1)[1])
    with place.database.reading() as session:
        count = session.get_one(Study, job.study_id).settings.behaviours_per_scenario
    for first in range(0, count, AT_A_TIME):
        which = list(range(first, min(first + AT_A_TIME, count)))
        place.report(run_id, f"filming behaviours {which[0] + 1} to {which[-1] + 1} of {count}", first / count)
        step(f"film-{first}", _film, place, run_id, job.study_id, scenario, which)


def _film(place: Workplace, run_id: int, study_id: int, scenario: int, which: list[int]) -> None:
    with place.database.reading() as session:
        study = session.get_one(Study, study_id)
        task, settings = study.task, study.settings
    behaviours = laboratory.behaviours(task, scenario, settings.behaviours_per_scenario)
    shots = [(task, scenario, behaviours[index], 0, settings.clip_steps) for index in which]
    recorded = place.compute.run_all(Lane.CLIPS, place.beat(run_id), laboratory.record_clip, shots)
    for index, each in zip(which, recorded, strict=True):
        rollout = {
            "scenario": scenario,
            "behaviour": index,
            "mode": behaviours[index].described(),
            "trajectory_sha256": place.store.put(each.trajectory),
            "success": each.success,
        }
        clip = {
            "first_step": 0,
            "step_count": settings.clip_steps,
            "video_sha256": place.store.put(each.clip.video),
            "poster_sha256": place.store.put(each.clip.poster),
            "width": each.clip.width,
            "height": each.clip.height,
            "fps": each.clip.fps,
            "duration_ms": each.clip.duration_ms,
            "byte_count": len(each.clip.video),
        }
        with place.database.writing() as session:
            records.save_clip(session, study_id, rollout, clip)
