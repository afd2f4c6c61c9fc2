"""Bringing a study in from another installation."""

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, File, Form, Request, UploadFile
from fastapi.responses import RedirectResponse, Response

from app.domain.people import Role
from app.services import roles, study_import
from app.services.archive import ArchiveInvalid
from app.web.deps import CurrentExperimenter, StudioDep
from app.web.link_desk import Link
from app.web.templating import page

router = APIRouter()

LARGEST_ARCHIVE_BYTES = 16 * 1024**3


@router.get("/import", name="show_import")
def show_import(request: Request, experimenter: CurrentExperimenter) -> Response:
    """The form."""
    context = {"experimenter": experimenter, "error": None, "may_import": roles.may(experimenter, Role.EXPERIMENTER)}
    return page(request, "experimenter/import.html", context)


@router.post("/import", name="import_study", max_body_size=LARGEST_ARCHIVE_BYTES)
def import_study(
    request: Request,
    experimenter: CurrentExperimenter,
    studio: StudioDep,
    file: Annotated[UploadFile, File()],
    seal_key: Annotated[str, Form(max_length=100)] = "",
) -> Response:
    """Check the archive without holding up anybody, then bring it in and lead to the new links."""
    roles.require(experimenter, Role.EXPERIMENTER)
    try:
        reading = study_import.unpack(studio.store, file.file, seal_key)
        with reading as unpacked, studio.database.writing() as session:
            imported = study_import.bring_in(session, studio.store, unpacked, experimenter.name)
    except ArchiveInvalid as invalid:
        context = {"experimenter": experimenter, "error": invalid.message, "may_import": True}
        return page(request, "experimenter/import.html", context, HTTPStatus.UNPROCESSABLE_ENTITY)
    base = (studio.settings.public_url or str(request.base_url)).rstrip("/")
    links = [
        Link(code, f"{base}{request.app.url_path_for('open_link', token=token)}") for code, token in imported.tokens
    ]
    slug = imported.study.slug
    if not links:
        return RedirectResponse(request.app.url_path_for("show_study", slug=slug), HTTPStatus.SEE_OTHER)
    key = studio.link_desk.leave(experimenter.id, links)
    return RedirectResponse(request.app.url_path_for("show_links", slug=slug, key=key), HTTPStatus.SEE_OTHER)
