"""From the last label to films and controllers of every evaluated method, and what reconcile asks for on the way."""

import io
import json
import shutil
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from sqlalchemy import func, select

from app.db import Database
from app.domain.clips import Clip
from app.domain.evaluation import Controller, Film, Trial
from app.domain.models import Model, ModelKind, Run, RunKind, RunStatus
from app.domain.preferences import Query, Response
from app.domain.protocol import FROM_OTHERS, PAPER_METHODS, EvaluatedMethod, EvaluationMode, EvaluationSettings
from app.domain.run_keys import TRIALS
from app.domain.studies import Participant, Study
from app.services.evaluation import evaluation_plan
from app.storage import ArtefactStore
from tests.worker.at_hand import AtHand, at_once
from worker.compute import baseline_fitting
from worker.domain.trajectory import SIGNALS
from worker.jobs import reconcile
from worker.jobs.clips import evaluation_films
from worker.jobs.clips.evaluation_films import make_films
from worker.jobs.learning.baselines import train_method
from worker.jobs.runtime import due_lending, records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.methods import prefft
from worker.ml.rewards.reward_models import StructuredReward

LABELS = 10


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


def settle(database: Database, study: Study, **evaluation: Any) -> None:
    """Give the study an evaluation."""
    with database.writing() as session:
        changed = {
            "labels_per_participant": LABELS,
            "filter_milestones": (),
            "evaluation_scenarios": 10,
            "harm_share": 0.5,
            "evaluation": EvaluationSettings(**{"methods": PAPER_METHODS, **evaluation}),
        }
        settings = study.settings.model_copy(update=changed)
        session.get_one(Study, study.id).stored_settings = settings.model_dump(mode="json")


@pytest.fixture
def all_said(add_clips: Callable[[int], list[Clip]], answer: Callable[[Clip, Clip, Response], Query]) -> None:
    """The participant has given the last label."""
    clips = [clip for scenario in range(3) for clip in add_clips(scenario)]
    for index in range(LABELS):
        answer(clips[index], clips[index + 1], Response.LEFT if index % 3 else Response.RIGHT)


def due(database: Database, *kinds: RunKind) -> list[Job]:
    """What a round of the worker finds, after it has drawn what was to be drawn."""
    with database.writing() as session:
        for study_id in due_lending.unsettled(session):
            due_lending.settle(session, study_id)
        assert due_lending.unsettled(session) == []
    with database.reading() as session:
        return [job for job, _ in reconcile.due(session) if job.kind in kinds]


def answers_wanted(database: Database, study: Study, count: int) -> None:
    with database.writing() as session:
        asked = session.get_one(Study, study.id)
        asked.stored_settings = {**asked.stored_settings, "labels_per_participant": count}


def done(context: WorkerContext, job: Job, work: Callable[..., None] | None = None) -> int:
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
        records.set_labels(session, run_id, LABELS, "hash")
    if work:
        work(context, job, run_id, at_once)
    with context.database.writing() as session:
        records.finish_run(session, run_id)
    return run_id


def keep(context: WorkerContext, job: Job, controller: bytes = b"a controller") -> int:
    """The method that the job makes, not measured yet."""
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
        records.set_labels(session, run_id, LABELS, "hash")
        metrics = {"method": job.about.subject, "notes": [], "seconds": {}}
        records.save_model(session, run_id, ModelKind.METHOD, context.store.put(controller), metrics)
    return run_id


def learn(context: WorkerContext, *kinds: RunKind) -> None:
    """The reward model and the filter of the last label, or what is named, without the minutes they take."""
    rng = np.random.default_rng(0)
    reward = StructuredReward(0.1 * rng.standard_normal((8, len(SIGNALS)))).to_bytes()
    filtering = FilterWeights(mode={"speed_far": -0.5}).to_bytes()
    stored_of = {RunKind.REWARD: reward, RunKind.FILTER: filtering}
    for kind, stored in [(kind, stored_of[kind]) for kind in kinds or stored_of]:
        (job,) = due(context.database, kind)
        run_id = done(context, job)
        with context.database.writing() as session:
            records.save_model(session, run_id, ModelKind(kind.value), context.store.put(stored), {})


def names(jobs: list[Job]) -> list[str]:
    return ["/".join(job.key.split("/")[:3]) for job in jobs]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.usefixtures("all_said")
def test_after_the_last_label_every_method_is_trained_evaluated_and_filmed(
    context: WorkerContext, database: Database, study: Study, participant: Participant, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("critic_first_updates", 30), ("cloning_steps", 30)):
        monkeypatch.setattr(prefft.FineTuning, name, value)
    settle(database, study, trials=1, fine_tuning_steps=1000)
    learn(context)
    (method,) = due(database, RunKind.METHOD)
    assert names([method]) == ["method/participant-1/prefft"]
    run_id = done(context, method, train_method)
    with database.reading() as session:
        model = session.scalars(select(Model).where(Model.kind == ModelKind.METHOD)).one()
    assert (model.run_id, model.metrics["method"]) == (run_id, "prefft")
    assert model.metrics["evaluation"]["scenarios"] == 10
    assert not any(context.store.unfinished.folder(participant.id).iterdir())

    for filming in due(database, RunKind.FILMS):
        done(context, filming, make_films)
    assert due(database, RunKind.METHOD, RunKind.FILMS) == []

    with database.reading() as session:
        films = session.scalars(select(Film)).all()
        trials = evaluation_plan.trials_of(session, participant.id)
        methods = {each.letter: each.method for each in evaluation_plan.assignments_of(session, participant.id)}
    assert len(films) == 3 + 4
    assert all(context.store.has(film.video_sha256) and context.store.has(film.trajectory_sha256) for film in films)
    assert [trial.film is not None and trial.film.method for trial in trials] == [
        methods[trial.letter] for trial in trials
    ]
    compared = [(film.method, film.scenario) for film in films if film.scenario in evaluation_plan.COMPARISON_SCENARIOS]
    assert sorted(compared) == sorted(
        (method, scenario)
        for method in ("reference", "pbarl")
        for scenario in evaluation_plan.comparison_scenarios(participant)
    )
    trajectories = {film.trajectory_sha256 for film in films}
    assert len(trajectories) == len(films), "every method acts differently"


@pytest.mark.slow
@pytest.mark.usefixtures("all_said")
def test_for_a_physical_robot_every_letter_gets_a_controller(
    context: WorkerContext, database: Database, study: Study, participant: Participant
) -> None:
    settle(database, study, mode=EvaluationMode.PHYSICAL, methods=("reference", "pbarl"))
    learn(context)
    controllers, before_after = due(database, RunKind.FILMS)
    assert names([controllers, before_after]) == [
        "films/participant-1/controllers",
        "films/participant-1/before-after",
    ]
    done(context, controllers, make_films)
    with database.reading() as session:
        packed = evaluation_plan.controllers_of(session, participant.id)
    assert list(packed) == ["A", "B"]
    for letter, controller in packed.items():
        with zipfile.ZipFile(io.BytesIO(context.store.read(controller.artefact_sha256))) as archive:
            manifest = json.loads(archive.read("manifest.json"))
        assert (manifest["letter"], manifest["participant"], manifest["task"]) == (letter, "P01", "feeding")
    assert len({controller.byte_count for controller in packed.values()}) == 1


@pytest.mark.usefixtures("all_said")
def test_nothing_is_filmed_before_the_filter_and_no_trial_before_every_method(
    context: WorkerContext, database: Database, study: Study
) -> None:
    settle(database, study)
    (reward,) = due(database, RunKind.REWARD)
    assert due(database, RunKind.METHOD, RunKind.FILMS) == []
    done(context, reward)
    assert names(due(database, RunKind.METHOD, RunKind.FILMS)) == ["method/participant-1/prefft"]
    (filtering,) = due(database, RunKind.FILTER)
    done(context, filtering)
    assert names(due(database, RunKind.FILMS)) == ["films/participant-1/before-after"]
    (method,) = due(database, RunKind.METHOD)
    run_id = keep(context, method)
    assert names(due(database, RunKind.FILMS)) == ["films/participant-1/trials", "films/participant-1/before-after"]
    with database.reading() as session:
        assert session.get_one(Run, run_id).status == RunStatus.RUNNING, "it is measured while it is filmed"


@pytest.mark.slow
@pytest.mark.usefixtures("all_said")
def test_while_their_own_filter_is_fitted_the_other_robots_are_filmed_and_nothing_is_shown(
    context: WorkerContext, database: Database, study: Study, participant: Participant
) -> None:
    settle(database, study, trials=1, methods=("reference", "prefft", "pbarl"))
    (reward,) = due(database, RunKind.REWARD)
    done(context, reward)
    (method,) = due(database, RunKind.METHOD)
    keep(context, method, baseline_fitting.controller_of_filter("feeding", FilterWeights(mode={}).to_bytes()))
    (others,) = due(database, RunKind.FILMS)
    assert names([others]) == ["films/participant-1/others"]
    run_id = done(context, others, make_films)
    with database.reading() as session:
        films = session.scalars(select(Film)).all()
        assert sorted(film.method for film in films) == ["prefft", "reference"]
        assert all(trial.film_id is None for trial in evaluation_plan.trials_of(session, participant.id))
    learn(context, RunKind.FILTER)
    trials, _ = due(database, RunKind.FILMS)
    assert names([trials]) == ["films/participant-1/trials"]
    make_films(context, others, run_id, at_once)
    filmed, *rest = evaluation_films._portions(context, trials, TRIALS)
    assert {method for method, *_ in filmed} == {"prefft", "reference"}
    assert [[method for method, *_ in portion] for portion in rest] == [["pbarl"]]
    done(context, trials, make_films)
    with database.reading() as session:
        assert {film.id for film in films} < set(session.scalars(select(Film.id)))
        assert session.scalar(select(func.count(Film.id))) == len(films) + 1, "what is there is not filmed again"
        assert all(trial.film_id is not None for trial in evaluation_plan.trials_of(session, participant.id))


@pytest.mark.usefixtures("all_said")
def test_the_reference_is_filmed_while_somebody_answers_and_not_again_when_it_is_shown(
    context: WorkerContext, database: Database, study: Study, participant: Participant
) -> None:
    settle(database, study, methods=("reference", "pbarl"), trials=1)
    answers_wanted(database, study, LABELS + 1)
    (ahead,) = due(database, RunKind.FILMS)
    assert ahead.key == "films/participant-1/ahead"
    done(context, ahead, make_films)
    assert due(database, RunKind.FILMS) == []
    with database.reading() as session:
        films = session.scalars(select(Film)).all()
        compared = evaluation_plan.comparison_scenarios(participant)
        expected = [evaluation_plan.trial_scenario(participant, 1), *compared]
        assert [(film.method, film.model_id, film.scenario) for film in films] == [
            ("reference", None, scenario) for scenario in expected
        ]
    answers_wanted(database, study, LABELS)
    learn(context)
    for filming in due(database, RunKind.FILMS):
        done(context, filming, make_films)
    with database.reading() as session:
        methods = session.scalars(select(Film.method).order_by(Film.id)).all()
        assert methods == ["reference"] * len(films) + ["pbarl"] * len(films)
        assert all(trial.film_id is not None for trial in evaluation_plan.trials_of(session, participant.id))


@pytest.mark.parametrize(
    "evaluation", [None, {"methods": ("pbarl", "average")}, {"methods": ("reference", "pbarl"), "mode": "physical"}]
)
@pytest.mark.usefixtures("all_said")
def test_nothing_is_filmed_ahead_that_will_not_be_shown(
    database: Database, study: Study, evaluation: dict[str, Any] | None
) -> None:
    settle(database, study, **(evaluation or {}))
    answers_wanted(database, study, LABELS + 1)
    if evaluation is None:
        with database.writing() as session:
            plain = session.get_one(Study, study.id)
            plain.stored_settings = {**plain.stored_settings, "evaluation": None}
    assert due(database, RunKind.FILMS) == []


@pytest.mark.usefixtures("all_said")
def test_only_what_is_not_there_is_trained(context: WorkerContext, database: Database, study: Study) -> None:
    there = [EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL]
    not_trained = {*there, EvaluatedMethod.SELF_SET, *FROM_OTHERS}
    missing = [method for method in EvaluatedMethod if method not in not_trained]
    for methods in (there + missing[:3], there + missing[3:]):
        settle(database, study, methods=tuple(methods))
        for reward in due(database, RunKind.REWARD):
            done(context, reward)
        trained = [name.rsplit("/", 1)[1] for name in names(due(database, RunKind.METHOD))]
        assert trained == methods[2:]


@pytest.mark.usefixtures("all_said")
def test_without_an_evaluation_only_before_and_after_are_filmed(
    context: WorkerContext, database: Database, study: Study
) -> None:
    settle(database, study)
    with database.writing() as session:
        plain = session.get_one(Study, study.id)
        plain.stored_settings = {**plain.stored_settings, "evaluation": None}
    for kind in (RunKind.REWARD, RunKind.FILTER):
        (job,) = due(database, kind)
        done(context, job)
    assert names(due(database, RunKind.METHOD, RunKind.FILMS)) == ["films/participant-1/before-after"]


@pytest.mark.usefixtures("all_said")
def test_repeats_and_catch_pairs_after_the_last_label_ask_for_nothing_new(
    context: WorkerContext, database: Database, study: Study, answer: Callable[[Clip, Clip, Response], Query]
) -> None:
    settle(database, study)
    before = names(due(database, RunKind.REWARD)), due(database, RunKind.REWARD)[0].key
    with database.reading() as session:
        clips = session.scalars(select(Clip)).all()
    query = answer(clips[0], clips[1], Response.LEFT)
    with database.writing() as session:
        session.get_one(Query, query.id).purpose = "repeat"
    assert (names(due(database, RunKind.REWARD)), due(database, RunKind.REWARD)[0].key) == before


@pytest.mark.usefixtures("all_said")
def test_a_controller_is_not_exchanged_once_the_robot_has_moved(
    context: WorkerContext, database: Database, study: Study, participant: Participant
) -> None:
    settle(database, study, mode=EvaluationMode.PHYSICAL, methods=("reference", "pbarl"))
    learn(context)
    (job, _) = due(database, RunKind.FILMS)
    done(context, job, make_films)
    with database.writing() as session:
        kept = {each.method: each.artefact_sha256 for each in session.scalars(select(Controller))}
        session.scalars(select(Trial)).first().started_at = study.created_at  # type: ignore[union-attr]
        model = session.scalars(select(Model).where(Model.kind == ModelKind.FILTER)).one()
        model.artefact_sha256 = context.store.put(FilterWeights(mode={"speed_far": 0.9}).to_bytes())
        session.scalars(select(Run).where(Run.workflow_id == job.key)).one().status = RunStatus.RETRY
    done(context, job, make_films)
    with database.reading() as session:
        assert {each.method: each.artefact_sha256 for each in session.scalars(select(Controller))} == kept
    shutil.rmtree(context.store.unfinished.folder(participant.id), ignore_errors=True)
