"""Runs of the worker, the models they leave, and the bundles published from them."""

from datetime import datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import BigInteger, ForeignKey, Integer, String, Text, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from app.db import Base, now


class RunKind(StrEnum):
    """What a run makes."""

    CLIPS = "clips"
    REWARD = "reward"
    FILTER = "filter"
    REFINEMENT = "refinement"
    """What the last filter's refinement goes on from, made while the participant still answers."""
    METHOD = "method"
    """A method that is only evaluated, such as PrefFT."""
    SHARED = "shared"
    """A filter for several people or types of users together."""
    FILMS = "films"
    """Videos of methods on unseen scenarios."""
    REPORT = "report"
    EXPORT = "export"
    POWER = "power"
    """A simulation of how many people a study needs."""


class RunStatus(StrEnum):
    """Where a run is."""

    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    RETRY = "retry"
    """Somebody has asked for another attempt."""


class ModelKind(StrEnum):
    """What a model is."""

    REWARD = "reward"
    FILTER = "filter"
    METHOD = "method"


class Run(Base):
    """One piece of work with its provenance. The workflow id is deterministic, so asking twice is asking once."""

    __tablename__ = "run"

    id: Mapped[int] = mapped_column(primary_key=True)
    workflow_id: Mapped[str] = mapped_column(String(200), unique=True)
    kind: Mapped[str] = mapped_column(String(20))
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    participant_id: Mapped[int | None] = mapped_column(ForeignKey("participant.id"), index=True)
    status: Mapped[str] = mapped_column(String(20), default=RunStatus.RUNNING)
    stage: Mapped[str] = mapped_column(String(120), default="")
    progress: Mapped[float] = mapped_column(default=0.0)
    label_count: Mapped[int | None]
    label_hash: Mapped[str | None] = mapped_column(String(64))
    seed: Mapped[int | None]
    attempt: Mapped[int] = mapped_column(default=1)
    error: Mapped[str | None] = mapped_column(Text)
    started_at: Mapped[datetime] = mapped_column(default=now)
    heartbeat_at: Mapped[datetime] = mapped_column(default=now)
    finished_at: Mapped[datetime | None]


class Model(Base):
    """The result of one run for one participant."""

    __tablename__ = "model"

    id: Mapped[int] = mapped_column(primary_key=True)
    run_id: Mapped[int] = mapped_column(ForeignKey("run.id"), unique=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    kind: Mapped[str] = mapped_column(String(20))
    artefact_sha256: Mapped[str] = mapped_column(String(64))
    label_count: Mapped[int]
    label_hash: Mapped[str] = mapped_column(String(64))
    seed: Mapped[int]
    metrics: Mapped[dict[str, Any]]
    created_at: Mapped[datetime] = mapped_column(default=now)


class Bundle(Base):
    """A published export of one filter: a zip file that runs without this project."""

    __tablename__ = "bundle"
    __table_args__ = (UniqueConstraint("participant_id", "version"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    version: Mapped[int]
    model_id: Mapped[int] = mapped_column(ForeignKey("model.id"), unique=True)
    artefact_sha256: Mapped[str] = mapped_column(String(64))
    byte_count: Mapped[int]
    created_at: Mapped[datetime] = mapped_column(default=now)


class Report(Base):
    """Statistics and figures of one study, made when ratings or answers were newer than the last report."""

    __tablename__ = "report"

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    run_id: Mapped[int] = mapped_column(ForeignKey("run.id"), unique=True)
    basis: Mapped[str] = mapped_column(String(64))
    """Fingerprint of the rows it was made from."""
    contents: Mapped[dict[str, Any]]
    figures: Mapped[dict[str, Any]]
    """By name: {"svg": sha256, "png": sha256}."""
    created_at: Mapped[datetime] = mapped_column(default=now)


class Export(Base):
    """A file somebody has asked for: the whole data of a study, or an archive that another installation imports."""

    __tablename__ = "export"

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    kind: Mapped[str] = mapped_column(String(20))
    requested_by: Mapped[str] = mapped_column(String(80))
    requested_at: Mapped[datetime] = mapped_column(default=now)
    finished_at: Mapped[datetime | None]
    artefact_sha256: Mapped[str | None] = mapped_column(String(64))
    """None of a finished one: taken back, because somebody withdrew who was in it."""
    byte_count: Mapped[int | None] = mapped_column(BigInteger().with_variant(Integer, "sqlite"))  # videos of thousands
    missing: Mapped[dict[str, Any] | None]
    """What could not be put in, by what it is: {"video of a clip": [sha256, ...]}; None: nothing."""


class WorkerPresence(Base):
    """A worker's sign of life, so that the dashboard can say when nobody is computing."""

    __tablename__ = "worker_presence"

    name: Mapped[str] = mapped_column(String(80), primary_key=True)
    last_seen_at: Mapped[datetime] = mapped_column(default=now)


class Alert(Base):
    """A trouble of the installation that its operator is told of; deleted when they know that it is over."""

    __tablename__ = "alert"

    trouble: Mapped[str] = mapped_column(String(80), primary_key=True)
    words: Mapped[str] = mapped_column(Text)
    began_at: Mapped[datetime]
    told_at: Mapped[datetime | None]
    over_at: Mapped[datetime | None]
    due_at: Mapped[datetime]
    """When it is to be told, for the first time or again."""
