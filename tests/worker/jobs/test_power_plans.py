"""Plans of how many people are needed: due when they are asked for, simulated with progress, made once."""

from collections.abc import Callable
from typing import Any

import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.models import Run
from app.domain.power_plan import PowerInputs, PowerPlan
from app.domain.studies import Study
from app.services.studies import power
from app.storage import ArtefactStore
from tests import factories
from worker.compute.pools import Compute
from worker.jobs import reconcile
from worker.jobs.publishing import power_plans
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, Compute(1))


def at_once(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """A step of the engine, whatever its name."""
    assert name
    return function(*arguments)


def test_a_plan_is_due_until_it_is_simulated_and_only_of_the_study_as_it_is(
    context: WorkerContext, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(power_plans, "STUDIES", 20)
    with database.writing() as session:
        study = factories.make_study(
            session, evaluation={"methods": ["reference", "pbarl"], "head_to_heads": 1}, pool_scenarios=4
        )
        plan = power.ask(session, study, PowerInputs(most_people=12, effect=2.0, spread=0.3), "Ada")
    with database.reading() as session:
        (job,) = [job for job, _ in reconcile.due(session) if job.kind == "power"]
    assert job.key == str(power.key_of(plan))
    with database.writing() as session:
        run_id = records.begin_run(session, job, 1)
    power_plans.make(context, job, run_id, at_once)
    with database.reading() as session:
        contents = session.scalars(select(PowerPlan)).one().contents
        assert session.get_one(Run, run_id).progress > 0.5
        assert not [job for job, _ in reconcile.due(session) if job.kind == "power"]
    assert contents is not None
    assert contents["paired"]
    assert [row["people"] for row in contents["rows"]] == [4, 5, 6, 7, 9, 10, 11, 12]
    assert contents["rows"][-1]["ratings"]["power"] == 1.0
    assert contents["enough"]["ratings"] <= 12
    with database.writing() as session:
        power.ask(session, session.get_one(Study, study.id), PowerInputs(effect=1.0), "Ada")
        here = session.get_one(Study, study.id)
        here.stored_settings = {**here.stored_settings, "evaluation": None}
    with database.reading() as session:
        assert not [job for job, _ in reconcile.due(session) if job.kind == "power"]
