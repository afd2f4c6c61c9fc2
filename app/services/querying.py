"""Which pair a participant sees next, and how far along they are."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from itertools import islice, pairwise
from statistics import median

from sqlalchemy import select
from sqlalchemy.orm import Session, joinedload

from app.db import now
from app.domain.preferences import Label, LabelEvent, Query, current_labels
from app.domain.studies import Participant
from app.storage import ArtefactStore

log = logging.getLogger("app.querying")

RECENT_ANSWERS = 15
MIN_KNOWN_PACES = 5
LONGEST_PAUSE = timedelta(minutes=2)
"""A longer time between two answers was a break and says nothing about the pace."""

SEEN_EVERY = timedelta(seconds=10)


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
    undoable: Query | None
    """The query answered last, whose answer can be taken back."""


def next_turn(session: Session, store: ArtefactStore, participant: Participant) -> Turn:
    """The oldest ready pair of this participant, clips loaded, and what belongs on the page with it.

    Marks the pair as served. A pair whose files are not all stored is passed over.
    """
    labels = current_labels(session, participant.id)
    progress = progress_of(participant, labels)
    ready = [] if progress.finished else list(islice(_ready(session, store, participant), 2))
    query = ready[0] if ready else None
    following = ready[1] if len(ready) > 1 and progress.answered + 1 < progress.wanted else None
    if query is not None and query.served_at is None:
        query.served_at = now()
    newest = newest_answered(labels)
    return Turn(progress, query, following, newest.query if newest else None)


def progress_of(participant: Participant, labels: Sequence[Label]) -> Progress:
    """Answered and wanted labels, and the time the rest will take."""
    wanted = participant.study.settings.labels_per_participant
    pace_s = _pace_s(labels)
    left = max(0, wanted - len(labels))
    return Progress(len(labels), wanted, None if pace_s is None else round(pace_s * left))


def newest_answered(labels: Sequence[Label]) -> Label | None:
    """The label given last; None before the first."""
    return max(labels, key=lambda label: label.event.id, default=None)


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
    )
    for query in session.scalars(waiting):
        clips = (query.left_clip, query.right_clip)
        if all(store.has(sha256) for clip in clips for sha256 in (clip.video_sha256, clip.poster_sha256)):
            yield query
        else:
            log.warning("query %d of participant %d has lost its files and is passed over", query.id, participant.id)


def _pace_s(labels: Sequence[Label]) -> float | None:
    """Median time from one answer to the next, which includes watching, answering, saving and loading."""
    times = sorted(label.event.created_at for label in labels)[-RECENT_ANSWERS - 1 :]
    paces = [later - earlier for earlier, later in pairwise(times) if later - earlier < LONGEST_PAUSE]
    if len(paces) < MIN_KNOWN_PACES:
        return None
    return median(pace.total_seconds() for pace in paces)
