"""How much of each clip was played before an answer, whatever the speed."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0005"
down_revision: str | None = "0004"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None

COLUMNS = ("left_watched_ms", "right_watched_ms")


def upgrade() -> None:
    with op.batch_alter_table("label_event", schema=None) as batch_op:
        for name in COLUMNS:
            batch_op.add_column(sa.Column(name, sa.Integer(), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("label_event", schema=None) as batch_op:
        for name in COLUMNS:
            batch_op.drop_column(name)
