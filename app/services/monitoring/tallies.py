"""What is counted from each participant's answers and models, remembered until there are more of them.

Answers, words about them, and models are only ever added, or erased with the person: how many there are, and the
newest of them, tell whether what was counted still holds. Judging 20 000 answers takes half a second, finding out who
has new ones 15 ms.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from app.domain.models import Bundle, Model, ModelKind
from app.domain.preferences import LEARNED_FROM, Exclusion, LabelEvent, Query, Response
from app.services.answers import accuracy
from app.services.answers.accuracy import Predicted
from app.services.monitoring import participant_status
from app.services.monitoring.participant_status import GivenAnswer
from app.services.runs import model_metrics

Watermark = tuple[int | None, ...]


@dataclass(frozen=True)
class Tally:
    """One participant in numbers. Depends on nothing but their own answers and models, or it could not be kept."""

    answered: int
    counts: dict[Response, int]
    """Labels by kind."""
    curve: accuracy.Curve
    newest_filter: model_metrics.FilterVersion | None
    watched: participant_status.Watched


class Tallies:
    """Counts for whoever asks, and again only for those who have gone on since. One per database; any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._known: dict[int, tuple[Watermark, Tally]] = {}

    def of(self, session: Session, participant_ids: Sequence[int]) -> dict[int, Tally]:
        """The tally of each of these participants."""
        marks = _marks(session, participant_ids)
        with self._lock:
            known = {each: self._known[each] for each in participant_ids if each in self._known}
        stale = [each for each in participant_ids if each not in known or known[each][0] != marks[each]]
        fresh = _count(session, stale) if stale else {}
        with self._lock:
            self._known |= {each: (marks[each], tally) for each, tally in fresh.items()}
        return {each: fresh[each] if each in fresh else known[each][1] for each in participant_ids}


def _marks(session: Session, participant_ids: Sequence[int]) -> dict[int, Watermark]:
    marks: dict[int, Watermark] = dict.fromkeys(participant_ids, ())
    for whose, counted in (
        (Query.participant_id, select(Query.participant_id, func.count(), func.max(LabelEvent.id)).join(LabelEvent)),
        (Query.participant_id, _exclusions()),
        (Model.participant_id, select(Model.participant_id, func.count(), func.max(Model.id))),
        (Bundle.participant_id, select(Bundle.participant_id, func.count(), func.max(Bundle.id))),
    ):
        found = session.execute(counted.where(whose.in_(participant_ids)).group_by(whose))
        rows = {each: (count, newest) for each, count, newest in found}
        for each in participant_ids:
            marks[each] += rows.get(each, (0, None))
    return marks


def _exclusions() -> Select[int, int, int | None]:
    words = select(Query.participant_id, func.count(), func.max(Exclusion.id))
    return words.join(LabelEvent, LabelEvent.query_id == Query.id).join(Exclusion)


def _count(session: Session, participant_ids: Sequence[int]) -> dict[int, Tally]:
    given = participant_status.answers_given(session, participant_ids)
    models = participant_status.reward_models(session, participant_ids)
    filters = _newest_filters(session, participant_ids)
    return {each: _tally(given[each], models[each], filters.get(each)) for each in participant_ids}


def _tally(
    given: Sequence[GivenAnswer], models: Sequence[Model], newest_filter: model_metrics.FilterVersion | None
) -> Tally:
    labels = [each for each in given if each.answer.purpose in LEARNED_FROM]
    counting = [each for each in labels if not each.excluded]
    counts = dict.fromkeys(Response, 0)
    for label in labels:
        counts[label.answer.response] += 1
    return Tally(
        answered=len(labels),
        counts=counts,
        curve=accuracy.curve(
            accuracy.hits(
                Predicted(each.answer.response, each.predicted_right, each.drawn_at_random) for each in counting
            )
        ),
        newest_filter=newest_filter,
        watched=participant_status.judged(given, models),
    )


def _newest_filters(session: Session, participant_ids: Sequence[int]) -> dict[int, model_metrics.FilterVersion]:
    newest = (
        select(
            Model.id,
            func.row_number()
            .over(partition_by=Model.participant_id, order_by=(Model.label_count.desc(), Model.id.desc()))
            .label("place"),
        )
        .where(Model.participant_id.in_(participant_ids), Model.kind == ModelKind.FILTER)
        .subquery()
    )
    rows = session.execute(
        select(Model, Bundle)
        .join(newest, newest.c.id == Model.id)
        .outerjoin(Bundle, Bundle.model_id == Model.id)
        .where(newest.c.place == 1)
    )
    return {model.participant_id: model_metrics.filter_version(model, bundle) for model, bundle in rows}
