"""Rollouts that were made for one participant."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0022"
down_revision: str | None = "0021"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    with op.batch_alter_table("rollout") as table:
        table.add_column(sa.Column("participant_id", sa.Integer(), nullable=True))
        table.create_foreign_key(
            op.f("fk_rollout_participant_id_participant"), "participant", ["participant_id"], ["id"]
        )
        table.create_index(op.f("ix_rollout_participant_id"), ["participant_id"])


def downgrade() -> None:
    with op.batch_alter_table("rollout") as table:
        table.drop_index(op.f("ix_rollout_participant_id"))
        table.drop_constraint(op.f("fk_rollout_participant_id_participant"), type_="foreignkey")
        table.drop_column("participant_id")
