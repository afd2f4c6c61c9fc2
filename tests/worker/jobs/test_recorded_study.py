"""The demo study was made by an earlier version: from its answers the same is learned, exported and driven today.

Whether the same bits come out on one machine is what ``python -m tests.benchmarks.same_bits`` tells of two versions;
here processors may differ in the last ones.
"""

import io
import zipfile

import numpy as np
import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.models import Bundle, Model, ModelKind, RunKind
from app.domain.run_keys import RunKey
from app.domain.studies import Participant
from app.services.archives import demo_archive
from app.storage import ArtefactStore
from tests.worker.at_hand import AtHand
from worker.compute import learning, simulation
from worker.domain.scenarios import EVALUATION
from worker.jobs.learning import reward_models
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.filters.exported.filter_act import FilterAct, act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.prior import Prior
from worker.ml.rewards.reward_models import StructuredReward
from worker.sim.rollout import rollout
from worker.tasks import registry

TASK = "feeding"
BEFORE_CONTACT = 20
"""Control steps in which nothing multiplies small differences between processors."""
PEOPLE = ["neutral", "cautious", "impatient"]


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    with database.writing() as session:
        demo_archive.import_finished(session, store)
    return WorkerContext(database, store, AtHand())


def newest(session: Session, user: str, kind: ModelKind) -> Model:
    """What was learned last from a scripted participant's answers."""
    person = session.scalars(select(Participant).where(Participant.scripted_as == user)).one()
    model = records.newest_model(session, person.id, kind)
    assert model is not None
    return model


def weights_of(context: WorkerContext, model: Model) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    reward = load_reward_model(context.store.read(model.artefact_sha256))
    assert isinstance(reward, StructuredReward)
    return np.asarray(reward.weights, np.float64)


def bundle_of(context: WorkerContext, session: Session, model: Model) -> zipfile.ZipFile:
    published = session.scalars(select(Bundle).where(Bundle.model_id == model.id)).one()
    return zipfile.ZipFile(io.BytesIO(context.store.read(published.artefact_sha256)))


def filter_of(context: WorkerContext, model: Model) -> FilterAct:
    weights = FilterWeights.from_bytes(context.store.read(model.artefact_sha256))
    return act_of(registry.task(TASK).modes, simulation.reference_policy(TASK), weights)


def test_the_same_answers_give_the_same_reward_models(context: WorkerContext, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the prior of then, which knew nobody (decision 135)."""
    monkeypatch.setattr(learning, "prior_of", lambda task, spread, earlier: Prior.standard(len(spread)))
    for user in PEOPLE:
        _is_learned_again(context, user)


def _is_learned_again(context: WorkerContext, user: str) -> None:
    with context.database.writing() as session:
        recorded = newest(session, user, ModelKind.REWARD)
        person_id, count = recorded.participant_id, recorded.label_count
        key = RunKey(RunKind.REWARD, participant_id=person_id, labels=count, answers="answer-1")
        person = session.get_one(Participant, person_id)
        run_id = records.begin_run(session, Job(key, person.study_id), person.seed)
    reward_models._fit(context, run_id, person_id)
    with context.database.reading() as session:
        again = newest(session, user, ModelKind.REWARD)
    assert again.id != recorded.id
    assert again.label_hash == recorded.label_hash, user
    weights, before = weights_of(context, again), weights_of(context, recorded)
    np.testing.assert_allclose(weights, before, rtol=1e-5, atol=1e-6, err_msg=user)


def test_recorded_filters_are_exported_to_the_same_functions_and_drive_the_robot_as_they_did(
    context: WorkerContext,
) -> None:
    policy = simulation.reference_policy(TASK)
    for user in PEOPLE:
        with context.database.reading() as session:
            model = newest(session, user, ModelKind.FILTER)
            with bundle_of(context, session, model) as bundle:
                observations, means, actions = (
                    np.load(io.BytesIO(bundle.read(f"recorded/{name}.npy")))
                    for name in ("observations", "policy_means", "actions")
                )
        again = filter_of(context, model)
        np.testing.assert_allclose(again.exported.batch(observations, means), actions, atol=1e-6, err_msg=user)
        np.testing.assert_allclose([policy.mean(each) for each in observations], means, atol=1e-5, err_msg=user)
        driven = rollout(simulation.environment(TASK), again, EVALUATION.start).observations[:BEFORE_CONTACT]
        np.testing.assert_allclose(driven, observations[:BEFORE_CONTACT], atol=1e-4, err_msg=user)
