"""Who waits for changes sees everybody's, and nothing else."""

from contextlib import closing

from sqlalchemy import create_engine, select, update

from app.db import Database, Watch
from app.domain.studies import Study
from app.settings import Settings
from tests import databases, factories
from tests.waiting import until


def is_still(watch: Watch) -> bool:
    """Nothing has changed. What others write to other databases of a PostgreSQL server may count, until they pause."""
    return not watch.changed() if databases.SERVER is None else until(lambda: not watch.changed())


def test_what_was_there_before_is_a_change_once(database: Database) -> None:
    with closing(database.watch()) as watch:
        assert watch.changed()
        assert is_still(watch)


def test_reading_is_no_change_and_writing_is_one(database: Database) -> None:
    with closing(database.watch()) as watch:
        watch.changed()
        with database.reading() as session:
            assert session.scalars(select(Study)).all() == []
        assert is_still(watch)
        with database.writing() as session:
            factories.make_study(session)
        assert watch.changed()
        assert is_still(watch)


def test_what_is_written_while_one_looks_is_seen_the_next_time(database: Database) -> None:
    with closing(database.watch()) as watch:
        watch.changed()
        with database.writing() as session:
            factories.make_study(session)
            session.flush()
            assert is_still(watch), "not yet committed"
        assert watch.changed()


def test_another_process_s_changes_count(database: Database, settings: Settings) -> None:
    with database.writing() as session:
        factories.make_study(session)
    with closing(database.watch()) as watch:
        watch.changed()
        other = create_engine(settings.sqlalchemy_url)
        with other.begin() as connection:
            connection.execute(update(Study).values(name="Renamed"))
        other.dispose()
        assert watch.changed()


def test_who_watches_does_not_keep_erased_rows_in_the_files(database: Database) -> None:
    with closing(database.watch()) as watch:
        watch.changed()
        assert database.forget_erased(), "the files could not be rewritten"
        watch.changed()
        with database.writing() as session:
            factories.make_study(session)
        assert watch.changed(), "still watching the rewritten file"
