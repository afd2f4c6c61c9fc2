"""What several web servers must know of each other: new links on their way to a page, and attempts to log in."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0011"
down_revision: str | None = "0010"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    op.create_table(
        "new_links",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("key_sha256", sa.String(64), nullable=False),
        sa.Column("experimenter_id", sa.Integer(), nullable=False),
        sa.Column("sealed", sa.Text(), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["experimenter_id"], ["experimenter.id"], name=op.f("fk_new_links_experimenter_id_experimenter")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_new_links")),
        sa.UniqueConstraint("key_sha256", name=op.f("uq_new_links_key_sha256")),
    )
    op.create_table(
        "login_attempt",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("kind", sa.String(20), nullable=False),
        sa.Column("address_sha256", sa.String(64), nullable=False),
        sa.Column("account_sha256", sa.String(64), nullable=False),
        sa.Column("browser_sha256", sa.String(64), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_login_attempt")),
    )


def downgrade() -> None:
    op.drop_table("login_attempt")
    op.drop_table("new_links")
