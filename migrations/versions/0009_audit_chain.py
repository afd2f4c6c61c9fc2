"""The audit log is chained, its subjects can be erased, and erasures leave receipts.

Rows of before are chained as they are found. Of people who have withdrawn and of studies that were deleted, what would
name them is left out first.
"""

import hashlib
import json
import re
import secrets
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa
from alembic import op

revision: str = "0009"
down_revision: str | None = "0008"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None

_CODE = re.compile(r"P\d{2,8}")
_SUBJECT = re.compile(r"([a-z0-9-]+)(?:/(P\d{2,8}))?(?=[/: ]|$)")
_RUN = re.compile(r"\b(participant|study)-(\d+)\b")
_OF_ACCOUNTS = re.compile(r"account |role |password|API token|logged in")
_GONE = "somebody whose data are erased"
_event = sa.table(
    "audit_event",
    *(sa.column(name) for name in ("actor", "action", "subject", "subject_salt", "subject_hash")),
    *(sa.column(name) for name in ("previous_hash", "row_hash")),
    *(sa.column(name, sa.Integer) for name in ("id", "study_id", "participant_id")),
    sa.column("at", sa.DateTime(timezone=True)),
)


def upgrade() -> None:
    op.create_table(
        "erasure_receipt",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=True),
        sa.Column("contents", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_erasure_receipt")),
    )
    op.create_index(op.f("ix_erasure_receipt_study_id"), "erasure_receipt", ["study_id"])
    with op.batch_alter_table("audit_event") as batch_op:
        batch_op.alter_column("subject", existing_type=sa.String(200), nullable=True)
        batch_op.add_column(sa.Column("study_id", sa.Integer(), nullable=True))
        batch_op.add_column(sa.Column("participant_id", sa.Integer(), nullable=True))
        batch_op.add_column(sa.Column("subject_salt", sa.String(32), nullable=True))
        for name in ("subject_hash", "previous_hash", "row_hash"):
            batch_op.add_column(sa.Column(name, sa.String(64), nullable=False, server_default=""))
    _chain(op.get_bind())
    with op.batch_alter_table("audit_event") as batch_op:
        for name in ("subject_hash", "previous_hash", "row_hash"):
            batch_op.alter_column(name, existing_type=sa.String(64), existing_nullable=False, server_default=None)
        batch_op.create_index("ix_audit_event_actor_action_subject", ["actor", "action", "subject"])
        for name in ("action", "study_id", "participant_id"):
            batch_op.create_index(f"ix_audit_event_{name}", [name])


def downgrade() -> None:
    op.execute(sa.update(_event).where(_event.c.subject.is_(None)).values(subject=_GONE))
    with op.batch_alter_table("audit_event") as batch_op:
        for name in ("actor_action_subject", "action", "study_id", "participant_id"):
            batch_op.drop_index(f"ix_audit_event_{name}")
        for name in ("row_hash", "previous_hash", "subject_hash", "subject_salt", "participant_id", "study_id"):
            batch_op.drop_column(name)
        batch_op.alter_column("subject", existing_type=sa.String(200), nullable=False)
    op.drop_index(op.f("ix_erasure_receipt_study_id"), "erasure_receipt")
    op.drop_table("erasure_receipt")


def _chain(connection: sa.Connection) -> None:
    rows = connection.execute(sa.select(_event).order_by(_event.c.id)).mappings().all()
    changes, previous = [], "0" * 64
    for row, told in zip(rows, _told(connection, rows), strict=True):
        salt = secrets.token_hex(16)
        actor = "participant" if _CODE.fullmatch(row["actor"]) else row["actor"]
        moment = (row["at"] if row["at"].tzinfo else row["at"].replace(tzinfo=UTC)).astimezone(UTC)
        subject_hash = _sha256([salt, told["subject"], told["participant_id"]])
        row_hash = _sha256(
            [row["id"], _written(moment), actor, row["action"], told["study_id"], subject_hash, previous]
        )
        new = {"actor": actor, "subject_salt": salt, "subject_hash": subject_hash, "previous_hash": previous}
        changes.append({"number": row["id"], "row_hash": row_hash, **new, **told})
        previous = row_hash
    if changes:
        names = changes[0].keys() - {"number"}
        update = sa.update(_event).where(_event.c.id == sa.bindparam("number"))
        connection.execute(update.values({name: sa.bindparam(name) for name in names}), changes)


def _told(connection: sa.Connection, rows: Sequence[Mapping[Any, Any]]) -> Iterator[dict[str, Any]]:
    """Subject, study and participant of every row, in their order; without what would name those who are gone."""
    found = connection.execute(sa.text("SELECT slug, id FROM study WHERE deleted_at IS NULL"))
    studies: dict[str, int] = {slug: number for slug, number in found}  # noqa: C416  (rows are no pairs to mypy)
    present = {study_id: slug for slug, study_id in studies.items()}
    people, gone = dict[tuple[int, str], int](), set[int]()
    of_studies = dict[int, int]()
    for number, participant_id, study_id, withdrawn_at in connection.execute(
        sa.text("SELECT number, id, study_id, withdrawn_at FROM participant")
    ):
        people[study_id, f"P{number:02d}"] = participant_id
        of_studies[participant_id] = study_id
        if withdrawn_at is not None:
            gone.add(participant_id)
    deleted = {row["subject"]: row["id"] for row in rows if row["action"] == "study deleted"}
    for row in rows:
        study_id, participant_id, subject = _about(row, studies, people, of_studies)
        named = _SUBJECT.match(subject)
        if not _OF_ACCOUNTS.match(row["action"]) and named and row["id"] <= deleted.get(named[1], 0):
            study_id, participant_id, subject = None, None, "a deleted study"
        elif study_id is not None and study_id not in present:
            study_id, participant_id, subject = study_id, None, "a deleted study"
        elif participant_id in gone:
            participant_id, subject = None, _GONE
        yield {"study_id": study_id, "participant_id": participant_id, "subject": subject}


def _about(
    row: Mapping[Any, Any],
    studies: Mapping[str, int],
    people: Mapping[tuple[int, str], int],
    of_studies: Mapping[int, int],
) -> tuple[int | None, int | None, str]:
    """Study, participant and subject of a row, as far as they can be told from its words."""
    subject: str = row["subject"]
    if _OF_ACCOUNTS.match(row["action"]):
        return None, None, subject
    if row["action"] == "run retried":
        ids = {kind: int(number) for kind, number in _RUN.findall(subject)}
        participant_id = ids.get("participant")
        return ids.get("study", of_studies.get(participant_id or 0)), participant_id, subject
    named = _SUBJECT.match(subject)
    if named is None or named[1] not in studies:
        return None, None, subject
    study_id = studies[named[1]]
    return study_id, people.get((study_id, named[2])) if named[2] else None, subject


def _written(moment: datetime) -> str:
    return moment.isoformat(timespec="microseconds")


def _sha256(canonical: list[Any]) -> str:
    return hashlib.sha256(json.dumps(canonical, separators=(",", ":")).encode()).hexdigest()
