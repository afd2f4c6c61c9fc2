"""The page on which participants give a hint or two; asked for once, and there to be changed while they compare."""

from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Annotated
from uuid import UUID, uuid4

from fastapi import APIRouter, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from pydantic import BaseModel, ValidationError
from sqlalchemy.orm import Session

from app.domain.hints import hints_of
from app.domain.protocol import Stage
from app.domain.studies import Participant
from app.installed_tasks import hints
from app.services.answers import hint_offers, next_query
from app.services.participants import hinting
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import NotYet, Typed, WritingSession
from app.web.participant.pages import go, has_reached, is_in, participant_page
from app.web.texts import hint_words
from app.web.texts.languages import wording_of

router = APIRouter(prefix="/p/hints", route_class=AuthorizedRoute)

Comparing = Annotated[Participant, is_in(Stage.PAIRS)]
HasCompared = Annotated[Participant, has_reached(Stage.PAIRS)]

HINT = "hint-"
"""Before the name of a hint in the name of its box."""


class HintsForm(BaseModel):
    """One set of hints; its boxes are beside it."""

    client_uuid: UUID


@router.get("", name="show_hints")
def show_hints(request: Request, participant: Comparing, session: WritingSession) -> Response:
    """The hints that can be given, with those that count now."""
    if not hint_offers.asks(participant.study):
        raise NotYet
    next_query.seen(participant)
    return show(request, session, participant)


@router.post("", name="save_hints")
def save_hints(request: Request, participant: HasCompared, session: WritingSession, typed: Typed) -> Response:
    """Keep them and go on; the same page with a complaint where two cannot both be meant, or more than two."""
    form = _form(typed)
    given = [name.removeprefix(HINT) for name in typed if name.startswith(HINT)]
    next_query.seen(participant)
    problem = hint_offers.problem_of(participant, given)
    if problem is not None:
        return show(request, session, participant, given, problem)
    hinting.save(session, participant, given, form.client_uuid)
    return go(request, "show_next")


def _form(typed: Mapping[str, str]) -> HintsForm:
    """What was sent; which boxes there are depends on the task."""
    try:
        return HintsForm.model_validate({"client_uuid": typed.get("client_uuid")})
    except ValidationError as error:
        raise RequestValidationError([{**each, "loc": ("body", *each["loc"])} for each in error.errors()]) from None


def show(
    request: Request,
    session: Session,
    participant: Participant,
    given: Sequence[str] | None = None,
    problem: str | None = None,
) -> Response:
    """The page; ``given``: what is ticked already, what counts now when missing."""
    wording = wording_of(request, participant)
    context = {
        "hints": hint_words.words_of(wording, participant.study.task, hint_offers.offered(participant)),
        "given": hints_of(session, participant.id) if given is None else given,
        "problem": problem,
        "most": hints.MOST,
        "prefix": HINT,
        "client_uuid": uuid4(),
    }
    status = HTTPStatus.OK if problem is None else HTTPStatus.UNPROCESSABLE_ENTITY
    return participant_page(request, "participant/hints.html", participant, context, status)
