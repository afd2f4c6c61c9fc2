"""Naming one's own robot is tested against chance, and the test keeps its word in small studies."""

import numpy as np
import pytest
from scipy import stats

from worker.analysis.study.guesses import guess_report


def guesses(right: int, people: int) -> list[dict[str, object]]:
    return [{"participant": f"P{number}", "right": number < right} for number in range(people)]


def test_a_study_of_eight_as_by_hand() -> None:
    found = guess_report(guesses(6, 8), 3)
    tail = sum(stats.binom.pmf(k, 8, 1 / 3) for k in (6, 7, 8))
    assert (found["people"], found["right"], found["share"]) == (8, 6, 0.75)
    assert found["p"] == pytest.approx(tail, abs=1e-9), "no outcome below is as unlikely as six of eight"
    assert found["low"] == pytest.approx(stats.beta.ppf(0.025, 6, 3))
    assert found["high"] == pytest.approx(stats.beta.ppf(0.975, 7, 2))


@pytest.mark.parametrize("people", [8, 16, 24])
@pytest.mark.parametrize("robots", [2, 3, 4])
def test_where_people_guess_it_errs_in_at_most_one_study_of_twenty(people: int, robots: int) -> None:
    """Not simulated: every outcome with its probability."""
    counts = range(people + 1)
    found = [guess_report(guesses(right, people), robots) for right in counts]
    chance = stats.binom.pmf(counts, people, 1 / robots)
    assert sum(chance[right] for right in counts if found[right]["p"] < 0.05) <= 0.05
    for truth in np.linspace(0.05, 0.95, 19):
        covered = [each["low"] <= truth <= each["high"] for each in found]
        assert stats.binom.pmf(counts, people, truth) @ covered >= 0.95


def test_while_blinded_and_while_nobody_has_said_there_is_no_number() -> None:
    for rows in ([], [{"participant": "P01", "right": None}]):
        found = guess_report(rows, 3)
        assert found["chance"] == pytest.approx(1 / 3)
        assert [found[name] for name in ("right", "share", "low", "high", "p")] == [None] * 5
