"""People whose wishes are no sums of signals: what an episode is worth to them, and how they answer."""

import numpy as np
import pytest

from tests.benchmarks.nonlinear_filters import who_serves_whom
from tests.benchmarks.nonlinear_people import (
    ON_TIME_S,
    PEOPLE,
    Person,
    as_type,
    nearer_by_nearer,
    on_time,
    worst_moment,
)
from tests.benchmarks.rivals_report import gains_text
from tests.worker import invented
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.teachers import Manner, User

TASK = invented.TASK
STEPS = 60


def episode(seed: int = 0, **columns: FloatArray) -> Trajectory:
    """An invented one in which these signals are what the test is about, and the six costs are 0."""
    rng = np.random.default_rng(seed)
    signals = np.zeros((STEPS, len(SIGNALS)))
    for name, values in columns.items():
        signals[:, SIGNALS.index(name)] = values
    return invented.trajectory(rng, steps=STEPS, signals=signals, costs=np.zeros((STEPS, 6)))


def arriving(step: int) -> Trajectory:
    return episode(distance_m=np.where(np.arange(STEPS) < step, 0.4, 0.05))


def test_a_worst_moment_costs_once_however_long_the_rest_is_calm() -> None:
    jerk, calm = np.where(np.arange(STEPS) == 20, 0.5, 0.1), np.full(STEPS, 0.1)
    worth = [worst_moment(TASK, episode(speed_m_s=speed)) for speed in (jerk, calm)]
    assert worth[1].sum() - worth[0].sum() == pytest.approx(30.0 * 0.4)
    assert worth[1][:20].sum() == pytest.approx(worth[0][:20].sum()), "a clip that ends before it is worth the same"


@pytest.mark.parametrize("step", [20, 30, 45])
def test_arriving_costs_by_the_seconds_before_or_after_the_wished_time(step: int) -> None:
    worth = on_time(TASK, arriving(step)).sum()
    seconds_off = abs((step + 1) / 10 - ON_TIME_S[TASK.name])
    assert worth == pytest.approx(-4.0 * seconds_off, abs=0.45), "to a control step"


def test_turning_is_liked_far_away_and_minded_near() -> None:
    turning = np.full(STEPS, 1.0)
    far, near = (
        episode(distance_m=np.full(STEPS, metres), turn_speed_squared_rad2_s2=turning) for metres in (0.5, 0.02)
    )
    assert nearer_by_nearer(TASK, far).sum() > 0.0 > nearer_by_nearer(TASK, near).sum()


@pytest.mark.parametrize("person", PEOPLE.values(), ids=PEOPLE)
def test_whole_episodes_and_clips_of_everybody_are_judged_alike(person: Person) -> None:
    """The beginning of an episode is worth the same whatever comes after it."""
    whole = invented.trajectory(np.random.default_rng(1), steps=STEPS)
    cut = invented.trajectory(
        np.random.default_rng(1), steps=STEPS, signals=np.where(np.arange(STEPS)[:, None] < 30, whole.signals, 9.0)
    )
    np.testing.assert_allclose(person.wishes(TASK, whole)[:30], person.wishes(TASK, cut)[:30])


def test_somebody_who_drifts_answers_as_they_feel_by_then() -> None:
    slow = as_type(User.CAUTIOUS)
    drifting = Person(
        "turning",
        slow,
        wished_first=lambda task, each: -slow(task, each),
        manner=Manner(mistakes=0.0, equal_share=0.0),
    )
    clips = [invented.trajectory(np.random.default_rng(seed), steps=STEPS) for seed in (1, 2)]
    pairs = np.array([[0, 1]])
    says = drifting.answering(TASK, clips, pairs, STEPS, answers=11)
    first, last = (says(pairs, before, np.random.default_rng(0))[0] for before in (0, 10))
    assert {first, last} == {"left", "right"}


def test_somebody_who_tires_errs_more_and_more() -> None:
    errs = [PEOPLE["tiring"].manner_at(share).mistakes for share in (0.0, 0.5, 1.0)]
    assert errs == pytest.approx([0.05, 0.225, 0.4])


def test_everybodys_own_filter_is_set_beside_the_one_of_all_others_that_serves_them_best() -> None:
    """Of the same task, seed and method; a filter that was judged by few wishes says nothing of the others."""
    gained = {
        ("tired", "quick"): {"tired": [0.1, 0.2], "wide": [0.3, 0.5]},
        ("wide", "quick"): {"tired": [0.2, 0.2], "wide": [0.5, 0.5]},
        ("old", "quick"): {"old": [0.9, 0.9]},
        ("wide", "refined"): {"tired": [0.9, 0.9], "wide": [0.9, 0.9]},
    }
    names = ("tired", "wide", "old")
    rows = {
        (0, "feeding", person, method): {f"gains_{each}": gains_text(np.array(by.get(each, []))) for each in names}
        for (person, method), by in gained.items()
    }
    table = who_serves_whom(rows, "quick").splitlines()[2:]
    assert table == [
        "| feeding | 0 | tired | +15.0 | +20.0 | wide | -5.0 [-14.8, +4.8] |",
        "| feeding | 0 | wide | +50.0 | +40.0 | tired | +10.0 [-9.6, +29.6] |",
    ]
