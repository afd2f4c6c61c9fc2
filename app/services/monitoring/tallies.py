"""What is counted from each participant's answers and models, remembered until there are more of them.

Answers, words about them, and models are only ever added, or erased with the person: how many there are, and the
newest of them, tell whether what was counted still holds. Reading 20 000 answers takes half a second, finding out who
has new ones 15 ms; so what was read is kept, and only what is new is read.
"""

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from threading import Lock
from typing import NamedTuple

from sqlalchemy import case, func, select
from sqlalchemy.orm import Session

from app.domain.models import Bundle, Model, ModelKind
from app.domain.preferences import LEARNED_FROM, Exclusion, LabelEvent, Query, Response
from app.services.answers import accuracy, stopping_advice
from app.services.answers.accuracy import Predicted
from app.services.answers.misfit import Misfit, misfit_of
from app.services.answers.stopping_advice import Advice
from app.services.monitoring import participant_status
from app.services.monitoring.participant_status import GivenAnswer
from app.services.runs import model_metrics

MOST_REMEMBERED = 300
"""People whose answers are kept in memory, about 100 kB each."""
MOST_NEWS = 10
"""Answers of one person that are read one by one; of more, all of theirs are read."""
AT_ONCE = 10
"""People that are counted between two rests."""
REST = 4.0
"""Times as long as that took of a processor."""


class Watermark(NamedTuple):
    """How many rows of each kind somebody has, and the newest of them."""

    answers: tuple[int, int] = (0, 0)
    exclusions: tuple[int, int] = (0, 0)
    models: tuple[int, int] = (0, 0)
    bundles: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Tally:
    """One participant in numbers. Depends on nothing but their own answers and models, or it could not be kept."""

    answered: int
    counts: dict[Response, int]
    """Labels by kind."""
    curve: accuracy.Curve
    newest_filter: model_metrics.FilterVersion | None
    watched: participant_status.Watched


@dataclass(frozen=True)
class _Known:
    """What was counted for one participant, and what from."""

    mark: Watermark
    given: Mapping[int, GivenAnswer] | None
    """By the query's id, in the order of the queries; None: forgotten"""
    advice: Advice | None
    misfit: Misfit | None
    tally: Tally


class Tallies:
    """Counts for whoever asks, and again only for those who have gone on since. One per database; any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._known: dict[int, _Known] = {}
        self._rest = 0.0

    def unhurried(self) -> "Tallies":
        """The same counts, for whoever can wait: made in small portions, so that others get on meanwhile."""
        unhurried = copy(self)
        unhurried._rest = REST
        return unhurried

    def of(self, session: Session, participant_ids: Sequence[int]) -> dict[int, Tally]:
        """The tally of each of these participants."""
        marks = _marks(session, participant_ids)
        with self._lock:
            known = {each: self._known[each] for each in participant_ids if each in self._known}
        stale = [each for each in participant_ids if each not in known or known[each].mark != marks[each]]
        portion = AT_ONCE if self._rest else max(1, len(stale))
        for first in range(0, len(stale), portion):
            started_s = time.thread_time()
            fresh = _count(session, {each: marks[each] for each in stale[first : first + portion]}, known)
            known |= fresh
            with self._lock:
                self._keep(fresh)
            time.sleep(self._rest * (time.thread_time() - started_s))
        return {each: known[each].tally for each in participant_ids}

    def _keep(self, fresh: Mapping[int, _Known]) -> None:
        """The answers themselves of those only who went on last: of everybody in every study they would be too many."""
        for each, known in fresh.items():
            self._known.pop(each, None)
            self._known[each] = known  # at the end
        remembered = [each for each, known in self._known.items() if known.given is not None]
        for each in remembered[:-MOST_REMEMBERED]:
            self._known[each] = replace(self._known[each], given=None)


def _marks(session: Session, participant_ids: Sequence[int]) -> dict[int, Watermark]:
    words = select(Query.participant_id, func.count(), func.max(Exclusion.id))
    counted = {
        "answers": select(Query.participant_id, func.count(), func.max(LabelEvent.id)).join(LabelEvent),
        "exclusions": words.join(LabelEvent, LabelEvent.query_id == Query.id).join(Exclusion),
        "models": select(Model.participant_id, func.count(), func.max(Model.id)),
        "bundles": select(Bundle.participant_id, func.count(), func.max(Bundle.id)),
    }
    marks: dict[int, dict[str, tuple[int, int]]] = {each: {} for each in participant_ids}
    for name, statement in counted.items():
        whose = statement.selected_columns[0]
        for each, count, newest in session.execute(statement.where(whose.in_(participant_ids)).group_by(whose)):
            marks[each][name] = count, newest
    return {each: Watermark(**mark) for each, mark in marks.items()}


def _count(session: Session, marks: Mapping[int, Watermark], known: Mapping[int, _Known]) -> Mapping[int, _Known]:
    given = _given(session, marks, known)
    trained = [each for each in marks if each not in known or known[each].mark.models != marks[each].models]
    models = participant_status.reward_models(session, trained)
    advice = {each: stopping_advice.advice_of(models[each]) if each in models else known[each].advice for each in marks}
    misfit = {each: misfit_of(models[each]) if each in models else known[each].misfit for each in marks}
    published = {each for each in marks if each in models or known[each].mark.bundles != marks[each].bundles}
    filters = _newest_filters(session, list(published))
    return {
        each: _Known(
            mark,
            given[each],
            advice[each],
            misfit[each],
            _tally(
                list(given[each].values()),
                advice[each],
                misfit[each],
                filters.get(each) if each in published else known[each].tally.newest_filter,
            ),
        )
        for each, mark in marks.items()
    }


def _given(
    session: Session, marks: Mapping[int, Watermark], known: Mapping[int, _Known]
) -> Mapping[int, Mapping[int, GivenAnswer]]:
    """Everybody's answers, of which only those are read that are about queries with news.

    All of somebody's are read where an answer was left out or taken in again, rows have gone, or most is news.
    """
    unchanged = (each for each in marks if each in known and known[each].mark.exclusions == marks[each].exclusions)
    remembered = {each: given for each in unchanged if (given := known[each].given) is not None}
    told = _told_since(session, {each: known[each].mark.answers[1] for each in remembered})
    changed = {
        each: set(told[each])
        for each in remembered
        if marks[each].answers[0] == known[each].mark.answers[0] + len(told[each]) and len(told[each]) <= MOST_NEWS
    }
    answers = participant_status.answers_given(session, [each for each in marks if each not in changed])
    news = participant_status.answers_given(
        session, list(changed), [query for each in changed.values() for query in each]
    )
    for each, queries in changed.items():
        kept = [answer for query_id, answer in remembered[each].items() if query_id not in queries]
        answers[each] = sorted((*kept, *news[each]), key=_ordinal)
    return {each: {answer.answer.query_id: answer for answer in answers[each]} for each in marks}


def _told_since(session: Session, newest: Mapping[int, int]) -> Mapping[int, Sequence[int]]:
    """The queries about which somebody said something after their newest event known, once for each event."""
    told = defaultdict[int, list[int]](list)
    if newest:
        since = case(dict(newest), value=Query.participant_id)
        events = select(Query.participant_id, LabelEvent.query_id).join(LabelEvent, LabelEvent.query_id == Query.id)
        for each, query_id in session.execute(events.where(Query.participant_id.in_(newest), LabelEvent.id > since)):
            told[each].append(query_id)
    return told


def _ordinal(given: GivenAnswer) -> int:
    return given.answer.ordinal


def _tally(
    given: Sequence[GivenAnswer],
    advice: Advice | None,
    misfit: Misfit | None,
    newest_filter: model_metrics.FilterVersion | None,
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
        watched=participant_status.judged(given, advice, misfit),
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
