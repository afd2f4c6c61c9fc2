"""Runs tests on a PostgreSQL server of their own, started for them in a temporary directory and gone afterwards.

python -m tests.on_postgresql                                what continuous integration runs there: no case twice
python -m tests.on_postgresql tests/app tests/worker/jobs    any other choice, in pytest's own words
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import psycopg

from tests.waiting import until

WRITING = ("answer_pair", "archive", "draw_evaluation", "many_servers", "rate_robots", "undo_answer", "withdraw")
READING = ("api_pages", "audit_chain", "watch_database")
USUAL = (
    *(f"tests/app/test_{name}.py" for name in (*WRITING, *READING, "writing_sessions")),
    "tests/worker/jobs/test_erasure.py",
    "-n",
    "2",
    "--dist",
    "loadfile",
    "-q",
    "-m",
    "database and first_case and not slow and not browser",
)
SERVER_USER = "postgres"
"""Whom Debian's package makes: PostgreSQL refuses to run as root."""
FAST = {
    "fsync": "off",
    "full_page_writes": "off",
    "synchronous_commit": "off",
    "wal_level": "minimal",
    "max_wal_senders": "0",
    "autovacuum": "off",
    "max_connections": "300",
}
"""Nothing here outlives the run, so nothing has to reach a disk."""


def main() -> int:
    """Run pytest; returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="of pytest, paths first")
    arguments = parser.parse_args().arguments
    programs = find_programs()
    if programs is None:
        sys.stderr.write("These tests need PostgreSQL 15 or later: install your system's package 'postgresql'.\n")
        return 1
    with serving(programs) as url:
        command = [sys.executable, "-m", "pytest", *(arguments or USUAL)]
        return subprocess.run(command, env={**os.environ, "TEST_DATABASE_URL": url}, check=False).returncode


def find_programs() -> Path | None:
    """Where initdb and postgres are: Debian keeps them out of the search path, one directory for each version."""
    found = shutil.which("initdb")
    if found is not None:
        return Path(found).resolve().parent
    versions = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda path: int(path.parts[-3]))
    return versions[-1].parent if versions else None


@contextmanager
def serving(programs: Path, configuration: Mapping[str, str] = FAST) -> Iterator[str]:
    """A server that only this machine's processes reach; gives the address of its first database."""
    with tempfile.TemporaryDirectory(prefix="studio-postgresql-", ignore_cleanup_errors=True) as folder:
        if os.geteuid() == 0:
            shutil.chown(folder, SERVER_USER)
        data = Path(folder, "data")
        making = [f"{programs}/initdb", "-D", str(data), "-U", "studio", "-E", "UTF8", "--locale=C.UTF-8", "--no-sync"]
        run([*making, "--auth=trust"], folder)
        with running(programs, data, configuration) as url:
            yield url


@contextmanager
def running(programs: Path, data: Path, configuration: Mapping[str, str]) -> Iterator[str]:
    """The same on a data directory that is there; its socket and its log lie beside it."""
    folder = str(data.parent)
    settings = {**configuration, "listen_addresses": "", "unix_socket_directories": folder}
    options = [word for name, setting in settings.items() for word in ("-c", f"{name}={setting}")]
    with open(f"{folder}/log", "w") as log:  # noqa: PTH123  (ours, while the directory is the server's)
        server = subprocess.Popen(
            _as_server_user([f"{programs}/postgres", "-D", str(data), *options]), cwd=folder, stderr=log
        )
    try:
        until(lambda: server.poll() is not None or _answers(folder))
        if server.poll() is not None:
            raise RuntimeError(Path(folder, "log").read_text())
        yield f"postgresql+psycopg://studio@/postgres?host={folder}"
    finally:
        server.terminate()
        server.wait()


def folder_of(url: str) -> str:
    """Where the socket and the data directory of a server of ours are."""
    return parse_qs(urlsplit(url).query)["host"][0]


def process_of(url: str) -> int:
    """The number of the process that serves a database of ours, and is the parent of all that work for it."""
    return int(Path(folder_of(url), "data", "postmaster.pid").read_text().split()[0])


def run(command: Sequence[str], folder: str) -> None:
    """A program of PostgreSQL, as the user that its server has. Raises RuntimeError with what it says."""
    made = subprocess.run(_as_server_user(command), cwd=folder, capture_output=True, text=True, check=False)
    if made.returncode:
        raise RuntimeError(made.stderr)


def _as_server_user(command: Sequence[str]) -> list[str]:
    """So that it is not root, and ends with us even when we are killed."""
    user = ["--reuid", SERVER_USER, "--regid", SERVER_USER, "--clear-groups"] if os.geteuid() == 0 else []
    return ["setpriv", "--pdeathsig", "QUIT", *user, *command]


def _answers(folder: str) -> bool:
    try:
        psycopg.connect(host=folder, user="studio", dbname="postgres").close()
    except psycopg.OperationalError:
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())
