"""The OpenAPI document as our own page of documentation shows it."""

from collections.abc import Mapping
from datetime import datetime
from typing import Any


def described(document: Mapping[str, Any], prefix: str) -> list[dict[str, Any]]:
    """Its operations, one after the other; ``prefix``: where the API is mounted."""
    return [
        {
            "method": method.upper(),
            "path": prefix + path,
            "tag": operation["tags"][0],
            "summary": operation.get("description", operation["summary"]),
            "parameters": operation.get("parameters", []),
            "takes": _example(document, _schema(operation.get("requestBody", {}))),
            "gives": _example(document, _answer_schema(operation)),
        }
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]


def _answer_schema(operation: Mapping[str, Any]) -> Mapping[str, Any] | None:
    return next((_schema(each) for code, each in operation["responses"].items() if code.startswith("2")), None)


def _schema(body: Mapping[str, Any]) -> Mapping[str, Any] | None:
    schema: Mapping[str, Any] | None = body.get("content", {}).get("application/json", {}).get("schema")
    return schema


def _example(document: Mapping[str, Any], schema: Mapping[str, Any] | None) -> Any:
    """Something that the schema allows: its own examples where it has some, else its default."""
    if schema is None:
        return None
    if "$ref" in schema:
        return _example(document, document["components"]["schemas"][schema["$ref"].rpartition("/")[2]])
    for known in (schema.get("example"), *schema.get("examples", []), schema.get("default")):
        if known is not None:
            return known
    if "anyOf" in schema:
        return _example(document, schema["anyOf"][0])
    if "enum" in schema:
        return schema["enum"][0]
    if schema.get("type") == "array":
        return [_example(document, schema["items"])]
    if "properties" in schema:
        return {name: _example(document, each) for name, each in schema["properties"].items()}
    moment = datetime(2026, 1, 31, 9, 30).isoformat() + "Z"  # noqa: DTZ001  (written with its zone)
    plain = {"integer": 1, "number": 0.5, "boolean": True, "object": {}, "string": ""}
    return moment if schema.get("format") == "date-time" else plain.get(str(schema.get("type")))
