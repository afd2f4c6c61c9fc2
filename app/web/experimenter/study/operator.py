"""For whoever runs a physical robot in a blinded evaluation: the next trial by letter, what to press; and unblinding.

Works on a tablet beside the robot; nothing here says which method a letter hides until the study is unblinded.
"""

from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Form, Path, Request
from fastapi.responses import RedirectResponse, Response
from sqlalchemy.orm import Session

from app.domain.people import Experimenter
from app.domain.studies import Participant, Study
from app.services import audit
from app.services.evaluation import evaluation_plan, robot_operation, unblinding
from app.services.evaluation.robot_operation import LONGEST_REASON, RepetitionReasonMissing
from app.services.evaluation.unblinding import NAMES, ConfirmationDiffers
from app.services.participants import enrolment
from app.services.studies import studies
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
)
from app.web.media import AT_NO_TIME
from app.web.texts.templating import page

router = APIRouter(prefix="/studies/{slug}", route_class=AuthorizedRoute)

Letter = Annotated[str, Path(pattern=r"^[A-E]$")]


@router.get("/participants/{code}/operate", name="operate")
def operate(
    request: Request,
    slug: Slug,
    code: Code,
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    studio: StudioDep,
) -> Response:
    """The next trial, the list of all, and the controllers."""
    study, participant = _found(session, slug, code)
    subject = f"{slug}/{code}"
    audit.note_reading(studio.database, session, experimenter.name, "trials viewed", subject, participant=participant)
    return _desk_page(request, session, studio, (study, participant), experimenter)


@router.post("/participants/{code}/trials/{ordinal}/start", name="start_trial")
def start_trial(
    request: Request,
    slug: Slug,
    code: Code,
    ordinal: RowId,
    experimenter: ActingExperimenter,
    session: WritingSession,
) -> Response:
    """The robot begins to move: the participant is asked to watch."""
    study, participant = _found(session, slug, code)
    robot_operation.start(session, study, participant, ordinal, experimenter.name)
    return _back(request, slug, code)


@router.post("/participants/{code}/trials/{ordinal}/done", name="finish_trial")
def finish_trial(
    request: Request,
    slug: Slug,
    code: Code,
    ordinal: RowId,
    experimenter: ActingExperimenter,
    session: WritingSession,
) -> Response:
    """The robot is done: the participant is asked to rate."""
    study, participant = _found(session, slug, code)
    robot_operation.finish(session, study, participant, ordinal, experimenter.name)
    return _back(request, slug, code)


@router.post("/participants/{code}/trials/{ordinal}/repeat", name="repeat_trial")
def repeat_trial(
    request: Request,
    slug: Slug,
    code: Code,
    ordinal: RowId,
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
    reason: Annotated[str, Form(max_length=LONGEST_REASON)] = "",
) -> Response:
    """Something went wrong with the robot: once more, for a reason that is kept."""
    study, participant = _found(session, slug, code)
    try:
        robot_operation.repeat(session, study, participant, ordinal, reason, experimenter.name)
    except RepetitionReasonMissing as missing:
        return _desk_page(request, session, studio, (study, participant), experimenter, missing.message)
    return _back(request, slug, code)


@router.get("/participants/{code}/controllers/{letter}.zip", name="download_controller")
def download_controller(
    slug: Slug,
    code: Code,
    letter: Letter,
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """The robot of a letter as a zip file that runs without this project."""
    study, participant = _found(session, slug, code)
    controller = robot_operation.find_controller(session, studio.store, participant, letter)
    audit.record(
        session, experimenter.name, "controller downloaded", f"{study.slug}/{code}/{letter}", participant=participant
    )
    filename, sha256 = f"{slug}-{code}-{letter}.zip", controller.artefact_sha256
    headers = {"etag": f'"{sha256}"', "last-modified": AT_NO_TIME}
    return stored_file.send(studio.store, sha256, "application/zip", filename=filename, headers=headers)


@router.get("/unblind", name="show_unblinding")
def show_unblinding(
    request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession, studio: StudioDep
) -> Response:
    """What unblinding means, and the form; afterwards the key."""
    study = studies.find_study(session, slug)
    if study.unblinded_at is not None:
        audit.note_reading(studio.database, session, experimenter.name, "key of letters viewed", slug, study=study)
    return _unblinding_page(request, session, study, experimenter)


@router.post("/unblind", name="unblind_study")
def unblind_study(
    request: Request,
    slug: Slug,
    typed: Annotated[str, Form(max_length=100)],
    experimenter: ActingExperimenter,
    session: WritingSession,
) -> Response:
    """Unblind for good, if the study's short name was typed."""
    study = studies.find_study(session, slug)
    try:
        unblinding.unblind(session, study, typed, experimenter.name)
    except ConfirmationDiffers as differs:
        return _unblinding_page(request, session, study, experimenter, differs.message)
    return RedirectResponse(request.app.url_path_for("show_unblinding", slug=slug), HTTPStatus.SEE_OTHER)


def _found(session: Session, slug: str, code: str) -> tuple[Study, Participant]:
    study = studies.find_study(session, slug)
    return study, enrolment.find_by_code(session, study, code)


def _desk_page(
    request: Request,
    session: Session,
    studio: Studio,
    whose: tuple[Study, Participant],
    experimenter: Experimenter,
    error: str = "",
) -> Response:
    study, participant = whose
    settings = evaluation_plan.settings_of(study)
    context: dict[str, Any] = {
        "study": study,
        "code": participant.code,
        "experimenter": experimenter,
        "desk": robot_operation.desk_of(session, studio.store, study, participant),
        "trials_each": settings.trials if settings else 0,
        "longest_reason": LONGEST_REASON,
        "error": error,
    }
    status = HTTPStatus.UNPROCESSABLE_ENTITY if error else HTTPStatus.OK
    return page(request, "experimenter/operator.html", context, status)


def _unblinding_page(
    request: Request, session: Session, study: Study, experimenter: Experimenter, error: str = ""
) -> Response:
    if study.settings.evaluation is None:
        raise unblinding.NothingToUnblind
    answers = unblinding.answers(session, study)
    context = {
        "study": study,
        "experimenter": experimenter,
        "blinded": unblinding.is_blinded(study),
        "answers": answers,
        "all_given": all(each.given >= each.wanted for each in answers),
        "key": [] if unblinding.is_blinded(study) else unblinding.key_of(session, study),
        "names": NAMES,
        "error": error,
    }
    status = HTTPStatus.UNPROCESSABLE_ENTITY if error else HTTPStatus.OK
    return page(request, "experimenter/unblind.html", context, status)


def _back(request: Request, slug: str, code: str) -> RedirectResponse:
    return RedirectResponse(request.app.url_path_for("operate", slug=slug, code=code), HTTPStatus.SEE_OTHER)
