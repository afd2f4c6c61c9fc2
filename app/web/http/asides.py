"""What the web server does beside the requests, so that nobody's request has to."""

import asyncio
import time
from collections.abc import Sequence
from functools import partial

from fastapi.concurrency import run_in_threadpool
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
SHORTEN_EVERY_S = 1.0


async def count_ahead(studio: Studio) -> None:
    """Count the answers of everybody in studies at work once, the newest first: the first look need not wait for it."""
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


async def keep_log_short(studio: Studio) -> None:
    """Keep the database's log short until the server is asked to stop."""
    while not studio.closing.is_set():
        await asyncio.sleep(SHORTEN_EVERY_S)
        await run_in_threadpool(studio.database.keep_log_short)


def _count(studio: Studio, people: Sequence[int], session: Session) -> None:
    studio.tallies.of(session, people)


def _people(session: Session) -> list[int]:
    at_work = select(Participant.id).join(Study).where(Study.put_away_at.is_(None), Study.deleted_at.is_(None))
    return list(session.scalars(at_work.order_by(Participant.id.desc())))
