"""Counts attempts to get in, so that guessing is slow, cannot keep the server busy, and shuts nobody out for long.

Strangers share limits: per address, per account whatever the address, and all together. A browser that has logged in to
the account before (services/known_browsers) is counted by itself, so whoever guesses at a name from many addresses
slows down other strangers and not the person whose name it is.
"""

import hashlib
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import timedelta
from ipaddress import IPv6Address, ip_address
from threading import Lock

from sqlalchemy import delete, select

from app.db import Database, now
from app.domain.people import LoginAttempt

WINDOW_S = 60.0
ADDRESSES_PER_ACCOUNT = 3
"""One address alone cannot use up what strangers may try at one account."""
ADDRESSES_IN_TOTAL = 6


@dataclass(frozen=True)
class Attempt:
    at_s: float
    address: str
    account: str
    browser: str | None


class LoginAttempts:
    """So many attempts per minute. Only what was allowed is remembered, so the limits bound the memory as well."""

    def __init__(
        self,
        per_address: int,
        per_account: int | None = None,
        in_total: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._per_address = per_address
        self._per_account = per_account or ADDRESSES_PER_ACCOUNT * per_address
        self._in_total = in_total or ADDRESSES_IN_TOTAL * per_address
        self._clock = clock
        self._lock = Lock()
        self._recent: deque[Attempt] = deque()

    def allow(self, address: str, account: str = "", browser: str | None = None) -> bool:
        """Count one attempt; False, and not counted, when there were too many. ``browser``: one the account knows."""
        attempt = Attempt(self._clock(), _network(address), account, browser)
        with self._lock:
            while self._recent and self._recent[0].at_s <= attempt.at_s - WINDOW_S:
                self._recent.popleft()
            allowed = self._is_allowed(attempt, self._recent)
            if allowed:
                self._recent.append(attempt)
            return allowed

    def __len__(self) -> int:
        return len(self._recent)

    def _is_allowed(self, attempt: Attempt, recent: Iterable[Attempt]) -> bool:
        if attempt.browser is not None:
            return sum(each.browser == attempt.browser for each in recent) < self._per_address
        strangers = [each for each in recent if each.browser is None]
        return (
            len(strangers) < self._in_total
            and sum(each.address == attempt.address for each in strangers) < self._per_address
            and sum(each.account == attempt.account for each in strangers) < self._per_account
        )


class SharedAttempts(LoginAttempts):
    """The same limits for all web servers together: each asks the database about what it would let through itself.

    With SQLite there is one web server, and nothing is written.
    """

    def __init__(
        self,
        database: Database,
        kind: str,
        per_address: int,
        per_account: int | None = None,
        in_total: int | None = None,
    ) -> None:
        super().__init__(per_address, per_account, in_total)
        self._database, self._kind = database, kind

    def allow(self, address: str, account: str = "", browser: str | None = None) -> bool:
        """See LoginAttempts."""
        if not super().allow(address, account, browser):
            return False
        if self._database.is_sqlite:
            return True
        row = LoginAttempt(
            kind=self._kind,
            address_sha256=_hash(_network(address)),
            account_sha256=_hash(account),
            browser_sha256=None if browser is None else _hash(browser),
        )
        with self._database.alongside() as session:
            session.execute(delete(LoginAttempt).where(LoginAttempt.at < now() - timedelta(seconds=WINDOW_S)))
            known = session.scalars(select(LoginAttempt).where(LoginAttempt.kind == self._kind)).all()
            allowed = self._is_allowed(_as_attempt(row), [_as_attempt(each) for each in known])
            if allowed:
                session.add(row)
        return allowed


def _as_attempt(row: LoginAttempt) -> Attempt:
    return Attempt(0.0, row.address_sha256, row.account_sha256, row.browser_sha256)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _network(address: str) -> str:
    """Whoever has one IPv6 address has the 2**64 beside it, too."""
    try:
        parsed = ip_address(address)
    except ValueError:
        return address
    if not isinstance(parsed, IPv6Address):
        return address
    mapped = parsed.ipv4_mapped
    return str(mapped) if mapped else parsed.exploded[:19]
