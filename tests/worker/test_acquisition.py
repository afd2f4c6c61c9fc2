"""Which pairs are shown, with which probability, on which sides."""

import numpy as np
import pytest

from worker.ml.acquisition import balanced_sides, choose, disagreement, matched_pairs

SCORES = np.linspace(0.0, 1.0, 20)


def test_only_clips_of_one_scenario_are_paired() -> None:
    scenarios = [1, 1, 2, 2, 2]
    pairs = matched_pairs(scenarios)
    assert len(pairs) == 1 + 3
    assert all(scenarios[first] == scenarios[second] and first != second for first, second in pairs)


def test_clips_of_the_same_behaviour_are_not_paired_when_behaviours_are_known() -> None:
    assert matched_pairs([1, 1, 1], [0, 0, 5]).tolist() == [[0, 2], [1, 2]]


def test_no_pair_is_chosen_twice() -> None:
    choice = choose(20, 20, np.random.default_rng(0))
    assert sorted(choice.indices) == list(range(20))
    assert len(choose(50, 20, np.random.default_rng(0)).indices) == 20


def test_uniform_choice_logs_one_over_the_number_of_remaining_pairs() -> None:
    choice = choose(3, 10, np.random.default_rng(0))
    np.testing.assert_allclose(choice.propensities, [1 / 10, 1 / 9, 1 / 8])


def test_the_logged_propensity_is_how_often_the_pair_is_really_chosen_first() -> None:
    draws = [choose(1, 20, np.random.default_rng(seed), rule="disagreement", scores=SCORES) for seed in range(3000)]
    propensity = {int(draw.indices[0]): float(draw.propensities[0]) for draw in draws}
    for pair in (0, 19):
        frequency = np.mean([draw.indices[0] == pair for draw in draws])
        assert frequency == pytest.approx(propensity[pair], abs=0.02)


def test_disagreement_prefers_what_members_disagree_about_but_never_excludes_a_pair() -> None:
    rng = np.random.default_rng(0)
    draws = [choose(1, 20, rng, rule="disagreement", scores=SCORES, random_share=0.3) for _ in range(400)]
    assert np.mean([SCORES[draw.indices[0]] for draw in draws]) > 0.7
    assert min(float(draw.propensities[0]) for draw in draws) >= 0.3 / 20 - 1e-9


def test_members_that_agree_do_not_disagree() -> None:
    scores = disagreement(np.array([[0.9, 0.1], [0.9, 0.9]]))
    assert scores[0] == 0.0 < scores[1]


@pytest.mark.parametrize("random_share", [0.0, 1.2])
def test_a_choice_without_a_random_share_is_refused(random_share: float) -> None:
    with pytest.raises(ValueError, match="random"):
        choose(1, 5, np.random.default_rng(0), random_share=random_share)


def test_a_rule_that_needs_scores_says_so() -> None:
    with pytest.raises(ValueError, match="score"):
        choose(1, 5, np.random.default_rng(0), rule="disagreement")


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_sides_are_balanced(count: int) -> None:
    swapped = [int(balanced_sides(count, np.random.default_rng(seed)).sum()) for seed in range(30)]
    assert set(swapped) <= {count // 2, (count + 1) // 2}


def test_sides_are_in_no_fixed_order_and_repeatable() -> None:
    first, again, other = (balanced_sides(40, np.random.default_rng(seed)).tolist() for seed in (1, 1, 2))
    assert first == again != other
