"""Empty databases of the newest schema, made once and copied: making the tables takes longer than most tests."""

import tempfile
from functools import cache
from pathlib import Path

from app.db import Base, Database, file_of


@cache
def _empty() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "empty.sqlite3"
        database = Database(f"sqlite:///{path}")
        Base.metadata.create_all(database.writer)
        database.dispose()
        return path.read_bytes()


def make_tables(database: Database) -> None:
    """Give a database its tables, unless it has them."""
    path = file_of(database.url)
    assert path is not None
    if not path.exists():
        path.write_bytes(_empty())
