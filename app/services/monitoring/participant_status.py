"""What an experimenter should know about each participant while the study runs.

Flags ask for a look; they change nothing, and nothing is ever deleted or left out because of them.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import pairwise
from statistics import median

from sqlalchemy import func, select
from sqlalchemy.orm import Session, aliased

from app.db import now
from app.domain.choices import Strategy
from app.domain.clips import Clip, Rollout
from app.domain.designs import Ending
from app.domain.evaluation import Controller, Film
from app.domain.models import Bundle, Export, Model, ModelKind
from app.domain.participation import StageRecord
from app.domain.preferences import LabelEvent, Purpose, Query, Response, is_excluded
from app.domain.protocol import Stage
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.services.answers.consistency import Consistency, JudgedAnswer, consistency, seen
from app.services.answers.misfit import Misfit
from app.services.answers.stopping_advice import Advice
from app.services.participants import stages

INVITED, FINISHED, WITHDRAWN = "invited", "finished", "withdrawn"
STAGES_IN_WORDS: Mapping[Stage, str] = {
    Stage.CONSENT: "reading the consent",
    Stage.DEMOGRAPHICS: "first questions",
    Stage.INSTRUCTIONS: "reading the instructions",
    Stage.PRACTICE: "practising",
    Stage.PAIRS: "comparing",
    Stage.SELF_SETTING: "setting a robot",
    Stage.EVALUATION: "rating robots",
    Stage.QUESTIONNAIRE: "last questions",
    Stage.DEBRIEF: "debrief",
}
RANKED_CLIPS = 3
"""At either end of a ranking."""
_PURPOSES = {each.value: each for each in Purpose}
_RESPONSES = {each.value: each for each in Response}
BREAK_S = 120.0
"""A longer gap between two answers was a break and says nothing about the pace."""


@dataclass(frozen=True)
class Watched:
    """One participant's answers, judged."""

    consistency: Consistency
    pace_s: float | None
    """Median time from one answer to the next."""
    advice: Advice | None
    misfit: Misfit | None = None


@dataclass(frozen=True, slots=True)
class GivenAnswer:
    """One answer that counts, when it was given, and what had been foreseen."""

    answer: JudgedAnswer
    moment: datetime
    predicted_right: float | None
    drawn_at_random: bool
    excluded: bool
    """By an experimenter: it was given, and nothing is concluded from it."""


@dataclass(frozen=True)
class RankedClip:
    """A clip with its learned return, in standard deviations over the clips of the study."""

    clip: Clip
    learned_return: float


@dataclass(frozen=True)
class Liked:
    """The ends of a ranking, the best and the worst of them first."""

    best: Sequence[RankedClip]
    worst: Sequence[RankedClip]


@dataclass(frozen=True)
class StageTime:
    """How long somebody was in a stage."""

    stage: str
    record: StageRecord


def answers_given(
    session: Session, participant_ids: Sequence[int], query_ids: Sequence[int] | None = None
) -> dict[int, list[GivenAnswer]]:
    """Everything that each of them has answered and not undone, in the order of the queries; to these queries only."""
    left, right, newer = aliased(Clip), aliased(Clip), aliased(LabelEvent)
    superseded = select(newer.id).where(newer.query_id == LabelEvent.query_id, newer.revision > LabelEvent.revision)
    wanted = (
        select(
            Query.participant_id,
            *(Query.ordinal, Query.id, Query.purpose, Query.left_clip_id, Query.right_clip_id, Query.repeats_query_id),
            *(Query.expected, Query.predicted_right, Query.strategy),
            *(left.duration_ms.label("left_ms"), right.duration_ms.label("right_ms")),
            *(LabelEvent.response, LabelEvent.response_time_ms, LabelEvent.created_at, LabelEvent.watched_whole),
            *(LabelEvent.left_watched_ms, LabelEvent.right_watched_ms, LabelEvent.scrub_count, LabelEvent.by_script),
            is_excluded().label("excluded"),
        )
        .join(LabelEvent, LabelEvent.query_id == Query.id)
        .join(left, left.id == Query.left_clip_id)
        .join(right, right.id == Query.right_clip_id)
        .where(Query.participant_id.in_(participant_ids), LabelEvent.response.is_not(None), ~superseded.exists())
        .order_by(Query.participant_id, Query.ordinal)
    )  # columns, not objects: of 20 000 answers objects take two seconds
    rows = session.execute(wanted if query_ids is None else wanted.where(Query.id.in_(query_ids)))
    given: dict[int, list[GivenAnswer]] = {each: [] for each in participant_ids}
    for row in rows:
        answer = JudgedAnswer(
            ordinal=row.ordinal,
            query_id=row.id,
            purpose=_PURPOSES[row.purpose],
            response=_RESPONSES[row.response],
            left_clip_id=row.left_clip_id,
            right_clip_id=row.right_clip_id,
            repeats_query_id=row.repeats_query_id,
            expected=None if row.expected is None else _RESPONSES[row.expected],
            response_time_ms=row.response_time_ms,
            clip_ms=max(row.left_ms, row.right_ms),
            seen=seen(row, row.left_ms, row.right_ms),
            by_script=row.by_script,
        )
        drawn_at_random = row.strategy == Strategy.UNIFORM
        given[row.participant_id].append(
            GivenAnswer(answer, row.created_at, row.predicted_right, drawn_at_random, row.excluded)
        )
    return given


def reward_models(session: Session, participant_ids: Sequence[int]) -> dict[int, list[Model]]:
    """Everybody's reward models in the order of their labels."""
    theirs = select(Model).where(Model.participant_id.in_(participant_ids), Model.kind == ModelKind.REWARD)
    models: dict[int, list[Model]] = {each: [] for each in participant_ids}
    for model in session.scalars(theirs.order_by(Model.label_count, Model.id)):
        models[model.participant_id].append(model)
    return models


def judged(given: Sequence[GivenAnswer], advice: Advice | None, misfit: Misfit | None = None) -> Watched:
    """Everything that is said about the answers of one participant."""
    moments = sorted(each.moment for each in given if each.answer.purpose is not Purpose.PRACTICE)
    gaps = [(later - earlier).total_seconds() for earlier, later in pairwise(moments)]
    working = [gap for gap in gaps if gap <= BREAK_S]
    return Watched(
        consistency=consistency([each.answer for each in given if not each.excluded]),
        pace_s=median(working) if len(working) >= 3 else None,
        advice=advice,
        misfit=misfit,
    )


def liked_clips(session: Session, study: Study, model: Model | None) -> Liked | None:
    """What a reward model likes best and least of the study's clips; None while it has not said."""
    ranking = (model.metrics.get("ranking") or []) if model is not None else []
    if len(ranking) < 2:
        return None
    few = min(RANKED_CLIPS, len(ranking) // 2)
    of_study = select(Clip, Rollout).join(Rollout).where(Rollout.study_id == study.id).order_by(Clip.step_count.desc())
    clips = {(rollout.scenario, rollout.behaviour): clip for clip, rollout in session.execute(of_study)}
    ranked = [
        RankedClip(clips[scenario, behaviour], learned_return)
        for scenario, behaviour, learned_return in (*ranking[:few], *ranking[-few:])
        if (scenario, behaviour) in clips
    ]
    return Liked(ranked[:few], list(reversed(ranked[few:])))


def where_they_are(
    session: Session, settings: StudySettings, people: Sequence[Participant], answered: Mapping[int, int]
) -> dict[int, str]:
    """In words, by participant id. ``answered``: labels given, by participant id."""
    records = session.scalars(
        select(StageRecord).where(StageRecord.participant_id.in_([person.id for person in people]))
    )
    entered: dict[int, list[StageRecord]] = {person.id: [] for person in people}
    for record in records:
        entered[record.participant_id].append(record)
    return {person.id: _where(settings, person, answered.get(person.id, 0), entered[person.id]) for person in people}


def stage_counts(where: Mapping[int, str]) -> Sequence[tuple[str, int]]:
    """How many are in each stage, in the order of the stages; stages without anybody are left out."""
    counted = Counter(where.values())
    order = (INVITED, *STAGES_IN_WORDS.values(), FINISHED, *(each.label for each in Ending), WITHDRAWN)
    return [(stage, counted[stage]) for stage in order if counted[stage]]


def stage_times(session: Session, participant: Participant) -> Sequence[StageTime]:
    """When the participant came into each stage, in the order of the stages."""
    theirs = select(StageRecord).where(StageRecord.participant_id == participant.id)
    by_stage = {Stage(record.stage): record for record in session.scalars(theirs)}
    return [StageTime(words, by_stage[stage]) for stage, words in STAGES_IN_WORDS.items() if stage in by_stage]


def disk_use(session: Session, study: Study) -> int:
    """Bytes of the study's videos, bundles and exports; trajectories and models come on top and are small."""
    people = select(Participant.id).where(Participant.study_id == study.id)
    sums = (
        select(func.sum(Clip.byte_count)).join(Rollout).where(Rollout.study_id == study.id),
        select(func.sum(Film.byte_count)).where(Film.participant_id.in_(people)),
        select(func.sum(Controller.byte_count)).where(Controller.participant_id.in_(people)),
        select(func.sum(Bundle.byte_count)).where(Bundle.participant_id.in_(people)),
        select(func.sum(Export.byte_count)).where(Export.study_id == study.id),
    )
    return sum(session.scalar(each) or 0 for each in sums)


def answers_today(session: Session, study: Study) -> int:
    """Answers of the last 24 hours."""
    people = select(Participant.id).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    given = select(func.count(LabelEvent.id)).join(Query).where(Query.participant_id.in_(people))
    return session.scalar(given.where(LabelEvent.created_at > now() - timedelta(days=1))) or 0


def _where(settings: StudySettings, person: Participant, answered: int, records: Sequence[StageRecord]) -> str:
    if person.withdrawn_at is not None:
        return WITHDRAWN
    if person.ended_as is not None:
        return Ending(person.ended_as).label
    if person.completed_at is not None:
        return FINISHED
    way = stages.stages_of(settings)
    known = {Stage(record.stage): record for record in records}
    latest = next((stage for stage in reversed(way) if stage in known), None)
    if latest is not None and latest is not Stage.PAIRS and known[latest].finished_at is None:
        return INVITED if latest is Stage.CONSENT and person.last_seen_at is None else STAGES_IN_WORDS[latest]
    if answered >= settings.labels_per_participant and way[-1] is Stage.PAIRS:
        return FINISHED
    if person.instructed_at is not None:
        return STAGES_IN_WORDS[Stage.PAIRS]
    return STAGES_IN_WORDS[Stage.INSTRUCTIONS] if person.consented_at is not None else INVITED
