"""What the columns of several tables have in common."""

from collections.abc import Iterable
from typing import Any

from app.services.exports.export_formats import Column, ColumnKind

T, I, N = ColumnKind.TEXT, ColumnKind.INTEGER, ColumnKind.NUMBER  # noqa: E741
B, W, J = ColumnKind.BOOLEAN, ColumnKind.TIME, ColumnKind.JSON
"""A letter each (W: when), so that a column is one line to read: there are nearly two hundred."""

PARTICIPANT = Column("participant", T, "Code of the participant.", allowed="P01, P02, ...")
ORDINAL = Column("ordinal", I, "Place of the pair in this participant's order.", allowed="from 1")
SHA256 = "64 hexadecimal digits"
WITHOUT_SCRIPT = (
    "Whether the page's script sent it. False: a browser without script, where nothing is measured and nothing "
    "waits until the clips were seen. Empty: taken back, or from a version that did not note it."
)


def words(values: Iterable[Any]) -> str:
    """The values of an enumeration, one after the other."""
    return ", ".join(value.value for value in values)
