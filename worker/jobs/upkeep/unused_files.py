"""Files that nobody refers to: a worker was killed after it had stored a result and before it could write that down."""

import logging
import shutil
import time
from collections.abc import Collection
from contextlib import suppress
from datetime import timedelta

from sqlalchemy import select

from app.domain.run_keys import AHEAD
from app.domain.studies import Participant
from app.services.participants import withdrawal
from worker.jobs.runtime.context import WorkerContext

log = logging.getLogger("worker")

OLD_ENOUGH = timedelta(days=1)
"""Younger ones may be results that are about to be written down, by whoever."""
LEFT = timedelta(days=14)
"""So long what a refinement goes on from waits for somebody's other answers."""


def clear_away(context: WorkerContext, promised: Collection[str]) -> int:
    """Delete what no row refers to and nobody has asked for in a day; returns how many files that were.

    ``promised``: drafts of unfinished work, which will be referred to. Nothing can be written down meanwhile.
    """
    old = context.store.older_than(OLD_ENOUGH.total_seconds()) - set(promised)
    with context.database.writing() as session:
        orphans = old - withdrawal.in_use(session, old)
        if orphans:  # somebody may have put one of them here again while they were looked for
            orphans &= context.store.older_than(OLD_ENOUGH.total_seconds())
        for sha256 in orphans:
            context.store.delete(sha256)
    context.store.unfinished.clear_workspaces(OLD_ENOUGH.total_seconds())
    _clear_unfinished(context)
    _clear_what_was_made_ahead(context)
    if orphans:
        log.info("%d stored files that nobody refers to any more are cleared away", len(orphans))
    return len(orphans)


def _clear_unfinished(context: WorkerContext) -> None:
    """Of people whom another machine may have erased while this one was off."""
    with context.database.reading() as session:
        gone = session.scalars(select(Participant.id).where(Participant.withdrawn_at.is_not(None))).all()
    for participant_id in gone:
        shutil.rmtree(context.store.unfinished.folder(participant_id), ignore_errors=True)


def _clear_what_was_made_ahead(context: WorkerContext) -> None:
    """For people who will hardly go on answering; whoever does has it made again."""
    oldest_s = time.time() - LEFT.total_seconds()
    unfinished = context.store.unfinished
    for folder in unfinished.root.glob(f"*/{AHEAD}-*"):
        with suppress(FileNotFoundError):
            if folder.stat().st_mtime < oldest_s:
                unfinished.forget(folder)
