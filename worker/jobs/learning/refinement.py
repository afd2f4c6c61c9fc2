"""The refinement of a person's last filter, which takes minutes: most of it is done while they still answer.

What is made ahead follows the first of the answers, whenever it is made, so that the same answers give the same
filter. It lies in a folder of the person's until their last filter goes on from there; what is missing is made then.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from sqlalchemy import select

from app.domain.models import ModelKind
from app.domain.preferences import count_labels
from app.domain.run_keys import AHEAD
from app.domain.studies import Participant, Study
from app.files.unfinished import REFINEMENT
from app.installed_tasks.refinements import answers_ahead
from app.services.answers.misfit import Misfit, doubt_of
from worker.compute import refining, stages
from worker.compute.filter_fitting import T, TrainPatiently
from worker.compute.pools import Lane
from worker.jobs.learning import dataset, fits, patience, reward_models
from worker.jobs.runtime import due_work, records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.policies.checkpoint import Abandoned, go_on_from
from worker.ml.reinforcement.refinement import Refinement


def refine_ahead(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Make what the last filter will go on from, or as much of it as there is time for."""
    step("ahead", _make_ahead, context, run_id, job)


def refine(context: WorkerContext, run_id: int, job: Job, reward: str, draft: str, shared: bool) -> str:
    """The artefact of the refined filter, or of the same one where none is to be refined; empty: nobody needs it."""
    with context.database.reading() as session:
        settings = session.get_one(Study, job.study_id).settings
    doubt = None if shared else unlearned_doubt(context, job)
    if doubt:
        _clear_away(context, job)
        return context.store.put(unrefined(fits.load_draft(context, draft), doubt).to_bytes())
    lane = Lane.PATIENT if shared else Lane.LEARNING  # somebody waits for their last filter
    is_outdated = (lambda: False) if shared else partial(_is_outdated, context, job)
    begun = None if shared else _begun(context, run_id, job, is_outdated)
    fit = fits.fitting(context, run_id, job, context.store.read(reward), shared=shared)
    with _folder(context, run_id, job, shared) as folder:
        train: TrainPatiently[tuple[FilterDraft, ...]] = _trainer(context, run_id, folder, lane, is_outdated, bool)
        known = fits.pool_of(context, job).rollouts
        result = fit.refine(fits.load_draft(context, draft), known, settings.refinement_steps, begun, train)
        artefact = context.store.put(result.to_bytes()) if result else ""
        context.store.unfinished.forget(folder)
    if artefact and begun:
        _clear_away(context, job)
    return artefact


def unlearned_doubt(context: WorkerContext, job: Job) -> Misfit | None:
    """About whether the reward model says all that counts for the person, where nothing richer is followed."""
    with context.database.reading() as session:
        newest = records.newest_model(session, job.participant, ModelKind.REWARD)
    doubt = doubt_of([newest] if newest else [])
    return doubt if doubt and not doubt.is_learned else None


def unrefined(draft: FilterDraft, doubt: Misfit) -> FilterDraft:
    """The same filter; a refinement follows the reward model further than it can be trusted."""
    note = (
        f"The filter was not refined: {doubt.words} may count, which the reward model says not well enough to go far."
    )
    return replace(draft, notes=(*draft.notes, note))


def _clear_away(context: WorkerContext, job: Job) -> None:
    """Forget what was made ahead."""
    for done in context.store.unfinished.folder(job.participant).glob(f"{AHEAD}-*"):
        context.store.unfinished.forget(done)


def _make_ahead(context: WorkerContext, run_id: int, job: Job) -> None:
    folder = _folder_ahead(context, job)
    if folder is None:
        return
    with suppress(Abandoned):  # the last filter is there already, and has cleared away
        _train_ahead(context, run_id, job, folder, partial(_has_answered_everything, context, job))


def _begun(context: WorkerContext, run_id: int, job: Job, is_outdated: Callable[[], bool]) -> Path | None:
    """The folder of all that is made ahead; None: the answers that it would follow say nothing.

    What is not whole is made in another folder: a busy machine may still be at work on it in the first one, and would
    have it pause.
    """
    there = _folder_ahead(context, job)
    if there is None:
        return None
    with context.database.reading() as session:
        steps = session.get_one(Study, job.study_id).settings.refinement_steps
    if refining.is_ahead(there, Refinement(steps)):
        return there
    here = there.with_name(f"{there.name}-{run_id}")
    here.mkdir(exist_ok=True)
    context.store.unfinished.bring(here)
    go_on_from(there, here)
    _train_ahead(context, run_id, job, here, is_outdated)
    return here


def _folder_ahead(context: WorkerContext, job: Job) -> Path | None:
    """Where that is made which follows the first of somebody's answers; None: they say nothing."""
    with context.database.reading() as session:
        first = answers_ahead(session.get_one(Study, job.study_id).settings.labels_per_participant)
        followed = dataset.load_preferences(session, context.store, job.participant, first)
    if followed.pairs is None:
        return None
    folder = context.store.unfinished.folder(job.participant) / f"{AHEAD}-{followed.label_hash[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    context.store.unfinished.bring(folder)
    return folder


def _train_ahead(context: WorkerContext, run_id: int, job: Job, folder: Path, is_outdated: Callable[[], bool]) -> None:
    """From the checkpoint in this folder on."""
    with context.database.reading() as session:
        settings = session.get_one(Study, job.study_id).settings
    if refining.is_ahead(folder, Refinement(settings.refinement_steps)):
        return
    first = answers_ahead(settings.labels_per_participant)
    fitted = reward_models.fit(context, run_id, job.participant, Lane.LEARNING, first)
    if fitted is None:
        return
    pool, fit = fits.pool_of(context, job), fits.fitting(context, run_id, job, fitted.stored)
    # Not in the patient lane, whose processes get next to nothing beside an earlier filter and clips.
    train: TrainPatiently[bool] = _trainer(context, run_id, folder, Lane.LEARNING, is_outdated, bool)
    fit.refine_ahead(pool, settings.refinement_steps, train)


def _trainer(
    context: WorkerContext,
    run_id: int,
    folder: Path,
    lane: Lane,
    is_outdated: Callable[[], bool],
    is_whole: Callable[[T], bool],
) -> TrainPatiently[T]:
    """What trains part by part, and makes room for whoever waits longer."""

    def report(share: float) -> None:
        done = stages.so_far(stages.REFINED, "refinement", stages.TRAINED * share)
        context.report(run_id, f"refining the filter, {share:.0%} done", done)

    def train(part: Callable[[Path], T]) -> T | None:
        parts = patience.train(context, folder, lane, report, is_outdated, is_whole, part)
        return parts[-1] if parts else None

    return train


def _is_outdated(context: WorkerContext, job: Job) -> bool:
    with context.database.reading() as session:
        return due_work.is_outdated(session, job, begun=True)


def _has_answered_everything(context: WorkerContext, job: Job) -> bool:
    """Then their last filter goes on from here."""
    with context.database.reading() as session:
        answered = count_labels(session, select(Participant.id).where(Participant.id == job.participant))
        wanted = session.get_one(Study, job.study_id).settings.labels_per_participant
    return answered.get(job.participant, 0) >= wanted


@contextmanager
def _folder(context: WorkerContext, run_id: int, job: Job, shared: bool) -> Iterator[Path]:
    """For checkpoints: the participant's own; of what several people said nothing is kept for another process."""
    unfinished = context.store.unfinished
    if not shared:
        yield unfinished.folder(job.participant) / f"{REFINEMENT}-{run_id}"
        return
    unfinished.root.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=unfinished.root, prefix=f"{REFINEMENT}-", ignore_cleanup_errors=True) as name:
        yield Path(name)
