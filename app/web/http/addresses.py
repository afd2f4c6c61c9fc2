"""Addresses of routes by their names, looked up once."""

from functools import lru_cache
from typing import Any

from fastapi import FastAPI
from starlette.datastructures import URLPath

_MOST_WITH_SLASHES = 1000


class QuickAddresses(FastAPI):
    """An application that finds the address of a route by its name without asking every route each time.

    A page of pairs names ten addresses, a study's page hundreds; asking all routes took a fifth of saving an answer.
    Addresses with slashes are those of style sheets and scripts: asking for them took two fifths of a page's request.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self._forms: dict[tuple[str, ...], str] = {}
        """addresses with their parameters in braces, by name of the route and of the parameters"""
        self._with_slashes = lru_cache(_MOST_WITH_SLASHES)(super().url_path_for)

    def url_path_for(self, name: str, /, **path_params: Any) -> URLPath:
        """See starlette.applications.Starlette."""
        values = {each: str(value) for each, value in path_params.items()}
        if not all(values.values()) or "/" in "".join(values.values()):
            return self._with_slashes(name, **path_params)  # which refuses what does not fit this route
        asked = (name, *values)
        form = self._forms.get(asked)
        if form is None:
            form = self._forms[asked] = str(super().url_path_for(name, **{each: f"{{{each}}}" for each in values}))
        return URLPath(form.format_map(values), protocol="http")
