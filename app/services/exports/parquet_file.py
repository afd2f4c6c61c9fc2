"""A table of an export as Parquet, with typed columns and what they mean."""

from datetime import UTC, datetime, timedelta
from io import BytesIO
from typing import Any

from arro3.core import Array, DataType, Field, Schema
from arro3.core import Table as ArrowTable
from arro3.io import write_parquet
from sqlalchemy.orm import Session

from app.domain.studies import Study
from app.services.exports.csv_cells import json_text
from app.services.exports.export_formats import Column, ColumnKind, RowProvenance, Table

MEDIA_TYPE = "application/vnd.apache.parquet"
_TYPES = {
    ColumnKind.TEXT: DataType.utf8(),
    ColumnKind.INTEGER: DataType.int64(),
    ColumnKind.NUMBER: DataType.float64(),
    ColumnKind.BOOLEAN: DataType.bool(),
    ColumnKind.TIME: DataType.int64(),
    ColumnKind.JSON: DataType.utf8(),
}
_EPOCH, _MILLISECOND = datetime.fromtimestamp(0, UTC), timedelta(milliseconds=1)
_TIME = DataType.timestamp("ms", tz="UTC")


def content(table: Table, session: Session, study: Study, provenance: RowProvenance) -> bytes:
    """The file; json columns are text."""
    rows = [(*values, *provenance.values) for values in table.rows(session, study)]
    arrays = [_array(column, [row[place] for row in rows]) for place, column in enumerate(table.all_columns)]
    fields = [
        Field(column.name, array.type, nullable=True, metadata={"meaning": column.meaning, "unit": column.unit})
        for column, array in zip(table.all_columns, arrays, strict=True)
    ]
    file = BytesIO()
    write_parquet(ArrowTable.from_arrays(arrays, schema=Schema(fields)), file)
    return file.getvalue()


def _array(column: Column, values: list[Any]) -> Array:
    array = Array([_value(column.kind, value) for value in values], _TYPES[column.kind])
    return array.cast(_TIME) if column.kind is ColumnKind.TIME else array


def _value(kind: ColumnKind, value: Any) -> Any:
    if value is None:
        return None
    if kind is ColumnKind.JSON:
        return json_text(value)
    return (value - _EPOCH) // _MILLISECOND if isinstance(value, datetime) else value  # cut off, as in other files
