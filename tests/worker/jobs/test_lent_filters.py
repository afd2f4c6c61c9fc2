"""What a participant is shown of others: made of what was drawn, and never of somebody who has withdrawn."""

from collections.abc import Callable
from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import select

from app.db import Database, now
from app.domain.clips import Clip
from app.domain.evaluation import DonorRule, Donors, Film
from app.domain.models import Model, ModelKind, RunKind
from app.domain.preferences import Query, Response
from app.domain.protocol import EvaluatedMethod
from app.domain.run_keys import RunKey
from app.domain.studies import Participant, Study
from app.services.evaluation import donors, evaluation_plan
from app.services.participants import withdrawal
from app.storage import ArtefactStore
from tests import factories
from tests.worker.at_hand import AtHand, at_once
from tests.worker.jobs.test_evaluation_films import LABELS, answers_wanted, done, due, learn, names, settle
from worker.compute import baseline_fitting
from worker.jobs.clips import evaluation_films
from worker.jobs.clips.evaluation_films import make_films
from worker.jobs.learning import fits, lent_filters, shared_filters
from worker.jobs.learning.baselines import train_method
from worker.jobs.learning.lent_filters import LoanEnded
from worker.jobs.runtime import due_lending, records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_problem import FilterConfig

FITTED = b"a controller"
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


def fitted(context: WorkerContext, job: Job) -> str:
    """The filter that the job fits, without the minutes it takes: its artefact."""
    done(context, job)
    artefact = context.store.put(FITTED)
    with context.database.writing() as session:
        shared = due_lending.find(session, job)
        assert shared is not None
        shared.artefact_sha256, shared.metrics = artefact, {"notes": ["As it was fitted."]}
    return artefact


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
def test_nobody_is_lent_what_is_not_fitted_and_the_same_is_fitted_once_for_a_study(
    context: WorkerContext, study: Study, donor: Participant
) -> None:
    settle(context.database, study, trials=1, methods=("pbarl", "average"))
    learn(context)
    with context.database.writing() as session:
        job = Job(RunKey(RunKind.REWARD, participant_id=donor.id, labels=LABELS), study.id)
        run_id = records.begin_run(session, job, seed=1)
        records.set_labels(session, run_id, LABELS, "hash of the donor")
        records.save_model(session, run_id, ModelKind.REWARD, "0" * 64, {})
    assert due(context.database, RunKind.METHOD) == []
    (fitting,) = due(context.database, RunKind.SHARED)
    assert fitting.study_id == study.id
    fitted(context, fitting)
    (job,) = due(context.database, RunKind.METHOD)
    assert names([job]) == ["method/participant-1/average"]
    taken = lent_filters.take(context, job, 0, at_once, EvaluatedMethod.AVERAGE)
    assert context.store.read(str(taken["artefact"])) == FITTED
    assert taken["notes"] == ["As it was fitted."]
    with context.database.reading() as session:
        drawn = [donors.find(session, person, "average") for person in (1, donor.id)]
    assert [each.donors.types for each in drawn if each] == [("neutral", "cautious", "impatient")] * 2


class TestAhead:
    """Filters for several are asked for while somebody still answers, for what would be drawn for them now."""

    @pytest.fixture
    def answering(self, context: WorkerContext, study: Study, participant: Participant) -> Participant:
        """Somebody who is here, has given some of the answers, and is going to be shown both robots of others."""
        settle(context.database, study, trials=1, methods=("pbarl", "somebody_else", "average"))
        with context.database.writing() as session:
            person = session.get_one(Participant, participant.id)
            person.last_seen_at = now()
            factories.make_model(session, study, person, ModelKind.REWARD, {}, LABELS // 2 - 1)
        return person

    def asked(self, context: WorkerContext, study: Study) -> list[Donors]:
        due(context.database)
        with context.database.reading() as session:
            return [each.donors for each in donors.shared_filters(session, study)]

    @pytest.mark.usefixtures("answering")
    def test_while_nobody_has_finished_one_of_a_type_and_one_of_all(self, context: WorkerContext, study: Study) -> None:
        one, everybody = self.asked(context, study)
        assert len(one.types) == 1
        assert everybody == Donors(types=("neutral", "cautious", "impatient"))
        assert len(due(context.database, RunKind.SHARED)) == 2
        with context.database.reading() as session:
            assert donors.find(session, 1, "average") is None, "drawn is after half of the answers"

    @pytest.mark.parametrize("pool_scenarios", [2, 3])
    def test_before_anybody_comes_one_of_each_type_once_the_clips_are_there(
        self, context: WorkerContext, study: Study, add_clips: Callable[[int], list[Clip]], pool_scenarios: int
    ) -> None:
        settle(context.database, study, trials=1, methods=("pbarl", "somebody_else", "average"))
        clips = [clip for scenario in range(2) for clip in add_clips(scenario)]
        with context.database.writing() as session:
            changed = {"pool_scenarios": pool_scenarios, "behaviours_per_scenario": len(clips) // 2}
            stored = session.get_one(Study, study.id)
            stored.stored_settings = {**stored.stored_settings, **changed}
        types = [each.types for each in self.asked(context, study)]
        everybody = ("neutral", "cautious", "impatient")
        assert types == ([] if pool_scenarios == 3 else [*((each,) for each in everybody), everybody])
        assert self.asked(context, study) == self.asked(context, study)

    def test_nothing_for_whoever_has_left(self, context: WorkerContext, study: Study, answering: Participant) -> None:
        with context.database.writing() as session:
            session.get_one(Participant, answering.id).last_seen_at = now() - timedelta(hours=1)
        assert self.asked(context, study) == []

    @pytest.mark.usefixtures("answering")
    def test_once_somebody_has_finished_no_type_is_fitted_any_more(
        self, context: WorkerContext, study: Study, request: pytest.FixtureRequest
    ) -> None:
        first, _ = due(context.database, RunKind.SHARED)
        request.getfixturevalue("donor")
        (left,) = self.asked(context, study)
        assert len(left.types) == 3
        with context.database.writing() as session:
            run_id = records.begin_run(session, first, seed=1)
        stored = set[str]()
        shared_filters.fit(context.noting(stored), first, run_id, at_once)
        assert stored == set()

    @pytest.mark.usefixtures("answering")
    def test_the_mean_of_people_goes_with_each_of_them(self, context: WorkerContext, study: Study) -> None:
        with context.database.writing() as session:
            people = [factories.make_participant(session, study)[0] for _ in range(3)]
            for person in people:
                factories.make_model(session, study, person, ModelKind.FILTER, {}, LABELS)
        (mean,) = self.asked(context, study)
        assert mean == Donors(people=tuple(person.number for person in people))
        (fitting,) = due(context.database, RunKind.SHARED)
        artefact = fitted(context, fitting)
        with context.database.writing() as session:
            gone = session.get_one(Participant, people[0].id)
            withdrawal.withdraw(session, context.store, gone, gone.code)
        assert not context.store.has(artefact)
        (few,) = self.asked(context, study)
        assert len(few.types) == 3, "an average of two would tell too much about each of them"


class TestFilmedAhead:
    """In the second half of the answers it is drawn and filmed, for what is lent depends on no answer."""

    @pytest.fixture
    def filming(self, context: WorkerContext, study: Study, participant: Participant, donor: Participant) -> Job:
        """The films of the donor's filter, for somebody with one answer to go."""
        settle(context.database, study, trials=1, methods=("pbarl", "somebody_else"))
        answers_wanted(context.database, study, LABELS + 1)
        with context.database.writing() as session:
            person = session.get_one(Participant, participant.id)
            person.last_seen_at = now()
            factories.make_model(session, study, person, ModelKind.REWARD, {}, LABELS)
            session.scalars(select(Model).where(Model.participant_id == donor.id)).one().label_count = LABELS + 1
        (job,) = due(context.database, RunKind.FILMS)
        return job

    @pytest.mark.usefixtures("all_said")
    def test_the_films_become_those_of_the_method_and_are_not_made_twice(
        self, context: WorkerContext, study: Study, filming: Job, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        assert names([filming])[0].startswith("films/participant-1/lent-")
        done(context, filming, make_films)
        assert due(context.database, RunKind.FILMS) == []
        answers_wanted(context.database, study, LABELS)
        learn(context)
        monkeypatch.setattr("worker.jobs.learning.baselines._driven", lambda *_: [])
        monkeypatch.setattr("worker.jobs.learning.baselines.evaluate", lambda *_: {})
        (method,) = due(context.database, RunKind.METHOD)
        done(context, method, train_method)
        for rest in due(context.database, RunKind.FILMS):
            done(context, rest, make_films)
        with context.database.reading() as session:
            model = session.scalars(select(Model).where(Model.kind == ModelKind.METHOD)).one()
            lent = session.scalars(select(Film).where(Film.method == "somebody_else")).all()
            assert [(film.id, film.model_id) for film in lent] == [(1, model.id)]
            assert all(trial.film_id is not None for trial in evaluation_plan.trials_of(session, 1))

    @pytest.mark.usefixtures("all_said")
    def test_nothing_is_left_of_a_donor_who_withdraws_meanwhile(
        self, context: WorkerContext, donor: Participant, filming: Job, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        kept, made = evaluation_films._stored, dict[str, Any]()

        def stored(*arguments: Any) -> dict[str, Any]:
            made.update(kept(*arguments))
            with context.database.writing() as session:
                person = session.get_one(Participant, donor.id)
                withdrawal.withdraw(session, context.store, person, person.code)
            return made

        monkeypatch.setattr(evaluation_films, "_stored", stored)
        with pytest.raises(LoanEnded):
            done(context, filming, make_films)
        assert not any(context.store.has(made[name]) for name in made if name.endswith("sha256"))
        with context.database.reading() as session:
            assert session.scalars(select(Film)).all() == []


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
    monkeypatch.setattr(fits, "filter_config", lambda _settings: small)
    settle(context.database, study, trials=1, methods=("pbarl", method))
    learn(context)
    (fitting,) = due(context.database, RunKind.SHARED)
    done(context, fitting, shared_filters.fit)
    (job,) = due(context.database, RunKind.METHOD)
    taken = lent_filters.take(context, job, 0, at_once, EvaluatedMethod(method))
    assert context.store.has(str(taken["artefact"]))
    with context.database.reading() as session:
        drawn = donors.find(session, 1, method)
    assert drawn is not None
    assert len(drawn.donors.types) == {"somebody_else": 1, "average": 3}[method]
