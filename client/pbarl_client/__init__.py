"""Reads a study of a PbARL Studio over its API: tables as data frames, bundles as files."""

import io
import json
from http import HTTPStatus
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

    def whole(self, name: str, earlier: "pd.DataFrame | None" = None) -> "pd.DataFrame":
        """A whole table from one Parquet file, with the types of table(): quicker where a table is large.

        Args:
            name: as in the data dictionary.
            earlier: what an earlier call returned; it is returned again, without a download, while nothing in it has
                changed. Any table can be read so, and with any database.

        Raises:
            Refused: no such table or study, a token that is not valid or may not, ...
            ImportError: pandas needs pyarrow for it (pip install "pbarl-client[parquet]").
            ValueError: ``earlier`` is another table.
        """
        if earlier is not None and (earlier.attrs.get("whole") != name or "etag" not in earlier.attrs):
            raise ValueError(f"What is given as earlier is not what whole({name!r}) returned.")
        known = {} if earlier is None else {"If-None-Match": str(earlier.attrs["etag"])}
        answer = self._ask(f"{self._root}/tables/{quote(name, safe='')}.parquet", known)
        if answer is None:
            assert earlier is not None  # noqa: S101 -- the studio says so of what it was sent
            return earlier
        content, etag = answer
        types = self._types().get(name, {})
        frame = pd.read_parquet(io.BytesIO(content), engine="pyarrow")
        for column, kind in types.items():
            if kind == "json":
                frame[column] = [None if each is None else json.loads(each) for each in frame[column]]
        frame = _typed(frame[list(types)], types)
        frame.attrs = {"whole": name, "etag": etag}
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
        answer = self._ask(address, {})
        assert answer is not None  # noqa: S101 -- nothing was said to be known
        return answer[0]

    def _ask(self, address: str, headers: dict[str, str]) -> "tuple[bytes, str] | None":
        """Content and ETag; None: not modified."""
        if not address.startswith(f"{self._root}/"):  # nobody else gets the token
            raise ValueError(f"The studio led elsewhere: {address}")
        request = Request(address, headers={"Authorization": f"Bearer {self._token}", **headers})  # noqa: S310  (the user's address)
        try:
            with self._opener.open(request, timeout=PATIENCE_S) as answer:
                return answer.read(), str(answer.headers.get("ETag", ""))
        except HTTPError as error:
            if error.code == HTTPStatus.NOT_MODIFIED and headers:
                return None
            raise Refused(error.code, _detail(error)) from error


def _frame(rows: "list[dict[str, Any]]", types: dict[str, str]) -> "pd.DataFrame":
    return _typed(pd.DataFrame(rows, columns=list(types) or None), types)


def _typed(frame: "pd.DataFrame", types: dict[str, str]) -> "pd.DataFrame":
    frame = frame.copy()
    for name, kind in types.items():
        if kind == "time":
            frame[name] = pd.to_datetime(frame[name], utc=True, format="ISO8601").astype("datetime64[ms, UTC]")
        else:
            frame[name] = frame[name].astype(DTYPES[kind])
    return frame


def _detail(error: HTTPError) -> str:
    try:
        return str(json.loads(error.read())["detail"])
    except (ValueError, KeyError, TypeError):
        return str(error.reason)
