"""``check --deploy``: what is not safe about how this studio is set up, in words, and what to do about it.

It looks and changes nothing: neither the schema nor the permissions that other commands would close.
"""

import os
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import timedelta
from ipaddress import ip_address, ip_network
from pathlib import Path
from urllib.parse import urlsplit

from sqlalchemy import func, make_url, select
from sqlalchemy.orm import Session

from app import upgrading
from app.commands.parsers import Commands, add_command
from app.db import Database, now, sqlite
from app.domain.people import ApiToken, Experimenter
from app.programs import say
from app.services.backups import schedule
from app.settings import Settings

LONGEST_LOGIN_HOURS = 24
LONGEST_IDLE_MINUTES = 240
MOST_ATTEMPTS_PER_MINUTE = 60
OLD_INVITATION = timedelta(days=7)
LEAST_SECRET = 16
WIDEST_PROXY = {4: 24, 6: 64}
"""Shortest prefix of a network of proxies: a proxy is a machine or a few, not a campus."""
GUESSED_FIRST = {"studio", "postgres", "password", "secret", "changeme", "admin", "pbarl", "test", "..."}
_OTHERS = stat.S_IRWXG | stat.S_IRWXO


@dataclass(frozen=True)
class Finding:
    """One thing to know."""

    words: str
    is_unsafe: bool = True
    """False: safe in some places; whoever runs this studio decides."""


def add_to(commands: Commands) -> None:
    """Make the command known to the command line."""
    checking = add_command(commands, "check", check)
    checking.add_argument("--deploy", action="store_true", help="also say what is not safe when others can reach it")


def check(settings: Settings, deploy: bool) -> int:
    """Check settings and schema; with --deploy also what is not safe. Changes nothing; exits with 1 if there is any."""
    found = list(findings(settings) if deploy else _of_the_schema(settings))
    unsafe, remarks = [each for each in found if each.is_unsafe], [each for each in found if not each.is_unsafe]
    for each in unsafe:
        say(f"UNSAFE  {each.words}" if deploy else each.words)
    for each in remarks:
        say(f"note    {each.words}")
    if not unsafe:
        say("Nothing unsafe was found." if deploy else "Settings and schema are as they should be.")
    elif deploy:
        say(f"{len(unsafe)} things are not safe. docs/operating.md says how each setting works.")
    return 1 if unsafe else 0


def findings(settings: Settings) -> Iterator[Finding]:
    """Everything there is to say, in the order in which to mend it."""
    for look in (_of_the_network, _of_proxies, _of_files, _of_secrets, _of_logins, _of_backups):
        yield from look(settings)
    outdated = list(_of_the_schema(settings))
    yield from outdated or _of_accounts(settings)
    yield Finding("/api/docs and /api/v1/openapi.json are open to everybody. They describe, and hold no data.", False)


def _of_the_network(settings: Settings) -> Iterator[Finding]:
    url = urlsplit(settings.base_url)
    if url.scheme != "https" and not _is_here(url.hostname):
        yield Finding(
            f"PUBLIC_URL is {settings.base_url}: links, passwords and answers travel unencrypted. Put a proxy with "
            "HTTPS in front, and set PUBLIC_URL to its https:// address."
        )
    if url.scheme == "https" and not settings.secure_cookies:
        yield Finding("SECURE_COOKIES is not set: browsers would also send cookies unencrypted. Set it to true.")
    if not _is_here(settings.host):
        yield Finding(
            f"HOST is {settings.host}: the server can be reached past the proxy, without HTTPS. Leave it at 127.0.0.1; "
            "in a container, publish the port on 127.0.0.1 only.",
            is_unsafe=url.scheme != "https",
        )
    if url.scheme != "https" and _is_here(url.hostname) and settings.public_url is None:
        yield Finding("PUBLIC_URL is not set, so links lead to this machine only.", False)


def _of_proxies(settings: Settings) -> Iterator[Finding]:
    if urlsplit(settings.base_url).scheme == "https" and not settings.trusted_proxies:
        yield Finding(
            "TRUSTED_PROXIES is not set: to the limits on logins everybody behind the proxy is one address, and one "
            "who guesses shuts out the others. Set it to the proxy's address."
        )
    for each in filter(None, settings.trusted_proxies.split(",")):
        network = ip_network(each)
        if network.prefixlen < WIDEST_PROXY[network.version]:
            yield Finding(f"TRUSTED_PROXIES believes {each}, which is more than a few proxies. Name their addresses.")


def _of_files(settings: Settings) -> Iterator[Finding]:
    database = sqlite.file_of(settings.sqlalchemy_url)
    secret = [settings.signing_key_path, Path(".env"), *([database] if database else [])]
    if database is not None:
        secret += database.parent.glob(f"{database.name}[-.]*")
    for path in [*secret, *filter(None, (settings.backup_dir,))]:
        mode = _mode(path)
        if mode is not None and mode & _OTHERS:
            yield Finding(f"{path} can be read by other accounts of this machine. Close it: chmod go= {path}")
    if os.geteuid() == 0:
        yield Finding("This runs as root. Give the studio an account of its own, unless this is a container.", False)


def _of_secrets(settings: Settings) -> Iterator[Finding]:
    url = make_url(settings.sqlalchemy_url)
    if url.get_backend_name() != "sqlite":
        if url.password and (str(url.password).lower() in GUESSED_FIRST or len(str(url.password)) < LEAST_SECRET):
            yield Finding(f"The password in DATABASE_URL can be guessed. Use at least {LEAST_SECRET} characters.")
        local = url.host is None or url.host.startswith("/") or _is_here(url.host)
        if not local and url.query.get("sslmode") not in {"require", "verify-ca", "verify-full"}:
            yield Finding("DATABASE_URL leads elsewhere without ?sslmode=verify-full: answers travel unencrypted.")
    for name, value in (
        ("METRICS_TOKEN", settings.metrics_token),
        ("OIDC_CLIENT_SECRET", settings.oidc_client_secret and settings.oidc_client_secret.get_secret_value()),
    ):
        if value and (len(value) < LEAST_SECRET or len(set(value)) < LEAST_SECRET // 2):
            yield Finding(f"{name} can be guessed. Use at least {LEAST_SECRET} random characters.")


def _of_logins(settings: Settings) -> Iterator[Finding]:
    if settings.login_hours > LONGEST_LOGIN_HOURS:
        yield Finding(f"LOGIN_HOURS is {settings.login_hours}: a browser left alone stays open that long. 12 is usual.")
    if settings.login_idle_minutes > LONGEST_IDLE_MINUTES:
        idle = settings.login_idle_minutes
        yield Finding(f"LOGIN_IDLE_MINUTES is {idle}: a browser left alone stays open that long. 60 is usual.")
    if settings.login_attempts_per_minute > MOST_ATTEMPTS_PER_MINUTE:
        yield Finding("LOGIN_ATTEMPTS_PER_MINUTE lets passwords be guessed quickly. 10 is usual.")
    if settings.oidc_new_accounts == "experimenter":
        yield Finding("OIDC_NEW_ACCOUNTS lets everybody whom the identity provider knows make studies.", False)


def _of_backups(settings: Settings) -> Iterator[Finding]:
    if settings.backup_dir is None:
        yield Finding("BACKUP_DIR is not set: a broken disk takes every answer with it. Set it, best to another disk.")
        return
    device = _device(settings.backup_dir)
    if device is not None and device == _device(settings.data_dir):
        yield Finding("BACKUP_DIR is on the disk of DATA_DIR, and breaks with it. Take another disk.", False)
    standing = schedule.standing(settings.data_dir)
    if standing is None or standing.made_at is None:
        yield Finding("No backup has been made yet. Start the worker, or: python -m app backup")
    elif standing.failed_at is not None:
        yield Finding(f"The last backup failed: {standing.words}")
    elif standing.late:
        yield Finding(f"The newest backup is of {standing.made_at:%Y-%m-%d}. The worker makes them; does it run?")


def _of_the_schema(settings: Settings) -> Iterator[Finding]:
    present, newest = upgrading.revisions(settings)
    if present is None:
        yield Finding("There is no database yet. Start the studio once, or: python -m app migrate")
    elif present != newest:
        yield Finding(f"The database is of revision {present}, this version needs {newest}: python -m app migrate")


def _of_accounts(settings: Settings) -> Iterator[Finding]:
    database = Database(settings.sqlalchemy_url)
    try:
        with database.reading() as session:
            found = [finding for look in _ACCOUNTS for finding in look(session, settings)]
    finally:
        database.dispose()
    yield from found


def _without_second_factor(session: Session, settings: Settings) -> Iterator[Finding]:
    enabled = select(func.count(Experimenter.id)).where(Experimenter.disabled_at.is_(None))
    lacking = enabled.where(Experimenter.second_factor_since.is_(None), Experimenter.oidc_subject.is_(None))
    count = session.scalar(lacking) or 0
    if count and not settings.require_second_factor:
        of_all = session.scalar(enabled)
        yield Finding(
            f"{count} of {of_all} accounts have no second factor: a password that was seen or guessed opens them. "
            "REQUIRE_SECOND_FACTOR=true asks it of everybody."
        )


def _invited_long_ago(session: Session, settings: Settings) -> Iterator[Finding]:
    waiting = select(Experimenter.name).where(
        Experimenter.must_change_password,
        Experimenter.disabled_at.is_(None),
        Experimenter.created_at < now() - OLD_INVITATION,
    )
    for name in session.scalars(waiting.order_by(Experimenter.name)):
        yield Finding(f"The one-time password of {name} was never used. Disable the account, or make a new one.")


def _for_ever(session: Session, settings: Settings) -> Iterator[Finding]:
    lasting = select(func.count(ApiToken.id)).where(ApiToken.expires_at.is_(None), ApiToken.revoked_at.is_(None))
    if count := session.scalar(lasting):
        yield Finding(f"API tokens that never expire: {count}. Revoke them, and make new ones where they are needed.")


_ACCOUNTS: tuple[Callable[[Session, Settings], Iterator[Finding]], ...] = (
    _without_second_factor,
    _invited_long_ago,
    _for_ever,
)


def _is_here(host: str | None) -> bool:
    """Whether only this machine is meant."""
    try:
        return host == "localhost" or ip_address(host or "").is_loopback
    except ValueError:
        return False


def _mode(path: Path) -> int | None:
    try:
        return stat.S_IMODE(path.stat().st_mode)
    except OSError:
        return None


def _device(path: Path) -> int | None:
    try:
        return path.stat().st_dev
    except OSError:
        return None
