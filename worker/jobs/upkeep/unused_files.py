"""Files that nobody refers to: a worker was killed after it had stored a result and before it could write that down."""

import logging
import shutil
import time
from collections.abc import Collection
from datetime import timedelta
from pathlib import Path

from app.services.participants import withdrawal
from worker.jobs.runtime.context import WorkerContext

log = logging.getLogger("worker")

OLD_ENOUGH = timedelta(days=1)
"""Younger ones may be results that are about to be written down, by whoever."""


def clear_away(context: WorkerContext, promised: Collection[str]) -> int:
    """Delete what no row refers to and nobody has asked for in a day; returns how many files that were.

    ``promised``: drafts of unfinished work, which will be referred to. Nothing can be written down meanwhile.
    """
    old = context.store.older_than(OLD_ENOUGH.total_seconds()) - set(promised)
    with context.database.writing() as session:
        orphans = old - withdrawal.in_use(session, old)
        for sha256 in orphans:
            context.store.delete(sha256)
    for folder in (*_workspaces(context, "export-*"), *_workspaces(context, "import-*")):
        shutil.rmtree(folder, ignore_errors=True)
    if orphans:
        log.info("%d stored files that nobody refers to any more are cleared away", len(orphans))
    return len(orphans)


def _workspaces(context: WorkerContext, names: str) -> list[Path]:
    """Folders in which a killed program was writing or reading an archive: they hold what everybody has said."""
    oldest_s = time.time() - OLD_ENOUGH.total_seconds()
    return [each for each in context.store.unfinished(0).parent.glob(names) if each.stat().st_mtime < oldest_s]
