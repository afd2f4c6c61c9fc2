"""Arms of studies between subjects, how people came into them, and who was sent away before the end."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0017"
down_revision: str | None = "0014"
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
    op.add_column("participant", sa.Column("arm", sa.String(40), nullable=True))
    op.add_column("participant", sa.Column("ended_as", sa.String(20), nullable=True))


def downgrade() -> None:
    op.drop_column("participant", "ended_as")
    op.drop_column("participant", "arm")
    op.drop_table("allocation")
