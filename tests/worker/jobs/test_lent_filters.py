"""What a participant is shown of others: made of what was drawn, and never of somebody who has withdrawn."""

from collections.abc import Callable
from typing import Any

import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.clips import Clip
from app.domain.evaluation import DonorRule
from app.domain.models import Model, ModelKind, RunKind
from app.domain.preferences import Query, Response
from app.domain.protocol import EvaluatedMethod
from app.domain.run_keys import RunKey
from app.domain.studies import Participant, Study
from app.services.evaluation import donors
from app.services.participants import withdrawal
from app.storage import ArtefactStore
from tests.worker.at_hand import AtHand, at_once
from tests.worker.jobs.test_evaluation_films import LABELS, done, due, learn, names, settle
from worker.compute import baseline_fitting
from worker.jobs.clips.evaluation_films import make_films
from worker.jobs.learning import filters, lent_filters
from worker.jobs.learning.baselines import train_method
from worker.jobs.learning.lent_filters import LoanEnded
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.filters.filter_module import FilterWeights
from worker.ml.filters.filter_problem import FilterConfig

DONOR = FilterWeights(mode={"speed_far": 0.8}).to_bytes()


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


@pytest.fixture
def all_said(add_clips: Callable[[int], list[Clip]], answer: Callable[[Clip, Clip, Response], Query]) -> None:
    """The participant has given the last label."""
    clips = [clip for scenario in range(3) for clip in add_clips(scenario)]
    for index in range(LABELS):
        answer(clips[index], clips[index + 1], Response.LEFT if index % 3 else Response.RIGHT)


@pytest.fixture
def donor(database: Database, store: ArtefactStore, study: Study) -> Participant:
    with database.writing() as session:
        person = Participant(study_id=study.id, number=2, token_sha256="1" * 64, seed=6)
        session.add(person)
        session.flush()
        job = Job(RunKey(RunKind.FILTER, participant_id=person.id, labels=LABELS), study.id)
        run_id = records.begin_run(session, job, seed=1)
        records.set_labels(session, run_id, LABELS, "hash of the donor")
        records.save_model(session, run_id, ModelKind.FILTER, store.put(DONOR), {})
        records.finish_run(session, run_id)
    return person


def method_job(context: WorkerContext, study: Study, *methods: str) -> Job:
    """The method that is to be made of others, with everything before it done."""
    settle(context.database, study, trials=1, methods=("pbarl", *methods))
    learn(context)
    (job,) = due(context.database, RunKind.METHOD)
    return job


@pytest.mark.slow
@pytest.mark.usefixtures("all_said")
def test_somebody_else_s_filter_is_taken_as_it_is_and_the_model_does_not_say_whose(
    context: WorkerContext, study: Study, donor: Participant
) -> None:
    job = method_job(context, study, "somebody_else")
    assert names([job]) == ["method/participant-1/somebody_else"]
    done(context, job, train_method)
    with context.database.reading() as session:
        model = session.scalars(select(Model).where(Model.kind == ModelKind.METHOD)).one()
        drawn = donors.find(session, 1, EvaluatedMethod.SOMEBODY_ELSE)
    expected = baseline_fitting.controller_of_filter("feeding", DONOR)
    assert context.store.read(model.artefact_sha256) == expected
    assert drawn is not None
    assert (drawn.rule, drawn.donors.people) == (DonorRule.BY_LOT, (donor.number,))
    assert (model.participant_id, model.label_hash) == (1, "hash"), "what the borrower said, not the donor"
    assert set(model.metrics) == {"method", "evaluation", "notes", "seconds"}
    for filming in due(context.database, RunKind.FILMS):
        done(context, filming, make_films)
    assert due(context.database, RunKind.METHOD, RunKind.FILMS) == []


@pytest.mark.usefixtures("all_said")
def test_what_was_fitted_to_types_of_users_is_fitted_once_for_a_study(
    context: WorkerContext, study: Study, donor: Participant
) -> None:
    job = method_job(context, study, "average")
    types = ["neutral", "cautious", "impatient"]
    fitted = context.store.put(b"fitted for the first")
    with context.database.writing() as session:
        first = session.get_one(Participant, donor.id)
        donors.draw(session, session.get_one(Study, study.id), first, EvaluatedMethod.AVERAGE, types)
        earlier = Job(RunKey(RunKind.METHOD, participant_id=first.id, subject="average", labels=LABELS), study.id)
        run_id = records.begin_run(session, earlier, seed=1)
        records.set_labels(session, run_id, LABELS, "hash of the first")
        metrics = {"method": "average", "notes": ["As it was fitted."]}
        records.save_model(session, run_id, ModelKind.METHOD, fitted, metrics)
        run_id = records.begin_run(session, job, seed=1)
    made = lent_filters.make(context, job, run_id, at_once, EvaluatedMethod.AVERAGE)
    assert (made["artefact"], made["notes"]) == (fitted, ["As it was fitted."])


@pytest.mark.usefixtures("all_said")
def test_a_donor_who_withdraws_while_it_is_made_is_not_shown(
    context: WorkerContext, study: Study, donor: Participant, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = method_job(context, study, "somebody_else")
    made: list[str] = []

    def measured(*_arguments: Any) -> list[Any]:
        """Instead of driving through unseen scenarios: meanwhile the donor withdraws."""
        with context.database.writing() as session:
            person = session.get_one(Participant, donor.id)
            withdrawal.withdraw(session, context.store, person, person.code)
        return []

    def put(content: bytes) -> str:
        made.append(stored(content))
        return made[-1]

    stored = context.store.put
    monkeypatch.setattr(context.store, "put", put)
    monkeypatch.setattr("worker.jobs.learning.baselines._driven", measured)
    monkeypatch.setattr("worker.jobs.learning.baselines.evaluate", lambda *_: {})
    with pytest.raises(LoanEnded):
        done(context, job, train_method)
    assert len(made) == 1
    assert not context.store.has(made[0])
    with context.database.reading() as session:
        assert session.scalars(select(Model).where(Model.kind == ModelKind.METHOD)).all() == []


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.usefixtures("all_said")
@pytest.mark.parametrize("method", ["somebody_else", "average"])
def test_while_nobody_has_finished_a_filter_is_fitted_to_types_of_users(
    context: WorkerContext, study: Study, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    small = FilterConfig(mode_attempts=1, gate_scenarios=6, residual_rounds=0, evaluation_scenarios=10)
    monkeypatch.setattr(filters, "filter_config", lambda _settings: small)
    job = method_job(context, study, method)
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
    made = lent_filters.make(context, job, run_id, at_once, EvaluatedMethod(method))
    assert context.store.has(str(made["artefact"]))
    with context.database.reading() as session:
        drawn = donors.find(session, 1, method)
    assert drawn is not None
    assert len(drawn.donors.types) == {"somebody_else": 1, "average": 3}[method]
