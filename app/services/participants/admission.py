"""Who goes on: screening by the questions at the start, allocation to an arm, attention in catch pairs."""

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.designs import Ending
from app.domain.preferences import LabelEvent, Purpose, Query, Response
from app.domain.protocol import Stage
from app.domain.studies import Participant
from app.services import audit
from app.services.participants import arms, forms

_BEFORE = (Stage.CONSENT, Stage.DEMOGRAPHICS)
"""Stages after which somebody has arrived."""


def settle(session: Session, participant: Participant, stage: Stage | None) -> None:
    """Screen, allocate and check whoever is in this stage, as far as it is due; the study is loaded.

    Whoever has come to the end stays there.
    """
    if stage is None or stage in _BEFORE or participant.ended_as is not None:
        return
    ending = _ending(session, participant, stage)
    if ending is not None:
        participant.ended_as = ending
        subject = f"{participant.study.slug}/{participant.code}: {ending.label}"
        audit.record(session, audit.SYSTEM, "participant ended", subject, participant=participant)


def _ending(session: Session, participant: Participant, stage: Stage) -> Ending | None:
    study = participant.study
    if not is_admitted(session, participant):
        return Ending.SCREENED_OUT
    if study.settings.arms and participant.arm is None and not arms.allocate(session, study, participant):
        return Ending.FULL
    most = study.settings.end_after_misses
    if most and stage is Stage.PAIRS and misses(session, participant) >= most:
        return Ending.INATTENTIVE
    return None


def is_admitted(session: Session, participant: Participant) -> bool:
    """Whether the answers to the questions at the start let somebody take part."""
    rules = participant.study.settings.screening
    answers = forms.answers_of(session, participant, Stage.DEMOGRAPHICS) if rules else {}
    return all(rule.admits(answers.get(rule.name)) for rule in rules)


def misses(session: Session, participant: Participant) -> int:
    """Catch pairs on which the obviously worse side is preferred, by the answers that count now."""
    given = select(Query.id, Query.expected, LabelEvent.response).join(LabelEvent, LabelEvent.query_id == Query.id)
    given = given.where(Query.participant_id == participant.id, Query.purpose == Purpose.CATCH)
    newest = {query: (expected, said) for query, expected, said in session.execute(given.order_by(LabelEvent.revision))}
    return sum(said in (Response.LEFT, Response.RIGHT) and said != expected for expected, said in newest.values())
