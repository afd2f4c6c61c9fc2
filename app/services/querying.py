"""Which pair a participant sees next, and how far along they are."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import islice, pairwise
from statistics import median

from sqlalchemy import func, select
from sqlalchemy.orm import Session, aliased, joinedload

from app.db import now
from app.domain.preferences import LabelEvent, Query
from app.domain.studies import Participant
from app.storage import ArtefactStore

log = logging.getLogger("app.querying")

RECENT_ANSWERS = 15
MIN_KNOWN_PACES = 5
LONGEST_PAUSE = timedelta(minutes=2)
"""A longer time between two answers was a break and says nothing about the pace."""

SEEN_EVERY = timedelta(seconds=10)


@dataclass(frozen=True)
class Given:
    """The answers that count, in short."""

    count: int
    newest_query_id: int | None
    times: Sequence[datetime]
    """When the newest ones were given, in their order."""


@dataclass(frozen=True)
class Progress:
    """How far a participant is."""

    answered: int
    wanted: int
    seconds_left: int | None
    """At the person's own recent pace; None while too little is known."""

    @property
    def finished(self) -> bool:
        """Whether every label asked for has been given."""
        return self.answered >= self.wanted


@dataclass(frozen=True)
class Turn:
    """What a participant is to be shown now."""

    progress: Progress
    query: Query | None
    """None while no pair is ready, and when all are answered."""
    following: Query | None
    """The pair after it, so that the page can load it ahead."""
    undoable_id: int | None
    """The id of the query answered last, whose answer can be taken back."""


def next_turn(session: Session, store: ArtefactStore, participant: Participant) -> Turn:
    """The oldest ready pair of this participant, clips loaded, and what belongs on the page with it.

    Marks the pair as served. A pair whose files are not all stored is passed over.
    """
    given = answers_given(session, participant)
    progress = progress_of(participant, given)
    ready = [] if progress.finished else list(islice(_ready(session, store, participant), 2))
    query = ready[0] if ready else None
    following = ready[1] if len(ready) > 1 and progress.answered + 1 < progress.wanted else None
    if query is not None and query.served_at is None:
        query.served_at = now()
    return Turn(progress, query, following, given.newest_query_id)


def answers_given(session: Session, participant: Participant) -> Given:
    """How many answers count, and the newest of them. Counted by the database: this is asked for with every answer."""
    newer = aliased(LabelEvent)
    superseded = select(newer.id).where(newer.query_id == LabelEvent.query_id, newer.revision > LabelEvent.revision)
    counting = (
        select(LabelEvent.query_id, LabelEvent.created_at)
        .join(Query, Query.id == LabelEvent.query_id)
        .where(Query.participant_id == participant.id, LabelEvent.response.is_not(None), ~superseded.exists())
    )
    newest = session.execute(counting.order_by(LabelEvent.id.desc()).limit(RECENT_ANSWERS + 1)).all()
    return Given(
        count=session.scalar(select(func.count()).select_from(counting.subquery())) or 0,
        newest_query_id=newest[0].query_id if newest else None,
        times=[row.created_at for row in reversed(newest)],
    )


def progress_of(participant: Participant, given: Given) -> Progress:
    """Answered and wanted labels, and the time the rest will take."""
    wanted = participant.study.settings.labels_per_participant
    pace_s = _pace_s(given.times)
    left = max(0, wanted - given.count)
    return Progress(given.count, wanted, None if pace_s is None else round(pace_s * left))


def seen(participant: Participant) -> None:
    """Remember that the participant's browser was here."""
    if participant.last_seen_at is None or now() - participant.last_seen_at > SEEN_EVERY:
        participant.last_seen_at = now()


def _ready(session: Session, store: ArtefactStore, participant: Participant) -> Iterator[Query]:
    newest_response = (
        select(LabelEvent.response)
        .where(LabelEvent.query_id == Query.id)
        .order_by(LabelEvent.revision.desc())
        .limit(1)
        .scalar_subquery()
    )  # NULL when there is no event, and when the newest takes an answer back
    waiting = (
        select(Query)
        .where(Query.participant_id == participant.id, newest_response.is_(None))
        .options(joinedload(Query.left_clip), joinedload(Query.right_clip))
        .order_by(Query.ordinal)
        .execution_options(yield_per=2)  # the rest of the list is of no interest
    )
    for query in session.scalars(waiting):
        clips = (query.left_clip, query.right_clip)
        if all(store.has(sha256) for clip in clips for sha256 in (clip.video_sha256, clip.poster_sha256)):
            yield query
        else:
            log.warning("query %d of participant %d has lost its files and is passed over", query.id, participant.id)


def _pace_s(times: Sequence[datetime]) -> float | None:
    """Median time from one answer to the next, which includes watching, answering, saving and loading."""
    paces = [later - earlier for earlier, later in pairwise(times) if later - earlier < LONGEST_PAUSE]
    if len(paces) < MIN_KNOWN_PACES:
        return None
    return median(pace.total_seconds() for pace in paces)
