"""Filters for several people or types of users: one row each, so that they are fitted once and ahead."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0020"
down_revision: str | None = "0019"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    op.create_table(
        "shared_filter",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("stored_donors", sa.JSON(), nullable=False),
        sa.Column("asked_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("artefact_sha256", sa.String(64), nullable=True),
        sa.Column("metrics", sa.JSON(), nullable=True),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_shared_filter_study_id_study")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_shared_filter")),
    )
    op.create_index(op.f("ix_shared_filter_study_id"), "shared_filter", ["study_id"])


def downgrade() -> None:
    op.drop_table("shared_filter")
