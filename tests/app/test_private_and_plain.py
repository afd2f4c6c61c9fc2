"""At the terminal: files that are nobody else's, and sentences instead of tracebacks."""

import errno
import os
import stat
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from sqlalchemy.exc import IntegrityError, OperationalError

from app import __main__ as studio
from app.errors import AppError, in_words
from app.settings import Settings
from app.storage import ArtefactStore, keep_private
from tests import databases
from worker import __main__ as worker
from worker.jobs.runtime import engine

APP = [["migrate"], ["reset-password"], ["link"], ["demo"], ["import-study", "study.zip"], ["up"]]


Run = Callable[..., tuple[int, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Runs a command of the studio; gives exit code and what it said."""
    monkeypatch.chdir(tmp_path)  # where there is no .env
    if databases.SERVER is None:
        monkeypatch.delenv("DATABASE_URL", raising=False)

    def run(main: Callable[[Sequence[str]], int], arguments: Sequence[str], **environment: str) -> tuple[int, str]:
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        code = main(arguments)
        said = capsys.readouterr()
        return code, said.out + said.err

    return run


def says_what_to_do(done: tuple[int, str], words: str) -> bool:
    code, said = done
    return code == 1 and said.startswith("Error: ") and words in said


@pytest.fixture(autouse=True)
def _umask() -> Iterator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


class TestSentences:
    @pytest.mark.parametrize("arguments", APP)
    def test_a_data_directory_that_cannot_be_made(self, run: Run, tmp_path: Path, arguments: list[str]) -> None:
        (tmp_path / "data").write_text("A file of this name is in the way.")
        assert says_what_to_do(run(studio.main, arguments, DATA_DIR=str(tmp_path / "data"), PORT="0"), "DATA_DIR=")

    @pytest.mark.sqlite("about its files")
    def test_a_database_that_can_only_be_read(self, run: Run, tmp_path: Path) -> None:
        run(studio.main, ["demo"], DATA_DIR=str(tmp_path))
        url = f"sqlite:///file:{tmp_path}/studio.sqlite3?mode=ro&uri=true"
        assert says_what_to_do(run(studio.main, ["link"], DATABASE_URL=url), "can only be read")

    @pytest.mark.sqlite("about its files")
    def test_a_database_that_is_none(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "studio.sqlite3").write_bytes(b"no database " * 1000)
        assert says_what_to_do(run(studio.main, ["migrate"], DATA_DIR=str(tmp_path)), "Restore it from a backup")

    def test_a_database_in_a_directory_that_is_not_there(self, run: Run, tmp_path: Path) -> None:
        url = f"sqlite:///{tmp_path}/nowhere/studio.sqlite3"
        done = run(studio.main, ["migrate"], DATA_DIR=str(tmp_path), DATABASE_URL=url)
        assert says_what_to_do(done, "cannot be opened")

    def test_a_server_that_is_not_there(self, run: Run, tmp_path: Path) -> None:
        url = "postgresql://studio@127.0.0.1:1/studio"
        done = run(studio.main, ["migrate"], DATA_DIR=str(tmp_path), DATABASE_URL=url)
        assert says_what_to_do(done, "its server does not answer")

    def test_the_worker_says_the_same(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "data").write_text("A file of this name is in the way.")
        assert says_what_to_do(run(worker.main, ["run"], DATA_DIR=str(tmp_path / "data")), "DATA_DIR=")

    @pytest.mark.parametrize(("main", "command"), [(studio.main, "migrate"), (worker.main, "run")])
    def test_a_setting_that_is_not_valid_is_named(
        self, run: Run, main: Callable[[Sequence[str]], int], command: str
    ) -> None:
        assert says_what_to_do(run(main, [command], PORT="many"), "PORT: ")

    @pytest.mark.parametrize(
        ("error", "words"),
        [
            (PermissionError(errno.EACCES, "Permission denied", "/data/x"), "/data/x cannot be written. This account"),
            (OSError(errno.EROFS, "Read-only file system", "/data"), "can only be read"),
            (OSError(errno.ENOSPC, "No space left on device"), "The disk is full"),
            (OperationalError("x", None, Exception("database or disk is full")), "Free some space"),
            (OperationalError("x", None, Exception("attempt to write a readonly database")), "can only be read"),
            (AppError("As it is."), "As it is."),
        ],
    )
    def test_what_can_be_mended_is_said(self, error: Exception, words: str) -> None:
        assert words in (in_words(error) or "")

    @pytest.mark.parametrize(
        "error", [OSError("?"), OSError(errno.EBADF, "?"), IntegrityError("x", None, Exception("UNIQUE"))]
    )
    def test_our_own_mistakes_keep_their_traceback(self, error: Exception) -> None:
        assert in_words(error) is None


@pytest.mark.sqlite("about its files")
class TestFiles:
    def open_to_others(self, directory: Path) -> list[str]:
        return [
            str(path.relative_to(directory))
            for path in sorted(directory.rglob("*"))
            if stat.S_IMODE(path.stat().st_mode) & 0o077
        ]

    def test_what_the_programs_make_is_for_their_account_alone(self, run: Run, tmp_path: Path) -> None:
        directory = tmp_path / "data"
        assert run(studio.main, ["demo"], DATA_DIR=str(directory))[0] == 0
        ArtefactStore(directory / "artefacts").put(b"a film")
        assert (directory / "studio.sqlite3").exists()
        assert self.open_to_others(tmp_path) == []

    def test_what_an_earlier_version_left_open_is_closed_at_the_start(self, run: Run, tmp_path: Path) -> None:
        run(studio.main, ["demo"], DATA_DIR=str(tmp_path))
        ours = ["studio.sqlite3", "studio.sqlite3-wal", "studio.sqlite3-shm", "engine.sqlite3", "worker-1.lock"]
        for name in ours:
            (tmp_path / name).touch()
            (tmp_path / name).chmod(0o644)
        for name in ("artefacts", "unfinished", "backups"):
            (tmp_path / name).mkdir(mode=0o755)
        (tmp_path / "README.txt").touch()
        (tmp_path / "README.txt").chmod(0o644)  # not ours
        assert run(studio.main, ["migrate"], DATA_DIR=str(tmp_path))[0] == 0
        assert self.open_to_others(tmp_path) == ["README.txt"]

    def test_the_worker_keeps_its_engine_for_itself(self, tmp_path: Path) -> None:
        settings = Settings(_env_file=None, data_dir=tmp_path)
        path = engine.file_of(settings)
        assert path is not None
        path.touch(0o644)
        keep_private(settings)
        assert self.open_to_others(tmp_path) == []

    def test_a_database_elsewhere_is_closed_as_well(self, tmp_path: Path) -> None:
        (tmp_path / "mine.db").touch(0o644)
        (tmp_path / "mine.db-wal").touch(0o644)
        keep_private(
            Settings(_env_file=None, data_dir=tmp_path / "data", database_url=f"sqlite:///{tmp_path}/mine.db?timeout=9")
        )
        assert self.open_to_others(tmp_path) == []
