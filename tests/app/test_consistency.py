"""How far a person's answers can be trusted, from the answers alone."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from scipy import stats

from app.domain.clips import Clip
from app.domain.preferences import Label, LabelEvent, Purpose, Query, Response
from app.services.answers import consistency
from app.services.answers.consistency import Consistency, JudgedAnswer

LEFT, RIGHT, EQUAL, SKIP = Response.LEFT, Response.RIGHT, Response.EQUAL, Response.SKIP
numbers = count(1)


def answer(response: Response = LEFT, **columns: object) -> JudgedAnswer:
    """One answer to a pair of clips of its own."""
    number = next(numbers)
    usual = JudgedAnswer(number, number, Purpose.PREFERENCE, response, 10 * number, 10 * number + 1)
    return replace(usual, **columns)  # type: ignore[arg-type]


def again(before: JudgedAnswer, response: Response, *, swapped: bool = False) -> JudgedAnswer:
    """The same pair asked again."""
    sides = (before.left_clip_id, before.right_clip_id)
    left, right = sides[::-1] if swapped else sides
    return answer(
        response, purpose=Purpose.REPEAT, repeats_query_id=before.query_id, left_clip_id=left, right_clip_id=right
    )


def asked_twice(*said: tuple[Response, Response], swapped: bool = False) -> list[JudgedAnswer]:
    firsts = [answer(first) for first, _ in said]
    return [*firsts, *(again(each, second, swapped=swapped) for each, (_, second) in zip(firsts, said, strict=True))]


def of(answers: list[JudgedAnswer]) -> Consistency:
    return consistency.consistency(answers)


def test_the_same_clip_on_the_other_side_is_the_same_answer() -> None:
    judged = of(asked_twice((LEFT, RIGHT), (RIGHT, LEFT), swapped=True))
    assert judged.repeats.agreement is not None
    assert judged.repeats.agreement.value == 1.0
    assert judged.repeats.swapped == judged.repeats.agreement
    assert judged.repeats.unswapped is None


def test_who_answers_by_side_agrees_with_themselves_only_where_the_sides_stayed() -> None:
    judged = of(asked_twice(*[(LEFT, LEFT)] * 5) + asked_twice(*[(LEFT, LEFT)] * 5, swapped=True)).repeats
    assert judged.unswapped is not None
    assert judged.swapped is not None
    assert (judged.unswapped.value, judged.swapped.value) == (1.0, 0.0)


def test_cant_tell_is_no_answer_to_agree_with_and_equal_is_one() -> None:
    judged = of(asked_twice((SKIP, LEFT), (LEFT, SKIP), (EQUAL, EQUAL), (LEFT, EQUAL))).repeats
    assert judged.asked == 4
    assert judged.agreement is not None
    assert (judged.agreement.correct, judged.agreement.scored) == (1, 2)
    assert judged.decided is None


def test_kappa_is_one_without_contradiction_and_nought_at_chance() -> None:
    agreeing = of(asked_twice(*[(LEFT, LEFT), (RIGHT, RIGHT)] * 5)).repeats.kappa
    assert agreeing is not None
    assert agreeing.value == 1.0
    tossing = of(asked_twice(*[(LEFT, LEFT), (LEFT, RIGHT), (RIGHT, RIGHT), (RIGHT, LEFT)] * 5)).repeats.kappa
    assert tossing is not None
    assert tossing.value == pytest.approx(0.0)
    assert tossing.low < 0.0 < tossing.high


def test_kappa_of_a_worked_example() -> None:
    """16 of 20 alike, one in ten answers equal: e = .1^2 + .9^2 / 2 = .415, kappa = (.8 - .415) / .585."""
    said = [(LEFT, LEFT)] * 14 + [(EQUAL, EQUAL)] * 2 + [(LEFT, RIGHT)] * 4
    found = of(asked_twice(*said)).repeats.kappa
    assert found is not None
    assert found.value == pytest.approx(0.385 / 0.585)
    assert found.low == pytest.approx((0.58398 - 0.415) / 0.585, abs=1e-4)  # Wilson of 16 of 20: .58398 to .91933
    assert found.high == pytest.approx((0.91933 - 0.415) / 0.585, abs=1e-4)


def test_eight_of_eight_alike_are_no_certainty() -> None:
    found = of(asked_twice(*[(LEFT, LEFT), (RIGHT, RIGHT)] * 4)).repeats
    assert found.kappa is not None
    assert found.kappa.value == 1.0
    assert found.kappa.high == pytest.approx(1.0)
    assert found.kappa.low == pytest.approx(2 * 0.67559 - 1, abs=1e-4)  # Wilson of 8 of 8: .67559 to 1


@pytest.mark.parametrize("alike", [True, False])
def test_of_a_few_pairs_asked_twice_nothing_is_said_but_how_many(alike: bool) -> None:
    found = of(asked_twice(*[(LEFT, LEFT if alike else RIGHT)] * 4)).repeats
    assert (found.kappa, found.ceiling) == (None, None)
    assert found.agreement is not None
    assert found.agreement.scored == 4


def test_a_ceiling_that_may_be_guessing_is_not_shown() -> None:
    """4 of 8 alike: the best accuracy possible would be 50 % [50 %, 79 %]."""
    assert of(asked_twice(*[(LEFT, LEFT), (LEFT, RIGHT)] * 4)).repeats.ceiling is None


def test_nobody_who_always_says_equal_gets_a_kappa() -> None:
    assert of(asked_twice(*[(EQUAL, EQUAL)] * 6)).repeats.kappa is None


def test_the_ceiling_is_how_often_the_best_model_could_be_right() -> None:
    said = [(LEFT, LEFT)] * 82 + [(LEFT, RIGHT)] * 18
    ceiling = of(asked_twice(*said)).repeats.ceiling
    assert ceiling is not None
    assert ceiling.value == pytest.approx(0.9)  # .9^2 + .1^2 = .82
    assert 0.5 <= ceiling.low < 0.9 < ceiling.high <= 1.0


def test_only_the_worse_side_of_a_catch_pair_is_an_error() -> None:
    caught = [answer(said, purpose=Purpose.CATCH, expected=LEFT) for said in (LEFT, RIGHT, EQUAL, SKIP)]
    errors = of(caught).catch_errors
    assert errors is not None
    assert (errors.correct, errors.scored) == (1, 3)


@pytest.mark.parametrize(("wrong", "asked", "flagged"), [(1, 2, True), (1, 4, False), (2, 8, True), (0, 8, False)])
def test_more_errors_on_obvious_pairs_than_slips_explain_are_a_flag(wrong: int, asked: int, flagged: bool) -> None:
    said = [RIGHT] * wrong + [LEFT] * (asked - wrong)
    judged = of([answer(each, purpose=Purpose.CATCH, expected=LEFT) for each in said])
    assert ("catch_errors" in judged.flags) is flagged


@pytest.mark.parametrize("count", range(1, 6))
def test_a_few_answers_to_one_side_are_no_side_bias(count: int) -> None:
    """Four times left comes by chance to every eighth person who has no side."""
    assert "side_bias" not in of([answer(LEFT) for _ in range(count)]).flags


def test_always_left_is_a_side_bias_and_a_straight_line() -> None:
    judged = of([answer(LEFT) for _ in range(20)])
    assert judged.left is not None
    assert judged.left.low > 0.5
    assert judged.longest_run == 20
    assert {"side_bias", "straight_line"} <= set(judged.flags)


def test_left_and_right_in_turn_raise_no_flag() -> None:
    assert of([answer(side, response_time_ms=6000, clip_ms=6000, seen=1.0) for side in [LEFT, RIGHT] * 15]).flags == []


def test_an_answer_before_half_of_the_clip_was_played_is_too_fast() -> None:
    judged = of([answer(seen=0.4), answer(seen=0.5), answer(seen=1.0), answer(seen=None)])
    assert judged.too_fast is not None
    assert (judged.too_fast.correct, judged.too_fast.scored) == (1, 3)


@pytest.mark.parametrize(("count", "flagged"), [(9, False), (10, True)])
def test_nobody_is_called_too_fast_before_ten_answers(count: int, flagged: bool) -> None:
    assert ("too_fast" in of([answer(side, seen=0.1) for side in [LEFT, RIGHT] * 5][:count]).flags) is flagged


def watched(**columns: object) -> float | None:
    """What counts as seen of two clips of 6 and 4 s."""
    event = LabelEvent(**columns)
    query = Query(
        id=1, ordinal=1, purpose="preference", left_clip=Clip(duration_ms=6000), right_clip=Clip(duration_ms=4000)
    )
    (found,) = consistency.answers_of([Label(query, event, LEFT)])
    return found.seen


def test_what_was_played_counts_and_not_the_last_speed() -> None:
    """Watched whole at double speed, then set to a quarter: at that speed 3.2 s are enough for .8 s of clip."""
    played = {"left_watched_ms": 6000, "right_watched_ms": 4000}
    assert watched(response_time_ms=3200, playback_rate=0.25, **played) == 1.0
    assert watched(response_time_ms=60_000, playback_rate=2.0, left_watched_ms=1500, right_watched_ms=1500) == 0.25


def test_who_moved_through_the_clips_by_hand_may_have_seen_everything() -> None:
    assert watched(left_watched_ms=0, right_watched_ms=0, scrub_count=3) is None


def test_an_answer_from_before_this_was_recorded_gets_the_benefit_of_the_doubt() -> None:
    assert watched(response_time_ms=3200, playback_rate=0.25) == 1.0
    assert watched(response_time_ms=1200, playback_rate=0.25) == pytest.approx(0.4)
    assert watched(response_time_ms=1200, watched_whole=True) == 1.0
    assert watched() is None


def test_who_gets_slower_with_every_answer_is_seen_to() -> None:
    times = [int(6000 * 1.01**place) for place in range(60)]
    judged = of([answer(response_time_ms=time, clip_ms=6000) for time in times])
    assert judged.slowing is not None
    assert judged.slowing.per_hundred.value == pytest.approx(170.5, abs=2.0)  # 1.01^100 - 1
    assert "slowing" in judged.flags


@pytest.mark.parametrize("number", [20, 200])
def test_the_trend_of_times_has_the_interval_of_a_regression(number: int) -> None:
    """Times are whole milliseconds, so three digits of the regression on their logarithms are the same."""
    rng = np.random.default_rng(number)
    times = np.exp(rng.normal(8.7, 0.5, number)).astype(int)
    judged = of([answer(response_time_ms=int(time), clip_ms=6000) for time in times])
    found = stats.linregress(np.arange(number), np.log(times / 6000))
    margin = stats.t.ppf(0.975, number - 2) * found.stderr
    assert judged.slowing is not None
    ends = judged.slowing.per_hundred.low, judged.slowing.per_hundred.high
    expected = [100 * (np.exp(100 * (found.slope + side * margin)) - 1) for side in (-1, 1)]
    assert ends == pytest.approx(expected, rel=2e-3)


def test_less_agreement_in_the_second_half_is_there_to_be_seen() -> None:
    judged = of(asked_twice(*[(LEFT, LEFT)] * 5, *[(LEFT, RIGHT)] * 5))
    assert judged.early_agreement is not None
    assert judged.late_agreement is not None
    assert (judged.early_agreement.value, judged.late_agreement.value) == (1.0, 0.0)


def test_practice_is_left_out_of_everything() -> None:
    practice = [answer(LEFT, purpose=Purpose.PRACTICE, response_time_ms=1, clip_ms=6000) for _ in range(30)]
    assert of(practice) == of([])


def test_nothing_said_is_nothing_known() -> None:
    judged = of([])
    assert (judged.repeats.agreement, judged.repeats.kappa, judged.catch_errors, judged.left) == (None,) * 4
    assert (judged.too_fast, judged.slowing, judged.longest_run, judged.flags) == (None, None, 0, [])


def test_the_balance_counts_every_kind_of_answer() -> None:
    assert of([answer(LEFT), answer(LEFT), answer(SKIP)]).balance == {LEFT: 2, RIGHT: 0, EQUAL: 0, SKIP: 1}


def test_one_answer_without_the_pages_script_asks_for_a_look_and_practice_does_not() -> None:
    practice = answer(purpose=Purpose.PRACTICE, by_script=False)
    assert of([practice, answer(by_script=True), answer(by_script=None)]).flags == []
    judged = of([answer(by_script=True), answer(by_script=False)])
    assert (judged.without_script, judged.flags) == (1, ["without_script"])
