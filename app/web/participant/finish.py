"""The end of the way: the person's own robot, thanks, and the way back to a recruitment panel."""

from datetime import timedelta
from typing import Annotated
from uuid import uuid4

from fastapi import APIRouter, Request
from fastapi.responses import Response

from app.domain.protocol import Stage
from app.domain.studies import Awaited, Participant
from app.services.accounts import browser_sessions
from app.services.answers import next_query
from app.services.evaluation import robot_preparation
from app.services.monitoring import dashboard
from app.services.participants import completion, debrief, stages, visits
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    PARTICIPANT_COOKIE,
    CurrentParticipant,
    NotYet,
    StudioDep,
    WritingSession,
    set_cookie,
)
from app.web.participant.pages import back_from, go, has_reached, participant_page

router = APIRouter(prefix="/p", route_class=AuthorizedRoute)

AtDebrief = Annotated[Participant, has_reached(Stage.DEBRIEF)]


@router.get("/debrief", name="show_debrief")
def show_debrief(request: Request, participant: AtDebrief, session: WritingSession) -> Response:
    """The person's own robot before and after, side by side, and what it learned; or that it is still being made."""
    next_query.seen(participant)
    films = debrief.before_and_after(session, participant)
    next_query.waits(participant, None if films else Awaited.DEBRIEF)
    context = {
        "films": films,
        "seconds_left": None if films else robot_preparation.until_debrief_s(session, participant),
        "learned": debrief.learned(session, participant),
        "back_path": back_from(request, participant.study.settings, Stage.DEBRIEF),
    }
    return participant_page(request, "participant/debrief.html", participant, context)


@router.post("/debrief", name="finish_debrief")
def finish_debrief(request: Request, participant: AtDebrief, session: WritingSession) -> Response:
    """On to the end."""
    next_query.waits(participant, None)
    stages.finish(session, participant, Stage.DEBRIEF)
    return go(request, "show_next")


@router.get("/finished", name="show_finished")
def show_finished(
    request: Request, participant: CurrentParticipant, session: WritingSession, studio: StudioDep
) -> Response:
    """Thanks: the completion code, or the way back, which is taken by itself the first time only."""
    if stages.current_stage(session, participant) is not None or participant.ended_as is not None:
        raise NotYet
    next_query.seen(participant)
    first_time = completion.complete(participant)
    settings = participant.study.settings
    turn = next_query.next_turn(session, studio.store, participant)
    context = {
        "turn": turn,
        "detail": dashboard.participant_detail(session, participant.study, participant),
        "only_pairs": stages.stages_of(settings)[-1] is Stage.PAIRS,
        "return_address": completion.return_address(participant),
        "first_time": first_time,
        "undo_uuid": uuid4(),
        "next_visit": visits.next_visit(session, participant),
    }
    return participant_page(request, "participant/finished.html", participant, context)


@router.post("/visit", name="begin_visit")
def begin_visit(
    request: Request, participant: CurrentParticipant, session: WritingSession, studio: StudioDep
) -> Response:
    """Come back for the next visit; from here on the personal link leads there."""
    lifetime = timedelta(days=studio.settings.session_days)
    returned = visits.begin(session, participant)
    cookie = browser_sessions.open_for_participant(session, returned, lifetime)
    response = go(request, "show_next")
    set_cookie(response, studio.settings, PARTICIPANT_COOKIE, cookie, lifetime)
    return response
