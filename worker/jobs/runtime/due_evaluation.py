"""What the evaluation of one participant still needs: methods to be trained, films, controllers to be packed."""

from collections.abc import Collection
from dataclasses import replace

from app.domain.models import RunKind
from app.domain.protocol import EvaluatedMethod, EvaluationMode
from app.domain.run_keys import AHEAD, BEFORE_AFTER, CONTROLLERS, OTHERS, TRIALS, RunKey
from app.domain.studies import Study
from app.services.evaluation import evaluation_plan
from worker.jobs.runtime.records import Job


def due_ahead(study: Study, participant_id: int, arm: str | None) -> list[Job]:
    """What can be filmed for somebody who is still answering: the reference depends on no answer."""
    settings = evaluation_plan.settings_for(study, arm)
    is_shown = settings and settings.mode is EvaluationMode.VIDEO and EvaluatedMethod.REFERENCE in settings.methods
    return [Job(RunKey(RunKind.FILMS, participant_id=participant_id, subject=AHEAD), study.id)] if is_shown else []


def due(
    study: Study,
    reward: RunKey,
    succeeded: Collection[str],
    trained: Collection[str],
    robots_shown: bool,
    arm: str | None = None,
    *,
    has_set: bool = False,
) -> list[Job]:
    """What is to be trained, filmed or packed for somebody who has given all labels. ``reward``: their last model's.

    ``succeeded``, ``trained``: keys of finished runs, and of those that have left a method, measured or not.
    ``has_set``: they are through with the sliders, where there are any, so the robot that they have set can be made.
    Whoever has been shown robots rates those: other ones, learned without an excluded answer, would be for nobody.
    """
    if str(reward) not in succeeded:
        return []
    jobs = [] if robots_shown else _methods(study, reward, arm)
    jobs = [job for job in jobs if has_set or job.about.subject != EvaluatedMethod.SELF_SET]
    has_filter = str(replace(reward, kind=RunKind.FILTER)) in succeeded
    return jobs + _films(study, reward, trained, has_filter, robots_shown, arm)


def _methods(study: Study, reward: RunKey, arm: str | None) -> list[Job]:
    """What is to be trained for somebody whose last reward model, that of ``reward``, is there."""
    settings = evaluation_plan.settings_for(study, arm)
    return [
        Job(replace(reward, kind=RunKind.METHOD, subject=method), study.id)
        for method in (settings.methods if settings else ())
        if method in evaluation_plan.TRAINED
    ]


def _films(
    study: Study, reward: RunKey, trained: Collection[str], has_filter: bool, robots_shown: bool, arm: str | None
) -> list[Job]:
    """What is to be filmed or packed for somebody; without their last filter, trials of the others. ``reward``: theirs.

    ``robots_shown``: they have begun to rate, so that what they rate stays.
    """
    wanted = [BEFORE_AFTER] if has_filter and study.material is None else []
    settings = None if robots_shown else evaluation_plan.settings_for(study, arm)
    if settings and all(job.key in trained for job in _methods(study, reward, arm)):
        if settings.mode is EvaluationMode.VIDEO:
            wanted.append(TRIALS if has_filter else OTHERS)
        elif has_filter:
            wanted.append(CONTROLLERS)
    return [
        Job(replace(reward, kind=RunKind.FILMS, subject=what), study.id)
        for what in reversed(wanted)  # the debrief comes last
    ]
