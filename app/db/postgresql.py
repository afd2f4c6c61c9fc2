"""Connections to PostgreSQL, and upkeep of its files: the one place that knows its driver."""

import time
from typing import Any

from psycopg.types.string import StrDumperUnknown
from sqlalchemy import Engine, create_engine, event, text
from sqlalchemy.exc import OperationalError

POOL_SIZE, POOL_OVERFLOW = 15, 5
"""Connections that one process keeps, and how many more it may open."""
SESSION = {"tcp_keepalives_idle": "20", "tcp_keepalives_interval": "10", "tcp_keepalives_count": "3"}
"""A machine that vanishes in the middle of a transaction must not keep its locks for two hours."""
LOOK_EVERY_S = 0.1


def engine(url: str, patience_s: float) -> Engine:
    """Connections that wait so long for a lock, and that take every text that SQLite takes."""
    connections = create_engine(url, pool_pre_ping=True, pool_size=POOL_SIZE, max_overflow=POOL_OVERFLOW)

    @event.listens_for(connections, "connect")
    def prepare(connection: Any, _record: Any) -> None:
        connection.adapters.register_dumper(str, _TextDumper)
        for name, setting in {**SESSION, "lock_timeout": f"{1000 * patience_s:.0f}"}.items():
            connection.execute("SELECT set_config(%s, %s, false)", (name, setting))
        connection.commit()

    return connections


_OUR_TABLES = text("""
    SELECT format('%I.%I', schemaname, tablename) FROM pg_tables
    WHERE tableowner = current_user AND schemaname NOT IN ('pg_catalog', 'information_schema')
""")
_NOW = text("SELECT pg_snapshot_xmax(pg_current_snapshot())::text")
_SOMEBODY_SEES_THE_PAST = text("""
    SELECT pg_snapshot_xmin(pg_current_snapshot()) < CAST(:moment AS xid8) OR EXISTS (
    SELECT FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()
    AND age(backend_xmin) > age(CAST(:moment AS xid8)::xid))
""")
"""Whoever reads in this database, and whoever writes in any of the server's: our own snapshot begins with the first of
these, and what it could still see is copied as well."""


def rewrite_tables(connections: Engine, patience_s: float) -> bool:
    """Copy what is alive in every table, the engine's included, to new files. False while it is busy.

    What a transaction that began before could still see would be copied as well, so those are waited for.
    """
    give_up_s = time.monotonic() + patience_s
    try:
        with connections.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            moment = connection.scalar(_NOW)
            while connection.scalar(_SOMEBODY_SEES_THE_PAST, {"moment": moment}):
                if time.monotonic() > give_up_s:
                    return False
                time.sleep(LOOK_EVERY_S)
            connection.execute(text(f"VACUUM FULL {', '.join(connection.scalars(_OUR_TABLES))}"))
    except OperationalError:
        return False
    return True


class _TextDumper(StrDumperUnknown):
    """Sends text to PostgreSQL, which refuses the character NUL: it becomes the replacement character, as in HTML."""

    def dump(self, obj: str) -> Any:
        return super().dump(obj.replace("\0", "\N{REPLACEMENT CHARACTER}"))
