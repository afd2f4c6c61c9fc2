"""Runs the migrations on the database of the settings, or on the one given as ``sqlalchemy.url``."""

from typing import Any, Literal

from alembic import context
from sqlalchemy import Connection, Engine, create_engine, event, text

import app.domain.clips
import app.domain.evaluation
import app.domain.hints
import app.domain.models
import app.domain.participation
import app.domain.people
import app.domain.power_plan
import app.domain.preferences
import app.domain.self_setting
import app.domain.studies  # noqa: F401  (all of them fill Base.metadata)
from app.db import Base, UtcDateTime
from app.errors import AppError
from app.settings import Settings

PATIENCE_S = 600
MIGRATING = 1_347_310_156
"""Any number that no other program on the server uses."""


def render_item(kind: str, item: Any, _context: object) -> str | Literal[False]:
    """Write our time type as plain SQLAlchemy, so that old migrations never depend on today's code."""
    if kind == "type" and isinstance(item, UtcDateTime):
        return "sa.DateTime(timezone=True)"
    return False


def run() -> None:
    """Migrate in a single transaction, which a killed process leaves no half of, with SQLite as with PostgreSQL."""
    url = context.config.get_main_option("sqlalchemy.url") or Settings().sqlalchemy_url
    engine = create_engine(url)
    if engine.dialect.name == "sqlite":
        _begin_for_real(engine)
    with engine.connect() as connection:
        context.configure(
            connection=connection,
            target_metadata=Base.metadata,
            render_as_batch=True,
            render_item=render_item,
            transactional_ddl=True,
        )
        with context.begin_transaction():
            if engine.dialect.name == "postgresql":  # whoever comes second waits, and then finds it done
                connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": MIGRATING})
            context.run_migrations()
            if engine.dialect.name == "sqlite":
                _check_references(connection)
    engine.dispose()


def _begin_for_real(engine: Engine) -> None:
    """Python's driver would commit before every CREATE and ALTER; the lock taken first keeps a second program waiting.

    References are checked at the end: a table that is rebuilt is dropped in between, and would take along what refers
    to it.
    """

    @event.listens_for(engine, "connect")
    def prepare(connection: Any, _record: Any) -> None:
        connection.isolation_level = None
        connection.execute(f"PRAGMA busy_timeout={1000 * PATIENCE_S}")
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute("PRAGMA foreign_keys=OFF")

    @event.listens_for(engine, "begin")
    def start(connection: Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE")


def _check_references(connection: Connection) -> None:
    broken = connection.execute(text("PRAGMA foreign_key_check")).all()
    if broken:
        tables = ", ".join(sorted({row[0] for row in broken}))
        raise AppError(
            f"The database was not upgraded and is as it was: {len(broken)} of its rows refer to others that are not "
            f"there ({tables}). Restore it from a backup."
        )


run()
