"""Filters: from the participant's reward model to an evaluated, published bundle."""

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.choices import Method, RewardKind
from app.domain.models import Model, ModelKind
from app.domain.preferences import count_labels
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.answers import accuracy
from app.services.answers.misfit import CHANGING, Misfit, doubt_of
from app.services.exports.export_formats import provenance_of
from app.services.monitoring import dashboard
from app.services.participants import visits
from worker.compute import filter_finishing, learning, simulation, stages
from worker.compute.filter_fitting import FilterFit
from worker.compute.pools import Lane
from worker.jobs.learning import dataset, fits, refinement
from worker.jobs.runtime import due_work, records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.export import bundle
from worker.ml.export.bundle import Provenance
from worker.ml.filters.fitting.filter_draft import FilterDraft


class NothingToLearnFrom(AppError):
    """Every answer so far was "can't tell", so there is no reward model and no filter can be trained."""


def train_filter(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Train, evaluate and publish; every stage is a step, so that a killed worker loses one stage at most.

    Nothing is made of a filter that is outdated before it is begun, and none is gone on with once its person has given
    the last answer, for then they wait for the last one.
    """
    if step("is-outdated", is_outdated, context, job, False):
        return
    reward = step("reward", _choose_reward, context, run_id, job)
    if not reward:
        return
    with context.database.reading() as session:
        settings = session.get_one(Study, job.study_id).settings
    draft = ""
    for stage in stages.before_finish(fits.stages_of(settings, job)):
        if step(f"is-outdated-before-{stage}", is_outdated, context, job, True):
            return
        draft = step(stage, fit_stage, context, run_id, job, reward, draft, stage)
        if not draft:
            return
    step("publish", _publish, context, run_id, job, reward, draft)


def is_outdated(context: WorkerContext, job: Job, begun: bool) -> bool:
    """See due_work.is_outdated."""
    with context.database.reading() as session:
        return due_work.is_outdated(session, job, begun=begun)


def reward_to_follow(session: Session, run_id: int, job: Job) -> Model:
    """The participant's newest reward model; the run is now about the labels behind it. Raises NothingToLearnFrom."""
    model = records.newest_model(session, job.participant, ModelKind.REWARD)
    if model is None:
        raise NothingToLearnFrom
    records.set_labels(session, run_id, model.label_count, model.label_hash)
    return model


def _choose_reward(context: WorkerContext, run_id: int, job: Job) -> str:
    """The artefact of the reward model to follow: the newest. The printed method needs one on states and actions.

    Empty when the newest filter has already seen the same labels: somebody who answers faster than filters are trained
    passes several milestones at once.
    """
    with context.database.writing() as session:
        study = session.get_one(Study, job.study_id)
        task, settings = study.task, study.settings
        model = reward_to_follow(session, run_id, job)
        newest = records.newest_model(session, job.participant, ModelKind.FILTER)
        if newest is not None and newest.label_hash == model.label_hash:
            return ""
    if settings.method is Method.STUDIO or settings.reward_kind is not RewardKind.STRUCTURED:
        return model.artefact_sha256
    context.report(run_id, "learning a reward model on states and actions", 0.05)
    with context.database.reading() as session:
        preferences = dataset.load_preferences(session, context.store, job.participant)
        scale = dataset.signal_scale(session, context.store, job.study_id)
    if preferences.pairs is None:
        raise NothingToLearnFrom
    stored, _ = context.compute.run(
        Lane.LEARNING,
        context.beat(run_id),
        learning.fit_reward,
        task,
        RewardKind.MLP.value,
        preferences.pairs,
        preferences.targets,
        scale,
        model.seed,
    )
    return context.store.put(stored)


def fit_stage(
    context: WorkerContext, run_id: int, job: Job, reward: str, draft: str, stage: str, shared: bool = False
) -> str:
    """One stage of the fit: the artefact of a draft in, that of a better one out. ``shared``: see fits.fitting()."""
    if stage == "refinement":
        return refinement.refine(context, run_id, job, reward, draft, shared)
    fit = fits.fitting(context, run_id, job, context.store.read(reward), shared=shared)
    if stage == "quick":
        result = _find_quickly(context, job, fit)
    elif stage == "mode":
        result = fit.find_mode(fits.pool_of(context, job))
    elif stage == "printed":
        result = fit.fit_printed()
    elif stage == "archived":
        result = _choose_archived(context, job, fit, fits.load_draft(context, draft), shared)
    else:
        by_name = {"residual": fit.train_residual, "gate": fit.gate_residual, "promise": fit.keep_promise}
        result = by_name[stage](fits.load_draft(context, draft))
    return context.store.put(result.to_bytes())


def _find_quickly(context: WorkerContext, job: Job, fit: FilterFit) -> FilterDraft:
    """A policy refined beforehand goes further than what is not understood can be followed."""
    doubt = refinement.unlearned_doubt(context, job)
    draft = fit.find_quickly(fits.pool_of(context, job), archived=doubt is None)
    return refinement.unrefined(draft, doubt) if doubt and simulation.archived_policies(fit.task) else draft


def _choose_archived(context: WorkerContext, job: Job, fit: FilterFit, draft: FilterDraft, shared: bool) -> FilterDraft:
    """The best policy refined beforehand, if better."""
    if not simulation.archived_policies(fit.task):
        return draft
    doubt = None if shared else refinement.unlearned_doubt(context, job)
    if doubt:
        return refinement.unrefined(draft, doubt)
    return fit.choose_archived(draft, fits.pool_of(context, job))


def _publish(context: WorkerContext, run_id: int, job: Job, reward: str, draft: str) -> None:
    """Evaluate on unseen scenarios, write the bundle, and only then let anybody see it."""
    fit = fits.fitting(context, run_id, job, context.store.read(reward))
    with context.database.reading() as session:
        participant = session.get_one(Participant, job.participant)
        study = session.get_one(Study, job.study_id)
        model = records.newest_model(session, job.participant, ModelKind.REWARD)
        version = records.next_version(session, job.participant)
        run = records.seen_labels(session, run_id)
        export = provenance_of(session, study)
        notes = [
            *notes_on_script(participant),
            *notes_on_foresight(dashboard.curve_of(session, job.participant)),
            *notes_on_misfit(doubt_of([model] if model else [])),
            *notes_on_visits(session, participant),
        ]
    provenance = Provenance(
        study=study.name,
        participant=participant.code,
        version=version,
        label_count=run.label_count,
        label_hash=run.label_hash,
        seed=participant.seed,
        created_at=run.started_at.isoformat(timespec="seconds"),
        lock_hash=export.lock_hash,
        deviations=export.deviations,
    )
    learned = {**(model.metrics if model else {}), "foresight_notes": notes}
    finished = filter_finishing.finish(fit, fits.load_draft(context, draft), provenance, learned)
    packed = finished.bundle if context.key is None else bundle.signed(finished.bundle, context.key.signed)
    model_artefact, bundle_artefact = context.store.put(finished.filter_weights), context.store.put(packed)
    with context.database.writing() as session:
        saved = records.save_model(session, run_id, ModelKind.FILTER, model_artefact, finished.metrics)
        records.save_bundle(session, saved, version, bundle_artefact, len(packed))


def notes_on_script(participant: Participant) -> Sequence[str]:
    """What the model card has to say when nobody has answered."""
    if participant.scripted_as is None:
        return []
    return [
        f"{participant.code} is not a person: a program gave the answers of a user called {participant.scripted_as}."
    ]


def notes_on_foresight(curve: accuracy.Curve) -> Sequence[str]:
    """What the model card has to say about a reward model that nobody may rely on yet."""
    if curve.proven:
        return []
    foreseen = f"{curve.overall.correct:g} of {curve.overall.scored}" if curve.overall else "none"
    return [
        "The reward model behind this filter has not been shown to be better than guessing: before they were given it"
        f" foresaw {foreseen} of this person's preferences on pairs drawn at random. What it says about the person, the"
        " learned preference included, may mean nothing."
    ]


def notes_on_misfit(misfit: Misfit | None) -> Sequence[str]:
    """What the model card has to say about a reward model that does not fit the person."""
    if misfit is None or not (misfit.is_learned or misfit.is_shown):
        return []
    if misfit.is_learned and misfit.explanation == CHANGING:
        return [
            f"This person's answers are explained better by {misfit.words}. The reward model behind this filter has "
            "their mean over the last quarter of the answers."
        ]
    if misfit.is_learned:
        return [
            f"Weighted signals alone explain this person's answers less well than with terms for {misfit.words}, which "
            "the reward model behind this filter has."
        ]
    return [
        "The reward model behind this filter adds up weighted signals, and that does not fit this person: their answers"
        f" are explained better by {misfit.words}. The filter may suit them less than it could."
    ]


def notes_on_visits(session: Session, participant: Participant) -> Sequence[str]:
    """What the model card has to say about answers that are not counted in it."""
    before = visits.before(session, participant.id)
    if not before:
        return []
    earlier = sum(count_labels(session, select(Participant.id).where(Participant.id.in_(before))).values())
    return [f"This is visit {participant.visit}: {earlier} answers of the visits before were learned from as well."]
