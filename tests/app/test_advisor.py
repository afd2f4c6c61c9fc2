"""When more answers hardly pay: said after three retrainings, taken back when it is no longer so, noted once."""

from collections.abc import Sequence

import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.models import Model, ModelKind
from app.domain.people import AuditEvent
from app.services.answers import stopping_advice
from tests import factories


def models(regrets: Sequence[float | None]) -> list[Model]:
    return [
        Model(label_count=10 * (place + 1), metrics={} if regret is None else {"advice": {"relative_regret": regret}})
        for place, regret in enumerate(regrets)
    ]


@pytest.mark.parametrize(
    ("regrets", "since"),
    [
        ([1.0, 0.05, 0.05], None),
        ([1.0, 0.05, 0.05, 0.05], 40),
        ([0.05, 0.05, 0.05, 0.05, 0.05], 30),
        ([0.05, 0.05, 0.05, 0.9], None),
        ([0.05, 0.3, 0.05, 0.05, 0.05], 50),
        ([None, 0.05, None, 0.05, 0.05], 50),
    ],
)
def test_three_small_regrets_in_a_row_are_enough(regrets: list[float | None], since: int | None) -> None:
    advice = stopping_advice.advice_of(models(regrets))
    assert advice is not None
    assert (advice.enough_since, advice.regret) == (since, regrets[-1])


def test_nothing_is_said_of_models_without_a_regret() -> None:
    assert stopping_advice.advice_of(models([None, None])) is None
    assert stopping_advice.advice_of(models([0.05, 0.05, 0.05, None])) is None, "who is in doubt by now is not advised"
    assert stopping_advice.advice_of([]) is None


def test_it_is_noted_once(database: Database) -> None:
    with database.writing() as session:
        study = factories.make_study(session, "Pilot")
        participant, _ = factories.make_participant(session, study)
    for labels in (10, 20, 30, 40):
        metrics = {"advice": {"relative_regret": 0.05}}
        with database.writing() as session:
            factories.make_model(session, study, participant, ModelKind.REWARD, metrics, labels=labels)
            stopping_advice.note(session, study, participant)
    with database.reading() as session:
        noted = session.scalars(select(AuditEvent.subject).where(AuditEvent.action.startswith("more answers"))).all()
    assert noted == ["pilot/P01 after 30 answers"]
