"""Whether the server can do its work, asked of the database once for all who want to know."""

import asyncio
import time
from pathlib import Path

from fastapi.concurrency import run_in_threadpool

from app.db import Database
from app.services.monitoring import health

KNOWN_FOR_S = 5.0


class Readiness:
    """Looks at most every few seconds, because looking writes; anybody may ask as often as they like."""

    def __init__(self, database: Database, data_dir: Path) -> None:
        self._database, self._data_dir = database, data_dir
        self._known_until_s = 0.0
        self._complaint: str | None = None
        self._looking: asyncio.Future[str | None] | None = None

    async def complaint(self) -> str | None:
        """What is wrong; None when all is well."""
        if time.monotonic() < self._known_until_s:
            return self._complaint
        if self._looking is None:
            self._looking = asyncio.ensure_future(self._look())
        return await asyncio.shield(self._looking)

    async def _look(self) -> str | None:
        try:
            self._complaint = await run_in_threadpool(health.complaint, self._database, self._data_dir)
            self._known_until_s = time.monotonic() + KNOWN_FOR_S
        finally:
            self._looking = None
        return self._complaint
