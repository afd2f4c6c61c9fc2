"""Two robots side by side, which one somebody would rather have, and why in their own words."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0014"
down_revision: str | None = "0013"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    op.create_table(
        "head_to_head",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("ordinal", sa.Integer(), nullable=False),
        sa.Column("left_trial_id", sa.Integer(), nullable=False),
        sa.Column("right_trial_id", sa.Integer(), nullable=False),
        sa.Column("shown_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(
            ["participant_id"], ["participant.id"], name=op.f("fk_head_to_head_participant_id_participant")
        ),
        sa.ForeignKeyConstraint(["left_trial_id"], ["trial.id"], name=op.f("fk_head_to_head_left_trial_id_trial")),
        sa.ForeignKeyConstraint(["right_trial_id"], ["trial.id"], name=op.f("fk_head_to_head_right_trial_id_trial")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_head_to_head")),
        sa.UniqueConstraint("participant_id", "ordinal", name=op.f("uq_head_to_head_participant_id_ordinal")),
    )
    for column in ("participant_id", "left_trial_id", "right_trial_id"):
        op.create_index(op.f(f"ix_head_to_head_{column}"), "head_to_head", [column])
    op.create_table(
        "head_to_head_answer",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("head_to_head_id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("response", sa.String(8), nullable=False),
        sa.Column("reason", sa.String(1000), nullable=True),
        sa.Column("client_uuid", sa.String(36), nullable=False),
        sa.Column("response_time_ms", sa.Integer(), nullable=True),
        sa.Column("by_script", sa.Boolean(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["head_to_head_id"], ["head_to_head.id"], name=op.f("fk_head_to_head_answer_head_to_head_id_head_to_head")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_head_to_head_answer")),
        sa.UniqueConstraint("client_uuid", name=op.f("uq_head_to_head_answer_client_uuid")),
        sa.UniqueConstraint(
            "head_to_head_id", "revision", name=op.f("uq_head_to_head_answer_head_to_head_id_revision")
        ),
    )
    op.create_index(op.f("ix_head_to_head_answer_head_to_head_id"), "head_to_head_answer", ["head_to_head_id"])
    op.add_column("rating", sa.Column("reason", sa.String(1000), nullable=True))


def downgrade() -> None:
    op.drop_column("rating", "reason")
    op.drop_table("head_to_head_answer")
    op.drop_table("head_to_head")
