"""Arms of studies between subjects, who was sent away before the end, and plans of how many people are needed."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0017"
down_revision: str | None = "0016"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    op.create_table(
        "allocation",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("place", sa.Integer(), nullable=False),
        sa.Column("lot", sa.Double(), nullable=False),
        sa.Column("considered", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["participant_id"], ["participant.id"], name=op.f("fk_allocation_participant_id_participant")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_allocation")),
        sa.UniqueConstraint("participant_id", name=op.f("uq_allocation_participant_id")),
    )
    op.create_table(
        "power_plan",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("asked_by", sa.String(80), nullable=False),
        sa.Column("asked_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("basis", sa.String(64), nullable=False),
        sa.Column("stored_inputs", sa.JSON(), nullable=False),
        sa.Column("contents", sa.JSON(), nullable=True),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_power_plan_study_id_study")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_power_plan")),
    )
    op.create_index(op.f("ix_power_plan_study_id"), "power_plan", ["study_id"])
    op.add_column("participant", sa.Column("arm", sa.String(40), nullable=True))
    op.add_column("participant", sa.Column("ended_as", sa.String(20), nullable=True))


def downgrade() -> None:
    op.drop_column("participant", "ended_as")
    op.drop_column("participant", "arm")
    op.drop_table("power_plan")
    op.drop_table("allocation")
