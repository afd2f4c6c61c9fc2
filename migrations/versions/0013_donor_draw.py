"""Whose filter somebody is shown as a method that is not theirs."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0013"
down_revision: str | None = "0012"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    op.create_table(
        "donor_draw",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("method", sa.String(40), nullable=False),
        sa.Column("rule", sa.String(20), nullable=False),
        sa.Column("stored_donors", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["participant_id"], ["participant.id"], name=op.f("fk_donor_draw_participant_id_participant")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_donor_draw")),
        sa.UniqueConstraint("participant_id", "method", name=op.f("uq_donor_draw_participant_id_method")),
    )
    op.create_index(op.f("ix_donor_draw_participant_id"), "donor_draw", ["participant_id"])


def downgrade() -> None:
    op.drop_table("donor_draw")
