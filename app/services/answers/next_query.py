"""Which pair a participant sees next, and how far along they are."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import islice, pairwise
from statistics import median
from typing import NamedTuple

from sqlalchemy import bindparam, func, select, update
from sqlalchemy.orm import Session, aliased

from app.db import now
from app.domain.clips import Clip
from app.domain.preferences import LabelEvent, Purpose, Query
from app.domain.studies import Awaited, Participant
from app.services import participant_events
from app.services.answers import hint_offers
from app.services.participant_events import EventKind
from app.storage import ArtefactStore

log = logging.getLogger("app.querying")

PAIRS_AHEAD = 2
"""Pairs that the page loads while another is shown."""
RECENT_ANSWERS = 15
MIN_KNOWN_PACES = 5
LONGEST_PAUSE = timedelta(minutes=2)
"""A longer time between two answers was a break and says nothing about the pace."""

SEEN_EVERY = timedelta(seconds=10)


@dataclass(frozen=True)
class AnswerCounts:
    """The answers that count, in short."""

    count: int
    """to what is asked for in earnest: labels, repeats and catch pairs"""
    practised: int
    """practice pairs answered"""
    newest_query_id: int | None
    newest_is_practice: bool
    times: Sequence[datetime]
    """When the newest ones were given, in their order."""


@dataclass(frozen=True)
class PairProgress:
    """How far a participant is. Everything they will be asked counts, whatever it is for; practice does not."""

    answered: int
    wanted: int
    pace_s: float | None
    """From one answer to the next, the median of the newest ones; None while too little is known."""
    practised: int = 0
    practice_wanted: int = 0

    @property
    def practising(self) -> bool:
        """Whether practice pairs are still to come."""
        return self.practised < self.practice_wanted

    @property
    def finished(self) -> bool:
        """Whether every answer asked for has been given."""
        return not self.practising and self.answered >= self.wanted


class ClipFiles(NamedTuple):
    """A clip as a page needs it."""

    video_sha256: str
    poster_sha256: str
    width: int
    height: int
    fps: int


class ReadyQuery(NamedTuple):
    """A query that can be shown."""

    id: int
    purpose: str
    served_at: datetime | None
    left: ClipFiles
    right: ClipFiles


@dataclass(frozen=True)
class NextPair:
    """What a participant is to be shown now."""

    progress: PairProgress
    query: ReadyQuery | None
    """None while no pair is ready, during a break, and when all are answered."""
    following: Sequence[ReadyQuery]
    """The next few pairs after it, so that the page can load them ahead."""
    undoable_id: int | None
    """The id of the query answered last, whose answer can be taken back."""
    break_due: bool = False
    """Whether a break is to be offered before the next pair."""
    hints_due: bool = False
    """Whether the person is to be asked for hints before the next pair."""


# Statements that every answer needs are made once: making them took as long as running them.
_newer, _left, _right = aliased(LabelEvent), aliased(Clip), aliased(Clip)
_GIVEN = (
    select(
        LabelEvent.query_id,
        LabelEvent.created_at,
        Query.purpose,
        func.count().over().label("total"),
        func.count().filter(Query.purpose == Purpose.PRACTICE).over().label("practised"),
    )
    .join(Query, Query.id == LabelEvent.query_id)
    .where(
        Query.participant_id == bindparam("participant_id"),
        LabelEvent.response.is_not(None),
        ~select(_newer.id)
        .where(_newer.query_id == LabelEvent.query_id, _newer.revision > LabelEvent.revision)
        .exists(),
    )
    .order_by(LabelEvent.id.desc())
    .limit(RECENT_ANSWERS + 1)
)
_newest_response = (
    select(LabelEvent.response)
    .where(LabelEvent.query_id == Query.id)
    .order_by(LabelEvent.revision.desc())
    .limit(1)
    .scalar_subquery()
)  # NULL when there is no event, and when the newest takes an answer back
_WAITING = (
    select(
        Query.ordinal,
        Query.id,
        Query.purpose,
        Query.served_at,
        *(getattr(clip, name) for clip in (_left, _right) for name in ClipFiles._fields),
    )
    .join(_left, _left.id == Query.left_clip_id)
    .join(_right, _right.id == Query.right_clip_id)
    .where(
        Query.participant_id == bindparam("participant_id"),
        Query.ordinal > bindparam("after"),
        _newest_response.is_(None),
    )
    .order_by(Query.ordinal)
    .limit(1 + PAIRS_AHEAD)  # the rest is of no interest, as long as these have their files
)
_SERVE = (
    update(Query)
    .where(Query.id == bindparam("query_id"))
    .values(served_at=bindparam("moment"))
    .execution_options(synchronize_session=False)
)


def next_turn(session: Session, store: ArtefactStore, participant: Participant) -> NextPair:
    """The oldest ready pair of this participant, and what belongs on the page with it.

    Marks the pair as served. A pair whose files are not all stored is passed over.
    """
    given = answers_given(session, participant)
    progress = progress_of(participant, given)
    undoable_id = given.newest_query_id if given.newest_is_practice == progress.practising else None
    if _break_due(session, participant, progress):
        return NextPair(progress, None, (), undoable_id, break_due=True)
    earnest = not progress.practising and not progress.finished
    if earnest and hint_offers.are_due(session, participant, progress.answered):
        return NextPair(progress, None, (), undoable_id, hints_due=True)
    ready = [] if progress.finished else list(islice(_ready(session, store, participant), 1 + PAIRS_AHEAD))
    query = ready[0] if ready else None
    if query is not None and query.served_at is None:
        session.execute(_SERVE, {"query_id": query.id, "moment": now()})
    left = progress.practice_wanted - progress.practised + progress.wanted - progress.answered
    return NextPair(progress, query, ready[1:left], undoable_id)


def answers_given(session: Session, participant: Participant) -> AnswerCounts:
    """How many answers count, and the newest of them. Counted by the database: this is asked for with every answer."""
    newest = session.execute(_GIVEN, {"participant_id": participant.id}).all()
    total, practised = (newest[0].total, newest[0].practised) if newest else (0, 0)
    return AnswerCounts(
        count=total - practised,
        practised=practised,
        newest_query_id=newest[0].query_id if newest else None,
        newest_is_practice=bool(newest) and newest[0].purpose == Purpose.PRACTICE,
        times=[row.created_at for row in reversed(newest)],
    )


def progress_of(participant: Participant, given: AnswerCounts) -> PairProgress:
    """Given and wanted answers, and how fast they come."""
    settings = participant.study.settings
    return PairProgress(
        answered=given.count,
        wanted=settings.question_count,
        pace_s=_pace_s(given.times),
        practised=given.practised,
        practice_wanted=settings.practice_pairs,
    )


def end_break(session: Session, participant: Participant) -> None:
    """Store that the person goes on. At other times than in a break this changes nothing."""
    progress = progress_of(participant, answers_given(session, participant))
    if _break_due(session, participant, progress):
        participant_events.note_once(session, participant, EventKind.BREAK_OVER, progress.answered)


def _break_due(session: Session, participant: Participant, progress: PairProgress) -> bool:
    """After every so many answers, once: whoever takes one back and gives it again is not stopped again."""
    every = participant.study.settings.break_every
    between = every > 0 and 0 < progress.answered < progress.wanted and progress.answered % every == 0
    if not between or progress.practising:
        return False
    return not participant_events.known_at(session, participant, EventKind.BREAK_OVER, progress.answered)


def seen(participant: Participant) -> None:
    """Remember that the participant's browser was here."""
    if participant.last_seen_at is None or now() - participant.last_seen_at > SEEN_EVERY:
        participant.last_seen_at = now()


def waits(participant: Participant, awaited: Awaited | None) -> None:
    """Remember that the page shown now makes the participant wait, or (None) that it does not: work is ordered by it.

    Whoever leaves and comes back to the same waiting page has waited all the time.
    """
    if participant.waiting_for != awaited:
        participant.waiting_for = awaited
        participant.waiting_since = None if awaited is None else now()


def _ready(session: Session, store: ArtefactStore, participant: Participant) -> Iterator[ReadyQuery]:
    after = -1
    while rows := session.execute(_WAITING, {"participant_id": participant.id, "after": after}).all():
        after = rows[-1].ordinal
        for _, query_id, purpose, served_at, *clips in rows:
            half = len(clips) // 2
            query = ReadyQuery(query_id, purpose, served_at, ClipFiles(*clips[:half]), ClipFiles(*clips[half:]))
            files = (sha256 for clip in (query.left, query.right) for sha256 in (clip.video_sha256, clip.poster_sha256))
            if all(map(store.seems_whole, files)):
                yield query
            else:
                log.warning("query %d of participant %d has lost its files: passed over", query.id, participant.id)


def _pace_s(times: Sequence[datetime]) -> float | None:
    """Median time from one answer to the next, which includes watching, answering, saving and loading."""
    paces = [later - earlier for earlier, later in pairwise(times) if later - earlier < LONGEST_PAUSE]
    if len(paces) < MIN_KNOWN_PACES:
        return None
    return median(pace.total_seconds() for pace in paces)
