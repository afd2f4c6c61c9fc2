"""What was planned, and whether that was before the data.

The plan is the locked document's, never that of settings which may have been changed since.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.domain.evaluation import Rating, Trial
from app.domain.preferences import LabelEvent, Purpose, Query
from app.domain.protocol import PlannedTest
from app.domain.studies import Deviation, Participant, Study
from app.services.answers import exclusions
from app.services.studies import locking

TEST_NAMES: Mapping[str, str] = {
    PlannedTest.PAIRED_T: "Paired t",
    PlannedTest.MIXED_MODEL: "Linear mixed model",
    PlannedTest.CUMULATIVE_LINK: "Cumulative link mixed model",
    PlannedTest.WILCOXON: "Wilcoxon signed-rank",
    PlannedTest.EQUIVALENCE: "Equivalence, two one-sided paired t",
    PlannedTest.TWO_SAMPLE_T: "Two-sample t, as in the paper",
    PlannedTest.WELCH_T: "Welch t, between people",
    PlannedTest.PERMUTATION: "Permutation, between people",
    PlannedTest.CUMULATIVE_LINK_BETWEEN: "Cumulative link model, between people",
    PlannedTest.EQUIVALENCE_BETWEEN: "Equivalence, two one-sided Welch t, between people",
}


class PlanStanding(StrEnum):
    """What the study's times prove about its plan, the least first."""

    NOT_LOCKED = "not_locked"
    AFTER_UNBLINDING = "after_unblinding"
    AFTER_RATINGS = "after_ratings"
    BEFORE_RATINGS = "before_ratings"
    """Locked after the first answers to pairs, but before anybody had rated a robot."""
    BEFORE_DATA = "before_data"


_IN_WORDS = {
    PlanStanding.NOT_LOCKED: "The study was never locked, so nothing shows that its tests were chosen before the data: "
    "every test is exploratory.",
    PlanStanding.AFTER_UNBLINDING: "The study was locked after it had been unblinded, when results could be seen: "
    "every test is exploratory.",
    PlanStanding.AFTER_RATINGS: "The study was locked after the first ratings had come in: every test is exploratory.",
    PlanStanding.BEFORE_RATINGS: "Planned tests were locked after the first answers to pairs, and before the first "
    "rating.",
    PlanStanding.BEFORE_DATA: "Planned tests were locked before the first answer.",
}


@dataclass(frozen=True)
class LeftOut:
    """Answers that were excluded after locking, or taken in again, for one reason and on one side of unblinding."""

    excluded: bool
    reason: str
    """Empty for those taken in again."""
    after_unblinding: bool
    whose: Sequence[str]
    """The code of the person for every answer."""


@dataclass(frozen=True)
class Plan:
    """The tests of a study, and the times that tell what they are worth."""

    standing: PlanStanding
    named: Sequence[str]
    """Tests of the locked document; of a study that is not locked those of its settings."""
    added: Sequence[str]
    """Tests that the settings have gained since."""
    locked_at: datetime | None
    first_answer_at: datetime | None
    first_rating_at: datetime | None
    unblinded_at: datetime | None
    deviations: Sequence[Deviation]
    left_out: Sequence[LeftOut]

    @property
    def planned(self) -> Sequence[str]:
        """Tests that may be called planned: locked before anything that they test was there."""
        return self.named if self.standing in (PlanStanding.BEFORE_DATA, PlanStanding.BEFORE_RATINGS) else ()

    @property
    def in_words(self) -> str:
        """What a reader has to know about the plan."""
        parts = [_IN_WORDS[self.standing]]
        if self.added:
            names = ", ".join(TEST_NAMES[test] for test in self.added)
            parts.append(f"Named only after locking, and so not planned: {names}.")
        if self.deviations:
            after = sum(self.seen_before(each) for each in self.deviations)
            parts.append(
                f"Changes after locking: {len(self.deviations)}, of which {after} when there were ratings already."
            )
        if self.left_out:
            parts.append(self._left_out_in_words())
        return " ".join(parts)

    def seen_before(self, deviation: Deviation) -> bool:
        """Whether there were ratings when the study was changed."""
        return self.first_rating_at is not None and deviation.at >= self.first_rating_at

    def _left_out_in_words(self) -> str:
        count = sum(len(each.whose) for each in self.left_out)
        after = sum(len(each.whose) for each in self.left_out if each.after_unblinding)
        seen = f", of which {after} after unblinding" if self.unblinded_at is not None else ""
        return f"Answers excluded or taken in again after locking: {count}{seen}."


def plan_of(session: Session, study: Study) -> Plan:
    """Of a study as it stands."""
    people = select(Participant.id).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    answers = select(func.min(LabelEvent.created_at)).join(Query).where(Query.participant_id.in_(people))
    ratings = select(func.min(Rating.created_at)).join(Trial).where(Trial.participant_id.in_(people))
    first_answer_at = session.scalar(answers.where(Query.purpose != Purpose.PRACTICE))
    first_rating_at = session.scalar(ratings)
    now_named = [test.value for test in study.settings.planned_tests]
    locked = study.lock_document.get("planned_tests", []) if study.lock_document is not None else now_named
    return Plan(
        standing=_standing(study, first_answer_at, first_rating_at),
        named=[test for test in locked if test in TEST_NAMES],
        added=[test for test in now_named if test not in locked],
        locked_at=study.locked_at,
        first_answer_at=first_answer_at,
        first_rating_at=first_rating_at,
        unblinded_at=study.unblinded_at,
        deviations=locking.deviations(session, study),
        left_out=_left_out(session, study),
    )


def _left_out(session: Session, study: Study) -> Sequence[LeftOut]:
    """Since the study was locked, the first first."""
    if study.locked_at is None:
        return []
    whose: dict[tuple[bool, str, bool], list[str]] = {}
    for each in exclusions.changed_since(session, study, study.locked_at):
        after_unblinding = study.unblinded_at is not None and each.word.at >= study.unblinded_at
        same = (each.word.excluded, each.word.reason, after_unblinding)
        whose.setdefault(same, []).append(each.participant.code)
    return [LeftOut(*same, codes) for same, codes in whose.items()]


def _standing(study: Study, first_answer_at: datetime | None, first_rating_at: datetime | None) -> PlanStanding:
    if study.lock_document is None or study.locked_at is None:
        return PlanStanding.NOT_LOCKED
    moments = (
        (study.unblinded_at, PlanStanding.AFTER_UNBLINDING),
        (first_rating_at, PlanStanding.AFTER_RATINGS),
        (first_answer_at, PlanStanding.BEFORE_RATINGS),
    )
    for moment, standing in moments:
        if moment is not None and study.locked_at >= moment:
            return standing
    return PlanStanding.BEFORE_DATA
