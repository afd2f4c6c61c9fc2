"""Which method hides behind which letter, and in which order: balanced, drawn from seeds, drawn once."""

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from threading import Barrier

import pytest
from sqlalchemy import func, select

from app.db import Database
from app.domain.evaluation import Assignment, Trial
from app.domain.protocol import EvaluatedMethod, EvaluationSettings
from app.domain.studies import Participant, Study
from app.services.evaluation import evaluation_plan
from app.services.evaluation.evaluation_plan import order_of_methods, williams_rows
from tests import factories

SIZES = [2, 3, 4, 5]


@pytest.mark.parametrize("count", SIZES)
def test_over_one_cycle_every_method_comes_equally_often_at_every_place(count: int) -> None:
    methods = tuple(EvaluatedMethod)[:count]
    cycle = len(williams_rows(count))
    places = Counter(
        (place, method)
        for number in range(1, cycle + 1)
        for place, method in enumerate(order_of_methods("7", methods, number))
    )
    assert set(places.values()) == {cycle // count}
    assert len(places) == count * count


@pytest.mark.parametrize("count", SIZES)
def test_over_one_cycle_every_method_follows_every_other_equally_often(count: int) -> None:
    methods = tuple(EvaluatedMethod)[:count]
    cycle = len(williams_rows(count))
    followed = Counter(
        pair for number in range(1, cycle + 1) for pair in pairwise(order_of_methods("7", methods, number))
    )
    assert len(followed) == count * (count - 1)
    assert len(set(followed.values())) == 1


def test_with_three_methods_six_participants_have_all_six_orders() -> None:
    methods = EvaluationSettings().methods
    assert len({tuple(order_of_methods("3", methods, number)) for number in range(13, 19)}) == 6


def test_another_study_has_another_sequence_of_orders_and_the_same_study_the_same() -> None:
    methods = EvaluationSettings().methods

    def sequence(secret: int) -> list[tuple[EvaluatedMethod, ...]]:
        return [tuple(order_of_methods(str(secret), methods, number)) for number in range(1, 13)]

    assert sequence(1) == sequence(1)
    assert len({tuple(sequence(seed)) for seed in range(10)}) > 5
    assert sequence(1)[:6] != sequence(1)[6:], "the next cycle is drawn anew"


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        return factories.make_study(session, evaluation=EvaluationSettings())


@pytest.fixture
def participant(database: Database, study: Study) -> Participant:
    with database.writing() as session:
        return factories.make_participant(session, study)[0]


def test_every_letter_is_met_in_one_block_of_trials_and_letters_follow_the_order(
    database: Database, study: Study, participant: Participant
) -> None:
    with database.writing() as session:
        evaluation_plan.draw(session, study, participant)
        trials = evaluation_plan.trials_of(session, participant.id)
        methods = {each.letter: each.method for each in evaluation_plan.assignments_of(session, participant.id)}
    assert [trial.letter for trial in trials] == list("AAABBBCCC")
    assert [trial.repetition for trial in trials] == [1, 2, 3] * 3
    assert list(methods.values()) == list(order_of_methods(study.key_secret, EvaluationSettings().methods, 1))


def test_all_methods_of_a_participant_meet_the_same_scenarios_and_other_participants_meet_others(
    database: Database, study: Study, participant: Participant
) -> None:
    with database.writing() as session:
        other, _ = factories.make_participant(session, study)
        for person in (participant, other):
            evaluation_plan.draw(session, study, person)
        mine, others = (
            [each.scenario for each in evaluation_plan.trials_of(session, p.id)] for p in (participant, other)
        )
    assert mine[:3] == mine[3:6] == mine[6:]
    assert len(set(mine)) == 3
    assert not set(mine) & set(others)
    assert set(mine) | set(others) <= set(evaluation_plan.TRIAL_SCENARIOS)


def test_twenty_who_draw_at_once_draw_once(database: Database, study: Study, participant: Participant) -> None:
    barrier = Barrier(20)

    def draw(_number: int) -> None:
        barrier.wait()
        with database.writing() as session:
            evaluation_plan.draw(session, study, session.get_one(Participant, participant.id))

    with ThreadPoolExecutor(20) as pool:
        list(pool.map(draw, range(20)))
    with database.reading() as session:
        assert session.scalar(select(func.count(Assignment.id))) == 3
        assert session.scalar(select(func.count(Trial.id))) == 9
