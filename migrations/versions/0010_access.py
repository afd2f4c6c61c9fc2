"""Studies have members, and whoever could see and do what before still can.

The role that was called "owner" is "administrator" now: an owner is a member of a study.
"""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0010"
down_revision: str | None = "0009"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    op.create_table(
        "study_member",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("experimenter_id", sa.Integer(), nullable=False),
        sa.Column("role", sa.String(20), nullable=False),
        sa.Column("added_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_study_member_study_id_study")),
        sa.ForeignKeyConstraint(
            ["experimenter_id"], ["experimenter.id"], name=op.f("fk_study_member_experimenter_id_experimenter")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_study_member")),
        sa.UniqueConstraint("study_id", "experimenter_id", name=op.f("uq_study_member_study_id_experimenter_id")),
    )
    op.create_index(op.f("ix_study_member_experimenter_id"), "study_member", ["experimenter_id"])
    with op.batch_alter_table("experimenter") as batch_op:
        batch_op.alter_column(
            "role", existing_type=sa.String(20), existing_nullable=False, server_default="administrator"
        )
    op.execute("UPDATE experimenter SET role = 'administrator' WHERE role = 'owner'")
    op.execute(
        "INSERT INTO study_member (study_id, experimenter_id, role, added_at) "
        "SELECT study.id, experimenter.id, CASE experimenter.role WHEN 'administrator' THEN 'owner' "
        "WHEN 'experimenter' THEN 'editor' ELSE 'viewer' END, CURRENT_TIMESTAMP "
        "FROM study CROSS JOIN experimenter WHERE study.deleted_at IS NULL"
    )


def downgrade() -> None:
    op.execute("UPDATE experimenter SET role = 'owner' WHERE role = 'administrator'")
    with op.batch_alter_table("experimenter") as batch_op:
        batch_op.alter_column("role", existing_type=sa.String(20), existing_nullable=False, server_default="owner")
    op.drop_index(op.f("ix_study_member_experimenter_id"), "study_member")
    op.drop_table("study_member")
