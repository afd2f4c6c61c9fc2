"""Whether, when and in which order somebody is offered hints, and which of them go together."""

import random
from collections.abc import Collection, Sequence

from sqlalchemy.orm import Session

from app.domain.hints import newest_hints
from app.domain.studies import Participant, Study
from app.installed_tasks import hints

SEEN_FIRST = 3
"""Pairs that somebody has answered at least: nobody knows before what a robot may do otherwise."""


def asks(study: Study) -> bool:
    """Whether participants are asked for hints: the study wants it, and its task has some."""
    return study.settings.asks_for_hints and study.material is None and bool(hints.of_task(study.task))


def are_due(session: Session, participant: Participant, answered: int) -> bool:
    """Once, when the introduction was seen, and until something was said, were it that nothing is special."""
    study = participant.study
    if not asks(study) or answered < max(study.settings.introduction_count, SEEN_FIRST):
        return False
    return newest_hints(session, participant.id) is None


def offered(participant: Participant) -> Sequence[str]:
    """Names of what can be hinted at, in an order of this person's own: the first of a list is taken more often."""
    names = list(hints.of_task(participant.study.task))
    random.Random(f"hints {participant.seed}").shuffle(names)  # noqa: S311 -- an order, no secret
    return names


def problem_of(participant: Participant, given: Collection[str]) -> str | None:
    """What a person has to change first, by the name of its words: "too-many", "contradicting"."""
    known = [name for name in hints.of_task(participant.study.task) if name in given]
    if len(known) > hints.MOST:
        return "too-many"
    return "contradicting" if hints.contradicting(participant.study.task, known) else None
