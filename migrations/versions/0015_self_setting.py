"""Robots that participants set themselves with sliders, and films that show a setting at once."""

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0015"
down_revision: str | None = "0014"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    op.add_column("study", sa.Column("mode_axes", sa.JSON(), nullable=True))
    op.create_table(
        "self_setting",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("mode", sa.JSON(), nullable=False),
        sa.Column("moved", sa.String(60), nullable=True),
        sa.Column("filmed", sa.Boolean(), nullable=False),
        sa.Column("client_uuid", sa.String(36), nullable=False),
        sa.Column("response_time_ms", sa.Integer(), nullable=True),
        sa.Column("by_script", sa.Boolean(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["participant_id"], ["participant.id"], name=op.f("fk_self_setting_participant_id_participant")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_self_setting")),
        sa.UniqueConstraint("client_uuid", name=op.f("uq_self_setting_client_uuid")),
        sa.UniqueConstraint("participant_id", "revision", name=op.f("uq_self_setting_participant_id_revision")),
    )
    op.create_index(op.f("ix_self_setting_participant_id"), "self_setting", ["participant_id"])
    op.create_table(
        "preview_film",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("self_setting_id", sa.Integer(), nullable=True),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("mode", sa.JSON(), nullable=False),
        sa.Column("video_sha256", sa.String(64), nullable=False),
        sa.Column("poster_sha256", sa.String(64), nullable=False),
        sa.Column("width", sa.Integer(), nullable=False),
        sa.Column("height", sa.Integer(), nullable=False),
        sa.Column("fps", sa.Integer(), nullable=False),
        sa.Column("duration_ms", sa.Integer(), nullable=False),
        sa.Column("byte_count", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_preview_film_study_id_study")),
        sa.ForeignKeyConstraint(
            ["self_setting_id"], ["self_setting.id"], name=op.f("fk_preview_film_self_setting_id_self_setting")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_preview_film")),
        sa.UniqueConstraint(
            "study_id", "self_setting_id", "number", name=op.f("uq_preview_film_study_id_self_setting_id_number")
        ),
    )
    for column in ("study_id", "self_setting_id", "video_sha256", "poster_sha256"):
        op.create_index(op.f(f"ix_preview_film_{column}"), "preview_film", [column])


def downgrade() -> None:
    op.drop_table("preview_film")
    op.drop_table("self_setting")
    op.drop_column("study", "mode_axes")
