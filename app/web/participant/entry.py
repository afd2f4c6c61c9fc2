"""The participant's way: the personal link, the page one should be on, instructions."""

from datetime import timedelta
from functools import partial
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Request
from fastapi.responses import Response
from sqlalchemy.orm import Session

from app.domain.protocol import Stage
from app.domain.studies import Participant
from app.services.accounts import browser_sessions
from app.services.answers import next_query
from app.services.participants import admission, completion, enrolment, stages, visits
from app.services.studies.retirement import StudyDeleted, StudyPutAway
from app.web.error_pages import wants_json
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    PARTICIPANT_COOKIE,
    AnsweringParticipant,
    Studio,
    StudioDep,
    Token,
    WritingSession,
    set_cookie,
)
from app.web.participant import pairs
from app.web.participant.pages import ADDRESSES, back_from, go, has_reached, participant_page
from app.web.texts import languages

router = APIRouter(prefix="/p", route_class=AuthorizedRoute)

AtInstructions = Annotated[Participant, has_reached(Stage.INSTRUCTIONS)]


@router.get("/next", name="show_next")
async def show_next(request: Request, answering: AnsweringParticipant) -> Response:
    """Where this person should be: the pair to compare now, or on to the page of their stage."""
    return await answering.act(partial(_next, request, answering.studio))


def _next(request: Request, studio: Studio, session: Session, participant: Participant) -> Response:
    next_query.seen(participant)
    if participant.study.put_away_at is not None:
        return _closed(request, participant)
    stage = stages.current_stage(session, participant)
    admission.settle(session, participant, stage)
    if participant.ended_as is not None and not wants_json(request):
        return _ended(request, participant)
    for_script = wants_json(request) and stages.reached(session, participant, Stage.PAIRS)
    if stage in (Stage.PRACTICE, Stage.PAIRS) or for_script:
        return pairs.show_turn(request, session, studio, participant)
    return go(request, "show_finished" if stage is None else ADDRESSES[stage])


@router.get("/instructions", name="show_instructions")
def show_instructions(request: Request, participant: AtInstructions) -> Response:
    """The task and the keys."""
    settings = participant.study.settings
    context = {"back_path": back_from(request, settings, Stage.INSTRUCTIONS)}
    return participant_page(request, "participant/instructions.html", participant, context)


@router.post("/instructions", name="finish_instructions")
def finish_instructions(request: Request, participant: AtInstructions, session: WritingSession) -> Response:
    """Store that the instructions were read, then start."""
    stages.finish(session, participant, Stage.INSTRUCTIONS)
    return go(request, "show_next")


def _ended(request: Request, participant: Participant) -> Response:
    """Thanks before the end: that the study does not go on, and the way back to the panel with a code of its own."""
    context = {
        "code": completion.code_of(participant),
        "return_address": completion.return_address(participant),
        "first_time": False,
    }
    return participant_page(request, "participant/ended.html", participant, context)


def _closed(request: Request, participant: Participant) -> Response:
    """In a study that is put away: why it does not go on, and the way to withdraw."""
    if wants_json(request):
        raise StudyPutAway
    return participant_page(request, "participant/closed.html", participant, {}, HTTPStatus.GONE)


# The last one: every other address below /p/ goes before a token.
@router.get("/{token}", name="open_link")
def open_link(request: Request, token: Token, session: WritingSession, studio: StudioDep) -> Response:
    """Exchange the personal link for a cookie and leave its address, so that the token stays in no history."""
    participant = visits.newest(session, enrolment.find_by_token(session, token))
    if participant.study.deleted_at is not None:
        raise StudyDeleted
    if participant.withdrawn_at is not None:
        return go(request, "show_withdrawn")
    lifetime = timedelta(days=studio.settings.session_days)
    cookie = browser_sessions.open_for_participant(session, participant, lifetime)
    response = go(request, "show_next")  # there they are seen: whoever only looks at links is not the participant
    set_cookie(response, studio.settings, PARTICIPANT_COOKIE, cookie, lifetime)
    languages.remember(response, studio.settings, languages.wording_of(request, participant).language)
    response.headers["referrer-policy"] = "no-referrer"
    return response
