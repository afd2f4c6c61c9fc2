"""Recording ratings: append-only, each exactly once, and only of what was shown."""

from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.domain.evaluation import Rating, Trial
from app.domain.protocol import EvaluationMode
from app.domain.studies import Participant
from app.errors import AppError
from app.services.evaluation import head_to_heads


class TrialNotFound(AppError):
    """There is no such robot for you to rate. Please go on with the one you are shown."""

    status = HTTPStatus.NOT_FOUND


class TrialNotShown(AppError):
    """You have not seen this robot yet. Please go on with the one you are shown."""

    status = HTTPStatus.CONFLICT


class RatedAlready(AppError):
    """This robot has a rating already, and that is the one which counts. The last rating can still be changed."""

    status = HTTPStatus.CONFLICT


class CorrectionTooLate(AppError):
    """Only the last rating can be changed, and this is an earlier one."""

    status = HTTPStatus.CONFLICT


class RatingMisdirected(AppError):
    """This rating was already given to another robot. Please reload the page and rate again."""

    status = HTTPStatus.CONFLICT


@dataclass(frozen=True)
class Score:
    """What somebody says about one trial: 1 to 5 each, and why in their own words."""

    satisfaction: int
    personalisation: int
    reason: str | None = None


def rate(
    session: Session,
    participant: Participant,
    trial_id: int,
    score: Score,
    client_uuid: UUID,
    *,
    corrects: int = 0,
    response_time_ms: int | None = None,
    by_script: bool | None = None,
) -> Rating:
    """Store one rating and return it; sent again, it is the same one. The study is loaded.

    ``corrects``: how many ratings the trial had on the page that is sent: 0 for a first rating, else this
    is a correction.
    Raises TrialNotFound, TrialNotShown, RatedAlready (somebody else's click was first, or an old page was sent again
    with other values), CorrectionTooLate and RatingMisdirected.
    """
    trial = _own_trial(session, participant, trial_id)
    ratings = _ratings(session, trial)
    known = _earlier(session, ratings, score, client_uuid)
    if known is not None:
        return known
    if not _was_shown(participant, trial):
        raise TrialNotShown
    if len(ratings) != corrects:
        raise RatedAlready
    if ratings and not is_last_rated(session, trial):
        raise CorrectionTooLate
    settings = participant.study.settings.evaluation
    rating = Rating(
        trial_id=trial.id,
        revision=corrects + 1,
        satisfaction=score.satisfaction,
        personalisation=score.personalisation,
        client_uuid=str(client_uuid),
        response_time_ms=response_time_ms,
        by_script=by_script,
        reason=score.reason if settings is not None and settings.ask_reasons else None,
    )
    return _append(session, trial, rating)


def find_rated(session: Session, participant: Participant, trial_id: int) -> tuple[Trial, Rating]:
    """A trial of the participant's with the rating that counts, to be corrected.

    Raises TrialNotFound when it has none, and CorrectionTooLate when a later one has been rated.
    """
    trial = _own_trial(session, participant, trial_id)
    ratings = _ratings(session, trial)
    if not ratings:
        raise TrialNotFound
    if not is_last_rated(session, trial):
        raise CorrectionTooLate
    return trial, ratings[-1]


def is_last_rated(session: Session, trial: Trial) -> bool:
    """Whether nothing that came later has an answer."""
    if head_to_heads.have_begun(session, trial.participant_id):
        return False
    later = select(Rating.id).join(Trial)
    later = later.where(Trial.participant_id == trial.participant_id, Trial.ordinal > trial.ordinal)
    return session.scalar(later.limit(1)) is None


def _own_trial(session: Session, participant: Participant, trial_id: int) -> Trial:
    mine = select(Trial).where(Trial.id == trial_id, Trial.participant_id == participant.id)
    trial = session.scalar(mine.with_for_update())  # SQLite: the whole database is already ours
    if trial is None:
        raise TrialNotFound
    return trial


def _ratings(session: Session, trial: Trial) -> Sequence[Rating]:
    return session.scalars(select(Rating).where(Rating.trial_id == trial.id).order_by(Rating.revision)).all()


def _was_shown(participant: Participant, trial: Trial) -> bool:
    settings = participant.study.settings.evaluation
    if settings is not None and settings.mode is EvaluationMode.PHYSICAL:
        return trial.finished_at is not None
    return trial.shown_at is not None


def _earlier(session: Session, ratings: Sequence[Rating], score: Score, client_uuid: UUID) -> Rating | None:
    """The rating this client has sent before. Raises RatedAlready when it then said something else."""
    known = session.scalar(select(Rating).where(Rating.client_uuid == str(client_uuid)))
    if known is None:
        return None
    if known.id not in {rating.id for rating in ratings}:
        raise RatingMisdirected
    if (known.satisfaction, known.personalisation) != (score.satisfaction, score.personalisation):
        raise RatedAlready
    return known


def _append(session: Session, trial: Trial, rating: Rating) -> Rating:
    """Add it; if another request was first, say so. The unique constraints are the last judge."""
    try:
        with session.begin_nested():
            session.add(rating)
            session.flush()
    except IntegrityError as error:
        twin = next((each for each in _ratings(session, trial) if each.client_uuid == rating.client_uuid), None)
        if twin is None:
            raise RatedAlready from error
        return twin
    return rating
