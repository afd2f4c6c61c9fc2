"""What a participant is shown of their own robot: before and after in one scenario, and what it learned."""

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session, aliased

from app.domain.evaluation import Film
from app.domain.models import Bundle, Model, ModelKind
from app.domain.protocol import EvaluatedMethod
from app.domain.studies import Participant
from app.services.evaluation import evaluation_plan
from app.services.runs import model_metrics

MOST_LESSONS = 4
"""More would not be read."""
MOST_PERCENT = 100
NOTICED_PERCENT = 5
"""Of what it was before: smaller differences of speed or force are hardly noticed, however certain they are."""
_MUCH = {"C_f": 10.0, "C_hf": 10.0, "C_fd": 1.0}
"""From which difference on more than double is called much, per episode: newtons summed over control steps of .1 s,
pieces. Less is a little more, of next to nothing. Where a symbol is not in here, more than double is always much."""
_LITTLE = "little"
_TOGETHER = {
    ("less", "more"): "pace-quicker",
    ("more", "less"): "pace-calmer",
    ("less", "less"): "pace-less-motion",
    ("more", "more"): "pace-more-motion",
}
"""Distance from the person and motion, C_d and C_v, both changed: one sentence, for two would seem to contradict each
other. C_v adds up to the way gone, so whoever moves more may still be longer away from the person."""


@dataclass(frozen=True)
class BeforeAndAfter:
    """Two films of one scenario."""

    before: Film
    after: Film


@dataclass(frozen=True)
class Lesson:
    """One thing that the person's robot does otherwise than before, beyond chance and enough to be noticed."""

    words: str
    """Names the sentence among the texts of participants: debrief-..."""
    percent: int
    """By how much, of what it was before."""


@dataclass(frozen=True)
class Learned:
    """What the newest filter does otherwise, over so many scenarios it had not met."""

    scenarios: int
    lessons: Sequence[Lesson]
    is_reference: bool
    """Nothing was surely better for the person, so theirs is the robot that everybody meets."""


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
            before.scenario.in_(evaluation_plan.comparison_scenarios(participant)),  # never one that was rated blindly
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
    version = model_metrics.filter_version(*row)
    costs = [each for each in version.costs if each.symbol in model_metrics.COST_SYMBOLS]
    if version.scenarios is None or not costs:
        return None
    return Learned(version.scenarios, lessons_of(costs)[:MOST_LESSONS], version.uses_reference)


def lessons_of(changes: Sequence[model_metrics.Change]) -> Sequence[Lesson]:
    """What is to be said of measured changes of the six costs, the largest first, little ones last; none contradict."""
    noticed = {change.symbol: _percent(change) for change in changes if _is_noticed(change)}
    more = {change.symbol: change.delta > 0 for change in changes}
    how = {change.symbol: _how(change) for change in changes}
    lessons = []
    if {"C_d", "C_v"} <= noticed.keys():
        distance, motion = ("more" if more[symbol] else "less" for symbol in ("C_d", "C_v"))
        noticed.pop("C_d")
        lessons.append(Lesson(_TOGETHER[distance, motion], noticed.pop("C_v")))
    lessons += [Lesson(f"{symbol}-{how[symbol]}", percent) for symbol, percent in noticed.items()]
    return sorted(lessons, key=lambda lesson: (lesson.words.endswith(_LITTLE), -lesson.percent))


def _is_noticed(change: model_metrics.Change) -> bool:
    """Whether the interval allows no other direction, and the difference is large enough to be seen or felt."""
    certain = change.low > 0 or change.high < 0
    return certain and bool(change.reference) and _percent(change) >= NOTICED_PERCENT


def _percent(change: model_metrics.Change) -> int:
    return round(100 * abs(change.delta) / abs(change.reference)) if change.reference else 0


def _how(change: model_metrics.Change) -> str:
    """less, more, or, since a percentage above 100 would only frighten, much or a little."""
    if change.delta <= 0:
        return "less"
    if _percent(change) <= MOST_PERCENT:
        return "more"
    return "much" if change.delta >= _MUCH.get(change.symbol, 0.0) else _LITTLE
