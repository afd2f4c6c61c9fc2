"""Filters that are lent: whose turn it is to draw, and which filters for several donors are to be fitted for that.

None of it depends on what the borrower answers, so filters are fitted while people answer, for what would be drawn for
them now, and in the second half of their answers it is drawn, to be filmed ahead. Types of users only stand in, for
the first people of a study: their filters are fitted before anybody comes, once the study's clips are there. When
people have finished it is drawn again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.clips import Clip, Rollout
from app.domain.evaluation import DonorDraw, Donors, SharedFilter
from app.domain.models import Model, ModelKind, RunKind
from app.domain.protocol import FROM_OTHERS, EvaluatedMethod, EvaluationMode
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.evaluation import donors, evaluation_plan
from worker.compute import shared_reward
from worker.jobs.runtime.records import Job, models_of, newest_model

SEEN_WITHIN = timedelta(minutes=30)
"""Whoever was here so recently may give the last answer soon."""
DRAWN_FROM = 0.5
"""Share of the answers from which on it is drawn: the films take a minute or two, and few leave after so many."""


@dataclass(frozen=True)
class _Needs:
    """What one study needs beyond what it has."""

    draws: Sequence[tuple[Participant, EvaluatedMethod]]
    filters: Sequence[Donors]
    """that nobody has asked for"""
    superfluous: Sequence[SharedFilter]
    """asked for, not fitted, and nobody's any more"""

    def __bool__(self) -> bool:
        return bool(self.draws or self.filters or self.superfluous)


def unsettled(session: Session) -> list[int]:
    """Ids of studies in which settle() has something to do."""
    at_work = select(Study).where(Study.deleted_at.is_(None), Study.put_away_at.is_(None)).order_by(Study.id)
    return [study.id for study in session.scalars(at_work).all() if _has_needs(session, study)]


def settle(session: Session, study_id: int) -> None:
    """Draw for whom it is time, and ask for the filters that are needed, now or soon. Twice is once."""
    study = session.scalars(select(Study).where(Study.id == study_id).with_for_update()).one()
    types = shared_reward.types_of(study.task)
    for participant, method in _needs(session, study).draws:
        donors.draw(session, study, participant, method, types)
    needs = _needs(session, study)
    for whose in needs.filters:
        session.add(SharedFilter(study_id=study.id, stored_donors=whose.model_dump(mode="json")))
    for each in needs.superfluous:
        session.delete(each)


def due(session: Session, study: Study) -> list[Job]:
    """The filters to be fitted, the first that was asked for first."""
    asked = [each for each in donors.shared_filters(session, study) if each.artefact_sha256 is None]
    return [Job(donors.key_of(each), study.id) for each in asked]


def find(session: Session, job: Job) -> SharedFilter | None:
    """What the job fits; None when nobody needs it any more."""
    shared = session.get(SharedFilter, job.number)
    return shared if shared is not None and donors.key_of(shared) == job.about else None


def films_ahead(session: Session, study: Study, participant_id: int, arm: str | None) -> list[Job]:
    """Films of what was drawn for somebody who still answers, as far as it is fitted."""
    settings = evaluation_plan.settings_for(study, arm)
    if settings is None or settings.mode is not EvaluationMode.VIDEO:
        return []
    lent = [method for method in settings.methods if method in FROM_OTHERS]
    drawn = [found for method in lent if (found := donors.find(session, participant_id, method))]
    return [Job(donors.key_of_films(each), study.id) for each in drawn if _is_fitted(session, study, each)]


def is_missing(session: Session, job: Job) -> bool:
    """Whether the method that the job makes is still to be drawn, or to be fitted to the donors that were."""
    if job.kind != RunKind.METHOD or job.about.subject not in FROM_OTHERS:
        return False
    drawn = donors.find(session, job.participant, job.about.subject)
    study, borrower = session.get_one(Study, job.study_id), session.get_one(Participant, job.participant)
    if drawn is None or donors.is_superseded(session, study, borrower, drawn):
        return True
    return not _is_fitted(session, study, drawn)


def _is_fitted(session: Session, study: Study, drawn: DonorDraw) -> bool:
    """Whether what was drawn can be lent: a person's own filter is there already."""
    shared = donors.shared_filter(session, study, drawn.donors) if drawn.donors.share_a_filter else None
    return not drawn.donors.share_a_filter or (shared is not None and shared.artefact_sha256 is not None)


def _has_needs(session: Session, study: Study) -> bool:
    try:
        return bool(_needs(session, study))
    except AppError:  # a laboratory's task that is not here: whoever tries to learn in this study is told
        return False


def _needs(session: Session, study: Study) -> _Needs:
    draws: list[tuple[Participant, EvaluatedMethod]] = []
    wanted: list[Donors] = []
    for participant, method, said in _borrowers(session, study):
        drawn = donors.find(session, participant.id, method)
        again = drawn is not None and donors.is_superseded(session, study, participant, drawn)
        if again or (drawn is None and said >= DRAWN_FROM):
            draws.append((participant, method))
        types = shared_reward.types_of(study.task)
        whose = donors.foresee(session, study, participant, method, types)[1] if drawn is None else drawn.donors
        if whose.share_a_filter:
            wanted.append(whose.without_candidates)
    wanted += _of_types(session, study)
    there = donors.shared_filters(session, study)
    asked = [each.donors for each in there]
    return _Needs(
        draws,
        [whose for whose in dict.fromkeys(wanted) if whose not in asked],
        [each for each in there if each.artefact_sha256 is None and each.donors not in wanted],
    )


def _borrowers(session: Session, study: Study) -> Iterator[tuple[Participant, EvaluatedMethod, float]]:
    """Who is to be shown a robot of others that is not made yet, which one, and what share of the answers they gave."""
    if study.settings.evaluation is None or study.material is not None:
        return
    begun = evaluation_plan.begun(session, study)
    here = select(Participant).where(Participant.study_id == study.id, Participant.withdrawn_at.is_(None))
    for participant in session.scalars(here.where(Participant.ended_as.is_(None)).order_by(Participant.id)).all():
        settings = evaluation_plan.settings_for(study, participant.arm)
        lent = [method for method in settings.methods if method in FROM_OTHERS] if settings else []
        reward = newest_model(session, participant.id, ModelKind.REWARD) if lent else None
        if reward is None or participant.id in begun:
            continue
        said = reward.label_count / study.settings.labels_per_participant
        made = _made(session, participant.id, reward)
        for method in lent:
            if method not in made and (said >= 1 or _is_here(participant)):
                yield participant, method, said


def _of_types(session: Session, study: Study) -> list[Donors]:
    """What the first people of a study may be lent: none once somebody has finished, or before its clips are there."""
    settings = study.settings
    if settings.evaluation is None or study.material is not None:
        return []
    in_arms = {method for arm in settings.arms for method in arm.methods}
    methods = {*settings.evaluation.methods, *in_arms}.intersection(FROM_OTHERS)
    if not methods or donors.has_finished(session, study) or not _has_all_clips(session, study):
        return []
    types = shared_reward.types_of(study.task)
    each = [Donors(types=(name,)) for name in types] if EvaluatedMethod.SOMEBODY_ELSE in methods else []
    return each + ([Donors(types=tuple(types))] if EvaluatedMethod.AVERAGE in methods else [])


def _has_all_clips(session: Session, study: Study) -> bool:
    settings = study.settings
    of_pool = select(func.count(Clip.id)).join(Rollout).where(Rollout.study_id == study.id)
    of_pool = of_pool.where(Rollout.participant_id.is_(None), Clip.step_count == settings.clip_steps)
    return (session.scalar(of_pool) or 0) >= settings.pool_scenarios * settings.behaviours_per_scenario


def _made(session: Session, participant_id: int, reward: Model) -> set[str]:
    """The methods that were made since this reward model."""
    models = models_of(session, participant_id, ModelKind.METHOD)
    return {str(each.metrics.get("method")) for each in models if each.label_hash == reward.label_hash}


def _is_here(participant: Participant) -> bool:
    return participant.last_seen_at is not None and now() - participant.last_seen_at < SEEN_WITHIN
