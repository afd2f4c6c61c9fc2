"""What most tests of pages need, a participant in the middle of a study; and another installation to bring studies."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID, uuid4

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from httpx2 import Response as Answer
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.preferences import LabelEvent, Query
from app.domain.studies import Participant, Study
from app.main import create_app
from app.services.archives import study_import
from app.settings import Settings
from app.storage import ArtefactStore
from tests import databases, factories
from tests.app.gate import Gate, make_gate
from tests.databases import make_tables
from tests.made_once import made_once

JSON = {"Accept": "application/json"}


def agree(browser: TestClient) -> Answer:
    """Agree to the consent text that the browser is shown."""
    shown = re.search(r'name="shown" value="(\w+)"', browser.get("/p/consent").text)
    assert shown is not None
    return browser.post("/p/consent", data={"shown": shown[1]})


@dataclass
class TakingPart:
    """A participant, their browser, and the queries waiting for them."""

    browser: TestClient
    participant: Participant
    token: str
    study: Study
    queries: Sequence[Query]
    database: Database

    def answer(self, query: Query, response: str = "left", uuid: UUID | None = None, **fields: object) -> Answer:
        """Send an answer as the page's script does."""
        form = {"response": response, "client_uuid": str(uuid or uuid4()), **fields}
        return self.browser.post(f"/p/queries/{query.id}/label", data=form, headers=JSON)

    def undo(self, query: Query, uuid: UUID | None = None) -> Answer:
        """Take an answer back as the page's script does."""
        form = {"client_uuid": str(uuid or uuid4())}
        return self.browser.post(f"/p/queries/{query.id}/undo", data=form, headers=JSON)

    def turn(self) -> Answer:
        """Ask for what is to be shown now."""
        return self.browser.get("/p/next", headers=JSON)

    def events(self, query: Query) -> Sequence[LabelEvent]:
        """What the database holds about a query, oldest first."""
        of_query = select(LabelEvent).where(LabelEvent.query_id == query.id).order_by(LabelEvent.revision)
        with self.database.reading() as session:
            return session.scalars(of_query).all()


@pytest.fixture
def taking_part(database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient]) -> TakingPart:
    """A participant who has read the instructions, opened the link, and has twelve queries waiting."""
    with database.writing() as session:
        participant_id, token = made_once(_somebody_with_queries, session, store)
        participant = session.get_one(Participant, participant_id)
        study = session.get_one(Study, participant.study_id)
        theirs = select(Query).where(Query.participant_id == participant_id).order_by(Query.ordinal)
        queries = session.scalars(theirs).all()
    browser = new_browser()
    browser.get(f"/p/{token}")
    return TakingPart(browser, participant, token, study, queries, database)


def _somebody_with_queries(session: Session, store: ArtefactStore) -> tuple[int, str]:
    study = factories.make_study(session)
    participant, token = factories.make_participant(session, study)
    factories.make_queries(session, store, participant, 12)
    return participant.id, token


@pytest.fixture
def elsewhere(tmp_path: Path) -> Iterator[FastAPI]:
    """Another installation, which already holds something: ids there are others."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    with databases.lent(folder) as url:
        application = create_app(Settings(_env_file=None, data_dir=folder, database_url=url, public_url=None))
        there: Database = application.state.studio.database
        make_tables(there)
        with there.writing() as session:
            study = factories.make_study(session, "Something else")
            person, _ = factories.make_participant(session, study)
            factories.make_queries(session, application.state.studio.store, person, 3)
        yield application
        there.dispose()


def bring(application: FastAPI, path: Path, seal_key: str = "") -> study_import.Imported:
    """Import an archive there."""
    studio = application.state.studio
    with studio.database.writing() as session:
        return study_import.read(session, studio.store, path, "experimenter", seal_key)


@pytest.fixture
def gate(studio_app: FastAPI, database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient]) -> Gate:
    """Two studies, and a browser of every kind of visitor."""
    return make_gate(studio_app, database, store, new_browser)
