"""Answers to questionnaires about one robot."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0016"
down_revision: str | None = "0015"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    op.add_column("form_answer", sa.Column("letter", sa.String(1), nullable=True))


def downgrade() -> None:
    op.drop_column("form_answer", "letter")
