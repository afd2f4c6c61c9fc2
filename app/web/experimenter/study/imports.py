"""Bringing a study in from another installation."""

import asyncio
import shutil
import tempfile
from http import HTTPStatus
from typing import IO, Annotated

from fastapi import APIRouter, Depends, Request
from fastapi.concurrency import contextmanager_in_threadpool, run_in_threadpool
from fastapi.responses import RedirectResponse, Response
from starlette.datastructures import UploadFile
from starlette.requests import ClientDisconnect
from starlette.types import Message, Receive

from app.domain.people import Experimenter, Role
from app.errors import AppError
from app.services.accounts import roles
from app.services.archives import study_import
from app.services.archives.archive import ArchiveInvalid
from app.services.archives.study_import import Imported
from app.services.studies import membership
from app.web.http import new_links
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import CurrentExperimenter, Studio, StudioDep, experimenter_asking
from app.web.http.new_links import NewLink
from app.web.texts.templating import page

router = APIRouter(route_class=AuthorizedRoute)

LONGEST_SEAL_KEY = 100
LARGEST_ARCHIVE_BYTES = 16 * 1024**3
MOST_OF_THE_DISK = 0.9
"""Of what is free where temporary files lie, the share that an upload may take."""
PATIENCE_S = 60.0
"""An upload of which nothing arrives for so long was given up."""


class SizeUnknown(AppError):
    """The upload did not say how large it is, so it was refused. Please use the form on the page of imports."""

    status = HTTPStatus.LENGTH_REQUIRED


class NoRoomForUpload(AppError):
    """This archive is larger than what the studio's disk has room for. Free some space, then import it again."""

    status = HTTPStatus.REQUEST_ENTITY_TOO_LARGE


class UploadStalled(AppError):
    """The upload stopped in the middle, so nothing was imported. Please try again."""

    status = HTTPStatus.REQUEST_TIMEOUT


@router.get("/import", name="show_import")
def show_import(request: Request, experimenter: CurrentExperimenter) -> Response:
    """The form."""
    context = {"experimenter": experimenter, "error": None, "may_import": roles.may(experimenter, Role.EXPERIMENTER)}
    return page(request, "experimenter/import.html", context)


async def _may_import(request: Request, studio: StudioDep) -> Experimenter:
    """Checked before a byte of the upload is read, and without a session that lasts as long as the upload."""
    async with studio.session_queue.reading() as session:
        return await run_in_threadpool(experimenter_asking, request, session, account_needed=Role.EXPERIMENTER)


@router.post("/import", name="import_study", max_body_size=LARGEST_ARCHIVE_BYTES)
async def import_study(
    request: Request, experimenter: Annotated[Experimenter, Depends(_may_import)], studio: StudioDep
) -> Response:
    """Check the archive without holding up anybody, then bring it in and lead to the new links.

    The form is no parameter: the framework reads those before it asks who is sending them.
    """
    _require_room(request)
    try:
        with studio.imports.place():
            async with Request(request.scope, _patiently(request)).form(max_files=1) as form:
                file, seal_key = form.get("file"), form.get("seal_key", "")
                if not isinstance(file, UploadFile) or not isinstance(seal_key, str):
                    raise ArchiveInvalid
                imported = await _bring_in(studio, file.file, seal_key[:LONGEST_SEAL_KEY], experimenter)
    except ClientDisconnect as error:
        raise UploadStalled from error
    except ArchiveInvalid as invalid:
        context = {"experimenter": experimenter, "error": invalid.message, "may_import": True}
        return page(request, "experimenter/import.html", context, HTTPStatus.UNPROCESSABLE_ENTITY)
    base = (studio.settings.public_url or str(request.base_url)).rstrip("/")
    links = [
        NewLink(code, f"{base}{request.app.url_path_for('open_link', token=token)}") for code, token in imported.tokens
    ]
    slug = imported.study.slug
    if not links:
        return RedirectResponse(request.app.url_path_for("show_study", slug=slug), HTTPStatus.SEE_OTHER)
    async with studio.session_queue.writing() as session:
        key = await run_in_threadpool(new_links.leave, session, experimenter.id, links)
    return RedirectResponse(request.app.url_path_for("show_links", slug=slug, key=key), HTTPStatus.SEE_OTHER)


async def _bring_in(studio: Studio, file: IO[bytes], seal_key: str, experimenter: Experimenter) -> Imported:
    unpacking = study_import.unpack(studio.store, file, seal_key)
    async with contextmanager_in_threadpool(unpacking) as unpacked, studio.session_queue.writing() as session:
        imported = await run_in_threadpool(study_import.bring_in, session, studio.store, unpacked, experimenter.name)
        membership.begin(session, imported.study, experimenter)
    return imported


def _require_room(request: Request) -> None:
    """The announced size, to which the server holds the sender. Raises SizeUnknown and NoRoomForUpload."""
    announced = request.headers.get("content-length", "")
    if not announced.isdecimal():
        raise SizeUnknown
    if int(announced) > MOST_OF_THE_DISK * shutil.disk_usage(tempfile.gettempdir()).free:
        raise NoRoomForUpload


def _patiently(request: Request) -> Receive:
    async def receive() -> Message:
        try:
            async with asyncio.timeout(PATIENCE_S):
                return await request.receive()
        except TimeoutError as error:
            raise UploadStalled from error

    return receive
