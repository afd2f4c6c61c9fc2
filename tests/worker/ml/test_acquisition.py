"""Which pairs are shown, with which probability, on which sides."""

import numpy as np
import pytest

from worker.ml.acquisition import (
    Choice,
    Strategy,
    balanced_sides,
    choose,
    contested,
    disagreement,
    entropy,
    expected_answers,
    information_gain,
    matched_pairs,
    score,
)

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


def test_what_was_drawn_at_random_is_marked_and_really_was() -> None:
    """Whoever measures a model on what it chose to ask measures it where it is worst."""
    rng = np.random.default_rng(5)
    draws = [choose(1, 20, rng, rule="disagreement", scores=SCORES, random_share=0.3) for _ in range(4000)]
    random = np.array([draw.indices[0] for draw in draws if draw.at_random[0]])
    assert len(random) == pytest.approx(0.3 * 4000, rel=0.1)
    counts = np.bincount(random, minlength=20)
    assert counts.min() > 0.5 * counts.mean(), "all candidates alike"
    assert choose(5, 20, rng).at_random.all()


def test_members_that_agree_do_not_disagree() -> None:
    scores = disagreement(np.array([[0.9, 0.1], [0.9, 0.9]]))
    assert scores[0] == 0.0 < scores[1]


SURE_AND_DIVIDED, ALL_UNSURE, AGREED = 0, 1, 2
MEMBERS = np.array([[0.99, 0.5, 0.95], [0.01, 0.5, 0.95], [0.98, 0.5, 0.96], [0.02, 0.5, 0.94]])
"""(E, 3) columns as named above"""


def test_information_gain_prefers_confident_disagreement_over_common_doubt_and_entropy_does_not() -> None:
    gain, doubt = information_gain(MEMBERS), entropy(MEMBERS)
    assert gain.argmax() == SURE_AND_DIVIDED
    assert gain[ALL_UNSURE] == pytest.approx(0.0, abs=1e-9)
    assert doubt[ALL_UNSURE] == pytest.approx(np.log(2))
    assert doubt[ALL_UNSURE] >= doubt[SURE_AND_DIVIDED] > doubt[AGREED]


def test_information_gain_is_never_negative_nor_more_than_the_entropy() -> None:
    members = np.random.default_rng(0).random((6, 100))
    assert (information_gain(members) > -1e-12).all()
    assert (information_gain(members) <= entropy(members)).all()


def test_contested_prefers_the_pair_that_others_disagree_about() -> None:
    assert contested(MEMBERS[:3]).argmax() == SURE_AND_DIVIDED
    assert contested(MEMBERS[:3])[ALL_UNSURE] == 0.0
    with pytest.raises(ValueError, match="Two"):
        contested(MEMBERS[:1])


def test_a_contested_pair_is_not_asked_again_once_this_person_s_answer_is_clear() -> None:
    others = np.array([[0.05, 0.1, 0.5], [0.95, 0.9, 0.5]])
    own = np.array([[0.01, 0.4, 0.5], [0.02, 0.6, 0.5]])
    assert contested(others).argmax() == 0
    assert contested(others, own).argmax() == 1


def test_stand_ins_answer_by_their_returns_whatever_their_unit() -> None:
    differences = np.array([[3.0, -1.0, 0.0], [3000.0, -1000.0, 0.0]])
    expected = expected_answers(differences)
    np.testing.assert_allclose(expected[0], expected[1])
    assert expected[0, 0] > 0.5 > expected[0, 1]
    assert expected[0, 2] == 0.5


RULES: tuple[Strategy, ...] = ("disagreement", "entropy", "information_gain")


@pytest.mark.parametrize("rule", RULES)
def test_every_rule_logs_chances_of_the_whole_and_keeps_its_random_share(rule: Strategy) -> None:
    members = np.random.default_rng(1).random((4, 6))
    chances: dict[int, float] = {}
    for seed in range(300):
        choice = choose(1, 6, np.random.default_rng(seed), rule=rule, scores=score(rule, members), random_share=0.6)
        chances[int(choice.indices[0])] = float(choice.propensities[0])
    assert sum(chances.values()) == pytest.approx(1.0)
    assert min(chances.values()) >= 0.6 / 6


def test_what_others_think_is_no_function_of_one_s_own_model() -> None:
    with pytest.raises(ValueError, match="alone"):
        score("contested", MEMBERS)


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


MADE = 3
"""So many pairs were made for the person; they stand after the twenty of the pool."""


@pytest.mark.parametrize("rule", ["uniform", "entropy"])
def test_with_a_share_that_follows_the_propensity_is_still_how_often_a_pair_is_drawn(rule: Strategy) -> None:
    def draw(seed: int) -> Choice:
        rng = np.random.default_rng(seed)
        return choose(1, 20, rng, rule=rule, scores=SCORES[::-1], random_share=0.3, made=MADE, following_share=0.4)

    draws = [draw(seed) for seed in range(3000)]
    first = np.array([each.indices[0] for each in draws])
    following, at_random = (np.array([getattr(each, name)[0] for each in draws]) for name in ("following", "at_random"))
    assert following.mean() == pytest.approx(0.4, abs=0.03)
    assert at_random.mean() == pytest.approx(0.6 if rule == "uniform" else 0.3, abs=0.03)
    np.testing.assert_array_equal(following, first >= 20, "what was made for the person is drawn as such, and only so")
    propensity = {int(each.indices[0]): float(each.propensities[0]) for each in draws}
    assert sum(propensity.values()) == pytest.approx(1.0)
    for pair in (0, 10, 19, 20, 22):
        assert np.mean(first == pair) == pytest.approx(propensity[pair], abs=0.03)


def test_as_long_as_nothing_was_made_the_rule_chooses_all_the_same() -> None:
    choice = choose(4, 4, np.random.default_rng(0), random_share=0.5, following_share=0.5)
    assert choice.at_random.all()
    np.testing.assert_allclose(choice.propensities, [1 / 4, 1 / 3, 1 / 2, 1])


def test_when_all_that_was_made_is_given_the_rule_chooses_the_rest() -> None:
    choice = choose(20, 20, np.random.default_rng(0), random_share=0.3, made=2, following_share=0.7)
    assert choice.following.sum() == 2
    assert len(set(choice.indices)) == 20
    before, last = np.flatnonzero(choice.following)
    left = 20 - (last - 1)  # of the pool, once the second one is drawn
    assert choice.propensities[before] == pytest.approx(0.7 / 2)
    assert choice.propensities[last] == pytest.approx(0.7)
    np.testing.assert_allclose(choice.propensities[last + 1 :], 1 / np.arange(left, left - (19 - last), -1))


def test_a_share_that_follows_leaves_the_random_one_alone() -> None:
    with pytest.raises(ValueError, match="following_share"):
        choose(1, 20, np.random.default_rng(0), random_share=0.3, following_share=0.8, made=MADE)
