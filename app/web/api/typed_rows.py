"""Rows of tables in the OpenAPI document: a schema for each table, made from the data dictionary."""

from typing import Any

from fastapi import FastAPI

from app.services.exports import export_tables
from app.services.exports.export_formats import Column, ColumnKind, Table

PATH = "/studies/{slug}/tables/{table}"
_TYPES: dict[ColumnKind, dict[str, Any]] = {
    ColumnKind.TEXT: {"type": ["string", "null"]},
    ColumnKind.INTEGER: {"type": ["integer", "null"]},
    ColumnKind.NUMBER: {"type": ["number", "null"]},
    ColumnKind.BOOLEAN: {"type": ["boolean", "null"]},
    ColumnKind.TIME: {"type": ["string", "null"], "format": "date-time"},
    ColumnKind.JSON: {},
}


def document_rows(api: FastAPI) -> None:
    """Have the OpenAPI document say what the rows of every table hold, told apart by ``table``."""
    made = api.openapi

    def openapi() -> dict[str, Any]:
        document = made()
        schemas = document["components"]["schemas"]
        if "Page" in schemas:  # the document is kept, and changed once
            _describe(document["paths"][PATH]["get"]["responses"]["200"]["content"]["application/json"], schemas)
        return document

    api.openapi = openapi  # type: ignore[method-assign]  # FastAPI's documented way


def _describe(answer: dict[str, Any], schemas: dict[str, Any]) -> None:
    page = schemas.pop("Page")
    names = {table.name: f"{table.name.capitalize()}Page" for table in export_tables.TABLES}
    for table in export_tables.TABLES:
        row = f"{table.name.capitalize()}Row"
        schemas[row] = _row(table)
        properties = page["properties"] | {
            "table": {"type": "string", "const": table.name},
            "rows": {"type": "array", "items": _reference(row)},
        }
        schemas[names[table.name]] = {**page, "title": names[table.name], "properties": properties}
    answer["schema"] = {
        "oneOf": [_reference(name) for name in names.values()],
        "discriminator": {
            "propertyName": "table",
            "mapping": {table: _reference(name)["$ref"] for table, name in names.items()},
        },
        "example": {name: each["examples"][0] for name, each in page["properties"].items()},
    }


def _row(table: Table) -> dict[str, Any]:
    columns = {column.name: _column(column) for column in table.all_columns}
    return {
        "type": "object",
        "title": f"{table.name.capitalize()}Row",
        "description": table.meaning,
        "properties": columns,
        "required": list(columns),
        "additionalProperties": False,
    }


def _column(column: Column) -> dict[str, Any]:
    said = (column.meaning, column.allowed, column.unit and f"In {column.unit}.")
    return {**_TYPES[column.kind], "description": " ".join(each for each in said if each)}


def _reference(name: str) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{name}"}
