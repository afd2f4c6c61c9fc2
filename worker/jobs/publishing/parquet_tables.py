"""A table of an export as Parquet."""

from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as parquet
from sqlalchemy.orm import Session

from app.domain.studies import Study
from app.services.exports.csv_cells import json_text
from app.services.exports.export_formats import ColumnKind, RowProvenance, Table

_ARROW = {
    ColumnKind.TEXT: pa.string(),
    ColumnKind.INTEGER: pa.int64(),
    ColumnKind.NUMBER: pa.float64(),
    ColumnKind.BOOLEAN: pa.bool_(),
    ColumnKind.TIME: pa.timestamp("ms", "UTC"),
    ColumnKind.JSON: pa.string(),
}


def write(table: Table, session: Session, study: Study, provenance: RowProvenance, target: IO[bytes]) -> int:
    """The table as one file; returns how many rows it has."""
    found = arrow_table(table, session, study, provenance)
    parquet.write_table(found, target)
    return len(found)


def arrow_table(table: Table, session: Session, study: Study, provenance: RowProvenance) -> pa.Table:
    """The table with typed columns; json columns are text, and meanings are kept with the columns."""
    columns = table.all_columns
    rows = [(*values, *provenance.values) for values in table.rows(session, study)]
    arrays = [
        pa.array([_arrow_value(column.kind, row[place]) for row in rows], _ARROW[column.kind])
        for place, column in enumerate(columns)
    ]
    fields = [
        pa.field(column.name, _ARROW[column.kind], metadata={"meaning": column.meaning, "unit": column.unit})
        for column in columns
    ]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def _arrow_value(kind: ColumnKind, value: Any) -> Any:
    return json_text(value) if kind is ColumnKind.JSON and value is not None else value
