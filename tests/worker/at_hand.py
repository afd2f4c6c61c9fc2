"""Work done where it is asked for: no other processes, no engine."""

import json
from collections.abc import Callable
from typing import Any

from worker.compute.pools import Compute, Lane


class AtHand(Compute):
    """Calls at once, in this process."""

    def __init__(self) -> None:
        super().__init__(1)

    def run(self, lane: Lane, beat: Callable[[], None], function: Any, *args: Any, **kwargs: Any) -> Any:
        """See Compute."""
        beat()
        return function(*args, **kwargs)

    def run_all(self, lane: Lane, beat: Callable[[], None], function: Any, arguments: list[tuple[Any, ...]]) -> Any:
        """See Compute."""
        return [self.run(lane, beat, function, *each) for each in arguments]


def at_once(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """A step of a workflow that nobody interrupts; what it returns survives being stored as JSON."""
    return json.loads(json.dumps(function(*arguments)))
