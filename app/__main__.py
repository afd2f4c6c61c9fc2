"""The command line of the studio: ``python -m app up`` starts everything, the rest is upkeep."""

import argparse
import ctypes
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import IO

from alembic import command
from alembic.config import Config
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.studies import USUAL_CLIP_STEPS, Study, StudySettings, TaskName
from app.errors import AppError
from app.services import accounts, archive, audit, enrolment, export_tables, exporting, studies
from app.settings import Settings
from app.storage import ArtefactStore

GRACE_S = 20.0
FALLS_ALLOWED = 3
FALLS_WITHIN_S = 60.0
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None  # loaded here: a forked child must not load libraries
_COLOURS = {"web": "\033[36m", "worker": "\033[35m"}
_RESET = "\033[0m"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m app", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, act in _COMMANDS.items():
        commands.add_parser(name, help=act.__doc__).set_defaults(act=act)
    demo = commands.add_parser("demo", help=demo_study.__doc__)
    demo.add_argument("--task", choices=[task.value for task in TaskName], default=TaskName.FEEDING.value)
    demo.set_defaults(act=demo_study)
    importing = commands.add_parser("import-study", help=import_study.__doc__)
    importing.add_argument("file", type=Path, help="the archive")
    importing.set_defaults(act=import_study)
    chosen = vars(parser.parse_args(arguments))
    act, _ = chosen.pop("act"), chosen.pop("command")
    try:
        result: int = act(Settings(), **chosen)
        return result
    except AppError as error:
        _say(f"Error: {error.message}")
        return 1


def migrate(settings: Settings) -> int:
    """Bring the database to the newest schema."""
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).resolve().parent.parent / "migrations"))
    config.set_main_option("sqlalchemy.url", settings.sqlalchemy_url.replace("%", "%%"))
    command.upgrade(config, "head")
    return 0


def reset_password(settings: Settings) -> int:
    """Give the first experimenter a new one-time password."""
    migrate(settings)
    with _database(settings).writing() as session:
        password = accounts.reset_password(session, accounts.FIRST_EXPERIMENTER)
    _say(f"New one-time password of {accounts.FIRST_EXPERIMENTER}: {password}")
    return 0


def participant_link(settings: Settings) -> int:
    """Add a participant to the newest study and print the personal link."""
    migrate(settings)
    with _database(settings).writing() as session:
        study = session.scalar(select(Study).where(Study.deleted_at.is_(None)).order_by(Study.id.desc()))
        if study is None:
            raise AppError("There is no study yet. Start the studio once, or create a study on the dashboard.")
        _, token = enrolment.add_participant(session, study)
    _say(f"{settings.base_url}/p/{token}")
    return 0


def dictionary(_settings: Settings) -> int:
    """Write the data dictionary of all exports to docs/protocol.md."""
    path = Path(__file__).resolve().parents[1] / "docs" / "protocol.md"
    path.write_text(exporting.dictionary_markdown(export_tables.TABLES))
    _say(f"Wrote {path}")
    return 0


def import_study(settings: Settings, file: Path) -> int:
    """Import an archive of a study and print new personal links of its participants."""
    migrate(settings)
    store = ArtefactStore(settings.data_dir / "artefacts")
    if not file.is_file():
        raise AppError(f"There is no file {file}.")
    unpacked = archive.unpack(store, file)
    with _database(settings).writing() as session:
        imported = archive.bring_in(session, store, unpacked, audit.SYSTEM)
        _say(f"Imported: {settings.base_url}/studies/{imported.study.slug}")
    for code, token in imported.tokens:
        _say(f"{code},{settings.base_url}/p/{token}")
    return 0


def demo_study(settings: Settings, task: str) -> int:
    """Make a demo study of a task with one participant and print the personal link."""
    migrate(settings)
    with _database(settings).writing() as session:
        link = _demo(session, settings, TaskName(task))
    _say(link)
    return 0


def up(settings: Settings) -> int:
    """Migrate, create the demo study on the first start, and run web server and worker until Ctrl-C."""
    _require_free_port(settings)
    migrate(settings)
    database = _database(settings)
    with database.writing() as session:
        greeting = _first_start(session, settings)
    database.dispose()
    return _Programs(greeting).run(
        {
            "web": [
                *("-m", "uvicorn", "app.main:create_app", "--factory", "--no-access-log", "--log-level", "warning"),
                *("--host", settings.host, "--port", str(settings.port), "--timeout-graceful-shutdown", "5"),
            ],
            "worker": ["-m", "worker", "run"],
        }
    )


def _database(settings: Settings) -> Database:
    return Database(settings.sqlalchemy_url)


def _require_free_port(settings: Settings) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            raise AppError(
                f"Port {settings.port} on {settings.host} cannot be used ({error.strerror}). "
                "Stop the program that uses it, or choose another: PORT=8001 make run"
            ) from error


def _first_start(session: Session, settings: Settings) -> str:
    """What to tell the person who started us; on an empty database this also creates what they need to begin."""
    lines = ["", "  PbARL Studio", "", f"  Dashboard         {settings.base_url}/studies"]
    password = accounts.create_first_experimenter(session)
    if password is not None:
        lines += [
            f"  Experimenter      {accounts.FIRST_EXPERIMENTER}",
            f"  One-time password {password}  (you choose your own at the first login)",
        ]
    if session.scalar(select(func.count(Study.id))) == 0:
        lines.append(f"  Participant link  {_demo(session, settings, TaskName.FEEDING)}")
    else:
        lines.append("  Participant links are made on the dashboard, or with: make link")
    return "\n".join([*lines, "", "  Ctrl-C stops everything; nothing is lost.", ""])


def _demo(session: Session, settings: Settings, task: TaskName) -> str:
    """The personal link of a new demo study's participant."""
    usual = StudySettings(clip_steps=USUAL_CLIP_STEPS[task])
    study = studies.create_study(session, f"Demo: {task}", usual, task=task)
    _, token = enrolment.add_participant(session, study)
    return f"{settings.base_url}/p/{token}"


class _Programs:
    """Web server and worker as child processes, their logs merged line by line.

    A program that falls is started again, as a service manager would; one that keeps falling stops everything.
    """

    def __init__(self, greeting: str) -> None:
        self._greeting = greeting
        self._stop = threading.Event()
        self._children: dict[str, subprocess.Popen[str]] = {}
        self._falls: dict[str, list[float]] = {}

    def run(self, programs: dict[str, list[str]]) -> int:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        for name, arguments in programs.items():
            self._children[name] = self._start(name, arguments)
        _say(self._greeting)
        while not self._stop.wait(0.2):
            for name, arguments in programs.items():
                if self._children[name].poll() is not None and not self._restart(name, arguments):
                    self._shut_down()
                    return 1
        self._shut_down()
        _say("Stopped.")
        return 0

    def _restart(self, name: str, arguments: list[str]) -> bool:
        """Start a fallen program again; False when it has fallen too often."""
        moment = time.monotonic()
        self._falls[name] = [fall for fall in self._falls.get(name, []) if moment - fall < FALLS_WITHIN_S] + [moment]
        code = self._children[name].returncode
        if len(self._falls[name]) > FALLS_ALLOWED:
            _say(f"The {name} keeps stopping (exit code {code}); its last lines above say why. Stopping everything.")
            return False
        _say(f"The {name} stopped by itself (exit code {code}); starting it again.")
        self._stop.wait(1.0)
        self._children[name] = self._start(name, arguments)
        return True

    def _start(self, name: str, arguments: list[str]) -> "subprocess.Popen[str]":
        # An own process group: Ctrl-C in the terminal reaches only us, and we stop the children in good order.
        child = subprocess.Popen(
            [sys.executable, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            start_new_session=True,
            preexec_fn=_end_with_parent,
        )
        if child.stdout is not None:
            threading.Thread(target=_forward, args=(name, child.stdout), daemon=True).start()
        return child

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._stop.set()

    def _shut_down(self) -> None:
        for child in self._children.values():
            if child.poll() is None:
                child.terminate()
        deadline = time.monotonic() + GRACE_S
        for child in self._children.values():
            try:
                child.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.kill()


def _end_with_parent() -> None:
    """Run in a new child: when the supervisor is killed outright, Linux asks the child to stop as Ctrl-C would have."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _forward(name: str, stream: IO[str]) -> None:
    colour, reset = (_COLOURS[name], _RESET) if sys.stdout.isatty() else ("", "")
    for line in stream:
        _say(f"{colour}{name:<6}{reset} {line.rstrip()}")


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


_COMMANDS: dict[str, Callable[[Settings], int]] = {
    "up": up,
    "migrate": migrate,
    "reset-password": reset_password,
    "link": participant_link,
    "dictionary": dictionary,
}

if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    sys.exit(main())
