"""Scripted teachers answer as their taste and their manner say."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from worker.ml.teachers import OMEGA, Manner, ScriptedTeacher, User

FAULTLESS = Manner(mistakes=0.0, equal_share=0.0)
POOL = np.random.default_rng(0).standard_normal((400, 2, 10))


def answers(manner: Manner, scale: float = 1.0) -> list[str]:
    """What a teacher of this manner says about the pool, with rewards in other units."""
    teacher = ScriptedTeacher.calibrated(manner, scale * POOL)
    rng = np.random.default_rng(1)
    return [teacher.answer(left, right, rng) for left, right in scale * POOL]


def share_right(said: list[str]) -> float:
    """How often the better side was named."""
    better = POOL.sum(-1)[:, 1] > POOL.sum(-1)[:, 0]
    return float(np.mean([(each == "right") == wanted for each, wanted in zip(said, better, strict=True)]))


def test_a_faultless_teacher_always_names_the_larger_return() -> None:
    assert share_right(answers(FAULTLESS)) == 1.0


def test_mistakes_are_as_frequent_as_said() -> None:
    assert share_right(answers(replace(FAULTLESS, mistakes=0.2))) == pytest.approx(0.8, abs=0.06)


def test_the_asked_share_of_pairs_is_called_equal_and_they_are_the_closest_ones() -> None:
    said = answers(replace(FAULTLESS, equal_share=0.25))
    difference = np.abs(np.diff(POOL.sum(-1))[:, 0])
    equal = np.array(said) == "equal"
    assert equal.mean() == pytest.approx(0.25, abs=0.01)
    assert difference[equal].max() <= difference[~equal].min()


def test_the_asked_share_is_skipped() -> None:
    assert Counter(answers(replace(FAULTLESS, skip_share=0.3)))["skip"] / 400 == pytest.approx(0.3, abs=0.07)


def test_a_less_rational_teacher_is_less_consistent() -> None:
    hardly, fairly, nearly = (share_right(answers(replace(FAULTLESS, rationality=beta))) for beta in (0.1, 1.0, 50.0))
    assert 0.4 < hardly < fairly < nearly
    assert nearly > 0.95


def test_a_myopic_teacher_looks_at_the_end() -> None:
    good_start = np.array([5.0, 0.0, 0.0, 0.0])
    good_end = np.array([0.0, 0.0, 0.0, 1.0])
    rng = np.random.default_rng(0)
    for myopia, expected in ((1.0, "left"), (0.5, "right")):
        teacher = ScriptedTeacher(replace(FAULTLESS, myopia=myopia), spread=1.0, equal_below=0.0)
        assert teacher.answer(good_start, good_end, rng) == expected


def test_the_unit_of_the_rewards_does_not_matter() -> None:
    manner = Manner(rationality=1.0, equal_share=0.1)
    assert answers(manner) == answers(manner, scale=1000.0)


def test_the_three_users_are_the_paper_s() -> None:
    assert OMEGA[User.NEUTRAL] == (1.0,) * 6
    assert OMEGA[User.CAUTIOUS] == (1.0, 2.0, 1.5, 2.5, 3.0, 2.0)
    assert OMEGA[User.IMPATIENT] == (2.0, 0.5, 0.75, 0.5, 1.5, 0.5)
