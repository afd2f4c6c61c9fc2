"""The participant's pages: personal link, consent, instructions, pairs, thanks."""

from dataclasses import dataclass
from datetime import timedelta
from http import HTTPStatus
from typing import Annotated, Any
from uuid import UUID, uuid4

from fastapi import APIRouter, Form, Request
from fastapi.responses import JSONResponse, RedirectResponse, Response
from pydantic import BaseModel, BeforeValidator, Field
from sqlalchemy.orm import Session

from app.domain import preferences
from app.domain.clips import Clip
from app.domain.studies import Participant
from app.services import browser_sessions, dashboard, enrolment, labelling, querying
from app.web.deps import (
    PARTICIPANT_COOKIE,
    CurrentParticipant,
    RowId,
    Studio,
    StudioDep,
    Token,
    WritingSession,
    set_cookie,
)
from app.web.error_pages import wants_json
from app.web.templating import page, time_left

router = APIRouter(prefix="/p")

_DAY_MS = 24 * 3600 * 1000
_Count = Annotated[int | None, BeforeValidator(lambda value: value or None), Field(ge=0, le=100_000)]
_Milliseconds = Annotated[int | None, BeforeValidator(lambda value: value or None), Field(ge=0, le=_DAY_MS)]


class LabelForm(BaseModel):
    """One answer. What the browser could not measure comes empty."""

    response: preferences.Response
    client_uuid: UUID
    response_time_ms: _Milliseconds = None
    replay_count: _Count = None
    play_error_count: _Count = None


@dataclass(frozen=True)
class Pair:
    """One pair as the page needs it; times in seconds, paths on this server."""

    query_id: int
    label_path: str
    left: dict[str, str]
    right: dict[str, str]
    width: int
    height: int
    fps: int


@router.get("/consent", name="show_consent")
def show_consent(request: Request, participant: CurrentParticipant) -> Response:
    """What taking part means; agreeing comes before everything else."""
    return _page(request, "participant/consent.html", participant)


@router.post("/consent", name="give_consent")
def give_consent(
    request: Request, participant: CurrentParticipant, version: Annotated[str, Form(max_length=40)]
) -> Response:
    """Store the agreement to the text that was shown; if it has changed meanwhile, show the new one."""
    if version == participant.study.settings.consent_version:
        enrolment.consent(participant, version)
    return _go(request, "show_instructions")


@router.get("/instructions", name="show_instructions")
def show_instructions(request: Request, participant: CurrentParticipant) -> Response:
    """The task and the keys."""
    if not enrolment.has_consented(participant):
        return _go(request, "show_consent")
    return _page(request, "participant/instructions.html", participant)


@router.post("/instructions", name="finish_instructions")
def finish_instructions(request: Request, participant: CurrentParticipant) -> Response:
    """Store that the instructions were read, then start."""
    if enrolment.has_consented(participant):
        enrolment.instruct(participant)
    return _go(request, "show_next_pair")


@router.get("/next", name="show_next_pair")
def show_next_pair(
    request: Request, participant: CurrentParticipant, session: WritingSession, studio: StudioDep
) -> Response:
    """The pair to compare now, a waiting page while none is ready, or what comes before or after the pairs."""
    if not enrolment.has_consented(participant):
        return _go(request, "show_consent")
    if participant.instructed_at is None:
        return _go(request, "show_instructions")
    querying.seen(participant)
    turn = querying.next_turn(session, studio.store, participant)
    if wants_json(request):
        return JSONResponse(_turn_for_script(request, turn))
    if turn.progress.finished:
        return _go(request, "show_finished")
    context = {"turn": turn, "state": _turn_for_script(request, turn)}
    if turn.query is None:
        return _page(request, "participant/waiting.html", participant, context)
    context |= {"pair": _pair(request, turn.query), "client_uuid": uuid4(), "undo_uuid": uuid4()}
    return _page(request, "participant/pair.html", participant, context)


@router.post("/queries/{query_id}/label", name="label_query")
def label_query(
    request: Request,
    query_id: RowId,
    form: Annotated[LabelForm, Form()],
    participant: CurrentParticipant,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """Record the answer; the transaction is committed before this response leaves."""
    watching = labelling.Watching(form.response_time_ms, form.replay_count, form.play_error_count)
    labelling.record_label(session, participant, query_id, form.response, form.client_uuid, watching)
    return _go_on(request, session, studio, participant)


@router.post("/queries/{query_id}/undo", name="undo_label")
def undo_label(
    request: Request,
    query_id: RowId,
    client_uuid: Annotated[UUID, Form()],
    participant: CurrentParticipant,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """Take the newest answer back; its pair is the next to be shown."""
    labelling.undo_label(session, participant, query_id, client_uuid)
    return _go_on(request, session, studio, participant)


@router.get("/finished", name="show_finished")
def show_finished(
    request: Request, participant: CurrentParticipant, session: WritingSession, studio: StudioDep
) -> Response:
    """Thanks, and how far the person's own robot is."""
    turn = querying.next_turn(session, studio.store, participant)
    if not turn.progress.finished:
        return _go(request, "show_next_pair")
    querying.seen(participant)
    detail = dashboard.participant_detail(session, participant.study, participant)
    return _page(
        request,
        "participant/finished.html",
        participant,
        {"turn": turn, "detail": detail, "undo_uuid": uuid4()},
    )


@router.get("/{token}", name="open_link")
def open_link(request: Request, token: Token, session: WritingSession, studio: StudioDep) -> Response:
    """Exchange the personal link for a cookie and leave its address, so that the token stays in no history."""
    participant = enrolment.find_by_token(session, token)
    lifetime = timedelta(days=studio.settings.session_days)
    cookie = browser_sessions.open_for_participant(session, participant, lifetime)
    querying.seen(participant)
    response = _go(request, "show_next_pair")
    set_cookie(response, studio.settings, PARTICIPANT_COOKIE, cookie, lifetime)
    response.headers["referrer-policy"] = "no-referrer"
    return response


def _go(request: Request, name: str) -> RedirectResponse:
    return RedirectResponse(request.app.url_path_for(name), HTTPStatus.SEE_OTHER)


def _go_on(request: Request, session: Session, studio: Studio, participant: Participant) -> Response:
    """What comes after an answer: for a script the next pair at once, for a plain form the page that shows it."""
    querying.seen(participant)
    if not wants_json(request):
        return _go(request, "show_next_pair")
    return JSONResponse(_turn_for_script(request, querying.next_turn(session, studio.store, participant)))


def _turn_for_script(request: Request, turn: querying.Turn) -> dict[str, Any]:
    progress = turn.progress
    return {
        "state": "finished" if progress.finished else "waiting" if turn.query is None else "pair",
        "answered": progress.answered,
        "wanted": progress.wanted,
        "time_left": None if progress.seconds_left is None else time_left(progress.seconds_left),
        "pair": None if turn.query is None else vars(_pair(request, turn.query)),
        "following": None if turn.following is None else vars(_pair(request, turn.following)),
        "undo_path": None
        if turn.undoable_id is None
        else request.app.url_path_for("undo_label", query_id=turn.undoable_id),
    }


def _pair(request: Request, query: preferences.Query) -> Pair:
    def paths(clip: Clip) -> dict[str, str]:
        return {
            "video": request.app.url_path_for("show_video", sha256=clip.video_sha256),
            "poster": request.app.url_path_for("show_poster", sha256=clip.poster_sha256),
        }

    return Pair(
        query_id=query.id,
        label_path=request.app.url_path_for("label_query", query_id=query.id),
        left=paths(query.left_clip),
        right=paths(query.right_clip),
        width=query.left_clip.width,
        height=query.left_clip.height,
        fps=query.left_clip.fps,
    )


def _page(request: Request, template: str, participant: Participant, context: dict[str, Any] | None = None) -> Response:
    shared = {"study": participant.study, "settings": participant.study.settings, "participant": participant}
    return page(request, template, shared | (context or {}))
