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

SMALL_REGRET = 0.08
"""Of what a robot of one's own could gain, see worker.ml.stopping. Why so much, and how often it errs:
docs/results/advice_to_stop.md."""
IN_A_ROW = 3
"""Retrainings with a small regret: a single one is often chance."""
_ACT = "more answers would hardly pay"


@dataclass(frozen=True)
class Advice:
    """How much more answers could still gain."""

    regret: float
    """The newest: the share of what could be gained that is still missing, see worker.ml.stopping."""
    enough_since: int | None
    """Answers after which it had been small for IN_A_ROW retrainings; None: not yet, or no longer."""


def advice_of(models: Sequence[Model]) -> Advice | None:
    """From a participant's reward models in the order of their labels; None while the newest has nothing to go by."""
    regrets = [(model.label_count, _regret(model.metrics)) for model in models]
    known = [(label_count, regret) for label_count, regret in regrets if regret is not None]
    return Advice(known[-1][1], enough_since(known)) if known and regrets[-1][1] is not None else None


def enough_since(
    known: Sequence[tuple[int, float]], small: float = SMALL_REGRET, in_a_row: int = IN_A_ROW
) -> int | None:
    """Of numbers of answers and the regret after each: when it had been small often enough, and has been since."""
    since, row = None, 0
    for label_count, regret in known:
        row = row + 1 if regret < small else 0
        if row == 0:
            since = None
        elif row == in_a_row:
            since = label_count
    return since


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
    regret = advice.get("relative_regret") if isinstance(advice, dict) else None
    return float(regret) if isinstance(regret, (int, float)) else None
