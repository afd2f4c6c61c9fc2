"""Inviting people: personal links as a list, a file and a sheet to print, and the open address for panels."""

from collections.abc import Sequence
from http import HTTPStatus
from typing import Annotated

import segno
from fastapi import APIRouter, Form, Path, Request
from fastapi.responses import RedirectResponse, Response
from markupsafe import Markup
from sqlalchemy.orm import Session
from starlette.background import BackgroundTask

from app import signing
from app.domain.people import Experimenter
from app.domain.studies import Study
from app.services import audit
from app.services.archives import study_import
from app.services.exports.csv_cells import csv_line
from app.services.participants import enrolment, recruitment_panel, withdrawal
from app.services.studies import studies
from app.web.http import new_links
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    ActingExperimenter,
    Code,
    CurrentExperimenter,
    ReadingSession,
    Slug,
    Studio,
    StudioDep,
    WritingSession,
)
from app.web.http.new_links import NewLink
from app.web.texts.templating import page

router = APIRouter(prefix="/studies", route_class=AuthorizedRoute)

MAX_NEW_PARTICIPANTS = 50
LinkKey = Annotated[str, Path(pattern=r"^[A-Za-z0-9_-]{10,40}$")]


@router.post("/{slug}/participants", name="add_participants")
def add_participants(
    request: Request,
    slug: Slug,
    count: Annotated[int, Form(ge=1, le=MAX_NEW_PARTICIPANTS)],
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """Add people to the study and lead to their links."""
    study = studies.find_study(session, slug)
    added = [enrolment.add_participant(session, study, experimenter.name) for _ in range(count)]
    links = [NewLink(participant.code, link_of(request, studio, token)) for participant, token in added]
    return _see(request, "show_links", slug=slug, key=new_links.leave(session, experimenter.id, links))


@router.post("/{slug}/participants/{code}/link", name="renew_link")
def renew_link(
    request: Request,
    slug: Slug,
    code: Code,
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """Replace a participant's link; the old one stops working."""
    study = studies.find_study(session, slug)
    participant = enrolment.find_by_code(session, study, code)
    token = enrolment.renew_link(session, study, participant, experimenter.name)
    links = [NewLink(participant.code, link_of(request, studio, token))]
    return _see(request, "show_links", slug=slug, key=new_links.leave(session, experimenter.id, links))


@router.post("/{slug}/participants/{code}/link/revoke", name="revoke_link")
def revoke_link(
    request: Request, slug: Slug, code: Code, experimenter: ActingExperimenter, session: WritingSession
) -> Response:
    """Switch a participant's link off, until there is a new one."""
    study = studies.find_study(session, slug)
    enrolment.revoke_link(session, study, enrolment.find_by_code(session, study, code), experimenter.name)
    return _see(request, "show_participant", slug=slug, code=code)


@router.get("/{slug}/links/{key}", name="show_links")
def show_links(
    request: Request,
    slug: Slug,
    key: LinkKey,
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """New links, for as long as the desk keeps them."""
    study = studies.find_study(session, slug)
    links = new_links.pick_up(session, experimenter.id, key)
    _note_looking(studio, session, experimenter, study, links)
    imported, signer = study_import.signer_of(session, study)
    context = {
        "study": study,
        "experimenter": experimenter,
        "signature": signing.in_words(signer, studio.settings) if imported else None,
        "links": links,
        "key": key,
    }
    return page(request, "experimenter/links.html", context)


@router.get("/{slug}/links/{key}/sheet", name="show_sheet")
def show_sheet(
    request: Request,
    slug: Slug,
    key: LinkKey,
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """A card for each participant, with code, link and QR code: to print and to cut."""
    links = new_links.pick_up(session, experimenter.id, key)
    study = studies.find_study(session, slug)
    _note_looking(studio, session, experimenter, study, links)
    context = {
        "study": study,
        "cards": [(link, _qr_code(link.url)) for link in links],
        "key": key,
    }
    return page(request, "experimenter/links_sheet.html", context)


@router.get("/{slug}/links/{key}/links.csv", name="download_links")
def download_links(
    slug: Slug, key: LinkKey, experimenter: CurrentExperimenter, session: ReadingSession, studio: StudioDep
) -> Response:
    """Codes and links as a file that spreadsheets and mail programs read."""
    headers = {"content-disposition": f'attachment; filename="{slug}-links.csv"'}
    links = new_links.pick_up(session, experimenter.id, key)
    _note_looking(studio, session, experimenter, studies.find_study(session, slug), links)
    return Response(_as_csv(links), media_type="text/csv; charset=utf-8", headers=headers)


@router.post("/{slug}/joining/open", name="open_joining")
def open_joining(request: Request, slug: Slug, experimenter: ActingExperimenter, session: WritingSession) -> Response:
    """Let people join by an address that is the same for everybody."""
    recruitment_panel.open_joining(session, studies.find_study(session, slug), experimenter.name)
    return _see(request, "show_joining", slug=slug)


@router.post("/{slug}/joining/close", name="close_joining")
def close_joining(request: Request, slug: Slug, experimenter: ActingExperimenter, session: WritingSession) -> Response:
    """Let nobody new in by that address."""
    recruitment_panel.close_joining(session, studies.find_study(session, slug), experimenter.name)
    return _see(request, "show_joining", slug=slug)


@router.get("/{slug}/joining", name="show_joining")
def show_joining(
    request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession, studio: StudioDep
) -> Response:
    """The open address, and what a recruitment panel has to know."""
    study = studies.find_study(session, slug)
    address = None
    if study.join_token is not None:
        address = _base(request, studio) + str(request.app.url_path_for("join_study", token=study.join_token))
    context = {"study": study, "settings": study.settings, "experimenter": experimenter, "address": address}
    return page(request, "experimenter/joining.html", context)


@router.get("/{slug}/participants/{code}/erase", name="show_erasing")
def show_erasing(
    request: Request, slug: Slug, code: Code, experimenter: CurrentExperimenter, session: ReadingSession
) -> Response:
    """What erasing somebody at their request means."""
    study = studies.find_study(session, slug)
    context = {
        "study": study,
        "person": enrolment.find_by_code(session, study, code),
        "experimenter": experimenter,
        "error": None,
    }
    return page(request, "experimenter/erase.html", context)


@router.post("/{slug}/participants/{code}/erase", name="erase_participant")
def erase_participant(
    request: Request,
    slug: Slug,
    code: Code,
    typed: Annotated[str, Form(max_length=200)],
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """Erase everything about somebody who has asked for it, when their code was typed."""
    study = studies.find_study(session, slug)
    participant = enrolment.find_by_code(session, study, code)
    if typed.strip().upper() != code:
        error = f"What was typed is not {code}. Nothing was erased."
        context = {"study": study, "person": participant, "experimenter": experimenter, "error": error}
        return page(request, "experimenter/erase.html", context, HTTPStatus.UNPROCESSABLE_ENTITY)
    withdrawal.withdraw(session, studio.store, participant, experimenter.name)
    response = _see(request, "show_study", slug=slug)
    response.background = BackgroundTask(studio.database.forget_erased)  # after the commit
    return response


def _qr_code(url: str) -> Markup:
    """Black on white in both themes: cameras read nothing else reliably. Error correction M: a fold does no harm."""
    drawn = segno.make(url, error="m", micro=False).svg_inline(omitsize=True, border=3, light="#fff")
    return Markup(drawn)  # noqa: S704  (drawn by us from an address that we made)


def _as_csv(links: Sequence[NewLink]) -> str:
    return "".join([csv_line(("participant", "link")), *(csv_line((link.code, link.url)) for link in links)])


def _note_looking(
    studio: Studio, session: Session, experimenter: Experimenter, study: Study, links: Sequence[NewLink]
) -> None:
    """Whoever has a personal link can answer in that person's name."""
    action = "personal links viewed"
    if links:
        audit.note_reading(studio.database, session, experimenter.name, action, study.slug, study=study)


def _base(request: Request, studio: Studio) -> str:
    """The public address if one is set, else the one the experimenter uses."""
    return (studio.settings.public_url or str(request.base_url)).rstrip("/")


def link_of(request: Request, studio: Studio, token: str) -> str:
    return _base(request, studio) + str(request.app.url_path_for("open_link", token=token))


def _see(request: Request, name: str, **parameters: str) -> RedirectResponse:
    return RedirectResponse(request.app.url_path_for(name, **parameters), HTTPStatus.SEE_OTHER)
