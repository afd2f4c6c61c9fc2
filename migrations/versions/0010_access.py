"""Members of studies, second factors, scopes of tokens, links that are revoked.

Whoever could see and do what before still can: accounts become members, tokens keep all rights and do not expire.

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
    op.create_table(
        "recovery_code",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("experimenter_id", sa.Integer(), nullable=False),
        sa.Column("code_sha256", sa.String(64), nullable=False),
        sa.Column("used_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(
            ["experimenter_id"], ["experimenter.id"], name=op.f("fk_recovery_code_experimenter_id_experimenter")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_recovery_code")),
    )
    op.create_index(op.f("ix_recovery_code_experimenter_id"), "recovery_code", ["experimenter_id"])
    with op.batch_alter_table("experimenter") as batch_op:
        batch_op.add_column(sa.Column("oidc_subject", sa.String(500), nullable=True))
        batch_op.create_unique_constraint(op.f("uq_experimenter_oidc_subject"), ["oidc_subject"])
        batch_op.add_column(sa.Column("totp_secret", sa.String(64), nullable=True))
        batch_op.add_column(sa.Column("second_factor_since", sa.DateTime(timezone=True), nullable=True))
        batch_op.add_column(sa.Column("totp_used_step", sa.Integer(), nullable=True))
        batch_op.add_column(sa.Column("wrong_codes", sa.Integer(), nullable=False, server_default="0"))
        batch_op.add_column(sa.Column("code_wrong_at", sa.DateTime(timezone=True), nullable=True))
    with op.batch_alter_table("browser_session") as batch_op:
        batch_op.add_column(sa.Column("browser", sa.String(80), nullable=True))
        batch_op.add_column(sa.Column("second_factor_due", sa.Boolean(), nullable=False, server_default=sa.false()))
    with op.batch_alter_table("api_token") as batch_op:
        batch_op.add_column(sa.Column("scope", sa.String(10), nullable=False, server_default="write"))
        batch_op.add_column(sa.Column("study_id", sa.Integer(), nullable=True))
        batch_op.add_column(sa.Column("expires_at", sa.DateTime(timezone=True), nullable=True))
        batch_op.create_foreign_key(op.f("fk_api_token_study_id_study"), "study", ["study_id"], ["id"])
        batch_op.create_index(op.f("ix_api_token_study_id"), ["study_id"])
    with op.batch_alter_table("participant") as batch_op:
        batch_op.add_column(sa.Column("link_revoked_at", sa.DateTime(timezone=True), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("participant") as batch_op:
        batch_op.drop_column("link_revoked_at")
    with op.batch_alter_table("api_token") as batch_op:
        batch_op.drop_index(op.f("ix_api_token_study_id"))
        batch_op.drop_constraint(op.f("fk_api_token_study_id_study"), type_="foreignkey")
        for name in ("expires_at", "study_id", "scope"):
            batch_op.drop_column(name)
    # Before this version such a session would be a whole one.
    op.execute("DELETE FROM browser_session WHERE second_factor_due")
    with op.batch_alter_table("browser_session") as batch_op:
        for name in ("second_factor_due", "browser"):
            batch_op.drop_column(name)
    with op.batch_alter_table("experimenter") as batch_op:
        batch_op.drop_constraint(op.f("uq_experimenter_oidc_subject"), type_="unique")
        for name in (
            "oidc_subject",
            "code_wrong_at",
            "wrong_codes",
            "totp_used_step",
            "second_factor_since",
            "totp_secret",
        ):
            batch_op.drop_column(name)
    op.drop_index(op.f("ix_recovery_code_experimenter_id"), "recovery_code")
    op.drop_table("recovery_code")
    op.execute("UPDATE experimenter SET role = 'owner' WHERE role = 'administrator'")
    with op.batch_alter_table("experimenter") as batch_op:
        batch_op.alter_column("role", existing_type=sa.String(20), existing_nullable=False, server_default="owner")
    op.drop_index(op.f("ix_study_member_experimenter_id"), "study_member")
    op.drop_table("study_member")
