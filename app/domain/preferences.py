"""Queries (two clips side by side) and the append-only record of what was answered."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from sqlalchemy import (
    CheckConstraint,
    ColumnElement,
    ForeignKey,
    Select,
    String,
    Subquery,
    Text,
    UniqueConstraint,
    false,
    func,
    select,
)
from sqlalchemy.orm import Mapped, Session, mapped_column, relationship
from sqlalchemy.sql.base import ExecutableOption

from app.db import Base, now
from app.domain.clips import Clip


class Response(StrEnum):
    """What can be said about a pair."""

    LEFT = "left"
    RIGHT = "right"
    EQUAL = "equal"
    SKIP = "skip"


class SkipReason(StrEnum):
    """Why somebody cannot tell."""

    NO_DIFFERENCE_SEEN = "no_difference_seen"
    BOTH_BAD = "both_bad"
    NOT_COMPARABLE = "not_comparable"
    NOT_SEEN = "not_seen"
    OTHER = "other"


class Purpose(StrEnum):
    """Why a pair is shown."""

    PRACTICE = "practice"
    """To learn the keys; never learned from."""
    INTRODUCTION = "introduction"
    """A label on whole trajectories, before the others."""
    PREFERENCE = "preference"
    REPEAT = "repeat"
    """An earlier pair again, half of them with the sides exchanged: how far the person agrees with themselves."""
    CATCH = "catch"
    """A pair with an obvious answer."""


LEARNED_FROM = (Purpose.INTRODUCTION, Purpose.PREFERENCE)
"""What counts as a label: everything else measures the person, not their taste."""


FOLLOWING = "following"
"""How a label's pair was chosen that follows the person, whatever the study's rule."""
PRACTICE, REPEAT, OBVIOUS, NO_OBVIOUS_PAIR = "practice", "repeat", "obvious", "no_obvious_pair"
"""How pairs that are no labels were chosen; the last: a repeat in the place of a catch pair that could not be had."""
NO_LABELS = (PRACTICE, REPEAT, OBVIOUS, NO_OBVIOUS_PAIR)


class Query(Base):
    """Two clips put to one participant; sides are fixed here and never drawn again."""

    __tablename__ = "query"
    __table_args__ = (
        UniqueConstraint("participant_id", "ordinal"),
        CheckConstraint("left_clip_id <> right_clip_id", name="two_clips"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    ordinal: Mapped[int]
    left_clip_id: Mapped[int] = mapped_column(ForeignKey("clip.id"), index=True)
    right_clip_id: Mapped[int] = mapped_column(ForeignKey("clip.id"), index=True)
    purpose: Mapped[str] = mapped_column(String(20), default=Purpose.PREFERENCE, server_default=Purpose.PREFERENCE)
    repeats_query_id: Mapped[int | None] = mapped_column(ForeignKey("query.id"), index=True)
    """Which pair a repeat asks again."""
    expected: Mapped[str | None] = mapped_column(String(8))
    """The obvious answer to a catch pair: left or right."""
    strategy: Mapped[str] = mapped_column(String(40))
    propensity: Mapped[float]
    predicted_right: Mapped[float | None]
    """P(right preferred) by the newest model that had not seen this query's label."""
    predicted_by_model_id: Mapped[int | None] = mapped_column(ForeignKey("model.id"))
    created_at: Mapped[datetime] = mapped_column(default=now)
    served_at: Mapped[datetime | None]

    left_clip: Mapped[Clip] = relationship(foreign_keys=left_clip_id, lazy="raise")
    right_clip: Mapped[Clip] = relationship(foreign_keys=right_clip_id, lazy="raise")


class LabelEvent(Base):
    """One answer, or the undoing of one. Never changed, never deleted; the highest revision of a query counts.

    UNIQUE(query_id, revision) makes one of twenty racing answers win; UNIQUE(client_uuid) makes a repeat recognisable.
    """

    __tablename__ = "label_event"
    __table_args__ = (UniqueConstraint("query_id", "revision"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    query_id: Mapped[int] = mapped_column(ForeignKey("query.id"), index=True)
    revision: Mapped[int]
    response: Mapped[str | None] = mapped_column(String(8))
    """One of Response; None means that the previous answer was undone."""
    client_uuid: Mapped[str] = mapped_column(String(36), unique=True)
    response_time_ms: Mapped[int | None]
    """From the first frame of both videos to the answer; None when not measured."""
    replay_count: Mapped[int | None]
    play_error_count: Mapped[int | None]
    reason: Mapped[str | None] = mapped_column(String(40))
    """Why the person could not tell, one of SkipReason."""
    mattered: Mapped[str | None] = mapped_column(String(40))
    """What the person said made the difference, one of app.installed_tasks.qualities."""
    stall_count: Mapped[int | None]
    stalled_ms: Mapped[int | None]
    """How long a clip had to wait for the network while playing."""
    largest_drift_ms: Mapped[int | None]
    """By how much the two clips were apart at worst, before they were brought together again."""
    playback_rate: Mapped[float | None]
    """The speed at the moment of the answer; 1 is real time."""
    scrub_count: Mapped[int | None]
    watched_whole: Mapped[bool | None]
    """Whether both clips were seen from beginning to end before the answer."""
    left_watched_ms: Mapped[int | None]
    right_watched_ms: Mapped[int | None]
    """How much of each clip was played before the answer, in the clip's own time: no matter how fast or how often."""
    by_script: Mapped[bool | None]
    """Whether the page's script sent it, and so saw to it that the clips had been shown; None: it was not noted yet."""
    created_at: Mapped[datetime] = mapped_column(default=now)


class Exclusion(Base):
    """An experimenter's word that an answer is left out of learning and statistics, or counts again.

    Append-only: the newest word about an answer counts. Whoever answers the pair anew gives an answer that counts.
    """

    __tablename__ = "exclusion"

    id: Mapped[int] = mapped_column(primary_key=True)
    label_event_id: Mapped[int] = mapped_column(ForeignKey("label_event.id"), index=True)
    excluded: Mapped[bool]
    reason: Mapped[str] = mapped_column(Text)
    actor: Mapped[str] = mapped_column(String(80))
    at: Mapped[datetime] = mapped_column(default=now)


@dataclass(frozen=True)
class Label:
    """The answer that counts for one query, whatever the query was for."""

    query: Query
    event: LabelEvent
    response: Response


def current_labels(session: Session, participant_id: int, *options: ExecutableOption) -> Sequence[Label]:
    """Every label of the participant that was neither undone nor excluded, in the order of the queries.

    Labels are answers that are learned from; ``options`` say what to load with each query.
    """
    return _answered(session, participant_id, LEARNED_FROM, options)


def current_answers(session: Session, participant_id: int, *options: ExecutableOption) -> Sequence[Label]:
    """Like current_labels, with practice, repeats and catch pairs: all that was answered and not undone or excluded."""
    return _answered(session, participant_id, tuple(Purpose), options)


def count_labels(session: Session, people: Select[int]) -> dict[int, int]:
    """How many labels each of these participants has given and not undone; whoever has given none is left out.

    Excluded ones are among them: they were given, and nobody has to give others. ``people`` selects the ids.
    Counted by the database, for all at once: the worker asks for it all the time.
    """
    newest = _newest(Query.participant_id.in_(people))
    counting = (
        select(Query.participant_id, func.count())
        .join(LabelEvent)
        .join(newest, (newest.c.query_id == LabelEvent.query_id) & (newest.c.revision == LabelEvent.revision))
        .where(LabelEvent.response.is_not(None), Query.purpose.in_(LEARNED_FROM))
        .group_by(Query.participant_id)
    )
    return dict(session.execute(counting).all())


def is_excluded() -> ColumnElement[bool]:
    """Whether the LabelEvent of the enclosing statement is left out."""
    newest = (
        select(Exclusion.excluded)
        .where(Exclusion.label_event_id == LabelEvent.id)
        .order_by(Exclusion.id.desc())
        .limit(1)
        .correlate(LabelEvent)
        .scalar_subquery()
    )
    return func.coalesce(newest, false())


def _newest(of_interest: ColumnElement[bool]) -> Subquery:
    """The newest revision of every answered query of interest."""
    revisions = select(LabelEvent.query_id, func.max(LabelEvent.revision).label("revision"))
    return (
        revisions.join(Query, Query.id == LabelEvent.query_id)
        .where(of_interest)
        .group_by(LabelEvent.query_id)
        .subquery()
    )


def _answered(
    session: Session, participant_id: int, purposes: Sequence[Purpose], options: Sequence[ExecutableOption]
) -> Sequence[Label]:
    newest = _newest(Query.participant_id == participant_id)
    rows = session.execute(
        select(Query, LabelEvent)
        .join(LabelEvent, LabelEvent.query_id == Query.id)
        .join(newest, (newest.c.query_id == LabelEvent.query_id) & (newest.c.revision == LabelEvent.revision))
        .where(LabelEvent.response.is_not(None), Query.purpose.in_(purposes), ~is_excluded())
        .order_by(Query.ordinal)
        .options(*options)
    )
    return [Label(query, event, Response(event.response)) for query, event in rows if event.response is not None]
