"""A studio in a directory, made as ``python -m app migrate`` makes it, with people in it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from app.db import Database
from app.domain.studies import Participant
from app.settings import Settings
from app.storage import ArtefactStore
from tests import backed_up
from tests.databases import make_tables


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(_env_file=None, data_dir=tmp_path / "data", database_url=None, backup_dir=None)


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    database = Database(settings.sqlalchemy_url)
    make_tables(database)
    yield database
    database.dispose()


@pytest.fixture
def store(settings: Settings) -> ArtefactStore:
    return ArtefactStore.of(settings)


@pytest.fixture
def people(database: Database, store: ArtefactStore) -> list[Participant]:
    with database.writing() as session:
        return backed_up.fill(session, store)
