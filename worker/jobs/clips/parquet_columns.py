"""Columns of Parquet files that somebody else has made, within limits, as arrays that hold what they promise."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as parquet

from worker.domain.type_aliases import Float32Array

LARGEST_FILE_BYTES = 1 << 30
MOST_ROWS = 5_000_000
MOST_VALUES = 64_000_000
"""Of one column, lists counted whole: 256 MB as arrays."""


class ParquetRefused(ValueError):
    """This file is no Parquet file, is damaged, or holds something else than it should; says what."""


def read(path: Path, names: Sequence[str]) -> pa.Table:
    """These columns, in this order. Raises ParquetRefused."""
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise ParquetRefused(f"larger than {LARGEST_FILE_BYTES / 1e9:.1f} GB")
        with parquet.ParquetFile(path) as file:
            _check(file, names)
            table = file.read(columns=list(names), use_threads=False).select(list(names))
            table.validate(full=True)
            return table
    except (pa.ArrowException, OSError, KeyError) as error:
        raise ParquetRefused(f"not a Parquet file that can be read ({str(error)[:200]})") from error


def _check(file: parquet.ParquetFile, names: Sequence[str]) -> None:
    """What the file says of itself, before anything of it is unpacked."""
    missing = [name for name in names if name not in file.schema_arrow.names]
    if missing:
        raise ParquetRefused(f"the column {missing[0]} is missing")
    if file.metadata.num_rows > MOST_ROWS:
        raise ParquetRefused(f"more than {MOST_ROWS} rows; split it, or choose fewer episodes")
    values = dict.fromkeys(names, 0)
    for group in range(file.metadata.num_row_groups):
        columns = file.metadata.row_group(group)
        for place in range(columns.num_columns):
            column = columns.column(place)
            name = next((each for each in names if f"{column.path_in_schema}.".startswith(f"{each}.")), None)
            if name is not None:
                values[name] += max(column.num_values, column.total_uncompressed_size // 8)
    if max(values.values(), default=0) > MOST_VALUES:
        raise ParquetRefused(f"a column of more than {MOST_VALUES} values; split the file")


def numbers(table: pa.Table, name: str, width: int) -> Float32Array:
    """A column of numbers, or of lists of ``width`` numbers, as (rows, width). Raises ParquetRefused."""
    column = table.column(name).combine_chunks()
    kind = column.type
    if column.null_count:
        raise ParquetRefused(f"{name} has rows without a value")
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        lengths = pc.list_value_length(column)
        if len(column) and pc.min_max(lengths).as_py() != {"min": width, "max": width}:
            raise ParquetRefused(f"{name} has rows that are not of {width} numbers")
        column = column.flatten()
    elif width != 1:
        raise ParquetRefused(f"{name} has one value a row, expected {width}")
    if column.null_count or not _is_number(column.type):
        raise ParquetRefused(f"{name} holds something else than numbers")
    if pa.types.is_boolean(column.type):
        column = column.cast(pa.uint8())
    return np.asarray(column.to_numpy(zero_copy_only=False), np.float32).reshape(len(table), width)


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind))


def records(table: pa.Table, kinds: Mapping[str, type]) -> list[dict[str, Any]]:
    """Rows as plain values, each of the kind that is expected of its column. Raises ParquetRefused."""
    rows: list[dict[str, Any]] = table.to_pylist()
    for number, row in enumerate(rows):
        for name, kind in kinds.items():
            if kind is float and isinstance(row[name], int):
                row[name] = float(row[name])
            if not isinstance(row[name], kind) or isinstance(row[name], bool):
                raise ParquetRefused(f"{name} of row {number} is {str(row[name])[:40]!r}, expected {kind.__name__}")
    return rows


def names_in(path: Path) -> Sequence[str]:
    """The columns that a file has. Raises ParquetRefused."""
    try:
        names: list[str] = parquet.read_schema(path).names
        return names
    except (pa.ArrowException, OSError) as error:
        raise ParquetRefused(f"not a Parquet file that can be read ({str(error)[:200]})") from error
