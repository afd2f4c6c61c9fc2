"""The secret that the letters of an evaluation are drawn from, and what an export could not hold."""

import secrets
from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision: str = "0003"
down_revision: str | None = "0002"
branch_labels: Sequence[str] | None = None
depends_on: Sequence[str] | None = None


def upgrade() -> None:
    with op.batch_alter_table("export", schema=None) as batch_op:
        batch_op.add_column(sa.Column("missing", sa.JSON(), nullable=True))
    with op.batch_alter_table("study", schema=None) as batch_op:
        batch_op.add_column(sa.Column("key_secret", sa.String(length=64), nullable=True))
    study = sa.table("study", sa.column("id", sa.Integer), sa.column("key_secret", sa.String))
    connection = op.get_bind()
    for number in connection.scalars(sa.select(study.c.id)).all():
        connection.execute(study.update().where(study.c.id == number).values(key_secret=secrets.token_hex(32)))
    with op.batch_alter_table("study", schema=None) as batch_op:
        batch_op.alter_column("key_secret", existing_type=sa.String(length=64), nullable=False)


def downgrade() -> None:
    with op.batch_alter_table("study", schema=None) as batch_op:
        batch_op.drop_column("key_secret")
    with op.batch_alter_table("export", schema=None) as batch_op:
        batch_op.drop_column("missing")
