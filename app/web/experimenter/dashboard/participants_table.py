"""The table of a study's participants: what the address says is what is shown, so that it works without script."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import Depends, Query

from app.domain.models import RunStatus
from app.services.monitoring.dashboard import ParticipantRow, StudyOverview
from app.services.monitoring.participant_status import INVITED, WITHDRAWN

ATTENTION = "attention"
"""Shown: those with flags or failed work."""
EVERYBODY = ""
PAGE_SIZE = 50
ON_ONE_PAGE = 0


class Order(StrEnum):
    """By what the table is sorted."""

    ATTENTION = "attention"
    """What asks for a look first, then whoever is there now."""
    CODE = "code"
    ANSWERS = "answers"
    SEEN = "seen"
    FORESEEN = "foreseen"


@dataclass(frozen=True)
class View:
    """What somebody wants to see of the table."""

    order: Order = Order.ATTENTION
    backwards: bool = False
    show: str = EVERYBODY
    """ATTENTION, a stage in words, or everybody"""
    find: str = ""
    """Part of a code"""
    all_ticked: bool = False
    page: int = 1
    """ON_ONE_PAGE: all rows, however many there are"""

    def address(self, **changes: Any) -> str:
        """The part of an address that asks for this view with changes; nothing for the usual one."""
        asked = {
            "sort": self.order.value,
            "backwards": "yes" if self.backwards else "",
            "show": self.show,
            "find": self.find,
            "tick": "all" if self.all_ticked else "",
            "page": str(self.page),
        } | changes
        usual = {"sort": Order.ATTENTION.value, "page": "1"}
        written = urlencode({name: value for name, value in asked.items() if value and usual.get(name) != value})
        return f"?{written}" if written else ""


@dataclass(frozen=True)
class Choice:
    """One way to narrow the table."""

    show: str
    text: str
    count: int


@dataclass(frozen=True)
class PeopleTable:
    """The rows of one page in their order; who was invited and never came is apart."""

    rows: Sequence[ParticipantRow]
    count: int
    """on all pages"""
    page: int
    pages: int
    never_came: Sequence[ParticipantRow]
    choices: Sequence[Choice]
    view: View


def _view(
    sort: Order = Order.ATTENTION,
    backwards: Annotated[str, Query(max_length=3)] = "",
    show: Annotated[str, Query(max_length=40)] = EVERYBODY,
    find: Annotated[str, Query(max_length=20)] = "",
    tick: Annotated[str, Query(max_length=3)] = "",
    page: Annotated[int, Query(ge=ON_ONE_PAGE, le=100_000)] = 1,
) -> View:
    return View(sort, backwards == "yes", show, find.strip(), tick == "all", page)


WantedView = Annotated[View, Depends(_view)]


def people_table(overview: StudyOverview, view: View) -> PeopleTable:
    """The rows that are wanted, as they are wanted."""
    found = [row for row in overview.rows if view.find.upper() in row.participant.code]
    shown = [row for row in found if _is_shown(row, view.show)]
    apart = [row for row in shown if row.stage == INVITED]
    rows = sorted((row for row in shown if row.stage != INVITED), key=_KEYS[view.order], reverse=view.backwards)
    alarming = sum(needs_a_look(row) for row in found)
    choices = [
        Choice(EVERYBODY, "all", len(found)),
        Choice(ATTENTION, "needing attention", alarming),
        *(Choice(stage, stage, count) for stage, count in overview.stage_counts),
    ]
    size = PAGE_SIZE if view.page != ON_ONE_PAGE else max(1, len(rows))
    pages = max(1, -(-len(rows) // size))
    page = min(max(1, view.page), pages)
    return PeopleTable(rows[(page - 1) * size : page * size], len(rows), page, pages, apart, choices, view)


def needs_a_look(row: ParticipantRow) -> bool:
    """Whether something has failed for this person, or a flag is raised."""
    return _failed(row) or bool(row.flags and row.stage != WITHDRAWN)


def _failed(row: ParticipantRow) -> bool:
    return row.run is not None and row.run.status == RunStatus.FAILED


def _is_shown(row: ParticipantRow, show: str) -> bool:
    return needs_a_look(row) if show == ATTENTION else show in (EVERYBODY, row.stage)


def _urgency(row: ParticipantRow) -> Any:
    gone = row.stage == WITHDRAWN
    return gone, not _failed(row), -len(row.flags), not row.active, row.participant.number


def _seen(row: ParticipantRow) -> Any:
    seen_at = row.participant.last_seen_at
    return -(seen_at.timestamp() if seen_at else 0.0), row.participant.number


def _foreseen(row: ParticipantRow) -> Any:
    newest = row.curve.newest
    return newest is None, newest.value if newest else 0.0, row.participant.number


_KEYS: Mapping[Order, Callable[[ParticipantRow], Any]] = {
    Order.ATTENTION: _urgency,
    Order.CODE: lambda row: row.participant.number,
    Order.ANSWERS: lambda row: (row.answered, row.participant.number),
    Order.SEEN: _seen,
    Order.FORESEEN: _foreseen,
}
