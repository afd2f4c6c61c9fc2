"""What participants may wish for in general, such as "slower near me": directions of some of a task's signals."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

from app.installed_tasks import catalogue
from app.installed_tasks.description import HintedAt
from app.installed_tasks.lab import LabDescription

MOST = 2
"""Hints that somebody may give at a time: more say less about what matters most."""


def of_task(task: str) -> Mapping[str, HintedAt]:
    """What can be hinted at, as the task's folder declares it. Empty for clips that were recorded elsewhere.

    Where a laboratory declares none, less and more of each signal that it has words for; never more of a cost.
    """
    installed = catalogue.find(task)
    if installed is None:
        return {}
    description = installed.description
    if description.hints or not isinstance(description, LabDescription):
        return description.hints
    return dict(_of_signals(description))


def contradicting(task: str, names: Sequence[str]) -> bool:
    """Whether two of these cannot be wished for at once."""
    known = of_task(task)
    return any(known[one].contradicts(known[other]) for one, other in combinations(names, 2))


def _of_signals(description: LabDescription) -> Iterator[tuple[str, HintedAt]]:
    for name, signal in description.signals.items():
        yield f"less_{name}", HintedAt(less=(name,), words=signal.words)
        if not signal.cost:
            yield f"more_{name}", HintedAt(more=(name,), words=signal.words)
