"""``check --deploy``: each unsafe thing is said by itself, a safe deployment passes, and nothing is changed."""

import stat
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from alembic import command
from alembic.config import Config
from sqlalchemy import text

from app import __main__ as program
from app import signing
from app.commands import deploy_check
from app.db import Database, now
from app.domain.people import ApiToken, Experimenter
from app.paths import MIGRATIONS
from app.services.backups import schedule
from app.settings import Settings
from tests import databases


@pytest.fixture
def safe(settings: Settings, database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Settings:
    """A deployment as it should be."""
    monkeypatch.chdir(tmp_path)
    backups = tmp_path / "backups"
    backups.mkdir(mode=0o700)
    with database.writing() as session:
        session.add(Experimenter(name="ada", password_hash="-", must_change_password=False, second_factor_since=now()))
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    config.set_main_option("sqlalchemy.url", settings.sqlalchemy_url.replace("%", "%%"))
    command.stamp(config, "head")
    signing.load(settings)
    note(settings, schedule.Standing(24, now(), made_at=now()))
    close(tmp_path)
    return Settings(
        _env_file=None,
        data_dir=settings.data_dir,
        database_url=settings.database_url,
        public_url="https://studio.example",
        secure_cookies=True,
        trusted_proxies="127.0.0.1",
        backup_dir=backups,
    )


def note(settings: Settings, standing: schedule.Standing) -> None:
    """As the worker would."""
    schedule._note(settings.data_dir, standing)


def close(folder: Path) -> None:
    for path in folder.rglob("*"):
        path.chmod(stat.S_IMODE(path.stat().st_mode) & ~0o077)


def unsafe(settings: Settings) -> list[str]:
    return [each.words for each in deploy_check.findings(settings) if each.is_unsafe]


def test_a_safe_deployment_passes(safe: Settings, capsys: pytest.CaptureFixture[str]) -> None:
    assert unsafe(safe) == []
    assert deploy_check.check(safe, deploy=True) == 0
    assert "Nothing unsafe was found." in capsys.readouterr().out


CHANGED: dict[str, tuple[dict[str, Any], str]] = {
    "plain http": ({"public_url": "http://studio.example", "trusted_proxies": ""}, "travel unencrypted"),
    "cookies": ({"secure_cookies": False}, "SECURE_COOKIES"),
    "open to the network": ({"public_url": None, "host": "192.0.2.1"}, "PUBLIC_URL is http://192.0.2.1"),
    "no proxy": ({"trusted_proxies": ""}, "TRUSTED_PROXIES is not set"),
    "a campus of proxies": ({"trusted_proxies": "10.0.0.0/8"}, "more than a few proxies"),
    "no backup": ({"backup_dir": None}, "BACKUP_DIR is not set"),
    "long logins": ({"login_hours": 24 * 30}, "LOGIN_HOURS"),
    "idle logins": ({"login_idle_minutes": 24 * 60}, "LOGIN_IDLE_MINUTES"),
    "quick guesses": ({"login_attempts_per_minute": 1000}, "LOGIN_ATTEMPTS_PER_MINUTE"),
    "metrics": ({"metrics_token": "aaaaaaaaaaaaaaaaaaaa"}, "METRICS_TOKEN can be guessed"),
}


@pytest.mark.parametrize(("changed", "said"), CHANGED.values(), ids=CHANGED.keys())
def test_each_unsafe_setting_is_said(safe: Settings, changed: dict[str, Any], said: str) -> None:
    found = unsafe(safe.model_copy(update=changed))
    assert len([words for words in found if said in words]) == 1, found


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("postgresql+psycopg://studio:studio@127.0.0.1/studio", ["can be guessed"]),
        ("postgresql+psycopg://studio:0f3kd93jfo2k3jf92l@db.example/studio", ["travel unencrypted"]),
        ("postgresql+psycopg://studio:0f3kd93jfo2k3jf92l@db.example/studio?sslmode=verify-full", []),
        ("postgresql+psycopg://studio@/studio", []),
    ],
)
def test_an_address_of_the_database_is_looked_at(safe: Settings, url: str, said: list[str]) -> None:
    found = list(deploy_check._of_secrets(safe.model_copy(update={"database_url": url})))
    assert [words for words in said if any(words in each.words for each in found)] == said
    assert len(found) == len(said)


@pytest.mark.parametrize("name", ["signing.key", ".env", "backups"])
def test_what_others_can_read_is_said_and_left_alone(safe: Settings, tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.touch()
    path.chmod(0o755)
    assert [name in words for words in unsafe(safe)] == [True]
    assert stat.S_IMODE(path.stat().st_mode) == 0o755


@pytest.mark.sqlite("a database file is SQLite's")
def test_a_database_that_others_can_read_is_said(safe: Settings, tmp_path: Path) -> None:
    (tmp_path / "studio.sqlite3").chmod(0o644)
    assert ["studio.sqlite3" in words for words in unsafe(safe)] == [True]


@pytest.mark.parametrize(
    ("standing", "said"),
    [
        (schedule.Standing(24, now()), "No backup has been made yet"),
        (schedule.Standing(24, now(), made_at=now(), failed_at=now(), words="The disk is full."), "The disk is full."),
        (schedule.Standing(24, now(), made_at=now() - timedelta(days=9)), "does it run?"),
    ],
)
def test_backups_that_are_not_made_are_said(safe: Settings, standing: schedule.Standing, said: str) -> None:
    note(safe, standing)
    assert [said in words for words in unsafe(safe)] == [True]


def test_accounts_without_a_second_factor_are_counted(safe: Settings, database: Database) -> None:
    with database.writing() as session:
        session.add(Experimenter(name="kim", password_hash="-", must_change_password=False))
        session.add(Experimenter(name="off", password_hash="-", disabled_at=now()))
        session.add(Experimenter(name="lee", password_hash="-", must_change_password=False, oidc_subject="x y"))
    assert [words.partition(":")[0] for words in unsafe(safe)] == ["1 of 3 accounts have no second factor"]
    assert unsafe(safe.model_copy(update={"require_second_factor": True})) == []


def test_a_one_time_password_that_lies_about_is_said(safe: Settings, database: Database) -> None:
    with database.writing() as session:
        session.add(
            Experimenter(name="kim", password_hash="-", second_factor_since=now(), created_at=now() - timedelta(days=8))
        )
    assert ["one-time password of kim" in words for words in unsafe(safe)] == [True]


def test_tokens_without_an_end_are_said(safe: Settings, database: Database) -> None:
    with database.writing() as session:
        session.add(ApiToken(experimenter_id=1, name="old", token_sha256="0" * 64))
    assert ["API tokens" in words for words in unsafe(safe)] == [True]


def test_an_old_schema_is_said_and_left_as_it_is(safe: Settings, database: Database) -> None:
    with database.writer.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '0009'"))
    assert ["of revision 0009" in words for words in unsafe(safe)] == [True]
    with database.reading() as session:
        assert session.scalar(text("SELECT version_num FROM alembic_version")) == "0009"


def test_the_command_says_what_is_unsafe_and_exits_with_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DATA_DIR", str(tmp_path / "new"))
    monkeypatch.chdir(tmp_path)
    assert program.main(["check", "--deploy"]) == 1
    said = capsys.readouterr().out
    assert "UNSAFE  BACKUP_DIR is not set" in said
    assert ("UNSAFE  There is no database yet" in said) == (databases.SERVER is None)  # where one is lent
    assert not (tmp_path / "new").exists(), "it changes nothing"
    assert program.main(["migrate"]) == 0
    assert program.main(["check"]) == 0
