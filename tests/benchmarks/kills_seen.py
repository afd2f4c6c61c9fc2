"""What an onlooker sees while programs are killed, and what is found afterwards: answers, models, files, overlaps."""

import io
import threading
import zipfile
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import combinations
from typing import NamedTuple

from sqlalchemy import func, select
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.models import Bundle, ModelKind, Run, RunStatus
from app.domain.preferences import LabelEvent, count_labels
from app.domain.studies import Participant, Study
from app.services.monitoring import damage
from app.storage import ArtefactStore
from worker.jobs.learning import dataset
from worker.jobs.runtime import records
from worker.jobs.runtime.due_work import filter_due, reward_due

LOOK_S = 0.1
BEATS_WITHIN = timedelta(seconds=8)
"""A run of which nothing is heard for longer rests: its worker was killed and has not come back yet."""


@dataclass
class Findings:
    """What is to be nought, and what it was counted over."""

    lost: int = 0
    """answers that were acknowledged and are not there"""
    doubled: int = 0
    """answers stored twice, and pairs with two first answers"""
    stale: list[str] = field(default_factory=list)
    """people whose newest model or bundle has not seen what it should have"""
    overlaps: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    """stored files that a row names and whose content is not what was stored, while killing and afterwards"""
    answers: int = 0
    people: int = 0
    runs: Counter[str] = field(default_factory=Counter)
    files: int = 0
    bundles: int = 0

    @property
    def nothing_is_wrong(self) -> bool:
        """Whether everything that is to be nought is."""
        return not (self.lost or self.doubled or self.stale or self.overlaps or self.broken)


class _Sign(NamedTuple):
    """A time at which a worker said that it is at a run; the participant and the kind of the run, and its key."""

    participant: int
    kind: str
    key: str
    at: datetime


class Onlooker(threading.Thread):
    """Looks at the database all the time, as pages do, and reads every file at the moment at which a row names it."""

    def __init__(self, database: Database, store: ArtefactStore) -> None:
        super().__init__(daemon=True)
        self._database, self._store = database, store
        self._signs: set[_Sign] = set()
        self._read: set[str] = set()
        self._broken: list[str] = []
        self._enough = threading.Event()

    def run(self) -> None:
        while not self._enough.wait(LOOK_S):
            with suppress(OperationalError), self._database.reading() as session:
                running = select(Run.participant_id, Run.kind, Run.workflow_id, Run.heartbeat_at)
                rows = session.execute(running.where(Run.status == RunStatus.RUNNING, Run.participant_id.is_not(None)))
                self._signs |= {_Sign(person, kind, key, at) for person, kind, key, at in rows if person is not None}
                named = [use for use in damage.uses(session) if use.sha256 not in self._read]
            for use in named:
                self._read.add(use.sha256)
                if not self._store.has(use.sha256):
                    self._broken.append(use.what)

    def look_back(self, acknowledged: Mapping[str, int]) -> Findings:
        """Everything there is to be found now."""
        self._enough.set()
        self.join()
        found = Findings(overlaps=list(self._overlaps()), broken=list(self._broken))
        with self._database.reading() as session:
            stored = Counter(session.scalars(select(LabelEvent.client_uuid)))
            first = Counter(session.scalars(select(LabelEvent.query_id).where(LabelEvent.revision == 1)))
            found.lost = len(acknowledged.keys() - stored.keys())
            found.doubled = sum(count - 1 for each in (stored, first) for count in each.values())
            found.answers, found.people = len(acknowledged), session.scalar(select(func.count(Participant.id))) or 0
            found.runs = Counter(f"{kind} {status}" for kind, status in session.execute(select(Run.kind, Run.status)))
            uses = list(damage.uses(session))
            found.files = len({use.sha256 for use in uses})
            found.broken += [use.what for use in uses if not self._store.scrub(use.sha256)]
            for sha256 in session.scalars(select(Bundle.artefact_sha256)):
                found.bundles += 1
                with zipfile.ZipFile(io.BytesIO(self._store.read(sha256))) as archive:
                    found.broken += [name for name in [archive.testzip()] if name is not None]
        found.stale = list(self._stale())
        return found

    def _stale(self) -> Iterator[str]:
        with self._database.reading() as session:
            for person in session.scalars(select(Participant)).all():
                settings = session.get_one(Study, person.study_id).settings
                answered = count_labels(session, select(Participant.id).where(Participant.id == person.id))
                count = answered.get(person.id, 0)
                rewards, filters = reward_due(settings, count), filter_due(settings, count)
                if rewards and not self._has_seen(session, person, ModelKind.REWARD, rewards):
                    yield f"reward model of participant {person.id} ({count} labels)"
                if filters and not self._has_seen(session, person, ModelKind.FILTER, filters):
                    yield f"filter or bundle of participant {person.id} ({count} labels)"

    def _has_seen(self, session: Session, person: Participant, kind: ModelKind, labels: int) -> bool:
        """Whether the newest model has seen so many labels, and just those, if it has seen as many as there are."""
        newest = records.newest_model(session, person.id, kind)
        said = dataset.load_preferences(session, self._store, person.id)
        if newest is None or newest.label_count < labels:
            return False
        if newest.label_count == said.label_count and newest.label_hash != said.label_hash:
            return False
        published = session.scalar(select(Bundle.id).where(Bundle.model_id == newest.id))
        return kind == ModelKind.REWARD or published is not None

    def _overlaps(self) -> Iterator[str]:
        """Runs of one kind of one participant, both of which somebody was at, at the same time."""
        beats: dict[tuple[int, str], dict[str, list[datetime]]] = defaultdict(lambda: defaultdict(list))
        for sign in sorted(self._signs, key=lambda sign: sign.at):
            beats[sign.participant, sign.kind][sign.key].append(sign.at)
        for runs in beats.values():
            for (one, ones), (other, others) in combinations(runs.items(), 2):
                if any(a <= d and c <= b for a, b in _spans(ones) for c, d in _spans(others)):
                    yield f"{one} and {other}"


def _spans(beats: list[datetime]) -> list[tuple[datetime, datetime]]:
    """From the first to the last of the signs that follow each other without a long silence."""
    spans = [(beats[0], beats[0])]
    for at in beats[1:]:
        begun, last = spans[-1]
        if at - last <= BEATS_WITHIN:
            spans[-1] = (begun, at)
        else:
            spans.append((at, at))
    return spans
