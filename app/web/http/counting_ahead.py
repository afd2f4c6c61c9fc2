"""After a start, everybody's answers are counted once before anybody asks: the first look at a study need not wait."""

import asyncio
import time
from collections.abc import Sequence
from functools import partial

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from app.db import complaints
from app.domain.studies import Participant, Study
from app.web.http.deps import Studio

AT_ONCE = 10
"""People; somebody who saves an answer waits for a tenth of a second of counting at most."""
REST = 4.0
"""Times as long as the last few took, before the next."""
LONGEST_REST_S = 1.0
"""The server stops no sooner than this."""


async def count_ahead(studio: Studio) -> None:
    """Count for everybody in studies at work, the newest first, until done or the server is asked to stop."""
    try:
        people = await studio.session_queue.look(_people)
        for first in range(0, len(people), AT_ONCE):
            if studio.closing.is_set():
                return
            few, started_s = people[first : first + AT_ONCE], time.perf_counter()
            await studio.session_queue.look(partial(_count, studio, few))
            await asyncio.sleep(min(LONGEST_REST_S, REST * (time.perf_counter() - started_s)))
    except SQLAlchemyError as error:  # whoever looks at a study will count, and be told what is wrong
        complaints.error("counting ahead: %s", error)


def _count(studio: Studio, people: Sequence[int], session: Session) -> None:
    studio.tallies.of(session, people)


def _people(session: Session) -> list[int]:
    at_work = select(Participant.id).join(Study).where(Study.put_away_at.is_(None), Study.deleted_at.is_(None))
    return list(session.scalars(at_work.order_by(Participant.id.desc())))
