"""The migrations build what the models describe, and can be taken back."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from sqlalchemy import Engine, create_engine, inspect, text

import app.domain.clips
import app.domain.evaluation
import app.domain.models
import app.domain.participation
import app.domain.people
import app.domain.preferences
import app.domain.studies  # noqa: F401  (all of them fill Base.metadata)
from app.db import Base
from tests import databases


@pytest.fixture
def config(tmp_path: Path) -> Iterator[Config]:
    config = Config()
    config.set_main_option("script_location", "migrations")
    with databases.lent(tmp_path, with_tables=False) as url:
        config.set_main_option("sqlalchemy.url", url.replace("%", "%%"))
        yield config


@pytest.fixture
def engine(config: Config) -> Iterator[Engine]:
    engine = create_engine(config.get_main_option("sqlalchemy.url") or "")
    yield engine
    engine.dispose()


def test_the_newest_migration_builds_exactly_what_the_models_describe(config: Config, engine: Engine) -> None:
    command.upgrade(config, "head")
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []


def test_every_migration_can_be_taken_back_and_made_again(config: Config, engine: Engine) -> None:
    command.upgrade(config, "head")
    command.downgrade(config, "base")
    assert inspect(engine).get_table_names() == ["alembic_version"]
    command.upgrade(config, "head")
    assert "label_event" in inspect(engine).get_table_names()


def test_every_study_of_the_second_version_gets_a_secret_of_its_own(config: Config, engine: Engine) -> None:
    command.upgrade(config, "0002")
    study = "INSERT INTO study (slug, name, task, stored_settings, seed, created_at)"
    with engine.begin() as connection:
        for slug in ("one", "other"):
            connection.execute(
                text(f"{study} VALUES (:slug, 'x', 'feeding', '{{}}', 7, '2026-01-02 03:04:05+00:00')"), {"slug": slug}
            )
    command.upgrade(config, "head")
    with engine.connect() as connection:
        secrets = connection.execute(text("SELECT key_secret FROM study")).scalars().all()
    assert len(set(secrets)) == 2
    assert all(len(secret) == 64 for secret in secrets)


def test_whoever_could_see_and_do_what_before_studies_had_members_still_can(config: Config, engine: Engine) -> None:
    command.upgrade(config, "0009")
    account = "INSERT INTO experimenter (name, password_hash, must_change_password, role, created_at)"
    study = "INSERT INTO study (slug, name, task, stored_settings, seed, created_at, key_secret)"
    with engine.begin() as connection:
        for role in ("owner", "experimenter", "reader"):
            connection.execute(text(f"{account} VALUES (:role, '-', false, :role, '2026-01-01')"), {"role": role})
        connection.execute(text(f"{study} VALUES ('pilot', 'x', 'feeding', '{{}}', 7, '2026-01-01', 's')"))
    command.upgrade(config, "head")
    joined = (
        "FROM experimenter JOIN study_member ON experimenter_id = experimenter.id JOIN study ON study_id = study.id"
    )
    with engine.connect() as connection:
        found = connection.execute(text(f"SELECT experimenter.name, experimenter.role, study_member.role {joined}"))
        assert {tuple(row) for row in found} == {
            ("owner", "administrator", "owner"),
            ("experimenter", "experimenter", "editor"),
            ("reader", "reader", "viewer"),
        }
