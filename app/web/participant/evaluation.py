"""The participant's blinded evaluation: watch a robot known by a letter, rate it, go on."""

from http import HTTPStatus
from typing import Annotated, Any
from uuid import UUID, uuid4

from fastapi import APIRouter, Form, Request
from fastapi.responses import JSONResponse, RedirectResponse, Response
from pydantic import BaseModel, BeforeValidator, Field

from app.domain.evaluation import LONGEST_REASON, Film, Rating, Trial
from app.domain.protocol import LIKERT_POINTS, Stage
from app.domain.studies import Awaited, Participant
from app.services.answers import next_query
from app.services.evaluation import evaluation_plan, ratings, robot_preparation
from app.services.evaluation.evaluation_plan import EvaluationState, NextTrial
from app.web.error_pages import wants_json
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import NotYet, RowId, StudioDep, WritingSession
from app.web.participant.pages import go, has_reached, is_in, participant_page

router = APIRouter(prefix="/p/evaluation", route_class=AuthorizedRoute)

_DAY_MS = 24 * 3600 * 1000
_Points = Annotated[int, Field(ge=1, le=LIKERT_POINTS)]
Milliseconds = Annotated[int | None, BeforeValidator(lambda value: value or None), Field(ge=0, le=_DAY_MS)]


def _words(value: object) -> object:
    """What was written, with plain line breaks; None for nothing."""
    return value.replace("\r\n", "\n").strip() or None if isinstance(value, str) else value


Reason = Annotated[Annotated[str, Field(max_length=LONGEST_REASON)] | None, BeforeValidator(_words)]

InEvaluation = Annotated[Participant, is_in(Stage.EVALUATION)]
AtEvaluation = Annotated[Participant, has_reached(Stage.EVALUATION)]

_TEMPLATES = {
    EvaluationState.PREPARING: "participant/evaluation_waiting.html",
    EvaluationState.COMING: "participant/evaluation_robot.html",
    EvaluationState.MOVING: "participant/evaluation_robot.html",
    EvaluationState.WATCHING: "participant/evaluation.html",
    EvaluationState.RATING: "participant/evaluation_rating.html",
}


class RatingForm(BaseModel):
    """One rating. What the browser could not measure comes empty."""

    satisfaction: _Points
    personalisation: _Points
    client_uuid: UUID
    corrects: Annotated[int, Field(ge=0, le=10_000)] = 0
    response_time_ms: Milliseconds = None
    reason: Reason = None


@router.get("", name="show_evaluation")
def show_evaluation(
    request: Request, participant: InEvaluation, session: WritingSession, studio: StudioDep
) -> Response:
    """The robot to watch and rate now, or how far the robots are."""
    next_query.seen(participant)
    turn = evaluation_plan.next_turn(session, studio.store, participant)
    next_query.waits(participant, Awaited.ROBOTS if turn.state is EvaluationState.PREPARING else None)
    if wants_json(request):
        return JSONResponse(_for_script(request, turn))
    if turn.state in (EvaluationState.COMPARING, EvaluationState.DESCRIBING):
        return RedirectResponse(next_path(request, turn), HTTPStatus.SEE_OTHER)
    if turn.trial is None:
        context: dict[str, Any] = {"turn": turn, "preparation": robot_preparation.preparation(session, participant)}
        return participant_page(request, _TEMPLATES[EvaluationState.PREPARING], participant, context)
    return _trial_page(request, participant, turn, turn.trial, None, _TEMPLATES[turn.state])


@router.get("/done", name="show_evaluation_done")
def show_evaluation_done(
    request: Request, participant: AtEvaluation, session: WritingSession, studio: StudioDep
) -> Response:
    """Everything is rated; the last rating can still be changed."""
    turn = evaluation_plan.next_turn(session, studio.store, participant)
    if turn.state is not EvaluationState.FINISHED:
        raise NotYet
    return participant_page(request, "participant/evaluation_done.html", participant, {"turn": turn})


@router.get("/trials/{trial_id}", name="show_last_rating")
def show_last_rating(
    request: Request, trial_id: RowId, participant: AtEvaluation, session: WritingSession, studio: StudioDep
) -> Response:
    """The rating given last, to be changed."""
    trial, rated = ratings.find_rated(session, participant, trial_id)
    turn = evaluation_plan.next_turn(session, studio.store, participant)
    trials = {each.id: each for each in evaluation_plan.trials_of(session, participant.id)}
    template = _TEMPLATES[EvaluationState.WATCHING if trials[trial.id].film else EvaluationState.RATING]
    return _trial_page(request, participant, turn, trials[trial.id], rated, template)


@router.post("/trials/{trial_id}/rating", name="rate_trial")
def rate_trial(
    request: Request,
    trial_id: RowId,
    form: Annotated[RatingForm, Form()],
    participant: AtEvaluation,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """Store the rating; the transaction is committed before this response leaves."""
    if participant.completed_at is not None:
        raise ratings.CorrectionTooLate
    score = ratings.Score(form.satisfaction, form.personalisation, form.reason)
    ratings.rate(
        session,
        participant,
        trial_id,
        score,
        form.client_uuid,
        corrects=form.corrects,
        response_time_ms=form.response_time_ms,
        by_script=wants_json(request),
    )
    next_query.seen(participant)
    turn = evaluation_plan.next_turn(session, studio.store, participant)
    path = next_path(request, turn)
    if wants_json(request):
        return JSONResponse({**_for_script(request, turn), "next_path": path})
    return RedirectResponse(path, HTTPStatus.SEE_OTHER)


@router.get("/next", name="leave_evaluation")
def leave_evaluation(request: Request, participant: AtEvaluation) -> Response:
    """On to what comes after the evaluation."""
    return go(request, "show_next")


def next_path(request: Request, turn: NextTrial) -> str:
    """The path of the page on which a participant goes on."""
    if turn.state is EvaluationState.DESCRIBING and turn.instrument is not None:
        asked = {"letter": turn.described, "instrument": turn.instrument.name}
        return str(request.app.url_path_for("show_robot_scale", **asked))
    names = {EvaluationState.COMPARING: "show_head_to_head", EvaluationState.FINISHED: "show_evaluation_done"}
    return str(request.app.url_path_for(names.get(turn.state, "show_evaluation")))


def _trial_page(
    request: Request, participant: Participant, turn: NextTrial, trial: Trial, rated: Rating | None, template: str
) -> Response:
    settings = evaluation_plan.settings_of(participant.study)
    context = {
        "turn": turn,
        "trial": trial,
        "trials_each": settings.trials if settings else 0,
        "rated": rated,
        "film": None if trial.film is None else _film(request, trial.film),
        "client_uuid": uuid4(),
        "points": range(1, LIKERT_POINTS + 1),
        "asks_reason": settings is not None and settings.ask_reasons,
        "longest_reason": LONGEST_REASON,
    }
    return participant_page(request, template, participant, context)


def _film(request: Request, film: Film) -> dict[str, Any]:
    """What the page needs of a film, and nothing that tells its method."""
    return {
        "video": request.app.url_path_for("show_video", sha256=film.video_sha256),
        "poster": request.app.url_path_for("show_poster", sha256=film.poster_sha256),
        "width": film.width,
        "height": film.height,
        "fps": film.fps,
    }


def _for_script(request: Request, turn: NextTrial) -> dict[str, Any]:
    return {
        "state": turn.state,
        "trial": None if turn.trial is None else turn.trial.ordinal,
        "rated": turn.rated,
        "wanted": turn.wanted,
    }
