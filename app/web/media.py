"""Clips and posters, under the hash of their content: once loaded, a browser never has to ask again."""

from email.utils import formatdate
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Depends, Request
from fastapi.responses import FileResponse, Response
from sqlalchemy import or_, select
from sqlalchemy.orm import Session

from app.domain.clips import Clip, Rollout
from app.domain.evaluation import Film
from app.domain.people import Experimenter
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.accounts import browser_sessions
from app.services.studies import membership
from app.storage import ArtefactStore
from app.web.http.deps import PARTICIPANT_COOKIE, ReadingSession, Sha256, StudioDep, experimenter_asking

router = APIRouter()

AT_NO_TIME = formatdate(0, usegmt=True)
"""When a film or a controller was made would tell, in a blinded study, with which others it was made."""
_FOREVER = "private, max-age=31536000, immutable"


class ClipNotFound(AppError):
    """There is no such clip."""

    status = HTTPStatus.NOT_FOUND


def _may_watch(request: Request, session: ReadingSession, sha256: Sha256) -> None:
    """A participant may watch the clips of their own study and their own films, an experimenter those of their studies.

    Raises ClipNotFound.
    """
    clips = select(Clip.id).join(Rollout).where(or_(Clip.video_sha256 == sha256, Clip.poster_sha256 == sha256))
    films = select(Film.id).where(or_(Film.video_sha256 == sha256, Film.poster_sha256 == sha256))
    experimenter, participant = _experimenter(request, session), _participant(request, session)
    found = []
    if experimenter is not None:
        theirs = select(Study.id).where(membership.visible_to(experimenter))
        people = select(Participant.id).where(Participant.study_id.in_(theirs))
        found += [clips.where(Rollout.study_id.in_(theirs)), films.where(Film.participant_id.in_(people))]
    if participant is not None:
        found += [
            clips.where(Rollout.study_id == participant.study_id),
            films.where(Film.participant_id == participant.id),
        ]
    if all(session.scalar(each.limit(1)) is None for each in found):
        raise ClipNotFound


MayWatch = Annotated[None, Depends(_may_watch, scope="function")]


@router.api_route("/media/{sha256}.mp4", methods=["GET", "HEAD"], name="show_video")
def show_video(request: Request, sha256: Sha256, studio: StudioDep, _allowed: MayWatch) -> Response:
    """The video of a clip; answers ranges."""
    return _artefact(request, studio.store, sha256, "video/mp4")


@router.api_route("/media/{sha256}.jpg", methods=["GET", "HEAD"], name="show_poster")
def show_poster(request: Request, sha256: Sha256, studio: StudioDep, _allowed: MayWatch) -> Response:
    """The first picture of a clip."""
    return _artefact(request, studio.store, sha256, "image/jpeg")


def _experimenter(request: Request, session: Session) -> Experimenter | None:
    try:
        return experimenter_asking(request, session)
    except AppError:
        return None


def _participant(request: Request, session: Session) -> Participant | None:
    cookie = request.cookies.get(PARTICIPANT_COOKIE)
    return browser_sessions.participant_of(session, cookie) if cookie else None


def _artefact(request: Request, store: ArtefactStore, sha256: str, media_type: str) -> Response:
    headers = {"etag": f'"{sha256}"', "cache-control": _FOREVER, "last-modified": AT_NO_TIME}
    known = request.headers.get("if-none-match", "")
    if known == "*" or sha256 in known:
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    path = store.verified(sha256)  # what is kept for ever must be what it is called
    return FileResponse(path, headers=headers, media_type=media_type, stat_result=path.stat())
