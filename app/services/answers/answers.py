"""Every answer of a study, to look at: narrowed by person, purpose, answer and what stands out about it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from http import HTTPStatus

from sqlalchemy import ColumnElement, Row, ScalarSelect, Select, and_, bindparam, case, func, or_, select, true
from sqlalchemy.orm import InstrumentedAttribute, Session, aliased, joinedload

from app.domain.clips import Clip
from app.domain.preferences import Exclusion, LabelEvent, Purpose, Query, Response, is_excluded
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.answers.consistency import FASTEST, TOO_FAST

PAGE_SIZE = 25
_SIDES = (Response.LEFT, Response.RIGHT)


class AnswerNotFound(AppError):
    """There is no such answer in this study. It may have been taken back; the list of answers shows what there is."""

    status = HTTPStatus.NOT_FOUND


class Mark(StrEnum):
    """What an answer can be looked up by."""

    MISPREDICTED = "mispredicted"
    """The model had expected the other side."""
    CONTRADICTS = "contradicts"
    """Says something else about a pair than the same person before."""
    MISSED_CATCH = "missed_catch"
    """Prefers the obviously worse side of a catch pair."""
    QUICK = "quick"
    """Given before half of the clip can have been seen."""
    WITHOUT_SCRIPT = "without_script"
    """Sent by the plain form, for the page's script was not there."""
    EXCLUDED = "excluded"


@dataclass(frozen=True)
class Wanted:
    """Which answers to look at; what is None does not matter."""

    code: str | None = None
    purpose: Purpose | None = None
    response: Response | None = None
    mark: Mark | None = None
    page: int = 1


@dataclass(frozen=True)
class ListedAnswer:
    """One answer that counts, with its pair (clips loaded) and what stands out about it."""

    participant: Participant
    query: Query
    event: LabelEvent
    marks: Sequence[Mark]
    exclusion: Exclusion | None
    """The word by which it is left out."""


@dataclass(frozen=True)
class AnswerPage:
    """One page of answers."""

    answers: Sequence[ListedAnswer]
    count: int
    """on all pages"""
    page: int
    pages: int


@dataclass(frozen=True)
class Looked:
    """One answer with all that was ever said about its pair, and its neighbours among what was looked for."""

    given: ListedAnswer
    events: Sequence[LabelEvent]
    """Oldest first; an event without a response takes the one before it back."""
    words: Sequence[Exclusion]
    """About the answer that counts, oldest first."""
    earlier_id: int | None
    later_id: int | None


def find(session: Session, study: Study, wanted: Wanted) -> AnswerPage:
    """One page of the answers that are wanted, by participant and in the order of the questions."""
    matching = _matching(study, wanted)
    count = session.scalar(select(func.count()).select_from(matching.subquery())) or 0
    pages = max(1, -(-count // PAGE_SIZE))
    page = min(max(1, wanted.page), pages)
    few = _in_order(matching).limit(PAGE_SIZE).offset((page - 1) * PAGE_SIZE)
    return AnswerPage(_loaded(session, [row.event_id for row in session.execute(few)]), count, page, pages)


def look(session: Session, study: Study, query_id: int, wanted: Wanted) -> Looked:
    """One answer. Raises AnswerNotFound."""
    event = counting_event(session, study, query_id)
    (given,) = _loaded(session, [event.id])
    events = select(LabelEvent).where(LabelEvent.query_id == query_id).order_by(LabelEvent.revision)
    words = select(Exclusion).where(Exclusion.label_event_id == event.id).order_by(Exclusion.id)
    place = (given.participant.number, given.query.ordinal)
    return Looked(
        given,
        session.scalars(events).all(),
        session.scalars(words).all(),
        _neighbour(session, study, wanted, place, ahead=False),
        _neighbour(session, study, wanted, place, ahead=True),
    )


def counting_event(session: Session, study: Study, query_id: int) -> LabelEvent:
    """The answer that counts for a pair of the study. Raises AnswerNotFound."""
    matching = _matching(study, Wanted()).where(Query.id == query_id)
    found = session.execute(matching).first()
    if found is None:
        raise AnswerNotFound
    return session.get_one(LabelEvent, found.event_id)


def counting_ids(study: Study) -> Select[int]:
    """The ids of the events of all answers of the study that count."""
    return _matching(study, Wanted()).with_only_columns(LabelEvent.id)


def _matching(study: Study, wanted: Wanted) -> Select[int, int, int, int]:
    """(event_id, query_id, number, ordinal) of the answers that count and are wanted."""
    matching = _COUNTING.where(Participant.study_id == study.id)
    if wanted.code is not None:
        matching = matching.where(Participant.number == int(wanted.code[1:]))
    if wanted.purpose is not None:
        matching = matching.where(Query.purpose == wanted.purpose)
    if wanted.response is not None:
        matching = matching.where(LabelEvent.response == wanted.response)
    return matching if wanted.mark is None else matching.where(_ONLY.get(wanted.mark, true()), _MARKED[wanted.mark])


def _in_order(matching: Select[int, int, int, int]) -> Select[int, int, int, int]:
    return matching.order_by(Participant.number, Query.ordinal)


def _neighbour(session: Session, study: Study, wanted: Wanted, place: tuple[int, int], *, ahead: bool) -> int | None:
    """The query next to a place among those that are wanted."""
    number, ordinal = place
    matching = _matching(study, wanted)
    if ahead:
        there = or_(Participant.number > number, and_(Participant.number == number, Query.ordinal > ordinal))
        found = session.execute(_in_order(matching.where(there)).limit(1)).first()
    else:
        there = or_(Participant.number < number, and_(Participant.number == number, Query.ordinal < ordinal))
        backwards = matching.where(there).order_by(Participant.number.desc(), Query.ordinal.desc())
        found = session.execute(backwards.limit(1)).first()
    return None if found is None else found.query_id


def _is_by_a_person() -> ColumnElement[bool]:
    """A program never runs the page's script, and is marked as one elsewhere."""
    scripted = select(Participant.id).where(Participant.scripted_as.is_not(None))
    return Query.participant_id.not_in(scripted)


def _mispredicted() -> ColumnElement[bool]:
    return or_(
        and_(LabelEvent.response == Response.LEFT, Query.predicted_right > 0.5),
        and_(LabelEvent.response == Response.RIGHT, Query.predicted_right < 0.5),
    )


def _quick() -> ColumnElement[bool]:
    """Given before TOO_FAST of both clips had been played; consistency.seen, in the database."""
    left_ms, right_ms = (_duration_ms(side) for side in (Query.left_clip_id, Query.right_clip_id))
    played = LabelEvent.left_watched_ms, LabelEvent.right_watched_ms
    measured = and_(*(each.is_not(None) for each in played))
    little = or_(played[0] < TOO_FAST * left_ms, played[1] < TOO_FAST * right_ms)
    could = LabelEvent.response_time_ms * FASTEST
    too_little = or_(could < TOO_FAST * left_ms, could < TOO_FAST * right_ms)
    unseen = case((measured, and_(func.coalesce(LabelEvent.scrub_count, 0) == 0, little)), else_=too_little)
    return and_(LabelEvent.watched_whole.is_not(True), unseen)


def _duration_ms(clip_id: InstrumentedAttribute[int]) -> ScalarSelect[int]:
    clip = aliased(Clip)
    return select(clip.duration_ms).where(clip.id == clip_id).correlate(Query).scalar_subquery()


def _contradicts() -> ColumnElement[bool]:
    """A repeat whose chosen clip, or equality, is not that of the answer that counts for the pair it asks again."""
    before, earlier = aliased(Query), aliased(LabelEvent)
    newest = (
        select(earlier.response, before.left_clip_id)
        .join(before, before.id == earlier.query_id)
        .where(before.id == Query.repeats_query_id)
        .order_by(earlier.revision.desc())
        .limit(1)
    )
    said = newest.with_only_columns(earlier.response).correlate(Query).scalar_subquery()
    left_then = newest.with_only_columns(before.left_clip_id).correlate(Query).scalar_subquery()
    turned = case(
        (said == Response.LEFT, Response.RIGHT.value), (said == Response.RIGHT, Response.LEFT.value), else_=said
    )
    same = case((left_then == Query.left_clip_id, said), else_=turned)
    told = and_(said.is_not(None), said != Response.SKIP, LabelEvent.response != Response.SKIP)
    return and_(Query.repeats_query_id.is_not(None), told, LabelEvent.response != same)


# Made once: making statements with so many aliases takes longer than running them.
_newer = aliased(LabelEvent)
_COUNTING = (
    select(LabelEvent.id.label("event_id"), Query.id.label("query_id"), Participant.number, Query.ordinal)
    .join(Query, Query.id == LabelEvent.query_id)
    .join(Participant, Participant.id == Query.participant_id)
    .where(
        Participant.is_preview.is_(False),
        LabelEvent.response.is_not(None),
        ~select(_newer.id)
        .where(_newer.query_id == LabelEvent.query_id, _newer.revision > LabelEvent.revision)
        .exists(),
    )
)
_CONDITIONS: Mapping[Mark, ColumnElement[bool]] = {
    Mark.MISPREDICTED: _mispredicted(),
    Mark.CONTRADICTS: _contradicts(),
    Mark.MISSED_CATCH: and_(Query.expected.is_not(None), LabelEvent.response.in_(_SIDES))
    & (LabelEvent.response != Query.expected),
    Mark.QUICK: _quick(),
    Mark.WITHOUT_SCRIPT: LabelEvent.by_script.is_(False) & _is_by_a_person(),
    Mark.EXCLUDED: is_excluded(),
}
_MARKED: Mapping[Mark, ColumnElement[bool]] = {
    mark: func.coalesce(condition, False)  # what is not known is not marked
    for mark, condition in _CONDITIONS.items()
}
"""Whether an answer, LabelEvent with its Query, bears a mark; decided by the database, for pages to be quick."""
_ONLY: Mapping[Mark, ColumnElement[bool]] = {
    Mark.CONTRADICTS: Query.repeats_query_id.is_not(None),
    Mark.MISSED_CATCH: Query.expected.is_not(None),
    Mark.EXCLUDED: LabelEvent.id.in_(select(Exclusion.label_event_id)),
}
"""What few answers are, and all that can bear the mark: told apart, so that the others are not looked at closely."""
_LOADING = (
    select(LabelEvent, Query, Participant, *(condition.label(mark.value) for mark, condition in _MARKED.items()))
    .join(Query, Query.id == LabelEvent.query_id)
    .join(Participant, Participant.id == Query.participant_id)
    .where(LabelEvent.id.in_(bindparam("event_ids", expanding=True)))
    .options(joinedload(Query.left_clip), joinedload(Query.right_clip))
)


def _loaded(session: Session, event_ids: Sequence[int]) -> Sequence[ListedAnswer]:
    """These answers in this order."""
    rows = session.execute(_LOADING, {"event_ids": event_ids})
    words = session.scalars(select(Exclusion).where(Exclusion.label_event_id.in_(event_ids)).order_by(Exclusion.id))
    newest = {word.label_event_id: word for word in words}
    given = {row.LabelEvent.id: _given(row, newest.get(row.LabelEvent.id)) for row in rows}
    return [given[event_id] for event_id in event_ids]


def _given(row: Row[*tuple[object, ...]], word: Exclusion | None) -> ListedAnswer:
    return ListedAnswer(
        participant=row.Participant,
        query=row.Query,
        event=row.LabelEvent,
        marks=[mark for mark in Mark if getattr(row, mark.value)],
        exclusion=word if word is not None and word.excluded else None,
    )
