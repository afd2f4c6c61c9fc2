"""Methods that are only evaluated, such as PrefFT: trained once somebody has given all labels, on what they said.

Those that others have taught are made by lent_filters, and measured and kept here like the rest.

Trained with what other people's reward models leave of the machine. A training keeps checkpoints in a folder of the
participant's, so a killed worker goes on where it was; the folder is removed at the end.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from sqlalchemy import select

from app.domain.choices import RewardKind
from app.domain.models import Model, ModelKind
from app.domain.protocol import FROM_OTHERS, EvaluatedMethod
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.evaluation import evaluation_plan, self_setting
from worker.analysis.filters.evaluation import evaluate
from worker.compute import baseline_fitting, learning
from worker.compute.baseline_fitting import Baseline
from worker.compute.pools import Lane
from worker.domain.scenarios import EVALUATION, first_of
from worker.domain.trajectory import Trajectory
from worker.jobs.learning import dataset, lent_filters, patience
from worker.jobs.learning.filters import NothingToLearnFrom, reward_to_follow
from worker.jobs.learning.lent_filters import LoanEnded
from worker.jobs.runtime import due_work, records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.rewards.loading import load_reward_model
from worker.tasks import registry

CHUNK = 10
"""Unseen scenarios between two signs of life."""
TRAINING_SHARE = 0.9
"""Of the progress; the rest is the drive through unseen scenarios."""


class NotSetYet(AppError):
    """The participant has not set a robot with the sliders yet."""


def train_method(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Train the method that the job names, drive it through unseen scenarios, and keep it."""
    method = EvaluatedMethod(job.about.subject)
    reward = step("reward", _choose_reward, context, run_id, job)
    artefact = step("kept", _kept, context, run_id)  # by an attempt that failed after that
    if not artefact:
        if method in FROM_OTHERS:
            trained = lent_filters.take(context, job, run_id, step, method)
        elif method is EvaluatedMethod.SELF_SET:
            trained = step("setting", _as_set, context, run_id, job)
        else:
            trained = step("train", _train, context, run_id, job, method.value, reward)
        if not trained:
            return  # the last answer was given again, and the same method is due anew
        step("keep", _keep, context, run_id, job, method.value, trained)
        artefact = trained["artefact"]
    step("measure", _measure, context, run_id, job, reward, artefact)


def _choose_reward(context: WorkerContext, run_id: int, job: Job) -> str:
    with context.database.writing() as session:
        return reward_to_follow(session, run_id, job).artefact_sha256


def _train(context: WorkerContext, run_id: int, job: Job, method: str, reward: str) -> dict[str, object]:
    """The artefact of the finished controller, and what is to be said about it; empty when nobody needs it any more.

    A training makes room for that of somebody who waits, and goes on from its checkpoint afterwards.
    """
    folder = _folder(context, job, run_id)
    folder.mkdir(parents=True, exist_ok=True)
    baseline = _baseline(context, run_id, job, method, reward, folder)

    def report(share: float) -> None:
        context.report(run_id, f"training a method to be evaluated, {share:.0%} done", TRAINING_SHARE * share)

    parts = patience.train(
        context,
        folder,
        Lane.PATIENT,
        report,
        partial(_is_outdated, context, job),
        lambda fitted: fitted.controller is not None,
        partial(baseline_fitting.fit, baseline),
    )
    if not parts or parts[-1].controller is None:
        context.store.unfinished.forget(folder)
        return {}
    artefact = context.store.put(parts[-1].controller)
    return {"artefact": artefact, "notes": list(parts[-1].notes), "seconds": sum(each.seconds for each in parts)}


def _as_set(context: WorkerContext, run_id: int, job: Job) -> dict[str, object]:
    """The mode that the person has set with sliders, around the reference policy, as a controller. Nothing is learned.

    Raises NotSetYet.
    """
    started = time.perf_counter()
    with context.database.reading() as session:
        task = session.get_one(Study, job.study_id).task
        setting = self_setting.newest(session, job.participant)
    if setting is None:
        raise NotSetYet
    weights = FilterWeights(mode=setting.mode).to_bytes()
    beat = context.beat(run_id)
    controller = context.compute.run(Lane.LEARNING, beat, baseline_fitting.controller_of_filter, task, weights)
    notes = ["Set with sliders by the person; not tested for harm, and no promise is made of it."]
    return {"artefact": context.store.put(controller), "notes": notes, "seconds": time.perf_counter() - started}


def _is_outdated(context: WorkerContext, job: Job) -> bool:
    with context.database.reading() as session:
        return due_work.is_outdated(session, job)


def _baseline(context: WorkerContext, run_id: int, job: Job, method: str, reward: str, folder: Path) -> Baseline:
    with context.database.reading() as session:
        study = session.get_one(Study, job.study_id)
        settings = evaluation_plan.settings_of(study)
        seed = session.get_one(Participant, job.participant).seed
        labels = records.seen_labels(session, run_id).label_count
    needs_actions = method == EvaluatedMethod.PBARL_PRINTED
    return Baseline(
        task=study.task,
        method=method,
        reward=context.store.read(reward),
        action_reward=_action_reward(context, run_id, job, reward, folder) if needs_actions else b"",
        labels=labels,
        seed=seed,
        fine_tuning_steps=settings.fine_tuning_steps if settings else 0,
    )


def _action_reward(context: WorkerContext, run_id: int, job: Job, reward: str, folder: Path) -> bytes:
    """A reward model that can rate untried actions: the participant's own if it can, else one of the same labels."""
    kept = folder / "action_reward.safetensors"
    with context.database.reading() as session:
        study = session.get_one(Study, job.study_id)
        seed = session.get_one(Participant, job.participant).seed
        if study.settings.reward_kind is not RewardKind.STRUCTURED:
            return context.store.read(reward)
        preferences = dataset.load_preferences(session, context.store, job.participant)
        scale = dataset.signal_scale(session, context.store, job.study_id)
    if kept.exists():
        return kept.read_bytes()
    if preferences.pairs is None:
        raise NothingToLearnFrom
    context.report(run_id, "learning a reward model on states and actions", 0.01)
    stored, _ = context.compute.run(
        Lane.PATIENT,
        context.beat(run_id),
        learning.fit_reward,
        study.task,
        RewardKind.MLP.value,
        preferences.pairs,
        preferences.targets,
        scale,
        seed,
    )
    kept.write_bytes(stored)
    return stored


def _kept(context: WorkerContext, run_id: int) -> str:
    with context.database.reading() as session:
        return session.scalar(select(Model.artefact_sha256).where(Model.run_id == run_id)) or ""


def _measure(context: WorkerContext, run_id: int, job: Job, reward: str, artefact: str) -> None:
    """What the method does in unseen scenarios; nobody waits for it, so it is filmed meanwhile. Raises LoanEnded."""
    started = time.perf_counter()
    with context.database.reading() as session:
        study = session.get_one(Study, job.study_id)
    scenarios = first_of(EVALUATION, study.settings.evaluation_scenarios)
    model = context.store.read(artefact)

    def beat_at(share: float) -> Callable[[], None]:
        words, done = "driving the method through unseen scenarios", TRAINING_SHARE + (1 - TRAINING_SHARE) * share
        return lambda: context.report(run_id, words, done)

    driven = _driven(context, study.task, model, scenarios, beat_at)
    reference = _reference(context, study.task, scenarios, context.beat(run_id))
    returns = load_reward_model(context.store.read(reward)).returns
    evaluation = evaluate(reference, driven, returns(reference), returns(driven), registry.task(study.task))
    with context.database.writing() as session:
        kept = session.scalar(select(Model).where(Model.run_id == run_id))
        if kept is None:
            raise LoanEnded
        took = {**kept.metrics["seconds"], "evaluation": round(time.perf_counter() - started, 1)}
        kept.metrics = {**kept.metrics, "evaluation": evaluation, "seconds": took}


def _keep(context: WorkerContext, run_id: int, job: Job, method: str, trained: dict[str, object]) -> None:
    """Record the model; nothing is left of somebody else's filter if they have withdrawn. Raises LoanEnded then."""
    artefact = str(trained["artefact"])
    metrics = {"method": method, "notes": trained["notes"], "seconds": {"fit": trained["seconds"]}}
    with context.database.writing() as session:
        try:
            if method in FROM_OTHERS:
                lent_filters.check(session, job, method, trained["draw"])
        except LoanEnded:
            lent_filters.forget(context, session, [artefact])
            raise
        model = records.save_model(session, run_id, ModelKind.METHOD, artefact, metrics)
        if method in FROM_OTHERS:
            lent_filters.take_over_films(session, model)
    context.store.unfinished.forget(_folder(context, job, run_id))


def _driven(
    context: WorkerContext, task: str, model: bytes, scenarios: range, beat_at: Callable[[float], Callable[[], None]]
) -> list[Trajectory]:
    driven: list[Trajectory] = []
    for first in range(0, len(scenarios), CHUNK):
        beat = beat_at(first / len(scenarios))
        driven += context.compute.run(
            Lane.PATIENT, beat, baseline_fitting.drive, task, model, scenarios[first : first + CHUNK]
        )
    return driven


def _reference(context: WorkerContext, task: str, scenarios: range, beat: Callable[[], None]) -> list[Trajectory]:
    """The frozen policy's rollouts, which the training of filters has made before in most cases."""
    key = (task, scenarios)
    if key not in context.references:
        model = baseline_fitting.controller_of_reference(task)
        context.references[key] = _driven(context, task, model, scenarios, lambda share: beat)
    return context.references[key]


def _folder(context: WorkerContext, job: Job, run_id: int) -> Path:
    return context.store.unfinished.folder(job.participant) / f"run-{run_id}"
