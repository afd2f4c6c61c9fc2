"""Joining by an address that is the same for everybody, as recruitment panels need it."""

import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, joinedload

from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services import audit
from app.services.participants import enrolment, visits
from app.services.participants.enrolment import LinkRevoked

LONGEST_PANEL_ID = 120
MOST_PARAMETERS = 20
LONGEST_PARAMETER = 200


class JoiningClosed(AppError):
    """This study cannot be joined by this address (any more). Please ask the people who gave it to you."""

    status = HTTPStatus.NOT_FOUND


class PanelIdMissing(AppError):
    """We cannot tell who you are: the address lacks your id. Please open the study again from where it was offered."""


@dataclass(frozen=True)
class Joined:
    """Who has come in, and the token of the personal link when it has just been made."""

    participant: Participant
    token: str | None


def open_joining(session: Session, study: Study, actor: str) -> str:
    """Let anybody join by an address with this token, from now on."""
    if study.join_token is None:
        study.join_token = secrets.token_urlsafe(24)
        audit.record(session, actor, "joining opened", study.slug, study=study)
    return study.join_token


def close_joining(session: Session, study: Study, actor: str) -> None:
    """Nobody new by the open address; those who are in go on by it no more, but by their own links."""
    if study.join_token is not None:
        study.join_token = None
        audit.record(session, actor, "joining closed", study.slug, study=study)


def find_study(session: Session, join_token: str) -> Study:
    """The study that is joined by this address. Raises JoiningClosed."""
    study = session.scalar(select(Study).where(Study.join_token == join_token))
    if study is None or study.put_away_at is not None:
        raise JoiningClosed
    return study


def panel_id_in(study: Study, parameters: Mapping[str, str]) -> str | None:
    """Who the panel says this is; None for a study without a panel. Raises PanelIdMissing."""
    name = study.settings.panel_parameter
    if not name:
        return None
    panel_id = parameters.get(name, "").strip()
    if not panel_id or len(panel_id) > LONGEST_PANEL_ID:
        raise PanelIdMissing
    return panel_id


def join(session: Session, study: Study, parameters: Mapping[str, str]) -> Joined:
    """The participant for these parameters of the panel: whoever has this id already, else somebody new.

    Without a panel parameter in the settings everybody is new. Raises PanelIdMissing, LinkRevoked and NoVisitYet.
    """
    panel_id = panel_id_in(study, parameters)
    if panel_id is None:
        return _add(session, study, None, parameters)
    known = _known(session, study, panel_id)
    if known is not None and known.link_revoked_at is not None:
        raise LinkRevoked
    if known is not None:
        return Joined(known, None)
    try:
        with session.begin_nested():
            return _add(session, study, panel_id, parameters)
    except IntegrityError:  # the same person, twice at once: the unique constraint let one in
        first = _known(session, study, panel_id)
        if first is None:
            raise
        return Joined(first, None)


def _known(session: Session, study: Study, panel_id: str) -> Participant | None:
    theirs = select(Participant).where(Participant.study_id == study.id, Participant.panel_id == panel_id)
    return session.scalar(theirs.options(joinedload(Participant.study)))


def _add(session: Session, study: Study, panel_id: str | None, parameters: Mapping[str, str]) -> Joined:
    earlier = visits.known_to_panel(session, study, panel_id) if panel_id else None
    if earlier is not None:
        participant, token = visits.begin(session, earlier), None
    else:
        participant, token = enrolment.add_participant(session, study)
    participant.panel_id = panel_id
    kept = list(parameters.items())[:MOST_PARAMETERS]
    participant.panel_parameters = {key[:LONGEST_PARAMETER]: value[:LONGEST_PARAMETER] for key, value in kept} or None
    session.flush()
    return Joined(participant, token)
