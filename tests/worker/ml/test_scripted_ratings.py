"""Scripted participants rate what suits them higher, and are not satisfied with a robot that fails."""

import numpy as np
import pytest

from worker.ml.scripted_ratings import RatingManner, ScriptedRater

SEEN = np.linspace(-20.0, -10.0, 101)
EXACT = RatingManner(noise=0.0, leniency=0.0)


def rater(manner: RatingManner = EXACT, seed: int = 0) -> ScriptedRater:
    return ScriptedRater(SEEN, manner, np.random.default_rng(seed))


@pytest.mark.parametrize(("value", "points"), [(-25.0, 1), (-17.5, 2), (-15.0, 3), (-12.4, 4), (-5.0, 5)])
def test_how_personal_it_is_follows_from_what_was_seen_before(value: float, points: int) -> None:
    assert rater().rate(value, success=True)[1] == points


def test_a_robot_that_suits_but_fails_is_personal_without_satisfying() -> None:
    satisfied, personal = rater().rate(-5.0, success=False)
    assert (satisfied, personal) == (3, 5)
    assert rater().rate(-5.0, success=True) == (5, 5)


def test_noise_moves_ratings_and_stays_on_the_scale() -> None:
    noisy = rater(RatingManner(noise=0.3))
    rated = [noisy.rate(-15.0, success=True) for _ in range(200)]
    assert {point for pair in rated for point in pair} == {1, 2, 3, 4, 5}


def test_people_differ_in_how_kind_they_are() -> None:
    manner = RatingManner(noise=0.0, leniency=0.3)
    assert len({rater(manner, seed).rate(-15.0, success=True) for seed in range(20)}) > 2
