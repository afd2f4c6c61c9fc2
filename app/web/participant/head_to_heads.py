"""The participant's head-to-heads: two robots side by side, which one would they rather have?"""

from collections.abc import Sequence
from http import HTTPStatus
from typing import Annotated, Any
from uuid import UUID, uuid4

from fastapi import APIRouter, Form, Query, Request
from fastapi.responses import JSONResponse, RedirectResponse, Response
from pydantic import BaseModel

from app.domain.evaluation import LONGEST_REASON, HeadToHead, HeadToHeadAnswer, HeadToHeadResponse, Trial
from app.domain.protocol import Stage
from app.domain.studies import Awaited, Participant
from app.services.answers import next_query
from app.services.evaluation import evaluation_plan, head_to_heads
from app.services.evaluation.evaluation_plan import EvaluationState, NextTrial
from app.services.evaluation.ratings import CorrectionTooLate
from app.web.error_pages import wants_json
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import RowId, StudioDep, WritingSession
from app.web.participant.evaluation import Milliseconds, Reason, next_path
from app.web.participant.pages import go, has_reached, is_in, participant_page

router = APIRouter(prefix="/p/head-to-heads", route_class=AuthorizedRoute)

AHEAD = 2
"""Head-to-heads that the page loads while another is shown."""

InEvaluation = Annotated[Participant, is_in(Stage.EVALUATION)]
AtEvaluation = Annotated[Participant, has_reached(Stage.EVALUATION)]


class HeadToHeadForm(BaseModel):
    """One answer. What the browser could not measure comes empty."""

    response: HeadToHeadResponse
    client_uuid: UUID
    reason: Reason = None
    response_time_ms: Milliseconds = None


@router.get("", name="show_head_to_head")
def show_head_to_head(
    request: Request, participant: InEvaluation, session: WritingSession, studio: StudioDep
) -> Response:
    """The two robots to compare now."""
    next_query.seen(participant)
    turn = evaluation_plan.next_turn(session, studio.store, participant)
    if turn.state is not EvaluationState.COMPARING:
        return go(request, "show_evaluation")
    next_query.waits(participant, None)
    if wants_json(request):
        return JSONResponse(_for_script(request, turn, turn.head_to_heads, None))
    return _page(request, participant, turn, turn.head_to_heads[0], None)


@router.get("/{head_to_head_id}", name="show_last_head_to_head")
def show_last_head_to_head(
    request: Request, head_to_head_id: RowId, participant: AtEvaluation, session: WritingSession, studio: StudioDep
) -> Response:
    """The answer given last, to be changed."""
    given = head_to_heads.find_answered(session, participant, head_to_head_id)
    turn = evaluation_plan.next_turn(session, studio.store, participant)
    asked = {each.id: each for each in head_to_heads.of_participant(session, participant.id)}
    return _page(request, participant, turn, asked[head_to_head_id], given)


@router.post("/{head_to_head_id}/answer", name="answer_head_to_head")
def answer_head_to_head(
    request: Request,
    head_to_head_id: RowId,
    form: Annotated[HeadToHeadForm, Form()],
    participant: AtEvaluation,
    session: WritingSession,
    studio: StudioDep,
    corrects: Annotated[int, Query(ge=0, le=10_000)] = 0,
) -> Response:
    """Store the answer; the transaction is committed before this response leaves."""
    if participant.completed_at is not None:
        raise CorrectionTooLate
    head_to_heads.answer(
        session,
        participant,
        head_to_head_id,
        form.response,
        form.client_uuid,
        reason=form.reason,
        corrects=corrects,
        response_time_ms=form.response_time_ms,
        by_script=wants_json(request),
    )
    next_query.seen(participant)
    turn = evaluation_plan.next_turn(session, studio.store, participant)
    next_query.waits(participant, Awaited.ROBOTS if turn.state is EvaluationState.PREPARING else None)
    path = next_path(request, turn)
    if not wants_json(request):
        return RedirectResponse(path, HTTPStatus.SEE_OTHER)
    return JSONResponse(_for_script(request, turn, turn.head_to_heads, None) | {"next_path": path})


def _page(
    request: Request, participant: Participant, turn: NextTrial, asked: HeadToHead, given: HeadToHeadAnswer | None
) -> Response:
    settings = evaluation_plan.settings_of(participant.study)
    shown = [asked] if given else turn.head_to_heads
    state = _for_script(request, turn, shown, given)
    allowed = set(HeadToHeadResponse) - (set() if settings and settings.head_to_head_ties else {"equal"})
    context: dict[str, Any] = {
        "state": state,
        "pair": state["pair"],
        "given": given,
        "responses": allowed,
        "asks_reason": settings is not None and settings.ask_reasons,
        "longest_reason": LONGEST_REASON,
        "client_uuid": uuid4(),
        "undo_uuid": None,
        "next_path": next_path(request, turn),
    }
    return participant_page(request, "participant/head_to_head.html", participant, context)


def _for_script(
    request: Request, turn: NextTrial, shown: Sequence[HeadToHead], given: HeadToHeadAnswer | None
) -> dict[str, Any]:
    """What the script of the page of pairs needs, which plays these as well."""
    pairs = [_pair(request, each, given.revision if given else 0) for each in shown[: 1 + AHEAD]]
    comparing = given is not None or turn.state is EvaluationState.COMPARING
    return {
        "state": "pair" if comparing else turn.state,
        "practising": False,
        "answered": turn.compared,
        "wanted": turn.to_compare,
        "time_left": None,
        "pair": pairs[0] if comparing else None,
        "following": pairs[1:] if comparing else [],
        "undo_path": None if given else _change_path(request, turn),
    }


def _change_path(request: Request, turn: NextTrial) -> str | None:
    """Where the answer given last can be changed; before the first, the last rating."""
    path: str | None = None
    if turn.changeable is not None:
        path = request.app.url_path_for("show_last_head_to_head", head_to_head_id=turn.changeable.id)
    elif turn.correctable is not None:
        path = request.app.url_path_for("show_last_rating", trial_id=turn.correctable.id)
    return path


def _pair(request: Request, each: HeadToHead, corrects: int) -> dict[str, Any]:
    """Two films without anything that tells their robots or methods."""
    path = request.app.url_path_for("answer_head_to_head", head_to_head_id=each.id)
    film = each.left_trial.film
    return {
        "query_id": each.id,
        "label_path": f"{path}?corrects={corrects}" if corrects else path,
        "left": _clip(request, each.left_trial),
        "right": _clip(request, each.right_trial),
        "width": film.width if film else 0,
        "height": film.height if film else 0,
        "fps": film.fps if film else 0,
    }


def _clip(request: Request, trial: Trial) -> dict[str, str]:
    film = trial.film
    if film is None:
        return {"video": "", "poster": ""}
    return {
        "video": request.app.url_path_for("show_video", sha256=film.video_sha256),
        "poster": request.app.url_path_for("show_poster", sha256=film.poster_sha256),
    }
