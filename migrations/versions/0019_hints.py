"""Plain hints that somebody gives beside their answers."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0019"
down_revision: str | None = "0018"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    op.create_table(
        "hint_event",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("hints", sa.String(200), nullable=False),
        sa.Column("offered", sa.Text(), nullable=False),
        sa.Column("answered", sa.Integer(), nullable=False),
        sa.Column("client_uuid", sa.String(36), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["participant_id"], ["participant.id"], name=op.f("fk_hint_event_participant_id_participant")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_hint_event")),
        sa.UniqueConstraint("client_uuid", name=op.f("uq_hint_event_client_uuid")),
        sa.UniqueConstraint("participant_id", "revision", name=op.f("uq_hint_event_participant_id_revision")),
    )
    op.create_index(op.f("ix_hint_event_participant_id"), "hint_event", ["participant_id"])


def downgrade() -> None:
    op.drop_table("hint_event")
