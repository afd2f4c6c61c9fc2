"""Which models are due for one participant, and which work nobody wants any more because there is something newer."""

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.models import RunKind
from app.domain.preferences import LEARNED_FROM, Exclusion, LabelEvent, Query, count_labels
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.installed_tasks.refinements import answers_ahead
from app.services.runs.estimates import PRESENT_WITHIN
from worker.jobs.runtime.records import Job


def present_ids(study: Study) -> Select[int]:
    """Everybody in the study who has not withdrawn."""
    return select(Participant.id).where(Participant.study_id == study.id, Participant.withdrawn_at.is_(None))


def people_here(study: Study) -> Select[int]:
    """Everybody in the study who is at their pages."""
    return present_ids(study).where(Participant.last_seen_at > now() - PRESENT_WITHIN)


def last_answers(session: Session, people: Select[int]) -> dict[int, int]:
    """The number of everybody's last answer that is learned from. ``people`` selects their ids."""
    events = select(Query.participant_id, func.max(LabelEvent.id)).join(LabelEvent)
    events = events.where(Query.participant_id.in_(people), Query.purpose.in_(LEARNED_FROM))
    return dict(session.execute(events.group_by(Query.participant_id)).all())


def reward_due(settings: StudySettings, answered: int) -> int:
    """The number of labels the newest reward model should have seen; 0 while there is nothing to learn from."""
    if answered >= settings.labels_per_participant:
        return settings.labels_per_participant
    return answered // settings.retrain_every_labels * settings.retrain_every_labels


def filter_due(settings: StudySettings, answered: int) -> int:
    """The newest milestone that has been passed; 0 before the first. Milestones passed in the meantime are skipped."""
    return max((milestone for milestone in settings.milestones if milestone <= answered), default=0)


def is_refinement_due(settings: StudySettings, answered: int) -> bool:
    """Whether it can be made ahead: none of the answers that it follows can be undone any more."""
    wanted = settings.labels_per_participant
    return settings.refinement_steps > 0 and answers_ahead(wanted) < answered < wanted


def gives_way(settings: StudySettings, answered: int) -> bool:
    """Whether an earlier filter waits while its person is here: what the last one goes on from is about to be made."""
    wanted = settings.labels_per_participant
    return settings.refinement_steps > 0 and answers_ahead(wanted) <= answered < wanted


def last_exclusions(session: Session, people: Select[int]) -> dict[int, int]:
    """The number of the last word about an answer that is learned from, of everybody about whom there is one."""
    words = select(Query.participant_id, func.max(Exclusion.id)).join(LabelEvent, LabelEvent.query_id == Query.id)
    words = words.join(Exclusion).where(Query.participant_id.in_(people), Query.purpose.in_(LEARNED_FROM))
    return dict(session.execute(words.group_by(Query.participant_id)).all())


def answers_known(settings: StudySettings, answered: int, last_answer: int, last_exclusion: int | None) -> str:
    """Of the keys of models: a last answer that is changed afterwards makes them new, and so does every exclusion."""
    marks = [f"answer-{last_answer}"] if answered >= settings.labels_per_participant else []
    marks += [] if last_exclusion is None else [f"exclusion-{last_exclusion}"]
    return "-".join(marks)


def is_outdated(session: Session, job: Job, *, begun: bool = False) -> bool:
    """Whether a newer model of the same kind is due, so that nobody needs this one.

    ``begun``: much has been done already; it is then outdated only by the last answer, after which somebody waits. Who
    answers faster than filters are trained would never get one otherwise.
    """
    settings = session.get_one(Study, job.study_id).settings
    mine = select(Participant.id).where(Participant.id == job.participant)
    answered = count_labels(session, mine).get(job.participant, 0)
    everything = settings.labels_per_participant
    if answered < everything and (begun or job.kind != RunKind.FILTER):
        return False
    if job.kind == RunKind.FILTER and filter_due(settings, answered) > (job.about.labels or 0):
        return True
    last, excluded = (each(session, mine).get(job.participant) for each in (last_answers, last_exclusions))
    known = answers_known(settings, answered, last or 0, excluded)
    return known != "" and known != job.about.answers
