"""Clips and posters, under the hash of their content: once loaded, a browser never has to ask again."""

from collections.abc import Iterator
from email.utils import formatdate
from functools import partial
from http import HTTPStatus

from fastapi import APIRouter, Request
from fastapi.responses import Response
from sqlalchemy import Select, String, bindparam, or_, select
from sqlalchemy.orm import Session

from app.domain.clips import Clip, Rollout
from app.domain.evaluation import Film
from app.domain.people import Experimenter
from app.domain.self_setting import PreviewFilm, SelfSetting
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.accounts import browser_sessions
from app.services.studies import membership
from app.storage import ArtefactStore
from app.web.http import stored_file
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import PARTICIPANT_COOKIE, Sha256, StudioDep, experimenter_asking

router = APIRouter(route_class=AuthorizedRoute)

AT_NO_TIME = formatdate(0, usegmt=True)
"""When a film or a controller was made would tell, in a blinded study, with which others it was made."""
_FOREVER = "private, max-age=31536000, immutable"


class ClipNotFound(AppError):
    """There is no such clip."""

    status = HTTPStatus.NOT_FOUND


# Made once: a browser asks for four files with every pair that is new to it.
_SHA256 = bindparam("sha256", type_=String)
_CLIP = select(Clip.id).join(Rollout).where(or_(Clip.video_sha256 == _SHA256, Clip.poster_sha256 == _SHA256)).limit(1)
_FILM = select(Film.id).where(or_(Film.video_sha256 == _SHA256, Film.poster_sha256 == _SHA256)).limit(1)
_PREVIEW = (
    select(PreviewFilm.id)
    .outerjoin(SelfSetting, SelfSetting.id == PreviewFilm.self_setting_id)
    .where(
        or_(PreviewFilm.video_sha256 == _SHA256, PreviewFilm.poster_sha256 == _SHA256),
        PreviewFilm.study_id == bindparam("study_id"),
        or_(PreviewFilm.self_setting_id.is_(None), SelfSetting.participant_id == bindparam("participant_id")),
    )
    .limit(1)
)
_CLIP_OF_STUDY = _CLIP.where(
    Rollout.study_id == bindparam("study_id"),
    or_(Rollout.participant_id.is_(None), Rollout.participant_id == bindparam("participant_id")),
)
_FILM_OF_PARTICIPANT = _FILM.where(Film.participant_id == bindparam("participant_id"))


@router.api_route("/media/{sha256}.mp4", methods=["GET", "HEAD"], name="show_video")
async def show_video(request: Request, sha256: Sha256, studio: StudioDep) -> Response:
    """The video of a clip; answers ranges."""
    return await studio.session_queue.look(partial(_artefact, request, studio.store, sha256, "video/mp4"))


@router.api_route("/media/{sha256}.jpg", methods=["GET", "HEAD"], name="show_poster")
async def show_poster(request: Request, sha256: Sha256, studio: StudioDep) -> Response:
    """The first picture of a clip."""
    return await studio.session_queue.look(partial(_artefact, request, studio.store, sha256, "image/jpeg"))


def _require_may_watch(request: Request, session: Session, sha256: str) -> None:
    """A participant may watch clips and previews of their own study, unless they were made for somebody else, and their
    own films, an experimenter clips and films of theirs.

    Raises ClipNotFound.
    """
    if not any(session.scalar(each, {"sha256": sha256, **whose}) for each, whose in _looked_for(request, session)):
        raise ClipNotFound


def _looked_for(request: Request, session: Session) -> Iterator[tuple[Select[int], dict[str, int]]]:
    participant = _participant(request, session)
    if participant is not None:
        whose = {"study_id": participant.study_id, "participant_id": participant.id}
        yield _CLIP_OF_STUDY, whose
        yield _FILM_OF_PARTICIPANT, whose
        yield _PREVIEW, whose
    experimenter = _experimenter(request, session)
    if experimenter is not None:
        theirs = select(Study.id).where(membership.visible_to(experimenter))
        people = select(Participant.id).where(Participant.study_id.in_(theirs))
        yield _CLIP.where(Rollout.study_id.in_(theirs)), {}
        yield _FILM.where(Film.participant_id.in_(people)), {}


def _experimenter(request: Request, session: Session) -> Experimenter | None:
    try:
        return experimenter_asking(request, session)
    except AppError:
        return None


def _participant(request: Request, session: Session) -> Participant | None:
    cookie = request.cookies.get(PARTICIPANT_COOKIE)
    return browser_sessions.participant_of(session, cookie) if cookie else None


def _artefact(request: Request, store: ArtefactStore, sha256: str, media_type: str, session: Session) -> Response:
    _require_may_watch(request, session, sha256)
    headers = {"etag": f'"{sha256}"', "cache-control": _FOREVER, "last-modified": AT_NO_TIME}
    known = request.headers.get("if-none-match", "")
    if known == "*" or sha256 in known:
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    return stored_file.send(store, sha256, media_type, headers=headers)
