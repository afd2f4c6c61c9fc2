"""A server killed under load has forgotten no answer that it said was saved, and doubles none on the way back."""

import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.preferences import LabelEvent
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.answering import Labeller, Server
from tests.databases import make_tables
from tests.waiting import PATIENCE_S, free_port

PEOPLE = 4
LABELS = 25
KILL_AFTER = 30


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(_env_file=None, data_dir=tmp_path, port=free_port())


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    database = Database(settings.sqlalchemy_url)
    make_tables(database)
    yield database
    database.dispose()


@pytest.fixture
def tokens(settings: Settings, database: Database) -> list[str]:
    store = ArtefactStore.of(settings)
    tokens = []
    with database.writing() as session:
        study = factories.make_study(session, labels_per_participant=LABELS, pool_scenarios=20)
        for _ in range(PEOPLE):
            participant, token = factories.make_participant(session, study)
            factories.make_queries(session, store, participant, LABELS)
            tokens.append(token)
    return tokens


def test_no_acknowledged_answer_is_lost_and_none_is_doubled_when_the_server_is_killed(
    settings: Settings, database: Database, tokens: list[str]
) -> None:
    server = Server(settings)
    acknowledged: Counter[str] = Counter()
    answers = threading.Semaphore(0)
    labellers = [Labeller(server.address, token, acknowledged, answers) for token in tokens]
    for labeller in labellers:
        labeller.start()
    for _ in range(KILL_AFTER):
        assert answers.acquire(timeout=PATIENCE_S)
    server.kill()
    with database.reading() as session:
        stored = set(session.scalars(select(LabelEvent.client_uuid)))
    assert set(acknowledged) <= stored, "an answer that was said to be saved is gone"
    server.start()
    for labeller in labellers:
        labeller.join(timeout=PATIENCE_S)
    server.kill()
    with database.reading() as session:
        per_query = Counter(session.scalars(select(LabelEvent.query_id)))
    assert len(per_query) == PEOPLE * LABELS
    assert set(per_query.values()) == {1}
