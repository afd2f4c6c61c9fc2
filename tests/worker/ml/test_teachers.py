"""Scripted teachers answer as their taste and their manner say."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from worker import cli
from worker.commands import rehearsing
from worker.ml.teachers import OMEGA, TASTES, Manner, ScriptedTeacher, Taste, User, random_taste, segment_returns

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


def test_at_rationality_1_a_typical_difference_is_seen_as_often_as_the_sigmoid_of_1_says() -> None:
    teacher = ScriptedTeacher(replace(FAULTLESS, rationality=1.0), spread=2.0, equal_below=0.0)
    rng = np.random.default_rng(0)
    said = [teacher.answer([0.0], [2.0], rng) for _ in range(4000)]
    assert said.count("right") / 4000 == pytest.approx(1 / (1 + np.exp(-1)), abs=0.02)


def test_myopia_discounts_by_how_long_ago_a_step_was() -> None:
    assert segment_returns(np.array([1.0, 1.0, 1.0]), 0.5) == pytest.approx(0.25 + 0.5 + 1.0)
    assert segment_returns(np.array([1.0, 1.0, 1.0])) == 3.0


def test_mistakes_also_befall_teachers_who_are_not_wholly_rational() -> None:
    sure = ScriptedTeacher(replace(FAULTLESS, rationality=50.0, mistakes=0.3), spread=1.0, equal_below=0.0)
    rng = np.random.default_rng(0)
    assert [sure.answer([0.0], [1.0], rng) for _ in range(2000)].count("left") / 2000 == pytest.approx(0.3, abs=0.03)


def test_answers_to_one_pair_do_not_depend_on_what_was_skipped_before() -> None:
    steady, skipping = (replace(FAULTLESS, rationality=1.0, skip_share=share) for share in (0.0, 0.4))
    pairs = zip(answers(steady), answers(skipping), strict=True)
    assert all(one == other for one, other in pairs if other != "skip")


def test_a_taste_of_one_s_own_is_named_after_its_weights() -> None:
    own = Taste.of_omega([1, 2, 1.5, 2.5, 3, 2])
    assert own == Taste("omega-1-2-1.5-2.5-3-2", (1, 2, 1.5, 2.5, 3, 2))


@pytest.mark.parametrize("omega", [(1.0,) * 5, (1.0,) * 5 + (float("nan"),)])
def test_weights_that_mean_nothing_are_refused(omega: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="6 finite weights"):
        Taste.of_omega(omega)


def test_a_cost_of_a_signal_that_is_not_measured_is_refused() -> None:
    with pytest.raises(ValueError, match="No signal is called noise"):
        Taste("quiet", per_signal={"noise": 1.0})


def test_the_paper_s_users_the_opposed_and_the_indirect_ones_go_by_name() -> None:
    opposed, indirect = {"slow", "quick", "close", "wide", "gentle", "brisk"}, {"steady", "upright", "tidy"}
    assert set(TASTES) == {"neutral", "cautious", "impatient"} | opposed | indirect
    assert TASTES["cautious"].omega == OMEGA[User.CAUTIOUS]


def test_people_of_the_population_differ_and_come_back_with_their_seed() -> None:
    first, again, other = (random_taste("somebody", np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first == again != other
    assert all(0.2 <= weight <= 5.0 for weight in first.omega)


def test_a_rehearsal_takes_names_and_weights_and_the_paper_s_three_when_nobody_is_named() -> None:
    def tastes(*words: str) -> list[str]:
        return [taste.name for taste in rehearsing._tastes(cli.parser().parse_args(["rehearse", *words]))]

    assert tastes() == ["neutral", "cautious", "impatient"]
    assert tastes("--users", "wide", "shy=1,3,2,2,1,1") == ["wide", "shy"]
    assert tastes("--omega", "1", "2", "1.5", "2.5", "3", "2") == ["omega-1-2-1.5-2.5-3-2"]
    assert tastes("--users", "slow", "--omega", *"111111") == ["slow", "omega-1-1-1-1-1-1"]


def test_a_rehearsal_can_use_any_reward_model_and_manner() -> None:
    words = "rehearse --reward preference_transformer --rationality 2 --myopia 0.9 --mistakes 0.1 --pooled-prior"
    options = cli.parser().parse_args(words.split())
    assert rehearsing._manner(options) == Manner(2.0, 0.9, 0.1, 0.10, 0.02)
    assert rehearsing.settings_of(options).reward_kind == "preference_transformer"
    assert rehearsing.settings_of(options).pooled_prior
