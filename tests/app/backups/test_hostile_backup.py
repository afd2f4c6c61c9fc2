"""A backup that somebody else has put there, or that a disk has spoiled, is refused before anything is touched."""

import hashlib
import json
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from app.db import Database
from app.errors import AppError
from app.services.backups import layout, making, restoring
from app.services.backups.layout import BackupRefused
from app.settings import Settings
from app.storage import ArtefactStore
from tests import backed_up
from tests.databases import make_tables

Spoil = Callable[[Path], None]
SPOILED: list[Spoil] = []


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A sound backup."""
    settings = Settings(_env_file=None, data_dir=tmp_path_factory.mktemp("data"), database_url=None)
    database = Database(settings.sqlalchemy_url)
    make_tables(database)
    with database.writing() as session:
        backed_up.fill(session, ArtefactStore.of(settings))
    (settings.data_dir / "some.key").write_bytes(b"key")
    yield making.make(settings, tmp_path_factory.mktemp("backups")).folder
    database.dispose()


@pytest.fixture
def folder(pristine: Path, tmp_path: Path) -> Path:
    """A copy of it, to be spoiled."""
    return Path(shutil.copytree(pristine, tmp_path / "backups" / pristine.name))


def an_artefact(folder: Path) -> Path:
    return min(folder.glob("artefacts/*/*"))


def rewrite(folder: Path, **changes: Any) -> None:
    """Give the manifest other values."""
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def change_database(folder: Path, statement: str) -> None:
    """Change rows, and have the manifest say the right hash."""
    path = folder / "studio.sqlite3"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(statement)
        connection.commit()
    content = path.read_bytes()
    rewrite(folder, database={"sha256": hashlib.sha256(content).hexdigest(), "byte_count": len(content)})


@SPOILED.append
def without_a_manifest(folder: Path) -> None:
    (folder / "manifest.json").unlink()


@SPOILED.append
def a_manifest_that_is_a_list(folder: Path) -> None:
    (folder / "manifest.json").write_text("[]")


@SPOILED.append
def a_manifest_nested_without_end(folder: Path) -> None:
    (folder / "manifest.json").write_text("[" * 100_000)


@SPOILED.append
def a_manifest_cut_in_half(folder: Path) -> None:
    path = folder / "manifest.json"
    path.write_bytes(path.read_bytes()[:-100])


@SPOILED.append
def a_manifest_that_fills_the_memory(folder: Path) -> None:
    os.truncate(folder / "manifest.json", layout.LARGEST_MANIFEST_BYTES + 1)


@SPOILED.append
def a_manifest_that_is_a_link(folder: Path) -> None:
    path = folder / "manifest.json"
    path.rename(folder.parent / "elsewhere.json")
    path.symlink_to(folder.parent / "elsewhere.json")


@SPOILED.append
def a_manifest_of_a_later_format(folder: Path) -> None:
    rewrite(folder, version=layout.VERSION + 1)


@SPOILED.append
def a_path_that_leads_out(folder: Path) -> None:
    (folder.parent / "evil").write_bytes(b"evil")
    key = {"sha256": hashlib.sha256(b"evil").hexdigest(), "byte_count": 4}
    rewrite(folder, beside={"../../evil": key})


@SPOILED.append
def a_log_beside_the_database(folder: Path) -> None:
    (folder / "beside" / "studio.sqlite3-wal").write_bytes(b"evil")
    key = {"sha256": hashlib.sha256(b"evil").hexdigest(), "byte_count": 4}
    rewrite(folder, beside={"studio.sqlite3-wal": key})


@SPOILED.append
def an_artefact_that_is_no_hash(folder: Path) -> None:
    rewrite(folder, artefacts={"../../../etc/passwd": 4})


@SPOILED.append
def an_artefact_of_another_content(folder: Path) -> None:
    path = an_artefact(folder)
    path.write_bytes(path.read_bytes()[::-1])


@SPOILED.append
def an_artefact_of_another_length(folder: Path) -> None:
    path = an_artefact(folder)
    path.write_bytes(path.read_bytes() + b"more")


@SPOILED.append
def a_missing_artefact(folder: Path) -> None:
    an_artefact(folder).unlink()


@SPOILED.append
def an_artefact_that_is_a_link(folder: Path) -> None:
    path = an_artefact(folder)
    path.rename(folder.parent / "elsewhere")
    path.symlink_to(folder.parent / "elsewhere")


@SPOILED.append
def an_artefact_that_is_a_pipe(folder: Path) -> None:
    path = an_artefact(folder)
    path.unlink()
    os.mkfifo(path)


@SPOILED.append
def an_artefact_that_is_a_folder(folder: Path) -> None:
    path = an_artefact(folder)
    path.unlink()
    path.mkdir()


@SPOILED.append
def artefacts_that_are_a_link(folder: Path) -> None:
    (folder / "artefacts").rename(folder.parent / "elsewhere")
    (folder / "artefacts").symlink_to(folder.parent / "elsewhere")


@SPOILED.append
def an_artefact_that_nobody_lists(folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["artefacts"].pop(an_artefact(folder).name)
    rewrite(folder, **manifest)


@SPOILED.append
def a_database_cut_in_half(folder: Path) -> None:
    path = folder / "studio.sqlite3"
    os.truncate(path, path.stat().st_size // 2)


@SPOILED.append
def a_database_of_noise(folder: Path) -> None:
    content = os.urandom(20_000)
    (folder / "studio.sqlite3").write_bytes(content)
    rewrite(folder, database={"sha256": hashlib.sha256(content).hexdigest(), "byte_count": len(content)})


@SPOILED.append
def a_row_less_than_said(folder: Path) -> None:
    change_database(folder, "DELETE FROM label_event WHERE id = 1")


@SPOILED.append
def rows_that_refer_to_nothing(folder: Path) -> None:
    change_database(folder, "DELETE FROM study")


@SPOILED.append
def another_revision_than_said(folder: Path) -> None:
    change_database(folder, "UPDATE alembic_version SET version_num = '0001'")


@SPOILED.append
def a_newer_schema(folder: Path) -> None:
    change_database(folder, "UPDATE alembic_version SET version_num = 'f00f'")
    rewrite(folder, revision="f00f")


@SPOILED.append
def a_list_of_withdrawals_that_is_none(folder: Path) -> None:
    (folder.parent / "withdrawn.json").write_text("{}")


@pytest.mark.parametrize("spoil", SPOILED, ids=lambda spoil: spoil.__name__)
def test_what_is_not_a_whole_backup_is_refused_in_words_and_nothing_is_touched(
    spoil: Spoil, folder: Path, settings: Settings
) -> None:
    restoring.verify(settings, folder)
    spoil(folder)
    settings.data_dir.mkdir()
    (settings.data_dir / "studio.sqlite3").write_bytes(b"what was there")
    with pytest.raises(AppError) as refused:
        restoring.restore(settings, folder, replace=True)
    assert len(refused.value.message) > 40
    assert [path.read_bytes() for path in settings.data_dir.iterdir() if path.name != "studio.lock"] == [
        b"what was there"
    ]
    if "withdrawals" not in spoil.__name__:
        with pytest.raises(AppError):
            restoring.verify(settings, folder)


def test_what_nobody_lists_is_not_restored(folder: Path, settings: Settings) -> None:
    (folder / "studio.sqlite3-wal").write_bytes(b"evil")
    (folder / "artefacts" / "more").write_bytes(b"evil")
    restoring.restore(settings, folder)
    assert backed_up.traces(settings.data_dir, "evil") == []


def test_every_file_is_read_by_a_verification(folder: Path, settings: Settings) -> None:
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != "manifest.json":
            content = path.read_bytes()
            path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
            with pytest.raises(BackupRefused):
                restoring.verify(settings, folder)
            path.write_bytes(content)
    restoring.verify(settings, folder)
