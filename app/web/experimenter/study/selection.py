"""What is done for several participants at once, those ticked in the table of a study."""

import io
import zipfile
from collections.abc import Iterator, Sequence
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response, StreamingResponse
from pydantic import StringConstraints
from sqlalchemy.orm import Session

from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services import audit
from app.services.participants import enrolment
from app.services.runs import publishing
from app.services.studies import studies
from app.storage import Artefact
from app.web.experimenter.study.invitations import link_of
from app.web.http import new_links
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import ActingExperimenter, Slug, StudioDep, WritingSession
from app.web.http.new_links import NewLink

router = APIRouter(prefix="/studies/{slug}/selection", route_class=AuthorizedRoute)

MOST = 1000
_Code = Annotated[str, StringConstraints(pattern=r"^P[0-9]{2,8}$")]
Codes = Annotated[list[_Code], Form(default_factory=list, max_length=MOST)]


class NobodyTicked(AppError):
    """Nobody is ticked. Go back, tick participants in the table, and press the button again."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class NoBundles(AppError):
    """None of these participants has a bundle yet. One is made after the first filter was trained."""

    status = HTTPStatus.CONFLICT


@router.post("/links", name="renew_links")
def renew_links(
    request: Request,
    slug: Slug,
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
    code: Codes,
) -> Response:
    """Replace the links of everybody who is ticked, and lead to the new ones; the old ones stop working."""
    study = studies.find_study(session, slug)
    links = []
    for participant in _ticked(session, study, code):
        token = enrolment.renew_link(session, study, participant, experimenter.name)
        links.append(NewLink(participant.code, link_of(request, studio, token)))
    key = new_links.leave(session, experimenter.id, links)
    address = request.app.url_path_for("show_links", slug=slug, key=key)
    return RedirectResponse(address, HTTPStatus.SEE_OTHER)


@router.post("/bundles.zip", name="download_bundles")
def download_bundles(
    slug: Slug,
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
    code: Codes,
) -> Response:
    """The newest bundle of everybody who is ticked and has one, as one zip file. Raises NoBundles."""
    study = studies.find_study(session, slug)
    found = publishing.newest_bundles(session, studio.store, _ticked(session, study, code))
    if not found:
        raise NoBundles
    files = []
    for participant, bundle in found:
        subject = f"{slug}/{participant.code}/{bundle.version}"
        audit.record(session, experimenter.name, "bundle downloaded", subject, participant=participant)
        name = f"{slug}-{participant.code}-v{bundle.version}.zip"
        files.append((name, studio.store.verified(bundle.artefact_sha256)))
    headers = {"content-disposition": f'attachment; filename="{slug}-bundles.zip"'}
    return StreamingResponse(_zipped(files), media_type="application/zip", headers=headers)


class _Sink(io.RawIOBase):
    """Takes what is written, and gives it on in pieces."""

    def __init__(self) -> None:
        super().__init__()
        self._pieces: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, piece: Any) -> int:
        self._pieces.append(bytes(piece))
        return len(piece)

    def taken(self) -> bytes:
        """What has come in since it was last asked."""
        pieces, self._pieces = self._pieces, []
        return b"".join(pieces)


def _zipped(files: Sequence[tuple[str, Artefact]]) -> Iterator[bytes]:
    """The files as one zip file, written while it is sent: no transaction waits for it."""
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as together:  # a bundle is packed already
        for name, artefact in files:
            with together.open(zipfile.ZipInfo(name), "w") as entry:
                for piece in artefact.pieces():
                    entry.write(piece)
                    yield sink.taken()
    yield sink.taken()


def _ticked(session: Session, study: Study, codes: list[str]) -> list[Participant]:
    """Everybody who is ticked and has not withdrawn. Raises NobodyTicked and ParticipantNotFound."""
    people = [enrolment.find_by_code(session, study, code) for code in dict.fromkeys(codes)]
    present = [each for each in people if each.withdrawn_at is None]
    if not present:
        raise NobodyTicked
    return present
