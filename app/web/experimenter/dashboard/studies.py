"""The experimenter's pages: studies, one study, one participant. Each is whole without script."""

from collections import Counter
from collections.abc import AsyncIterator, Mapping
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from jinja2 import Environment
from sqlalchemy.orm import Session

from app.db import now
from app.domain.people import Experimenter, Role
from app.domain.studies import Study
from app.services import audit
from app.services.monitoring import dashboard, form_summaries, study_state
from app.services.monitoring.tallies import Tallies
from app.services.participants import arms, debrief, enrolment
from app.services.runs import publishing
from app.services.studies import membership, studies
from app.web.experimenter.dashboard import charts, form_words, live
from app.web.experimenter.dashboard.participants_table import View, WantedView, people_table
from app.web.http import stored_file
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    ActingExperimenter,
    Code,
    CurrentExperimenter,
    ReadingSession,
    RowId,
    Slug,
    Studio,
    StudioDep,
    WritingSession,
    experimenter_asking,
)
from app.web.texts import task_words
from app.web.texts.templating import page

router = APIRouter(prefix="/studies", route_class=AuthorizedRoute)

LIST_PARTS = {"machine": "pieces/machine", "study_list": "studies/list"}
STUDY_PARTS = {
    "machine": "pieces/machine",
    "jobs": "study/jobs",
    "pool": "study/pool",
    "participants": "study/participants",
}
PARTICIPANT_PARTS = {
    "machine": "pieces/machine",
    "participant_summary": "participant/summary",
    "trust": "participant/trust",
    "accuracy": "participant/accuracy",
    "participant_forms": "participant/forms",
    "weights": "participant/weights",
    "liked": "participant/liked",
    "filters": "participant/filters",
    "runs": "participant/runs",
}
"""What is drawn anew while a page is open: by its name in data-fragment, the template of the experimenter's side."""


def _may_stream(request: Request, studio: StudioDep) -> Experimenter:
    """Checks login and membership before a stream begins, and holds no session while it lasts."""
    with studio.database.reading() as session:
        return experimenter_asking(request, session)


MayStream = Annotated[Experimenter, Depends(_may_stream)]


@router.get("", name="show_studies")
def show_studies(
    request: Request,
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    studio: StudioDep,
    put_away: bool = False,
) -> Response:
    """Every study that is at work, or those that are put away."""
    context = _list_context(session, studio, experimenter, put_away) | {
        "experimenter": experimenter,
        "parts": LIST_PARTS,
    }
    return page(request, "experimenter/studies.html", context)


@router.get("/live", name="stream_studies", response_class=EventSourceResponse)
async def stream_studies(
    request: Request, studio: StudioDep, experimenter: MayStream, put_away: bool = False
) -> AsyncIterator[ServerSentEvent]:
    """The list of studies as it changes: one for all administrators, one for each of the others."""
    templates = request.app.state.templates
    whose = "" if experimenter.role == Role.ADMINISTRATOR else f"{experimenter.id} "

    def draw(session: Session) -> Mapping[str, str]:
        return _draw(templates, LIST_PARTS, _list_context(session, studio, experimenter, put_away))

    async for event in live.redrawn_parts(request, studio, draw, whose):
        yield event


@router.get("/{slug}", name="show_study")
def show_study(
    request: Request,
    slug: Slug,
    view: WantedView,
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """One study: its pool and everybody in it."""
    context = _study_context(session, studio, slug, view) | {"experimenter": experimenter, "parts": STUDY_PARTS}
    context["arms"] = arms.loads(session, context["study"], now())
    return page(request, "experimenter/study.html", context)


@router.get("/{slug}/live", name="stream_study", response_class=EventSourceResponse)
async def stream_study(
    request: Request, slug: Slug, view: WantedView, studio: StudioDep, _allowed: MayStream
) -> AsyncIterator[ServerSentEvent]:
    """One study as it changes, in the view that the page was asked for."""
    templates = request.app.state.templates  # and nothing else of the request: what is drawn is for all who look

    def draw(session: Session) -> Mapping[str, str]:
        return _draw(templates, STUDY_PARTS, _study_context(session, studio, slug, view, studio.tallies.unhurried()))

    async for event in live.redrawn_parts(request, studio, draw):
        yield event


@router.post("/{slug}/runs/{run_id}/retry", name="retry_run")
def retry_run(
    request: Request, slug: Slug, run_id: RowId, experimenter: ActingExperimenter, session: WritingSession
) -> Response:
    """Ask for another attempt at a failed run."""
    study = studies.find_study(session, slug)
    publishing.retry_run(session, study, run_id, experimenter.name)
    return _see(request, "show_study", slug=slug)


@router.get("/{slug}/participants/{code}", name="show_participant")
def show_participant(
    request: Request,
    slug: Slug,
    code: Code,
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """One participant: what they said, what was learned, and what it changes."""
    _note_looking(studio, session, experimenter, slug, code)
    context = _participant_context(session, studio, slug, code)
    context |= {"experimenter": experimenter, "parts": PARTICIPANT_PARTS}
    return page(request, "experimenter/participant.html", context)


@router.get("/{slug}/participants/{code}/live", name="stream_participant", response_class=EventSourceResponse)
async def stream_participant(
    request: Request, slug: Slug, code: Code, studio: StudioDep, _allowed: MayStream
) -> AsyncIterator[ServerSentEvent]:
    """One participant as it changes."""
    await run_in_threadpool(_note_streaming, request, studio, slug, code)
    templates = request.app.state.templates  # and nothing else of the request: what is drawn is for all who look

    def draw(session: Session) -> Mapping[str, str]:
        return _draw(templates, PARTICIPANT_PARTS, _participant_context(session, studio, slug, code))

    async for event in live.redrawn_parts(request, studio, draw):
        yield event


@router.get("/{slug}/participants/{code}/bundles/{version}.zip", name="download_bundle")
def download_bundle(
    slug: Slug,
    code: Code,
    version: RowId,
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """The participant's filter as a zip file that runs without this project."""
    study = studies.find_study(session, slug)
    participant = enrolment.find_by_code(session, study, code)
    bundle = publishing.find_bundle(session, studio.store, participant, version)
    audit.record(session, experimenter.name, "bundle downloaded", f"{slug}/{code}/{version}", participant=participant)
    filename = f"{slug}-{code}-v{version}.zip"
    return stored_file.send(studio.store, bundle.artefact_sha256, "application/zip", filename=filename)


def _note_looking(studio: Studio, session: Session, experimenter: Experimenter, slug: str, code: str) -> None:
    person = enrolment.find_by_code(session, studies.find_study(session, slug), code)
    subject = f"{slug}/{code}"
    audit.note_reading(
        studio.database, session, experimenter.name, "participant's page viewed", subject, participant=person
    )


def _note_streaming(request: Request, studio: Studio, slug: str, code: str) -> None:
    with studio.database.reading() as session:
        _note_looking(studio, session, experimenter_asking(request, session), slug, code)


def _list_context(session: Session, studio: Studio, experimenter: Experimenter, put_away: bool) -> dict[str, Any]:
    """What the list shows to whoever may see the same studies."""
    theirs = membership.visible_to(experimenter)
    lines = dashboard.study_lines(session, theirs, put_away=put_away)
    names = Counter(line.study.name.casefold() for line in lines)
    return {
        "machine": dashboard.machine(session, studio.settings.data_dir, studio.store, theirs),
        "lines": lines,
        "standings": study_state.standings(session, lines),
        "twice": {line.study.id for line in lines if names[line.study.name.casefold()] > 1},
        "put_away": put_away,
        "put_away_count": studies.count_put_away(session, theirs),
    }


def _study_context(
    session: Session, studio: Studio, slug: str, view: View, tallies: Tallies | None = None
) -> dict[str, Any]:
    study = studies.find_study(session, slug)
    overview = dashboard.study_overview(session, study, tallies or studio.tallies)
    return {
        "study": study,
        "settings": study.settings,
        "overview": overview,
        "table": people_table(overview, view),
        "machine": dashboard.machine(session, studio.settings.data_dir, studio.store, Study.id == study.id),
        "sparkline": charts.sparkline,
        "scripted": enrolment.count_scripted(session, study),
    }


def _participant_context(session: Session, studio: Studio, slug: str, code: str) -> dict[str, Any]:
    study = studies.find_study(session, slug)
    participant = enrolment.find_by_code(session, study, code)
    detail = dashboard.participant_detail(session, study, participant, studio.tallies)
    return {
        "study": study,
        "settings": study.settings,
        "detail": detail,
        "films": debrief.before_and_after(session, participant),
        "machine": dashboard.machine(session, studio.settings.data_dir, studio.store, Study.id == study.id),
        "chart": charts.accuracy_chart(detail.row.curve, study.settings.labels_per_participant),
        "interval": charts.interval,
        "words": task_words.words_of(study.task),
        "forms": form_words.sheets(study, form_summaries.sheets_of(session, study, participant)),
    }


def _draw(templates: Environment, parts: Mapping[str, str], context: Mapping[str, Any]) -> Mapping[str, str]:
    return {name: templates.get_template(f"experimenter/{piece}.html").render(context) for name, piece in parts.items()}


def _see(request: Request, name: str, **parameters: str) -> RedirectResponse:
    return RedirectResponse(request.app.url_path_for(name, **parameters), HTTPStatus.SEE_OTHER)
