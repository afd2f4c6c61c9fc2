"""What a participant is shown of their own robot: before and after in one scenario, and what it learned."""

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session, aliased

from app.domain.evaluation import Film
from app.domain.models import Bundle, Model, ModelKind
from app.domain.protocol import EvaluatedMethod
from app.domain.studies import Participant
from app.services import evaluating, results

MOST_LESSONS = 4
"""More would not be read."""
MOST_PERCENT = 100


@dataclass(frozen=True)
class BeforeAndAfter:
    """Two films of one scenario."""

    before: Film
    after: Film


@dataclass(frozen=True)
class Lesson:
    """One thing that the person's robot does otherwise than before, beyond chance."""

    cost: str
    """One of results.COST_SYMBOLS."""
    more: bool
    percent: int
    """By how much, of what it was before."""

    @property
    def direction(self) -> str:
        """less, more, or much: more than double is a multiple of little, and its percentage would only frighten."""
        if not self.more:
            return "less"
        return "much" if self.percent > MOST_PERCENT else "more"


@dataclass(frozen=True)
class Learned:
    """What the newest filter does otherwise, over so many scenarios it had not met."""

    scenarios: int
    lessons: Sequence[Lesson]


def before_and_after(session: Session, participant: Participant) -> BeforeAndAfter | None:
    """The newest own robot beside the reference; None while either film is missing."""
    before, after = aliased(Film), aliased(Film)
    row = session.execute(
        select(before, after)
        .join(after, (after.participant_id == before.participant_id) & (after.scenario == before.scenario))
        .where(
            before.participant_id == participant.id,
            before.method == EvaluatedMethod.REFERENCE,
            after.method == EvaluatedMethod.PBARL,
            before.scenario.in_(evaluating.comparison_scenarios(participant)),  # never one that was rated blindly
        )
        .order_by(after.model_id.desc(), after.success.desc(), after.scenario)
        .limit(1)
    ).first()
    return None if row is None else BeforeAndAfter(*row)


def learned(session: Session, participant: Participant) -> Learned | None:
    """What the newest filter learned; None while there is none, or nothing was measured."""
    row = session.execute(
        select(Model, Bundle)
        .outerjoin(Bundle, Bundle.model_id == Model.id)
        .where(Model.participant_id == participant.id, Model.kind == ModelKind.FILTER)
        .order_by(Model.label_count.desc(), Model.id.desc())
        .limit(1)
    ).first()
    if row is None:
        return None
    version = results.filter_version(*row)
    if version.scenarios is None or not version.costs:
        return None
    lessons = [_lesson(cost) for cost in version.costs]
    certain = sorted((lesson for lesson in lessons if lesson is not None), key=lambda lesson: -lesson.percent)
    return Learned(version.scenarios, certain[:MOST_LESSONS])


def _lesson(change: results.Change) -> Lesson | None:
    """None when the interval allows no difference, or when it is too small to be seen."""
    if change.low <= 0 <= change.high or not change.reference:
        return None
    percent = round(100 * abs(change.delta) / abs(change.reference))
    return Lesson(change.symbol, change.delta > 0, percent) if percent >= 1 else None
