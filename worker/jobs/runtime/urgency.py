"""Whose work comes first: that of whoever waits, and the longer somebody waits the sooner.

Known from the database alone (Participant.waiting_for, waiting_since, last_seen_at), so every worker knows it.
"""

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from enum import IntEnum
from typing import NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.models import Model, Run, RunKind, RunStatus
from app.domain.protocol import FROM_OTHERS
from app.domain.run_keys import AHEAD, BEFORE_AFTER, LENT, MADE
from app.domain.studies import Awaited, Participant, Study
from app.services.evaluation import donors
from app.services.runs.estimates import PRESENT_WITHIN
from worker.jobs.runtime.records import Job

ASKED_WITHIN = timedelta(minutes=10)
"""So long after unblinding a report is what an experimenter waits for."""
_BEGINNING = datetime(1970, 1, 1, tzinfo=UTC)


class Level(IntEnum):
    """Why something is done, the most urgent first."""

    WAITING = 0
    """A participant looks at a waiting page for it right now."""
    ANSWERING = 1
    """A participant is here and will soon need it."""
    ASKED = 2
    """An experimenter has asked for it."""
    DUE = 3
    """A participant needs it who is not here, or waits for something else first."""
    POOL = 4
    """Clips of a study with participants, and filters and films that somebody may be shown later."""
    UNOPENED = 5
    """Clips of a study that has none."""
    UNREAD = 6
    """A report that nobody has asked for."""


class Urgency(NamedTuple):
    """Smaller is sooner: the level, since when somebody waits or was seen, and what one person needs first."""

    level: Level
    since: datetime
    step: int


_ORDER = (RunKind.REWARD, RunKind.REFINEMENT, RunKind.FILTER, RunKind.SHARED, RunKind.METHOD, RunKind.FILMS)
_STEPS = {RunKind.CLIPS: 0} | {kind: step for step, kind in enumerate(_ORDER)}
_LAST_STEP = len(_ORDER)


@dataclass(frozen=True)
class _Person:
    study_id: int
    seen_at: datetime | None
    awaited: str | None
    waiting_since: datetime | None
    present: bool


@dataclass(frozen=True)
class WhoWaits:
    """Everybody as they were at one moment."""

    people: Mapping[int, _Person] = field(default_factory=dict)
    just_unblinded: frozenset[int] = frozenset()
    shared_awaited: Mapping[str, datetime] = field(default_factory=dict)
    """Keys of filters for several, with since when somebody looks at a waiting page who is to be lent them."""
    measuring: frozenset[str] = frozenset()
    """Keys of runs that have left their method and only measure it: nobody waits for the numbers"""

    @classmethod
    def look(cls, session: Session) -> "WhoWaits":
        """As the database has it now."""
        moment = now()
        columns = (
            Participant.id,
            Participant.study_id,
            Participant.last_seen_at,
            Participant.waiting_for,
            Participant.waiting_since,
        )
        rows = session.execute(select(*columns).where(Participant.withdrawn_at.is_(None)))
        people = {
            row.id: _Person(
                row.study_id,
                row.last_seen_at,
                row.waiting_for,
                row.waiting_since,
                present=row.last_seen_at is not None and moment - row.last_seen_at <= PRESENT_WITHIN,
            )
            for row in rows
        }
        unblinded = session.scalars(select(Study.id).where(Study.unblinded_at > moment - ASKED_WITHIN))
        left = select(Run.workflow_id).join(Model, Model.run_id == Run.id).where(Run.kind == RunKind.METHOD)
        measuring = session.scalars(left.where(Run.status == RunStatus.RUNNING))
        return cls(people, frozenset(unblinded), _shared_awaited(session, people), frozenset(measuring))

    def urgency(self, job: Job) -> Urgency:
        """How soon the job is to be done."""
        if job.kind in (RunKind.EXPORT, RunKind.POWER) or (
            job.kind == RunKind.REPORT and job.study_id in self.just_unblinded
        ):
            return Urgency(Level.ASKED, _BEGINNING, 0)
        if job.kind == RunKind.REPORT:
            return Urgency(Level.UNREAD, _BEGINNING, 0)
        if job.kind == RunKind.SHARED:
            since = self.shared_awaited.get(job.key)
            level = Level.WAITING if since else max(Level.POOL, self._of_study(job.study_id).level)
            return Urgency(level, since or _BEGINNING, _STEPS[RunKind.SHARED])
        if job.about.subject in (AHEAD, LENT) and job.kind != RunKind.REFINEMENT:
            return Urgency(Level.POOL, _BEGINNING, _LAST_STEP)
        person = None if job.participant_id is None else self.people.get(job.participant_id)
        if person is None:
            return self._of_study(job.study_id)
        is_here = Level.ANSWERING if person.present and not person.awaited else Level.POOL
        if job.about.subject == MADE:  # nobody waits for it: as long as there is none, the study's rule chooses
            return Urgency(is_here, _BEGINNING, 0)
        if job.kind == RunKind.REFINEMENT:  # ahead, of their last filter: nobody will wait for their earlier ones
            return Urgency(is_here, person.seen_at or _BEGINNING, _STEPS[RunKind.REFINEMENT])
        found = _of_person(person, job)
        return found._replace(level=max(found.level, Level.DUE)) if job.key in self.measuring else found

    def _of_study(self, study_id: int) -> Urgency:
        """Of its clips, for which those wait who compare."""
        people = [each for each in self.people.values() if each.study_id == study_id]
        if not people:
            return Urgency(Level.UNOPENED, _BEGINNING, 0)
        comparing = [each for each in people if each.present and each.awaited in (None, Awaited.PAIR, Awaited.PREVIEW)]
        waiting = [each.waiting_since for each in comparing if each.awaited == Awaited.PAIR and each.waiting_since]
        if waiting:
            return Urgency(Level.WAITING, min(waiting), 0)
        return Urgency(Level.ANSWERING if comparing else Level.POOL, _BEGINNING, 0)


def _shared_awaited(session: Session, people: Mapping[int, _Person]) -> dict[str, datetime]:
    found: dict[str, datetime] = {}
    for number, person in people.items():
        if not person.present or person.awaited != Awaited.ROBOTS or person.waiting_since is None:
            continue
        for method in FROM_OTHERS:
            shared = donors.awaited_by(session, session.get_one(Participant, number), method)
            if shared is not None:
                key = str(donors.key_of(shared))
                found[key] = min(found.get(key, person.waiting_since), person.waiting_since)
    return found


def _of_person(person: _Person, job: Job) -> Urgency:
    before_after = job.about.subject == BEFORE_AFTER
    step = _LAST_STEP if before_after else _STEPS.get(RunKind(job.kind), _LAST_STEP)
    if not person.present:
        return Urgency(Level.DUE, person.seen_at or _BEGINNING, step)
    if person.awaited and person.waiting_since:
        comes_later = before_after and person.awaited != Awaited.DEBRIEF
        return Urgency(Level.DUE if comes_later else Level.WAITING, person.waiting_since, step)
    since = person.waiting_since or person.seen_at or _BEGINNING
    if job.kind == RunKind.FILMS and not before_after:  # they rate the first robots already, and the next one is due
        return Urgency(Level.WAITING, since, step)
    return Urgency(Level.ANSWERING, since, step)


class Gate:
    """Lets so many in at a time, the most urgent first; asked anew whenever one leaves, for urgency changes.

    ``holds_back``: whether nobody of this level is to be let in at present, although there is room.
    """

    LOOK_S = 1.0

    def __init__(self, places: int, holds_back: Callable[[Level], bool] = lambda _level: False) -> None:
        self._places = self._free = places
        self._holds_back = holds_back
        self._waiting: dict[int, Callable[[], Urgency]] = {}
        self._number = 0
        self._changed = threading.Condition()

    @property
    def inside(self) -> int:
        """How many have been let in, and are still there."""
        return self._places - self._free

    @contextmanager
    def passed(self, urgency: Callable[[], Urgency]) -> Iterator[None]:
        """Waits for a place, which is given back at the end."""
        with self._changed:
            self._number += 1
            mine = self._number
            self._waiting[mine] = urgency
            while not self._is_next(mine):
                self._changed.wait(self.LOOK_S)
            del self._waiting[mine]
            self._free -= 1
            self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._free += 1
                self._changed.notify_all()

    def is_awaited_above(self, level: Level) -> bool:
        """Whether somebody waits here who is more urgent than this level."""
        with self._changed:
            return any(urgency().level < level for urgency in self._waiting.values())

    def _is_next(self, mine: int) -> bool:
        ranks = {number: urgency() for number, urgency in self._waiting.items()}
        admissible = [(rank, number) for number, rank in ranks.items() if not self._holds_back(rank.level)]
        return self._free > 0 and bool(admissible) and min(admissible)[1] == mine
