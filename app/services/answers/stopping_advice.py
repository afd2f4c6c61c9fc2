"""When more answers hardly pay any more: said, or only remembered; nobody is ever stopped by it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.models import Model, ModelKind
from app.domain.people import AuditEvent
from app.domain.studies import Participant, Study
from app.services import audit

SMALL_REGRET = 0.2
"""Standard deviations of predicted return. With scripted people the expected regret begins at one to two and passes
this at 60 to 100 answers in two of our tasks; in the third it says little (docs/method.md, section 3)."""
IN_A_ROW = 3
"""Retrainings with a small regret: a single one is often chance."""
_ACT = "more answers would hardly pay"


@dataclass(frozen=True)
class Advice:
    """How much more answers could still gain."""

    regret: float
    """The newest, see worker.ml.stopping."""
    enough_since: int | None
    """Answers after which it had been small for IN_A_ROW retrainings; None: not yet, or no longer."""


def advice_of(models: Sequence[Model]) -> Advice | None:
    """From a participant's reward models in the order of their labels; None while there is nothing to go by."""
    known = [(model.label_count, regret) for model in models if (regret := _regret(model.metrics)) is not None]
    if not known:
        return None
    since, row = None, 0
    for label_count, regret in known:
        row = row + 1 if regret < SMALL_REGRET else 0
        if row == 0:
            since = None
        elif row == IN_A_ROW:
            since = label_count
    return Advice(known[-1][1], since)


def note(session: Session, study: Study, participant: Participant) -> None:
    """Keep in the audit log, once per person, when more answers hardly paid any more."""
    theirs = select(Model).where(Model.participant_id == participant.id, Model.kind == ModelKind.REWARD)
    advice = advice_of(session.scalars(theirs.order_by(Model.label_count, Model.id)).all())
    if advice is None or advice.enough_since is None:
        return
    noted = select(AuditEvent.id).where(AuditEvent.action == _ACT, AuditEvent.participant_id == participant.id)
    if session.scalar(noted.limit(1)) is None:
        subject = f"{study.slug}/{participant.code} after {advice.enough_since} answers"
        audit.record(session, audit.SYSTEM, _ACT, subject, participant=participant)


def _regret(metrics: dict[str, Any]) -> float | None:
    advice = metrics.get("advice")
    regret = advice.get("expected_regret") if isinstance(advice, dict) else None
    return float(regret) if isinstance(regret, (int, float)) else None
