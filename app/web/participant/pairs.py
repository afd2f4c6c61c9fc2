"""The pages on which pairs are compared: practice, pairs, breaks, and waiting for the next pair."""

from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, Any
from uuid import UUID, uuid4

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, BeforeValidator, Field
from sqlalchemy.orm import Session

from app.domain import preferences
from app.domain.preferences import Purpose, SkipReason
from app.domain.protocol import Stage
from app.domain.studies import Awaited, Participant
from app.services import participant_events
from app.services.answers import hint_offers, labelling, next_query
from app.services.participant_events import EventKind
from app.services.participants import admission, time_left
from app.services.participants.time_left import TimeLeft
from app.services.runs import estimates
from app.web.error_pages import wants_json
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import AnsweringParticipant, RowId, Studio
from app.web.participant.pages import go, participant_page
from app.web.texts import quality_words
from app.web.texts.languages import wording_of
from app.web.texts.wording import Wording

router = APIRouter(prefix="/p", route_class=AuthorizedRoute)

_DAY_MS = 24 * 3600 * 1000
_MINUTE_S, _HOUR_S = 60, 3600
_Missing = BeforeValidator(lambda value: None if value == "" else value)
_Count = Annotated[int | None, _Missing, Field(ge=0, le=100_000)]
_Milliseconds = Annotated[int | None, _Missing, Field(ge=0, le=_DAY_MS)]


class LabelForm(BaseModel):
    """One answer. What the browser could not measure comes empty."""

    response: preferences.Response
    client_uuid: UUID
    reason: Annotated[SkipReason | None, _Missing] = None
    mattered: Annotated[str | None, _Missing, Field(max_length=40)] = None
    response_time_ms: _Milliseconds = None
    replay_count: _Count = None
    play_error_count: _Count = None
    stall_count: _Count = None
    stalled_ms: _Milliseconds = None
    largest_drift_ms: _Milliseconds = None
    playback_rate: Annotated[float | None, _Missing, Field(gt=0, le=16)] = None
    scrub_count: _Count = None
    watched_whole: Annotated[bool | None, _Missing] = None
    left_watched_ms: _Milliseconds = None
    right_watched_ms: _Milliseconds = None


class UndoForm(BaseModel):
    """Which taking back this is, should it be sent twice."""

    client_uuid: UUID


class EventForm(BaseModel):
    """Something the page's script has noticed; breaks are noted by the server itself."""

    kind: EventKind
    query_id: Annotated[int | None, _Missing, Field(ge=1, le=2**31 - 1)] = None
    duration_ms: _Milliseconds = None
    count: _Count = None


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


def show_turn(request: Request, session: Session, studio: Studio, participant: Participant) -> Response:
    """The pair to compare now, a practice pair, a break, or a waiting page while no pair is ready.

    For the script the same as JSON, with ``state`` finished when nothing is left to compare.
    """
    next_query.seen(participant)
    turn = next_query.next_turn(session, studio.store, participant)
    next_query.waits(participant, Awaited.PAIR if _state(turn) == "waiting" else None)
    state = _turn_for_script(request, session, studio, participant, turn)
    if wants_json(request):
        return JSONResponse(state)
    if turn.break_due:
        participant_events.note_once(session, participant, EventKind.BREAK_BEGUN, turn.progress.answered)
    if turn.hints_due:
        return go(request, "show_hints")
    context: dict[str, Any] = {"turn": turn, "state": state, "undo_uuid": uuid4()}
    context["asks_for_hints"] = hint_offers.asks(participant.study) and not turn.progress.practising
    if state["state"] == "waiting":
        context["seconds_left"] = estimates.until_pair_s(session, participant.study)
    if turn.query is not None:
        context |= {"pair": _pair(request, turn.query), "client_uuid": uuid4(), "reasons": list(SkipReason)}
        context |= {"responses": set(preferences.Response), "next_path": None, "given": None}
        if participant.study.settings.asks_what_mattered and not state["practising"]:
            wording = wording_of(request, participant)
            context["qualities"] = quality_words.words_of(wording, participant.study.task)
    return participant_page(request, f"participant/{_template(turn)}.html", participant, context)


@router.post("/queries/{query_id}/label", name="label_query")
async def label_query(request: Request, query_id: RowId, answering: AnsweringParticipant) -> Response:
    """Record the answer; the transaction is committed before this response leaves."""

    def label(session: Session, participant: Participant, form: LabelForm) -> Response:
        measured = form.model_dump(exclude={"response", "client_uuid", "reason", "mattered"})
        watching = labelling.Watching(**measured, by_script=wants_json(request))
        said = form.response, form.client_uuid, watching, form.reason, form.mattered
        labelling.record_label(session, participant, query_id, *said)
        admission.settle(session, participant, Stage.PAIRS)
        return _go_on(request, session, answering.studio, participant)

    return await answering.act_on(LabelForm, label)


@router.post("/queries/{query_id}/undo", name="undo_label")
async def undo_label(request: Request, query_id: RowId, answering: AnsweringParticipant) -> Response:
    """Take the newest answer back; its pair is the next to be shown."""

    def undo(session: Session, participant: Participant, form: UndoForm) -> Response:
        labelling.undo_label(session, participant, query_id, form.client_uuid)
        return _go_on(request, session, answering.studio, participant)

    return await answering.act_on(UndoForm, undo)


@router.post("/break", name="end_break")
async def end_break(request: Request, answering: AnsweringParticipant) -> Response:
    """Go on after a break."""

    def go_on(session: Session, participant: Participant) -> Response:
        next_query.seen(participant)
        next_query.end_break(session, participant)
        return go(request, "show_next")

    return await answering.act(go_on)


@router.post("/events", name="note_event", status_code=HTTPStatus.NO_CONTENT)
async def note_event(answering: AnsweringParticipant) -> Response:
    """Keep what the script noticed; sent as a beacon, so nobody waits for an answer."""

    def note(session: Session, participant: Participant, form: EventForm) -> None:
        if form.kind not in (EventKind.BREAK_BEGUN, EventKind.BREAK_OVER):
            detail = {name: value for name, value in form.model_dump(exclude={"kind"}).items() if value is not None}
            participant_events.note(session, participant, form.kind, detail)

    await answering.act_on(EventForm, note)
    return Response(status_code=HTTPStatus.NO_CONTENT)


def in_words(say: Wording, left: TimeLeft) -> str:
    """A remaining time, rounded as roughly as it is known; of the comparing alone while the rest is not known."""
    if left.seconds < 1.5 * _MINUTE_S:
        time = say("pair-time-left-minute")
    elif left.seconds < 1.5 * _HOUR_S:
        time = say("pair-time-left-minutes", minutes=round(left.seconds / _MINUTE_S))
    else:
        time = say("pair-time-left-hours", hours=round(left.seconds / _HOUR_S, 1))
    return time if left.is_all else say("pair-time-left-comparing", time=time)


def _template(turn: next_query.NextPair) -> str:
    if turn.break_due:
        return "break"
    if turn.query is None:
        return "waiting"
    return "practice" if turn.query.purpose == Purpose.PRACTICE else "pair"


def _go_on(request: Request, session: Session, studio: Studio, participant: Participant) -> Response:
    """What comes after an answer: for a script the next pair at once, for a plain form the page that shows it."""
    next_query.seen(participant)
    if not wants_json(request):
        return go(request, "show_next")
    turn = next_query.next_turn(session, studio.store, participant)
    next_query.waits(participant, Awaited.PAIR if _state(turn) == "waiting" else None)
    return JSONResponse(_turn_for_script(request, session, studio, participant, turn))


def _turn_for_script(
    request: Request, session: Session, studio: Studio, participant: Participant, turn: next_query.NextPair
) -> dict[str, Any]:
    progress = turn.progress
    left = time_left.time_left(session, participant, turn.progress, studio.usual_times)
    practising = progress.practising
    return {
        "state": "finished" if participant.ended_as is not None else _state(turn),
        "practising": practising,
        "answered": progress.practised if practising else progress.answered,
        "wanted": progress.practice_wanted if practising else progress.wanted,
        "time_left": None if left is None else in_words(wording_of(request, participant), left),
        "pair": None if turn.query is None else vars(_pair(request, turn.query)),
        "following": [vars(_pair(request, query)) for query in turn.following],
        "undo_path": None
        if turn.undoable_id is None
        else request.app.url_path_for("undo_label", query_id=turn.undoable_id),
    }


def _state(turn: next_query.NextPair) -> str:
    if turn.progress.finished:
        return "finished"
    if turn.break_due:
        return "break"
    if turn.hints_due:
        return "hints"
    return "waiting" if turn.query is None else "pair"


def _pair(request: Request, query: next_query.ReadyQuery) -> Pair:
    def paths(clip: next_query.ClipFiles) -> dict[str, str]:
        return {
            "video": request.app.url_path_for("show_video", sha256=clip.video_sha256),
            "poster": request.app.url_path_for("show_poster", sha256=clip.poster_sha256),
        }

    return Pair(
        query_id=query.id,
        label_path=request.app.url_path_for("label_query", query_id=query.id),
        left=paths(query.left),
        right=paths(query.right),
        width=query.left.width,
        height=query.left.height,
        fps=query.left.fps,
    )
