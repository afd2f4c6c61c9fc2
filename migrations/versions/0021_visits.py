"""Return visits: who a participant was at the visit before, in another study."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0021"
down_revision: str | None = "0020"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    with op.batch_alter_table("participant") as table:
        table.add_column(sa.Column("visit", sa.Integer(), server_default="1", nullable=False))
        table.add_column(sa.Column("earlier_id", sa.Integer(), nullable=True))
        table.create_foreign_key(op.f("fk_participant_earlier_id_participant"), "participant", ["earlier_id"], ["id"])
        table.create_unique_constraint("uq_participant_earlier_id", ["earlier_id"])


def downgrade() -> None:
    with op.batch_alter_table("participant") as table:
        table.drop_constraint("uq_participant_earlier_id", type_="unique")
        table.drop_constraint(op.f("fk_participant_earlier_id_participant"), type_="foreignkey")
        table.drop_column("earlier_id")
        table.drop_column("visit")
