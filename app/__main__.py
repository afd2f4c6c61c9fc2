"""The command line of the studio: ``python -m app up`` starts everything, the rest is upkeep."""

import argparse
import gc
import logging
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app import data_directory, logs, signing, upgrading
from app.commands import audit_commands, deploy_check
from app.commands.parsers import Commands, add_command
from app.db import Database, now
from app.domain.studies import Study
from app.errors import EXPLAINED, AppError, in_words
from app.installed_tasks import catalogue, lab
from app.installed_tasks.lab import LabDescription
from app.logs import LogFormat
from app.paths import DOCS
from app.programs import Programs, say
from app.services import audit
from app.services.accounts import accounts, second_factor
from app.services.alerting import messages
from app.services.archives import demo_archive as demo
from app.services.archives import study_import
from app.services.backups import layout, making, restoring, schedule
from app.services.exports import export_formats, export_tables
from app.services.monitoring import damage
from app.services.participants import enrolment
from app.settings import Settings
from app.storage import ArtefactStore, keep_private

if TYPE_CHECKING:
    from fastapi import FastAPI

TURN_S = 0.0005
"""How long a thread of the web server computes while others wait for their turn; Python's own 5 ms are many answers."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m app", description=__doc__)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, act in _COMMANDS.items():
        add_command(commands, name, act)
    audit_commands.add_to(commands)
    deploy_check.add_to(commands)
    demo = add_command(commands, "demo", demo_study)
    demo.add_argument("--task", type=catalogue.as_argument, metavar="NAME", default=catalogue.usual())
    resetting = add_command(commands, "reset-second-factor", reset_second_factor)
    resetting.add_argument("name", help="of the account")
    importing = add_command(commands, "import-study", import_study)
    importing.add_argument("file", type=Path, help="the archive")
    importing.add_argument("--seal-key", default="", help="of the archive of a study that is still blinded")
    _add_backups(commands)
    chosen = vars(parser.parse_args(arguments))
    act, _ = chosen.pop("act"), chosen.pop("command")
    if act is not web:  # which writes its log in its own way
        logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        settings = Settings()
        if act is not deploy_check.check:  # which says what is open, and closes nothing
            keep_private(settings)
        result: int = act(settings, **chosen)
        return result
    except EXPLAINED as error:
        words = in_words(error)
        if words is None:
            raise
        say(f"Error: {words}")
        return 1


def _add_backups(commands: Commands) -> None:
    making = add_command(commands, "backup", back_up)
    making.add_argument("target", type=Path, nargs="?", help="directory of backups; default: BACKUP_DIR")
    restoring = add_command(commands, "restore", restore)
    restoring.add_argument("backup", type=Path, help="the folder of one backup")
    restoring.add_argument("--into", type=Path, help="another data directory; default: DATA_DIR")
    restoring.add_argument("--replace", action="store_true", help="move aside what is there")
    verifying = add_command(commands, "verify", verify)
    verifying.add_argument("backup", type=Path, help="the folder of one backup")


def migrate(settings: Settings) -> int:
    """Bring the database to the newest schema."""
    upgrading.upgrade(settings)
    with _database(settings) as database:
        with database.writing() as session:
            sealed = second_factor.seal_secrets(session, settings)
        if sealed:
            database.forget_erased()
    return 0


def reset_second_factor(settings: Settings, name: str) -> int:
    """Turn off the second factor of an account: its phone is lost, or the key that opened its secret."""
    migrate(settings)
    with _database(settings) as database, database.writing() as session:
        account = accounts.by_name(session, name)
        if account is None:
            raise accounts.ExperimenterNotFound
        second_factor.turn_off(session, account, audit.SYSTEM)
    say(f"The password of {name} is enough again. Set up a new second factor on the page of the account.")
    return 0


def reset_password(settings: Settings) -> int:
    """Give the first experimenter a new one-time password, and an account if there is none at all."""
    migrate(settings)
    with _database(settings) as database, database.writing() as session:
        password = accounts.create_first_experimenter(session)
        if password is None:
            password = accounts.reset_password(session, accounts.FIRST_EXPERIMENTER)
    say(f"New one-time password of {accounts.FIRST_EXPERIMENTER}: {password}")
    return 0


def participant_link(settings: Settings) -> int:
    """Add a participant to the newest study and print the personal link."""
    migrate(settings)
    with _database(settings) as database, database.writing() as session:
        study = session.scalar(select(Study).where(Study.deleted_at.is_(None)).order_by(Study.id.desc()))
        if study is None:
            raise AppError("There is no study yet. Start the studio once, or create a study on the dashboard.")
        _, token = enrolment.add_participant(session, study)
    say(f"{settings.base_url}/p/{token}")
    return 0


def dictionary(_settings: Settings) -> int:
    """Write the data dictionary of all exports to docs/protocol.md."""
    path = DOCS / "protocol.md"
    path.write_text(export_formats.dictionary_markdown(export_tables.TABLES))
    say(f"Wrote {path}")
    return 0


def import_study(settings: Settings, file: Path, seal_key: str = "") -> int:
    """Import an archive of a study and print new personal links of its participants."""
    migrate(settings)
    store = ArtefactStore.of(settings)
    if not file.is_file():
        raise AppError(f"There is no file {file}.")
    with (
        study_import.unpack(store, file, seal_key) as unpacked,
        _database(settings) as database,
        database.writing() as session,
    ):
        imported = study_import.bring_in(session, store, unpacked, audit.SYSTEM)
        say(f"Imported: {settings.base_url}/studies/{imported.study.slug}")
        say(signing.in_words(imported.signer, settings))
    for code, token in imported.tokens:
        say(f"{code},{settings.base_url}/p/{token}")
    return 0


def scrub(settings: Settings) -> int:
    """Read every stored file; list what is damaged or missing, by study, and set it aside to be made again."""
    migrate(settings)
    with _database(settings) as database, database.reading() as session:
        broken = damage.scrub(session, ArtefactStore.of(settings))
    for study, uses in sorted(broken.items()):
        say(f"{study}:")
        for use in uses:
            say(f"  {use.what} ({use.sha256[:12]}): {use.remedy}")
    say(f"{sum(map(len, broken.values()))} stored files are damaged or missing." if broken else "All files are whole.")
    return 1 if broken else 0


def back_up(settings: Settings, target: Path | None = None) -> int:
    """Copy the whole studio into a directory of backups, while it runs or not."""
    directory = target or settings.backup_dir
    if directory is None:
        raise AppError("Say into which directory, best on another disk, or set BACKUP_DIR.")
    backup = making.make(settings, directory)
    say(f"{backup.folder}: {_contents(backup)}")
    if lost := len(backup.manifest.missing):
        say(f"{lost} stored files are lost in the studio and not in the backup. To see which: python -m app scrub")
    for folder in schedule.with_somebody_erased(settings, directory):
        say(f"Somebody who is in {folder} has withdrawn since. Erase that backup.")
    return 0


def verify(settings: Settings, backup: Path) -> int:
    """Read everything in a backup and compare it with its manifest."""
    found = restoring.verify(settings, backup)
    say(f"{backup} is whole: {_contents(found)}")
    return 0


def restore(settings: Settings, backup: Path, into: Path | None, replace: bool) -> int:
    """Verify a backup and put it in place, while the studio is stopped."""
    done = restoring.restore(settings, backup, into, replace=replace)
    say(f"Restored into {done.data_dir}. What was in progress begins anew at the next start.")
    if done.replaced is not None:
        say(f"What was there before is in {done.replaced}; it is erased when somebody withdraws.")
    if done.erased_again:
        say(f"Erased again, as they have withdrawn since: {done.erased_again} participants or studies.")
    say("Accounts, passwords, API tokens and links are those of the backup: what was revoked since, revoke again.")
    return 0


def _contents(backup: layout.Backup) -> str:
    manifest = backup.manifest
    counted = ", ".join(f"{words}: {manifest.rows.get(table, 0)}" for table, words in _COUNTED.items())
    size = f"files: {len(manifest.artefacts)}, {backup.byte_count / 1e6:.1f} MB"
    return f"made {manifest.made_at:%Y-%m-%d %H:%M:%S} UTC; {counted}, {size}"


def test_alert(settings: Settings) -> int:
    """Send a message to ALERT_WEBHOOK and ALERT_MAIL_TO, to see whether it comes."""
    words = "This is a test: messages about troubles come this way."
    messages.send(settings, messages.Message(settings.base_url, [messages.Line("test", words, now())]))
    say("Sent.")
    return 0


def demo_study(settings: Settings, task: str) -> int:
    """Make a demo study of a task with one participant and print the personal link."""
    migrate(settings)
    with _database(settings) as database, database.writing() as session:
        token = demo.make_empty(session, task)
    say(f"{settings.base_url}/p/{token}")
    installed = catalogue.find(task)
    if installed and isinstance(installed.description, LabDescription) and not lab.whole(installed):
        say(f"Nothing is known yet of the ways to do {task}, so its clips wait: python -m worker explore --task {task}")
    return 0


def up(settings: Settings) -> int:
    """Migrate, import the demo study on the first start, and run web server and worker until Ctrl-C."""
    _require_free_port(settings)
    migrate(settings)
    with data_directory.shared(settings.data_dir):
        with _database(settings) as database, database.writing() as session:
            greeting = _first_start(session, settings)
        return Programs(
            greeting,
            settings.data_dir,
            {
                "web": ["-m", "app", "web"],
                "worker": ["-m", "worker", "run"],
            },
        ).run()


def web(settings: Settings) -> int:
    """Run the web server alone, on a database that is already of this version."""
    import uvicorn  # it takes longer to load than most commands take

    from app.web.http import connections

    connections.allow_many_files()
    _require_free_port(settings)
    store = ArtefactStore.of(settings)
    store.files.require_usable()
    store.unfinished.clear_workspaces(_DAY_S)
    in_json = settings.log_format is LogFormat.JSON
    logs.write_to_stderr(settings.log_format, logging.INFO if in_json else logging.WARNING)
    with data_directory.shared(settings.data_dir):  # the server does so, too, but cannot say in words why not
        uvicorn.run(
            partial(_prompt_app, settings),
            factory=True,
            host=settings.host,
            port=settings.port,
            log_config=None,
            access_log=False,  # it would tell personal links; ours tells routes
            proxy_headers=bool(settings.trusted_proxies),  # left alone, uvicorn believes whoever asks from this machine
            forwarded_allow_ips=settings.trusted_proxies or None,
            timeout_keep_alive=connections.KEPT_OPEN_S,
            http=connections.Connection,
            timeout_graceful_shutdown=5,
        )
    return 0


def _prompt_app(settings: Settings) -> "FastAPI":
    """The web server, with Python set so that nobody waits long for somebody else's request or for housekeeping."""
    gc.disable()  # looking for garbage took a sixth of the start, and there is none yet
    from app.main import create_app

    app = create_app(settings)
    sys.setswitchinterval(TURN_S)
    gc.collect()
    gc.freeze()  # the garbage collector went through all of this every ten seconds, 0.2 s each time
    gc.enable()
    return app


@contextmanager
def _database(settings: Settings) -> Iterator[Database]:
    database = Database(settings.sqlalchemy_url)
    try:
        yield database
    finally:
        database.dispose()


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
        token, remark = _demo(session, settings)
        lines += [f"  Participant link  {settings.base_url}/p/{token}", *remark]
    else:
        lines.append("  Participant links are made on the dashboard, or with: make link")
    return "\n".join([*lines, "", "  Ctrl-C stops everything; nothing is lost.", ""])


def _demo(session: Session, settings: Settings) -> tuple[str, Sequence[str]]:
    """The token of the participant's link in the demo study, and what is to be said of it."""
    try:
        return demo.import_finished(session, ArtefactStore.of(settings)), []
    except AppError as error:
        token = demo.make_empty(session, catalogue.usual())
        instead = "An empty demo study was made instead of the finished one; its first clips take a few minutes."
        return token, ["", f"  {instead}", f"  {error}"]


_DAY_S = 24 * 3600.0
_COUNTED = {"study": "studies", "participant": "participants", "label_event": "answers"}
_COMMANDS: dict[str, Callable[[Settings], int]] = {
    "up": up,
    "web": web,
    "migrate": migrate,
    "reset-password": reset_password,
    "link": participant_link,
    "dictionary": dictionary,
    "scrub": scrub,
    "test-alert": test_alert,
}

if __name__ == "__main__":
    sys.exit(main())
