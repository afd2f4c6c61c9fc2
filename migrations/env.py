"""Runs the migrations on the database of the settings, or on the one given as ``sqlalchemy.url``."""

from typing import Any, Literal

from alembic import context
from sqlalchemy import create_engine

import app.domain.clips
import app.domain.evaluation
import app.domain.models
import app.domain.participation
import app.domain.people
import app.domain.preferences
import app.domain.studies  # noqa: F401  (all of them fill Base.metadata)
from app.db import Base, UtcDateTime
from app.settings import Settings


def render_item(kind: str, item: Any, _context: object) -> str | Literal[False]:
    """Write our time type as plain SQLAlchemy, so that old migrations never depend on today's code."""
    if kind == "type" and isinstance(item, UtcDateTime):
        return "sa.DateTime(timezone=True)"
    return False


def run() -> None:
    """Migrate in one transaction per step, with tables rebuilt where SQLite cannot alter them."""
    url = context.config.get_main_option("sqlalchemy.url") or Settings().sqlalchemy_url
    engine = create_engine(url)
    with engine.connect() as connection:
        context.configure(
            connection=connection,
            target_metadata=Base.metadata,
            render_as_batch=True,
            render_item=render_item,
        )
        with context.begin_transaction():
            context.run_migrations()
    engine.dispose()


run()
