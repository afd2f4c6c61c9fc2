"""How well a model foresees answers, and when that may be called better than guessing."""

from random import Random

import pytest

from app.domain.preferences import Response
from app.services.answers import accuracy
from app.services.answers.accuracy import (
    Foresight,
    Predicted,
    curve,
    evidence_against_a_fair_coin,
    evidence_against_guessing,
)

LEFT, RIGHT, EQUAL, SKIP = Response.LEFT, Response.RIGHT, Response.EQUAL, Response.SKIP


def hits(*said: tuple[Response, float | None]) -> list[float]:
    return accuracy.hits(Predicted(response, predicted, drawn_at_random=True) for response, predicted in said)


def test_a_prediction_of_exactly_one_half_is_half_right_whatever_is_said() -> None:
    assert hits((LEFT, 0.5), (RIGHT, 0.5)) == [0.5, 0.5]
    assert hits((LEFT, 0.49), (RIGHT, 0.49), (LEFT, 0.51), (RIGHT, 0.51)) == [1.0, 0.0, 0.0, 1.0]


def test_only_what_prefers_a_side_was_predicted_and_drawn_at_random_is_scored() -> None:
    assert hits((EQUAL, 0.9), (SKIP, 0.9), (LEFT, None)) == []
    assert accuracy.hits([Predicted(LEFT, 0.1, drawn_at_random=False)]) == []


def test_the_window_looks_at_the_newest_answers_only() -> None:
    found = curve([0.0] * 30 + [1.0] * 30)
    assert found.newest is not None
    assert found.overall is not None
    assert (found.newest.value, found.overall.value) == (1.0, 0.5)


def test_evidence_by_hand() -> None:
    """2 int_{1/2}^1 p dp / (1/2) = 3/2, and without an answer there is none for or against."""
    assert evidence_against_guessing(1, 1) == pytest.approx(1.5)
    assert evidence_against_guessing(0, 1) == pytest.approx(0.5)
    assert evidence_against_guessing(0, 0) == 1.0
    assert evidence_against_a_fair_coin(1, 1) == pytest.approx(1.0)
    assert evidence_against_a_fair_coin(2, 2) == pytest.approx(4 / 3)


def test_thousands_of_answers_are_no_problem() -> None:
    assert evidence_against_guessing(3000, 3000) == float("inf")
    assert evidence_against_a_fair_coin(0, 3000) == float("inf")
    assert evidence_against_guessing(0, 3000) == pytest.approx(1 / 3001)
    assert evidence_against_a_fair_coin(1500, 3000) < 1


@pytest.mark.parametrize("scored", [1, 5, 40])
def test_a_guess_leaves_the_evidence_as_it_is_in_the_mean(scored: int) -> None:
    """What makes looking often honest: after one more guess, right or wrong, it is expected to be what it was."""
    for correct in range(scored + 1):
        for evidence in (evidence_against_guessing, evidence_against_a_fair_coin):
            after = (evidence(correct, scored + 1) + evidence(correct + 1, scored + 1)) / 2
            assert after == pytest.approx(evidence(correct, scored))


def test_who_guesses_is_hardly_ever_called_better_however_often_one_looks() -> None:
    wrongly = 0
    for seed in range(300):
        random, found = Random(seed), list[float]()  # noqa: S311
        for _ in range(200):
            found.append(float(random.random() < 0.5))
            if accuracy.foresight(found) is Foresight.BETTER:
                wrongly += 1
                break
    assert wrongly / 300 <= 0.05 + 2 * (0.05 * 0.95 / 300) ** 0.5


@pytest.mark.parametrize(
    ("correct", "wrong", "halves", "said"),
    [
        (0, 0, 0, Foresight.UNKNOWN),
        (1, 6, 0, Foresight.GUESSING),  # 14 %
        (4, 2, 0, Foresight.UNKNOWN),
        (7, 0, 0, Foresight.BETTER),
        (12, 9, 0, Foresight.GUESSING),
        (0, 0, 20, Foresight.GUESSING),
        (70, 30, 0, Foresight.BETTER),
    ],
)
def test_what_is_said_of_a_model(correct: int, wrong: int, halves: int, said: Foresight) -> None:
    assert accuracy.foresight([1.0] * correct + [0.0] * wrong + [0.5] * halves) is said
