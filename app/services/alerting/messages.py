"""Messages to the operator: by webhook, by mail, or by both."""

import logging
import smtplib
import ssl
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from email.message import EmailMessage
from urllib.parse import unquote, urlsplit

import httpx2

from app.errors import AppError
from app.settings import Settings

PATIENCE_S = 10.0
SMTP_PORTS = {"smtp": 25, "smtps": 465}

log = logging.getLogger(__name__)


class NobodyToTell(AppError):
    """Set ALERT_WEBHOOK or ALERT_MAIL_TO, so that there is somebody to tell."""


class NotTold(AppError):
    """The message could not be delivered."""


@dataclass(frozen=True)
class Line:
    """One trouble in a message."""

    trouble: str
    words: str
    since: datetime
    is_over: bool = False

    @property
    def text(self) -> str:
        """In one line."""
        return f"{'Over: ' if self.is_over else ''}{self.words} (since {self.since:%Y-%m-%d %H:%M} UTC)"


@dataclass(frozen=True)
class Message:
    """What the operator gets to read."""

    studio: str
    """its address"""
    lines: Sequence[Line]

    @property
    def title(self) -> str:
        """One line, for a subject."""
        standing = sum(not line.is_over for line in self.lines)
        return f"PbARL Studio: {f'{standing} to see to' if standing else 'over'} ({self.studio})"

    @property
    def text(self) -> str:
        """Everything, a line each."""
        return "\n".join([self.title, *(line.text for line in self.lines)])


def can_tell(settings: Settings) -> bool:
    """Whether the operator wants to be told."""
    return bool(settings.alert_webhook or settings.alert_mail_to)


def send(settings: Settings, message: Message) -> None:
    """Deliver it in every way that is set. Raises NobodyToTell, and NotTold when no way worked."""
    ways = {"ALERT_WEBHOOK": (settings.alert_webhook, _post), "ALERT_MAIL_TO": (settings.alert_mail_to, _mail)}
    wanted = {name: way for name, (is_set, way) in ways.items() if is_set}
    if not wanted:
        raise NobodyToTell
    failures = []
    for name, way in wanted.items():
        try:
            way(settings, message)
        except (httpx2.HTTPError, smtplib.SMTPException, OSError) as error:
            failures.append(f"{name}: {_without_address(error)}")
            log.warning("an alert could not be delivered: %s", failures[-1])
    if len(failures) == len(wanted):
        raise NotTold(f"The message could not be delivered. {'; '.join(failures)}")


def _post(settings: Settings, message: Message) -> None:
    """One JSON object; its ``text`` is what chat programs show."""
    troubles = [
        {"trouble": line.trouble, "words": line.words, "since": line.since.isoformat(), "over": line.is_over}
        for line in message.lines
    ]
    body = {"text": message.text, "studio": message.studio, "troubles": troubles}
    httpx2.post(settings.alert_webhook or "", json=body, timeout=PATIENCE_S).raise_for_status()


def _mail(settings: Settings, message: Message) -> None:
    mail = EmailMessage()
    mail["Subject"], mail["To"] = message.title, settings.alert_mail_to
    mail["From"] = settings.alert_mail_from
    mail.set_content(message.text)
    server = urlsplit(settings.smtp_url)
    host, port = server.hostname or "localhost", server.port or SMTP_PORTS[server.scheme]
    trusted = ssl.create_default_context()
    connected = (
        smtplib.SMTP_SSL(host, port, timeout=PATIENCE_S, context=trusted)
        if server.scheme == "smtps"
        else smtplib.SMTP(host, port, timeout=PATIENCE_S)
    )
    with connected as smtp:
        if server.scheme == "smtp" and smtp.has_extn("starttls"):
            smtp.starttls(context=trusted)
        if server.username:
            if not isinstance(smtp.sock, ssl.SSLSocket):
                raise smtplib.SMTPNotSupportedError("the server offers no encryption, so it gets no password")
            smtp.login(unquote(server.username), unquote(server.password or ""))
        smtp.send_message(mail)


def _without_address(error: Exception) -> str:
    """What went wrong, without the address: that of a webhook is a password."""
    if isinstance(error, httpx2.HTTPStatusError):
        return f"answered with {error.response.status_code}"
    if isinstance(error, smtplib.SMTPResponseException):
        return f"{error.smtp_code} {error.smtp_error!r}"
    return type(error).__name__ if isinstance(error, httpx2.HTTPError) else f"{type(error).__name__}: {error}"
