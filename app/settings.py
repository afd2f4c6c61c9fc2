"""Everything an operator may set, from the environment or a .env file, with units in the names."""

import re
from datetime import timedelta
from ipaddress import ip_network
from pathlib import Path
from typing import Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from app.logs import LogFormat


class Settings(BaseSettings):
    """Settings of web server and worker. Every program is handed one instance; there is no global."""

    model_config = SettingsConfigDict(env_file=".env", extra="ignore")

    data_dir: Path = Field(default=Path("data"), description="The one directory that everything is written to.")
    database_url: str | None = Field(default=None, description="SQLAlchemy URL; default: SQLite in the data dir.")
    storage_url: str | None = Field(default=None, description="s3://bucket/prefix; default: files in the data dir.")
    host: str = Field(default="127.0.0.1", description="Address the web server listens on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port the web server listens on.")
    public_url: str | None = Field(default=None, description="URL participants reach the server by, for links.")
    secure_cookies: bool = Field(default=False, description="Set when the server is reached by HTTPS only.")
    session_days: int = Field(default=30, ge=1, description="How long a participant's browser is remembered.")
    login_hours: int = Field(default=12, ge=1, description="How long an experimenter stays logged in.")
    login_idle_minutes: int = Field(default=60, ge=5, description="An experimenter who does nothing is logged out.")
    require_second_factor: bool = Field(default=False, description="Experimenters must set up a second factor.")
    login_attempts_per_minute: int = Field(default=10, ge=1, description="Password attempts per address.")
    trusted_proxies: str = Field(default="", description="Addresses or networks whose X-Forwarded-For is believed.")
    oidc_issuer: str | None = Field(default=None, description="Address of the identity provider (OpenID Connect).")
    oidc_client_id: str | None = Field(default=None, description="What the provider calls this studio.")
    oidc_client_secret: SecretStr | None = Field(default=None, description="Given by the provider, if it gives one.")
    oidc_account_claim: str = Field(default="email", description="Claim that is the name of an account here.")
    oidc_new_accounts: Literal["", "reader", "experimenter"] = Field(
        default="", description="Role of somebody the provider knows and this studio does not; none: refused."
    )
    signing_key_file: Path | None = Field(default=None, description="Private key; default: signing.key in DATA_DIR.")
    trusted_keys: str = Field(default="", description="Fingerprints of other studios' keys, separated by commas.")
    worker_name: str = Field(
        default="worker-1", max_length=80, description="Stable name: a restart goes on with its work."
    )
    log_format: LogFormat = Field(default=LogFormat.TEXT, description="json: one object per line, with ids.")
    metrics_token: str | None = Field(default=None, min_length=16, description="Bearer token for /metrics.")
    compute_processes: int = Field(default=2, ge=1, description="Processes for simulation and training.")

    alert_webhook: str | None = Field(default=None, description="Address that gets troubles as JSON.")
    alert_mail_to: str | None = Field(default=None, description="Who gets troubles by mail, separated by commas.")
    alert_mail_from: str = Field(default="pbarl-studio@localhost", description="Sender of those mails.")
    smtp_url: str = Field(default="smtp://localhost", description="Mail server: smtps://user:password@host:port.")

    backup_dir: Path | None = Field(default=None, description="Where the worker puts backups; default: it makes none.")
    backup_every_hours: int = Field(default=24, ge=1, description="Time between two backups of the worker.")
    backups_kept: int = Field(default=7, ge=1, description="So many backups stay in BACKUP_DIR, the newest.")

    @field_validator("database_url")
    @classmethod
    def _known_database(cls, url: str | None) -> str | None:
        """SQLite, or PostgreSQL by the driver that is installed, however its address is spelt."""
        if not url:
            return None
        scheme, colon, rest = url.partition("://")
        if scheme in {"postgres", "postgresql"}:
            scheme = "postgresql+psycopg"
        if not colon or scheme not in {"postgresql+psycopg", "sqlite", "sqlite+pysqlite"}:
            raise ValueError("Write postgresql+psycopg://user:password@host/database, or leave it out for SQLite.")
        return f"{scheme}://{rest}"

    @field_validator("alert_webhook")
    @classmethod
    def _address_of_webhook(cls, url: str | None) -> str | None:
        if url and urlsplit(url).scheme not in {"http", "https"}:
            raise ValueError("Write https://host/path.")
        return url or None

    @field_validator("smtp_url")
    @classmethod
    def _address_of_mail_server(cls, url: str) -> str:
        """A wrong port is told now, not when something is wrong."""
        parts = urlsplit(url)
        if parts.scheme not in {"smtp", "smtps"} or not parts.hostname or parts.port == 0:
            raise ValueError("Write smtps://user:password@host:port, or smtp:// for a server that offers STARTTLS.")
        return url

    @field_validator("storage_url")
    @classmethod
    def _known_storage(cls, url: str | None) -> str | None:
        """A bucket of an S3-compatible server; which server, and with which keys, AWS's usual variables say."""
        if url and not re.fullmatch(r"s3://[a-z0-9][a-z0-9.-]{1,61}[a-z0-9](/[A-Za-z0-9_-][A-Za-z0-9._-]*)*/?", url):
            raise ValueError("Write s3://bucket or s3://bucket/prefix, or leave it out for the data directory.")
        return url.rstrip("/") if url else None

    @field_validator("trusted_proxies")
    @classmethod
    def _only_addresses(cls, text: str) -> str:
        """Whoever is believed here says who asks, so nobody is believed by accident: no names, no "everybody"."""
        named = [part.strip() for part in text.split(",") if part.strip()]
        for each in named:
            try:
                network = ip_network(each)
            except ValueError as error:
                raise ValueError(f"{each} is neither an address nor a network such as 10.0.0.0/8.") from error
            if network.prefixlen == 0:
                raise ValueError(f"{each} is everybody. Name the proxy's own address.")
        return ",".join(named)

    @model_validator(mode="after")
    def _whole_provider(self) -> Self:
        """Over plain HTTP anybody in between could say who somebody is; on this machine nobody is in between."""
        if self.oidc_issuer is None:
            return self
        parts = urlsplit(self.oidc_issuer)
        if parts.scheme != "https" and parts.hostname not in {"127.0.0.1", "::1", "localhost"}:
            raise ValueError("OIDC_ISSUER begins with https://.")
        if not self.oidc_client_id:
            raise ValueError("OIDC_ISSUER needs OIDC_CLIENT_ID.")
        return self

    @field_validator("trusted_keys")
    @classmethod
    def _only_fingerprints(cls, text: str) -> str:
        """A wrong letter would silently trust nobody."""
        named = [part.strip().lower() for part in text.split(",") if part.strip()]
        for each in named:
            if not re.fullmatch(r"[0-9a-f]{64}", each):
                raise ValueError(f"{each} is no fingerprint: 64 characters from 0 to 9 and a to f.")
        return ",".join(named)

    @property
    def trusted_fingerprints(self) -> frozenset[str]:
        """Of the keys of other studios that this one knows."""
        return frozenset(self.trusted_keys.split(",")) - {""}

    @property
    def login_idle(self) -> timedelta:
        """After which an experimenter who does nothing is logged out."""
        return timedelta(minutes=self.login_idle_minutes)

    @property
    def login_whole(self) -> timedelta:
        """After which an experimenter is logged out in any case."""
        return timedelta(hours=self.login_hours)

    @property
    def signing_key_path(self) -> Path:
        """Where the private key of this installation lies."""
        return self.signing_key_file or self.data_dir / "signing.key"

    @property
    def sqlalchemy_url(self) -> str:
        """The database to use: as set, or studio.sqlite3 in the data directory."""
        return self.database_url or f"sqlite:///{self.data_dir.resolve() / 'studio.sqlite3'}"

    @property
    def base_url(self) -> str:
        """The address to print and to put into links, without a trailing slash."""
        return (self.public_url or f"http://{self.host}:{self.port}").rstrip("/")
