"""What somebody said made the difference between the clips of a pair."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0018"
down_revision: str | None = "0017"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    op.add_column("label_event", sa.Column("mattered", sa.String(40), nullable=True))


def downgrade() -> None:
    op.drop_column("label_event", "mattered")
