"""Pages about the API: its documentation, and the tokens of an account."""

import json
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.people import ApiToken, Experimenter, StudyRole, TokenScope
from app.domain.studies import Study
from app.services.accounts import api_tokens
from app.services.studies import membership, studies
from app.web.api import openapi
from app.web.api.callers import PREFIX
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import CurrentExperimenter, OwnAccount, ReadingSession, RowId, WritingSession
from app.web.texts.templating import page

router = APIRouter(route_class=AuthorizedRoute)


@router.get("/api/docs", name="show_api")
def show_api(request: Request) -> Response:
    """Everything that the API offers, on one page that loads nothing from anywhere else."""
    document = request.app.state.api.openapi()
    operations = openapi.described(document, PREFIX)
    for operation in operations:
        for side in ("takes", "gives"):
            example = operation[side]
            operation[side] = None if example is None else json.dumps(example, indent=2, ensure_ascii=False)
    context = {
        "document": document,
        "paragraphs": document["info"]["description"].strip().split("\n\n"),
        "tags": list(dict.fromkeys(operation["tag"] for operation in operations)),
        "operations": operations,
        "base": str(request.base_url).rstrip("/"),
        "prefix": PREFIX,
    }
    return page(request, "experimenter/api_docs.html", context)


@router.get("/tokens", name="show_tokens")
def show_tokens(request: Request, experimenter: CurrentExperimenter, session: ReadingSession) -> Response:
    """The tokens of this account."""
    return _tokens_page(request, session, experimenter)


@router.post("/tokens", name="create_token")
def create_token(
    request: Request,
    name: Annotated[str, Form(min_length=1, max_length=api_tokens.LONGEST_NAME)],
    experimenter: OwnAccount,
    session: WritingSession,
    scope: Annotated[TokenScope, Form()] = TokenScope.READ,
    study: Annotated[str, Form(pattern=r"^[a-z0-9-]{0,80}$")] = "",
    days: Annotated[int, Form(ge=1, le=max(api_tokens.LIFETIMES_DAYS))] = api_tokens.USUAL_LIFETIME_DAYS,
) -> Response:
    """Make a token and show it, this one time; there is nothing to come back to, so this is the page itself."""
    if study:
        membership.enter(session, experimenter, study, StudyRole.VIEWER)
    only = studies.find_study(session, study) if study else None
    made = api_tokens.create(session, experimenter, name, scope=scope, study=only, days=days)
    return _tokens_page(request, session, experimenter, made)


@router.post("/tokens/{token_id}/revoke", name="revoke_token")
def revoke_token(request: Request, token_id: RowId, experimenter: OwnAccount, session: WritingSession) -> Response:
    """Make a token worthless."""
    api_tokens.revoke(session, experimenter, token_id)
    return RedirectResponse(request.app.url_path_for("show_tokens"), HTTPStatus.SEE_OTHER)


def _tokens_page(
    request: Request, session: Session, experimenter: Experimenter, made: tuple[ApiToken, str] | None = None
) -> Response:
    theirs = select(Study).where(Study.deleted_at.is_(None), membership.visible_to(experimenter))
    tokens = api_tokens.of_experimenter(session, experimenter)
    only = select(Study.id, Study.name).where(Study.id.in_({token.study_id for token in tokens} - {None}))
    context = {
        "experimenter": experimenter,
        "tokens": tokens,
        "made": made,
        "studies": session.scalars(theirs.order_by(Study.name)).all(),
        "study_names": dict(session.execute(only).all()),
        "lifetimes": api_tokens.LIFETIMES_DAYS,
        "usual_lifetime": api_tokens.USUAL_LIFETIME_DAYS,
        "now": now(),
    }
    return page(request, "experimenter/tokens.html", context)
