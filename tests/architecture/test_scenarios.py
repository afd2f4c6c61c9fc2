"""No two purposes share a scenario: nothing is judged on what it was fitted to."""

import itertools

import pytest

from app.services.evaluation.evaluation_plan import COMPARISON_SCENARIOS, TRIAL_SCENARIOS
from worker.domain import scenarios

BLOCKS = {name: block for name, block in vars(scenarios).items() if isinstance(block, range)}
OF_THE_EVALUATION = {"trials": TRIAL_SCENARIOS, "comparisons": COMPARISON_SCENARIOS}


def test_no_two_purposes_share_a_scenario() -> None:
    assert len(BLOCKS) > 10
    spans = sorted((BLOCKS | OF_THE_EVALUATION).values(), key=lambda span: span.start)
    assert all(one.stop <= other.start for one, other in itertools.pairwise(spans))


def test_every_study_finds_its_pool_in_the_block() -> None:
    for seed in (0, 1, 89_999, 90_000, 2**31 - 1):
        assert scenarios.of_pool(seed, 0) in scenarios.POOL
        assert scenarios.of_pool(seed, 999) in scenarios.POOL


def test_a_block_gives_only_what_it_has() -> None:
    assert scenarios.first_of(scenarios.GATE, 3, skip=2) == range(2_000_002, 2_000_005)
    with pytest.raises(ValueError, match="only 1000000 scenarios from 2000000 on, not 1000001"):
        scenarios.first_of(scenarios.GATE, 1_000_000, skip=1)
