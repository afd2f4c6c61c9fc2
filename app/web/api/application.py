"""The API: the same data as the pages and exports, for programs. An application of its own below /api/v1."""

from typing import Any

from fastapi import Depends, FastAPI

from app.services.exports import export_formats
from app.web.api import data_routes, study_routes, table_files
from app.web.api import schemas as answers
from app.web.api.callers import PREFIX
from app.web.api.problems import add_problems, document_problems, only_known_parameters
from app.web.api.typed_rows import document_rows

DESCRIPTION = """\
Everything that the pages show and the exports hold, for programs.

Make a token on the page of API tokens and send it with every request: `Authorization: Bearer pbarl_...`. A token has
the rights of the account that made it in the studies this is a member of: a *viewer* may look at participants and
reports; an *editor* may also read tables, download bundles, add participants and ask for files; an *owner* also decides
who is a member. Other studies are not there at all. A token can be for reading or for one study only, and expires.

Times are UTC (ISO 8601), unknown is null. Errors are problem details (RFC 9457) whose `detail` says in words what
happened and what to do. Too many wrong tokens from one address are answered with 429 for a minute. Until a study is
unblinded, methods of the evaluation are letters here as everywhere.

Tables come in pages: follow `next`, whose `cursor` says where to go on. Together the pages are the table as it was when
the first one was asked for. There is no `offset` any more (what people answer between two pages would shift it), and a
parameter that an address does not know is refused with 422 instead of being ignored. A whole table as CSV or Parquet is
one file; send its `ETag` back as `If-None-Match`, and while nothing has changed the answer is 304 without a file.
"""

_PROBLEMS: dict[int | str, dict[str, Any]] = {
    code: {"model": answers.Problem, "description": words}
    for code, words in (
        (400, "Not understood, or not possible"),
        (401, "No valid token"),
        (403, "Not with this role"),
        (404, "Nothing here"),
        (409, "Not any longer, or not as things are"),
        (413, "Too much at once"),
        (422, "Not valid"),
        (429, "Too many wrong tokens"),
        (503, "The database or a stored file cannot be reached"),
    )
}


def create_api(path_for: Any, max_body_bytes: int) -> FastAPI:
    """The application to mount at PREFIX. ``path_for``: gives paths of the web's own routes."""
    api = FastAPI(
        title="PbARL Studio API",
        version=export_formats.software_version(),
        description=DESCRIPTION,
        openapi_url="/openapi.json",
        docs_url=None,  # the usual pages load their scripts from other servers; ours is /api/docs
        redoc_url=None,
        servers=[{"url": PREFIX}],
        root_path_in_servers=False,
        max_body_size=max_body_bytes,
        redirect_slashes=False,
    )
    api.state.path_for = path_for
    add_problems(api)
    for part in (study_routes, table_files, data_routes):
        api.include_router(part.router, responses=_PROBLEMS, dependencies=[Depends(only_known_parameters)])
    document_problems(api)
    document_rows(api)
    return api
