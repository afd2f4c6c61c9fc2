"""Answers can be excluded; studies can be put away and deleted."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0007"
down_revision: str | None = "0006"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None

_OF_STUDY = ("put_away_at", "deleted_at", "erased_at")


def upgrade() -> None:
    op.create_table(
        "exclusion",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("label_event_id", sa.Integer(), nullable=False),
        sa.Column("excluded", sa.Boolean(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("actor", sa.String(length=80), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["label_event_id"], ["label_event.id"], name=op.f("fk_exclusion_label_event_id_label_event")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_exclusion")),
    )
    op.create_index(op.f("ix_exclusion_label_event_id"), "exclusion", ["label_event_id"])
    with op.batch_alter_table("study", schema=None) as batch_op:
        for name in _OF_STUDY:
            batch_op.add_column(sa.Column(name, sa.DateTime(timezone=True), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("study", schema=None) as batch_op:
        for name in reversed(_OF_STUDY):
            batch_op.drop_column(name)
    op.drop_index(op.f("ix_exclusion_label_event_id"), "exclusion")
    op.drop_table("exclusion")
