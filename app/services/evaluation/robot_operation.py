"""The operator of a physical evaluation: starts the robot of a letter, says when it is done, repeats what went wrong.

Everything is kept in the audit log with the operator's name; letters are all an operator ever sees.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.evaluation import Controller, Rating, Trial
from app.domain.protocol import EvaluationMode
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services import audit
from app.services.evaluation import evaluation_plan
from app.storage import ArtefactStore

LONGEST_REASON = 200


class NotPhysical(AppError):
    """In this study nobody runs a robot: the participants watch films."""

    status = HTTPStatus.NOT_FOUND


class NotItsTurn(AppError):
    """This trial is not the next one. Somebody else may have gone on; look at the list again."""

    status = HTTPStatus.CONFLICT


class RatedMeanwhile(AppError):
    """This trial has been rated and cannot be repeated."""

    status = HTTPStatus.CONFLICT


class RepetitionReasonMissing(AppError):
    """Please write in a few words why the trial is repeated."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class ControllerNotFound(AppError):
    """There is no such controller yet, or its file is missing from the data directory."""

    status = HTTPStatus.NOT_FOUND


@dataclass(frozen=True)
class Line:
    """One trial as the operator sees it."""

    trial: Trial
    rated: bool
    current: bool


@dataclass(frozen=True)
class Desk:
    """What an operator has before them."""

    ready: bool
    """Every controller is there."""
    lines: Sequence[Line]
    letters: Sequence[str]
    """of the controllers that can be downloaded"""

    @property
    def current(self) -> Line | None:
        """The trial that is on, or comes next; None at the end."""
        return next((line for line in self.lines if line.current), None)


def desk_of(session: Session, store: ArtefactStore, study: Study, participant: Participant) -> Desk:
    """The participant's trials and controllers. Raises NotPhysical."""
    settings = evaluation_plan.settings_for(study, participant.arm)
    if settings is None or settings.mode is not EvaluationMode.PHYSICAL:
        raise NotPhysical
    trials = evaluation_plan.trials_of(session, participant.id)
    ratings = evaluation_plan.ratings_of(session, participant.id)
    current = next((trial.id for trial in trials if trial.id not in ratings), None)
    controllers = evaluation_plan.controllers_of(session, participant.id)
    return Desk(
        ready=bool(trials) and len(controllers) >= len(settings.methods),
        lines=[Line(trial, trial.id in ratings, trial.id == current) for trial in trials],
        letters=[letter for letter, each in controllers.items() if store.has(each.artefact_sha256)],
    )


def start(session: Session, study: Study, participant: Participant, ordinal: int, actor: str) -> None:
    """The robot begins to move; pressing twice changes nothing. Raises NotItsTurn."""
    trial = _current(session, participant, ordinal)
    if trial.started_at is None:
        trial.started_at = trial.shown_at = now()
        _record(session, actor, "trial started", study, participant, trial)


def finish(session: Session, study: Study, participant: Participant, ordinal: int, actor: str) -> None:
    """The robot has done its work, and is to be rated. Raises NotItsTurn."""
    trial = _current(session, participant, ordinal)
    if trial.started_at is None:
        raise NotItsTurn
    if trial.finished_at is None:
        trial.finished_at = now()
        _record(session, actor, "trial done", study, participant, trial)


def repeat(session: Session, study: Study, participant: Participant, ordinal: int, reason: str, actor: str) -> None:
    """Take the trial back to its start, for a reason that is kept. Raises ReasonMissing, RatedMeanwhile, NotItsTurn."""
    words = " ".join(reason.split())[:LONGEST_REASON]
    if not words:
        raise RepetitionReasonMissing
    trial = _trial(session, participant, ordinal)
    if session.scalar(select(Rating.id).where(Rating.trial_id == trial.id).limit(1)) is not None:
        raise RatedMeanwhile
    if trial.started_at is None:
        return
    trial.started_at = trial.finished_at = trial.shown_at = None
    audit.record(
        session, actor, "trial repeated", f"{_subject(study, participant, trial)}: {words}", participant=participant
    )


def find_controller(session: Session, store: ArtefactStore, participant: Participant, letter: str) -> Controller:
    """The controller behind a letter, its file present. Raises ControllerNotFound."""
    controller = evaluation_plan.controllers_of(session, participant.id).get(letter)
    if controller is None or not store.has(controller.artefact_sha256):
        raise ControllerNotFound
    return controller


def _trial(session: Session, participant: Participant, ordinal: int) -> Trial:
    theirs = select(Trial).where(Trial.participant_id == participant.id, Trial.ordinal == ordinal)
    trial = session.scalar(theirs.with_for_update())
    if trial is None:
        raise NotItsTurn
    return trial


def _current(session: Session, participant: Participant, ordinal: int) -> Trial:
    trial = _trial(session, participant, ordinal)
    ratings = evaluation_plan.ratings_of(session, participant.id)
    trials = evaluation_plan.trials_of(session, participant.id)
    if next((each.id for each in trials if each.id not in ratings), None) != trial.id:
        raise NotItsTurn
    return trial


def _record(session: Session, actor: str, action: str, study: Study, participant: Participant, trial: Trial) -> None:
    audit.record(session, actor, action, _subject(study, participant, trial), participant=participant)


def _subject(study: Study, participant: Participant, trial: Trial) -> str:
    return f"{study.slug}/{participant.code}/trial {trial.ordinal} ({trial.letter})"
