"""Tells the operator of every trouble once it lasts, again each day, and when it is over.

What has been told is in the database, so that several web servers tell it once, and a restart forgets nothing.
"""

import logging
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime, timedelta

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from app.db import Database, complaints, now
from app.domain.models import Alert
from app.errors import AppError
from app.services.alerting import messages, troubles
from app.services.alerting.messages import Line, Message
from app.services.alerting.troubles import Trouble
from app.services.monitoring.health import NOT_WRITABLE
from app.settings import Settings
from app.storage import ArtefactStore

LOOK_S = 20.0
SETTLES = timedelta(minutes=1)
"""What is over before that was no trouble."""
RETRY = timedelta(minutes=5)
REMINDER = timedelta(days=1)

log = logging.getLogger(__name__)


class Alerts:
    """Looks for troubles and tells of those that are due."""

    def __init__(self, settings: Settings, database: Database, store: ArtefactStore) -> None:
        self._settings, self._database, self._store = settings, database, store
        self._without_database: Alert | None = None

    def look(self, moment: datetime) -> None:
        """Tell what is to be told now; what cannot be delivered is tried again."""
        found = list(troubles.of_machine(self._settings))
        try:
            with self._database.writing() as session:
                found += troubles.of_studies(session, self._settings, self._store)
                due = [_line(each) for each in _due(session, found, moment)]
        except (SQLAlchemyError, OSError) as error:
            complaints.error("the database cannot be used: %s", error)
            self._tell_without_database(moment)
            return
        self._database_is_back()
        if due:
            self._tell(due)
            with self._database.writing() as session:
                _settle(session, due, moment)

    def _tell(self, lines: Sequence[Line]) -> None:
        messages.send(self._settings, Message(self._settings.base_url, lines))

    def _tell_without_database(self, moment: datetime) -> None:
        """Each web server for itself, from memory."""
        alert = self._without_database
        if alert is None:
            self._without_database = Alert(
                trouble="database", words=NOT_WRITABLE, began_at=moment, due_at=moment + SETTLES
            )
        elif alert.due_at <= moment:
            alert.due_at = moment + RETRY
            self._tell([_line(alert)])
            alert.told_at, alert.due_at = moment, moment + REMINDER

    def _database_is_back(self) -> None:
        alert, self._without_database = self._without_database, None
        if alert is not None and alert.told_at is not None:
            self._tell([Line(alert.trouble, alert.words, alert.began_at, is_over=True)])


@contextmanager
def watching(settings: Settings, database: Database, store: ArtefactStore) -> Iterator[None]:
    """Look now and then until the block ends, in a thread of its own; nothing when nobody wants to be told."""
    if not messages.can_tell(settings):
        yield
        return
    alerts, stop = Alerts(settings, database, store), threading.Event()

    def keep_looking() -> None:
        while not stop.wait(LOOK_S):
            try:
                alerts.look(now())
            except AppError as refusal:
                log.warning("%s", refusal.message)
            except Exception:  # the thread's edge: one look that fails must not be the last
                log.exception("could not look for troubles")

    threading.Thread(target=keep_looking, name="alerts", daemon=True).start()
    try:
        yield
    finally:
        stop.set()


def _due(session: Session, found: Sequence[Trouble], moment: datetime) -> Sequence[Alert]:
    """Bring the rows up to date; those to be told now. Another web server that looks meanwhile leaves them to us."""
    rows = {row.trouble: row for row in session.scalars(select(Alert))}
    for trouble in found:
        row = rows.get(trouble.key)
        if row is None:
            session.add(Alert(trouble=trouble.key, words=trouble.words, began_at=moment, due_at=moment + SETTLES))
            continue
        row.words = trouble.words
        if row.over_at is not None:
            row.over_at = None  # it was told, and what was told is true again
            row.due_at = (row.told_at or moment) + REMINDER
    for key in rows.keys() - {trouble.key for trouble in found}:
        if rows[key].told_at is None:
            session.delete(rows.pop(key))
        elif rows[key].over_at is None:
            rows[key].over_at, rows[key].due_at = moment, moment + SETTLES
    due = [row for row in rows.values() if row.due_at <= moment]
    for row in due:
        row.due_at = moment + RETRY
    return due


def _settle(session: Session, told: Sequence[Line], moment: datetime) -> None:
    for line in told:
        row = session.get(Alert, line.trouble)
        if row is not None and line.is_over and row.over_at is not None:
            session.delete(row)
        elif row is not None:
            row.told_at, row.due_at = moment, moment + REMINDER


def _line(alert: Alert) -> Line:
    return Line(alert.trouble, alert.words, alert.began_at, alert.over_at is not None)
