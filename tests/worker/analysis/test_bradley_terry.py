"""Bradley-Terry strengths against published and hand-computed values, and intervals that count people."""

from typing import Any

import numpy as np
import pytest

from worker.analysis.study.bradley_terry import error_of, head_to_head_report, strengths
from worker.analysis.wilson import wilson_interval


def answers(person: str, left: str, right: str, *said: str) -> list[dict[str, Any]]:
    return [{"participant": person, "left": left, "right": right, "response": each} for each in said]


def test_baseball_as_agresti_publishes_it() -> None:
    """American League East 1987: Agresti, Categorical Data Analysis (1990), section 10.6; Baltimore is zero."""
    wins = np.array(
        [
            [0, 7, 9, 7, 7, 9, 11],
            [6, 0, 7, 5, 11, 9, 9],
            [4, 6, 0, 7, 7, 8, 12],
            [6, 8, 6, 0, 6, 7, 10],
            [6, 2, 6, 7, 0, 7, 12],
            [4, 4, 5, 6, 6, 0, 6],
            [2, 4, 1, 3, 1, 7, 0],
        ],
        float,
    )
    found = strengths(wins)
    assert (found - found[-1]).round(2).tolist() == [1.58, 1.44, 1.29, 1.25, 1.11, 0.68, 0.0]


def test_two_methods_by_hand() -> None:
    """18 of 24 is a log odds of log 3; people of 3, 3, 3 and 0 wins, variance 4/3 of sum (w - n p)^2 / (n p q)^2."""
    rows = [row for person in range(6) for row in answers(str(person), "a", "b", *["left"] * 3, "right")]
    report = head_to_head_report(rows, ["a", "b"])
    assert report["comparisons"][0]["difference"] == pytest.approx(-np.log(3))
    assert report["wins"] == [[0, 18], [6, 0]]
    wins = np.array([[[0, w], [4 - w, 0]] for w in (4, 4, 4, 2, 2, 2)], float)
    found = strengths(wins.sum(axis=0))
    information, scores = 24 * 0.75 * 0.25, 6 * 1.0
    error, degrees_of_freedom = error_of(wins, found, np.array([-1.0, 1.0])) or (0.0, 0.0)
    assert error**2 == pytest.approx(6 / 5 * scores / information**2)
    assert degrees_of_freedom == pytest.approx(5)


def test_in_arms_only_those_count_who_tell_about_the_two_methods() -> None:
    """Arms of a with b and of b with c: a with b rests on four people, a with c on the four and the six."""
    rows = [row for p in range(4) for row in answers(f"x{p}", "a", "b", "left", "left" if p else "right", "right")]
    rows += [row for p in range(6) for row in answers(f"y{p}", "b", "c", "left", "left" if p % 2 else "right", "right")]
    by_pair = {(e["first"], e["second"]): e for e in head_to_head_report(rows, ["a", "b", "c"])["comparisons"]}
    alone = head_to_head_report([e for e in rows if e["participant"][0] == "x"], ["a", "b"])["comparisons"][0]
    for name in ("difference", "low", "high", "p"):
        assert by_pair["a", "b"][name] == pytest.approx(alone[name])
    assert by_pair["a", "b"]["degrees_of_freedom"] == pytest.approx(3)
    assert by_pair["b", "c"]["degrees_of_freedom"] == pytest.approx(5)
    assert by_pair["a", "c"]["degrees_of_freedom"] > by_pair["a", "b"]["degrees_of_freedom"]


@pytest.mark.parametrize("people", [1, 2])
def test_a_comparison_that_too_few_people_made_has_no_p(people: int) -> None:
    rows = [row for p in range(people) for row in answers(f"x{p}", "a", "b", "left", *["left"] * p, "right")]
    rows += [row for p in range(8) for row in answers(f"y{p}", "b", "c", "left", "left" if p % 2 else "right", "right")]
    by_pair = {(e["first"], e["second"]): e for e in head_to_head_report(rows, ["a", "b", "c"])["comparisons"]}
    assert by_pair["a", "b"]["p"] is by_pair["a", "b"]["low"] is by_pair["a", "c"]["p"] is None
    assert by_pair["b", "c"]["p"] is not None


def test_an_equal_is_half_a_win_and_sides_do_not_matter() -> None:
    one = [row for p in "wxyz" for row in answers(p, "a", "b", "left", "equal")]
    other = [row for p in "wxyz" for row in answers(p, "b", "a", "right", "equal")]
    first, second = (head_to_head_report(rows, ["a", "b"]) for rows in (one, other))
    assert first["wins"] == second["wins"] == [[0, 6], [2, 0]]
    assert first["comparisons"] == second["comparisons"]


def test_where_all_answered_alike_no_strength_has_an_interval_and_people_are_counted() -> None:
    """Five people of one opinion: 1 in 16 by chance, two-sided."""
    rows = [row for p in "vwxyz" for row in answers(p, "a", "b", "left", "left", "right")]
    report = head_to_head_report(rows, ["a", "b"])
    assert [each["low"] for each in report["strengths"]] == [None, None]
    found = report["comparisons"][0]
    assert (found["test"], found["p"], found["low"]) == ("wilcoxon", pytest.approx(1 / 16), None)
    assert found["chance"] == pytest.approx(1 / 3)
    assert (found["chance_low"], found["chance_high"]) == pytest.approx(wilson_interval(5 / 3, 5))


def test_a_robot_that_everybody_prefers_is_found_although_no_strength_fits() -> None:
    """Eight people prefer c to the two others always, and a to b as often as not."""
    rows = []
    for person in "stuvwxyz":
        rows += answers(person, "c", "a", "left", "left") + answers(person, "b", "c", "right", "right")
        rows += answers(person, "a", "b", "left" if person < "w" else "right", "equal")
    report = head_to_head_report(rows, ["a", "b", "c"])
    assert "always preferred" in report["not_computable"]
    by_pair = {(e["first"], e["second"]): e for e in report["comparisons"]}
    assert by_pair["a", "c"]["p"] == by_pair["b", "c"]["p"] == pytest.approx(2 / 2**8)
    assert by_pair["a", "c"]["p_holm"] == pytest.approx(3 * 2 / 2**8)
    assert by_pair["a", "c"]["chance"] == 1
    assert by_pair["a", "c"]["chance_low"] == pytest.approx(wilson_interval(8, 8)[0])
    assert by_pair["a", "b"]["p"] == 1
    assert by_pair["a", "b"]["difference"] is None


def test_who_sees_no_difference_at_all_is_no_evidence() -> None:
    rows = [row for p in "uvwxyz" for row in answers(p, "a", "b", "equal", "equal")]
    assert head_to_head_report(rows, ["a", "b"])["comparisons"][0]["p"] is None


def test_the_same_answers_from_fewer_people_say_less() -> None:
    many = [row for p in range(24) for row in answers(str(p), "a", "b", "left" if p % 3 else "right")]
    few = [row for p in range(8) for row in answers(str(p), "a", "b", *["left" if p % 3 else "right"] * 3)]
    wide, narrow = (head_to_head_report(rows, ["a", "b"])["comparisons"][0] for rows in (few, many))
    assert wide["p"] > narrow["p"]


def test_what_cannot_be_estimated_is_said() -> None:
    always = [row for p in "uvwxyz" for row in answers(p, "a", "b", "left")]
    assert "always preferred" in head_to_head_report(always, ["a", "b"])["not_computable"]
    few = head_to_head_report(always[:2], ["a", "b"])
    assert "4 are needed" in few["not_computable"]
    assert "comparisons" not in few
    assert head_to_head_report([], ["a", "b"])["answers"] == 0
