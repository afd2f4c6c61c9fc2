"""What was refused to somebody known, for the audit log: a role too low, a token too narrow, somebody else's study."""

from fastapi import Request
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from app.db import complaints
from app.domain.studies import Study
from app.services import audit
from app.services.accounts import hourly_counts
from app.web.http.deps import Studio
from app.web.http.request_log import route_of

ACTION = "access refused"


def note(request: Request) -> None:
    """Write down who asked for what, of an account and a study the 1st, 10th, 100th, ... time within an hour.

    When nothing is held any more, and so seldom that the writing need not wait for its turn in the event loop. A
    refusal that cannot be written down stays one.
    """
    studio: Studio = request.app.state.studio
    actor, slug = request.state.asking, request.path_params.get("slug")
    try:
        with studio.database.reading() as session:
            study = session.scalar(select(Study).where(Study.slug == slug)) if slug else None
        count = studio.refusals.count(f"{actor}/{study.slug if study else ''}")
        if count is not None:
            what = f"{request.method} {route_of(request.scope)}"
            if study is not None:
                what = what.replace("{slug}", study.slug)
            with studio.database.writing() as writing:
                audit.record(writing, actor, ACTION, hourly_counts.in_words(what, count), study=study)
    except SQLAlchemyError as error:
        complaints.error("a refusal could not be recorded: %s", error)
