"""A small studio with every file that its rows name, and what tests ask of its copies."""

import hashlib
import sqlite3
from contextlib import closing
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.clips import Rollout
from app.domain.models import ModelKind
from app.domain.participation import FormAnswer
from app.domain.studies import Participant
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.made_once import made_once

PEOPLE, ANSWERS = 3, 4


def mark_of(participant: Participant) -> str:
    """What this person has written into a form, and nobody else."""
    return f"only {participant.code} of study {participant.study_id} has said this"


def fill(session: Session, store: ArtefactStore, name: str = "Feeding at home") -> list[Participant]:
    """A study of people who have answered, filled in a form and got a model."""
    ids = made_once(_fill, session, store, name)
    return list(session.scalars(select(Participant).where(Participant.id.in_(ids)).order_by(Participant.id)))


def _fill(session: Session, store: ArtefactStore, name: str) -> list[int]:
    study = factories.make_study(session, name)
    people = []
    for _ in range(PEOPLE):
        participant, _ = factories.make_participant(session, study)
        for query in factories.make_queries(session, store, participant, ANSWERS):
            factories.make_label(session, query)
        text = mark_of(participant)
        session.add(FormAnswer(participant_id=participant.id, form="questionnaire", item="comments", value=text))
        model = factories.make_model(session, study, participant, ModelKind.REWARD, {})
        model.artefact_sha256 = store.put(f"model: {text}".encode())
        people.append(participant.id)
    for rollout in session.scalars(select(Rollout)):
        rollout.trajectory_sha256 = store.put(f"trajectory {rollout.id}".encode())
    session.flush()
    return people


def rows(path: Path) -> dict[str, list[tuple[object, ...]]]:
    """Everything in a database."""
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as connection:
        names = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {name: sorted(connection.execute(f"SELECT * FROM {name}"), key=repr) for name in names}  # noqa: S608


def artefacts(folder: Path) -> dict[str, str]:
    """Names below ``artefacts`` with the hash of what is in them."""
    files = [each for each in folder.glob("artefacts/*/*") if each.is_file()]
    return {each.name: hashlib.sha256(each.read_bytes()).hexdigest() for each in files}


def traces(folder: Path, mark: str) -> list[str]:
    """Files that hold the mark."""
    return [str(each) for each in sorted(folder.rglob("*")) if each.is_file() and mark.encode() in each.read_bytes()]


def open_studio(settings: Settings) -> tuple[Database, ArtefactStore]:
    """Database and files."""
    return Database(settings.sqlalchemy_url), ArtefactStore.of(settings)
