"""Whether the studio can do its work: keep what is said, in the schema it was written for, with room on the disk."""

import shutil
from functools import cache
from pathlib import Path

from sqlalchemy import text
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.orm import Session

from app.db import Database, complaints
from app.errors import AppError
from app.paths import MIGRATIONS

LEAST_FREE_BYTES = 200 * 1024**2
"""Below, the studio says that it is not ready, while there is still room for the answers of whoever is in the middle.

The dashboard warns long before."""

_VERSIONS = "alembic_version"

DISK_FULL = "The disk is nearly full. Free some space."
NOT_WRITABLE = "The database cannot be written. The log of the web server says why."
OLD_SCHEMA = "The database is not of this version. Start the studio anew, or run: python -m app migrate"


class OtherSchema(AppError):
    """The database is not of this version of the program. Install the same version on every machine, then run:
    python -m app migrate"""


def require_own_schema(session: Session) -> None:
    """Raises OtherSchema when the database is of an older or newer version, or of none."""
    try:
        revision = _revision(session)
    except DBAPIError as error:
        if _VERSIONS in str(error.orig):
            raise OtherSchema from error
        raise
    if revision != newest_revision():
        raise OtherSchema


def complaint(database: Database, data_dir: Path) -> str | None:
    """What is wrong, in words that tell strangers nothing; None when all is well. Writes, since only writing shows."""
    try:
        if shutil.disk_usage(data_dir).free < LEAST_FREE_BYTES:
            return DISK_FULL
        with database.writing(own_rows=True) as session:
            revision = _revision(session)
            session.execute(text("UPDATE alembic_version SET version_num = version_num"))
    except (SQLAlchemyError, OSError) as error:
        said = str(error.orig) if isinstance(error, DBAPIError) else str(error)
        complaints.error("not ready: %s", said)
        return OLD_SCHEMA if _VERSIONS in said else NOT_WRITABLE
    return None if revision == newest_revision() else OLD_SCHEMA


def _revision(session: Session) -> str | None:
    found: str | None = session.scalar(text("SELECT version_num FROM alembic_version"))
    return found


@cache
def newest_revision() -> str | None:
    """Of the schema this version was written for."""
    from alembic.config import Config  # takes a quarter of a second to load
    from alembic.script import ScriptDirectory

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    return ScriptDirectory.from_config(config).get_current_head()
