"""Reads a study of a PbARL Studio over its API: tables as data frames, bundles as files."""

import json
from typing import Any
from urllib.error import HTTPError
from urllib.parse import quote, urljoin
from urllib.request import HTTPRedirectHandler, Request, build_opener

import pandas as pd

__all__ = ["Client", "Refused"]

DTYPES = {"text": "string", "integer": "Int64", "number": "Float64", "boolean": "boolean", "json": "object"}
"""By the types of the data dictionary; "time" becomes an aware UTC time. All of them know what is unknown."""
PAGE = 1000
PATIENCE_S = 60.0


class Refused(Exception):
    """The studio refused, and its message says what to do. ``status``: of HTTP."""

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(f"{detail} (HTTP {status})")
        self.status = status


class _NoRedirects(HTTPRedirectHandler):
    """A studio sends nobody elsewhere, and whoever does shall not get the token."""

    def redirect_request(self, *_: Any) -> None:
        """Whatever is asked: no."""


class Client:
    """One study, read with an API token."""

    def __init__(self, address: str, token: str, study: str) -> None:
        """``address``: of the studio, as in the browser; ``study``: short name, as in the address of its pages."""
        self._root = f"{address.rstrip('/')}/api/v1/studies/{quote(study, safe='')}"
        self._token = token
        self._opener = build_opener(_NoRedirects)
        self._dictionary: dict[str, dict[str, str]] | None = None

    def tables(self) -> list[str]:
        """Names of all tables."""
        return list(self._types())

    def table(self, name: str, since: "pd.DataFrame | None" = None) -> "pd.DataFrame":
        """All rows of a table, or those that were added after an earlier reading of it.

        Args:
            name: as in the data dictionary (docs/protocol.md), for instance "ratings".
            since: what an earlier call returned. Only tables that grow can be read so: labels, forms, consent, events,
                ratings, models and deviations.

        Raises:
            Refused: no such table or study, a token that is not valid or may not, ...
            ValueError: ``since`` cannot be followed.
        """
        types = self._types().get(name)
        address: str | None = f"{self._root}/tables/{quote(name, safe='')}?limit={PAGE}"
        if since is not None:
            address = since.attrs.get("later")
            if since.attrs.get("table") != name or address is None:
                raise ValueError(f"What came after this reading of {name!r} cannot be told; leave `since` out.")
        rows, page = list[dict[str, Any]](), dict[str, Any]()
        while address is not None:
            page = json.loads(self._get(urljoin(self._root, address)))
            rows += page["rows"]
            address = page["next"]
        frame = _frame(rows, types or {})
        frame.attrs = {"table": name, "later": page["later"]}
        return frame

    def bundles(self, participant: str) -> "pd.DataFrame":
        """Every published filter of a participant, the newest first."""
        return pd.DataFrame(json.loads(self._get(f"{self._root}/participants/{quote(participant, safe='')}/bundles")))

    def bundle(self, participant: str, version: int | None = None) -> bytes:
        """The zip file of a filter, by default of the newest. Raises Refused, and LookupError where there is none."""
        if version is None:
            published = self.bundles(participant)
            if published.empty:
                raise LookupError(f"There is no filter of {participant} yet.")
            version = int(published["version"].max())
        return self._get(f"{self._root}/participants/{quote(participant, safe='')}/bundles/{version}.zip")

    def _types(self) -> dict[str, dict[str, str]]:
        if self._dictionary is None:
            tables = json.loads(self._get(f"{self._root}/tables"))
            self._dictionary = {
                each["name"]: {column["name"]: column["type"] for column in each["columns"]} for each in tables
            }
        return self._dictionary

    def _get(self, address: str) -> bytes:
        if not address.startswith(f"{self._root}/"):  # nobody else gets the token
            raise ValueError(f"The studio led elsewhere: {address}")
        request = Request(address, headers={"Authorization": f"Bearer {self._token}"})  # noqa: S310  (the user's address)
        try:
            with self._opener.open(request, timeout=PATIENCE_S) as answer:
                content: bytes = answer.read()
        except HTTPError as error:
            raise Refused(error.code, _detail(error)) from error
        return content


def _frame(rows: "list[dict[str, Any]]", types: dict[str, str]) -> "pd.DataFrame":
    frame = pd.DataFrame(rows, columns=list(types) or None)
    for name, kind in types.items():
        if kind == "time":
            frame[name] = pd.to_datetime(frame[name], utc=True, format="ISO8601")
        else:
            frame[name] = frame[name].astype(DTYPES[kind])
    return frame


def _detail(error: HTTPError) -> str:
    try:
        return str(json.loads(error.read())["detail"])
    except (ValueError, KeyError, TypeError):
        return str(error.reason)
