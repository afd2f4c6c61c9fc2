"""The order of a participant's pairs, and what practice and catch pairs show."""

from collections import Counter

import numpy as np
import pytest

from app.domain.preferences import Purpose
from app.domain.study_settings import StudySettings
from tests.worker import invented
from worker.domain.trajectory import SIGNALS
from worker.domain.type_aliases import Float32Array
from worker.jobs.learning import query_plan
from worker.ml.rewards.segments import SegmentPairs, Stretch

WHOLE_STUDY = StudySettings(
    labels_per_participant=200, practice_pairs=2, introduction_pairs=10, repeated_pairs=20, catch_pairs=5
)
DELIVERED_AT = 10


def stretch(*, success: bool, delivered: bool, spilled: float = 0.0, shown: int = 20) -> Stretch:
    """A run of 30 steps; only the first ones are shown."""
    signals: Float32Array = np.zeros((30, len(SIGNALS)), np.float32)
    signals[:, SIGNALS.index("undelivered")] = 1.0
    if delivered:
        signals[DELIVERED_AT:, SIGNALS.index("undelivered")] = 0.0
    signals[5, SIGNALS.index("spilled_on_person")] = spilled
    run = invented.trajectory(np.random.default_rng(1), steps=30, success=success, signals=signals)
    return Stretch(run, 0, shown)


def test_every_pair_that_was_asked_for_is_in_the_plan() -> None:
    plan = query_plan.plan(WHOLE_STUDY, seed=4)
    assert [slot.ordinal for slot in plan] == list(range(1, 2 + WHOLE_STUDY.question_count + 1))
    counts = Counter(slot.purpose for slot in plan)
    assert counts == {
        Purpose.PRACTICE: 2,
        Purpose.INTRODUCTION: 10,
        Purpose.PREFERENCE: 190,
        Purpose.REPEAT: 20,
        Purpose.CATCH: 5,
    }


def test_practice_comes_first_and_whole_trajectories_before_clips() -> None:
    purposes = [slot.purpose for slot in query_plan.plan(WHOLE_STUDY, seed=4)]
    assert purposes[:12] == [Purpose.PRACTICE] * 2 + [Purpose.INTRODUCTION] * 10
    assert not {Purpose.PRACTICE, Purpose.INTRODUCTION} & set(purposes[12:])


@pytest.mark.parametrize("seed", range(5))
def test_repeats_ask_different_earlier_labels_again_when_nobody_remembers(seed: int) -> None:
    plan = query_plan.plan(WHOLE_STUDY, seed)
    repeats = [slot for slot in plan if slot.purpose is Purpose.REPEAT]
    asked = [slot.repeats_ordinal or 0 for slot in repeats]
    assert len(set(asked)) == len(asked)
    assert all(plan[ordinal - 1].purpose is Purpose.PREFERENCE for ordinal in asked)
    assert min(slot.ordinal - ordinal for slot, ordinal in zip(repeats, asked, strict=True)) >= 10
    assert sum(slot.swapped for slot in repeats) == 10


def test_repeats_and_catch_pairs_are_spread_over_the_study() -> None:
    for purpose in (Purpose.REPEAT, Purpose.CATCH):
        places = [slot.ordinal for slot in query_plan.plan(WHOLE_STUDY, seed=4) if slot.purpose is purpose]
        assert max(places) - min(places) > 80


def test_the_plan_follows_from_the_seed_alone() -> None:
    assert query_plan.plan(WHOLE_STUDY, 4) == query_plan.plan(WHOLE_STUDY.model_copy(), 4)
    assert query_plan.plan(WHOLE_STUDY, 4) != query_plan.plan(WHOLE_STUDY, 5)


@pytest.mark.parametrize(
    "settings",
    [
        StudySettings(labels_per_participant=10, introduction_pairs=50, repeated_pairs=4, catch_pairs=2),
        StudySettings(labels_per_participant=10, repeated_pairs=30),
        StudySettings(labels_per_participant=10, introduction_pairs=9, repeated_pairs=100, catch_pairs=20),
    ],
)
def test_even_a_study_too_short_for_its_repeats_has_a_plan(settings: StudySettings) -> None:
    plan = query_plan.plan(settings, 1)
    assert len(plan) == settings.question_count
    for slot in plan:
        assert (slot.repeats_ordinal is not None) == (slot.purpose is Purpose.REPEAT)
        assert slot.repeats_ordinal is None or 0 < slot.repeats_ordinal < slot.ordinal


def test_a_run_that_fails_beside_a_clean_success_has_an_obvious_answer() -> None:
    clean, failed = stretch(success=True, delivered=True), stretch(success=False, delivered=False)
    assert query_plan.obvious_answer(clean, failed) == "left"
    assert query_plan.obvious_answer(failed, clean) == "right"


@pytest.mark.parametrize(
    "other",
    [
        stretch(success=True, delivered=True),
        stretch(success=True, delivered=False),  # slow, and somebody may like that
    ],
)
def test_two_runs_that_end_well_are_a_matter_of_taste(other: Stretch) -> None:
    assert query_plan.obvious_answer(stretch(success=True, delivered=True), other) is None


@pytest.mark.parametrize(
    "messy",
    [
        stretch(success=True, delivered=True, spilled=1.0),
        stretch(success=True, delivered=True, shown=DELIVERED_AT),  # the success is not in the clip
    ],
)
def test_only_a_success_that_is_clean_and_seen_is_obviously_better(messy: Stretch) -> None:
    assert query_plan.obvious_answer(messy, stretch(success=False, delivered=False)) is None


def test_practice_shows_the_pairs_that_differ_most() -> None:
    rng = np.random.default_rng(3)
    alike = invented.trajectory(rng)
    pairs = [(alike, alike)] * 19 + [(alike, invented.trajectory(rng))]
    assert query_plan.very_different(SegmentPairs.cut(pairs))[0] == 19
