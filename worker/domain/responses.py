"""What can be said about a pair, and the target it becomes: the only place where a response turns into a number."""

from collections.abc import Mapping
from typing import Literal

Response = Literal["left", "right", "equal", "skip"]

TARGETS: Mapping[str, float | None] = {"left": 0.0, "equal": 0.5, "right": 1.0, "skip": None}
"""The paper's y, by response: P(right preferred), left being sigma^0 and right sigma^1. "Can't tell" says nothing."""
