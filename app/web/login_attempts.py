"""Counts password attempts, so that guessing is slow and cannot keep the server busy with hashing."""

from limits import RateLimitItemPerMinute
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter


class LoginAttempts:
    """So many attempts per minute and address."""

    def __init__(self, per_minute: int) -> None:
        self._limit = RateLimitItemPerMinute(per_minute)
        self._limiter = MovingWindowRateLimiter(MemoryStorage())

    def allow(self, address: str) -> bool:
        """Count one attempt; False when there were too many."""
        return self._limiter.hit(self._limit, "password", address)
