"""Errors of the API as problem details (RFC 9457): in words what happened and what to do."""

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from sqlalchemy.exc import DatabaseError, OperationalError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from app.db import complaints
from app.errors import AppError, Refused, in_words
from app.web.api.callers import Whoever
from app.web.http import refusals
from app.web.http.security import HEADERS

MEDIA_TYPE = "application/problem+json"
_REPLACED = {"offset": "offset is gone, because answers between two pages would shift it: follow next instead."}


class ParameterUnknown(AppError):
    """This address does not know one of the parameters."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


async def only_known_parameters(request: Request, _asking: Whoever) -> None:
    """A parameter that is ignored is an answer to another question than the one that was asked.

    Told to nobody without a token.

    Raises ParameterUnknown, which names those that are known.
    """
    documented = request.app.openapi()["paths"][request.scope["route"].path][request.method.lower()]
    known = [each["name"] for each in documented.get("parameters", ()) if each["in"] == "query"]
    unknown = sorted(set(request.query_params) - set(known))
    if unknown:
        named = ", ".join(name[:40] for name in unknown[:5])
        replaced = [_REPLACED[name] for name in unknown if name in _REPLACED]
        words = f"It knows {', '.join(known)}." if known else "It takes none after the question mark."
        raise ParameterUnknown(" ".join([f"This address does not know: {named}.", words, *replaced]))


def add_problems(api: FastAPI) -> None:
    """Have every error of this application answered so."""

    @api.exception_handler(AppError)
    def ours(_request: Request, error: AppError) -> Response:
        return problem(error.status, error.message)

    @api.exception_handler(Refused)
    def refused(request: Request, error: Refused) -> Response:
        refusals.note(request)
        return problem(error.status, error.message)

    @api.exception_handler(HTTPException)
    def of_the_framework(_request: Request, error: HTTPException) -> Response:
        words = {
            HTTPStatus.NOT_FOUND: "There is nothing at this address. /api/docs lists what there is.",
            HTTPStatus.METHOD_NOT_ALLOWED: "This address cannot be used in that way. /api/docs says how.",
            HTTPStatus.REQUEST_ENTITY_TOO_LARGE: "That was more than we accept at once.",
        }
        status = HTTPStatus(error.status_code)
        return problem(status, words.get(status, "This request could not be understood."), error.headers)

    @api.exception_handler(RequestValidationError)
    def not_valid(_request: Request, error: RequestValidationError) -> Response:
        wrong = [
            f"{'.'.join(str(part) for part in each['loc'][1:]) or 'body'}: {each['msg']}" for each in error.errors()
        ]
        status = HTTPStatus.UNPROCESSABLE_ENTITY
        if any(each["loc"][0] == "path" for each in error.errors()):
            status = HTTPStatus.NOT_FOUND
        return problem(status, f"Not valid: {'; '.join(wrong)}.")

    @api.exception_handler(ClientDisconnect)
    def broken_off(_request: Request, _error: ClientDisconnect) -> Response:
        return Response(status_code=HTTPStatus.BAD_REQUEST)  # nobody is there to read it, and nothing is wrong here

    @api.exception_handler(OperationalError)
    def database_busy(_request: Request, error: OperationalError) -> Response:
        complaints.error("the database did not answer: %s", error.orig)
        message = "The database is busy or not ready. Nothing was saved; please try again in a moment."
        return problem(HTTPStatus.SERVICE_UNAVAILABLE, message, {"retry-after": "2"})

    @api.exception_handler(DatabaseError)
    def database_damaged(_request: Request, error: DatabaseError) -> Response:
        if in_words(error) is None:
            raise error
        complaints.error("the database cannot be used: %s", error.orig)
        message = "The database cannot be used at the moment. Nothing was saved; please tell who runs the studio."
        return problem(HTTPStatus.SERVICE_UNAVAILABLE, message, {"retry-after": "60"})

    @api.exception_handler(Exception)
    def unforeseen(_request: Request, _error: Exception) -> Response:
        message = "This is our fault, and it is in the log. Nothing was saved by this step; please try again."
        return problem(HTTPStatus.INTERNAL_SERVER_ERROR, message, HEADERS)


def document_problems(api: FastAPI) -> None:
    """Have the OpenAPI document name the content type that problems are sent with, and not that of other answers."""
    made = api.openapi

    def openapi() -> dict[str, Any]:
        document = made()
        for operation in (each for methods in document["paths"].values() for each in methods.values()):
            for code, answer in operation["responses"].items():
                if int(code) >= HTTPStatus.BAD_REQUEST and MEDIA_TYPE not in answer["content"]:
                    answer["content"] = {MEDIA_TYPE: answer["content"]["application/json"]}
        return document

    api.openapi = openapi  # type: ignore[method-assign]  # FastAPI's documented way


def problem(status: HTTPStatus, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    """Problem details, RFC 9457."""
    content = {"title": status.phrase, "status": int(status), "detail": detail}
    answer = JSONResponse(content, status, media_type=MEDIA_TYPE)
    answer.headers.update(headers or {})
    if status is HTTPStatus.UNAUTHORIZED:
        answer.headers["www-authenticate"] = "Bearer"
    return answer
