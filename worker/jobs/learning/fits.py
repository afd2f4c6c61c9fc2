"""What fits filters, as a study and a person have it: settings, seeds, the pool; and how far a fit is."""

from app.domain.choices import Method
from app.domain.models import RunKind
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from worker.analysis.filters.promise import Promise
from worker.compute import stages
from worker.compute.filter_fitting import FilterFit
from worker.compute.stages import Stages
from worker.jobs.learning import dataset
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.filters.fitting.pool import Pool

PRESSED_SHARE = 0.7
"""Of the share of scenarios that may be harmed: what a gate lets pass, so that most of it can be promised."""


def stages_of(settings: StudySettings, job: Job) -> Stages:
    """What is done for a filter: less for a person's own who still answers, and is soon given the next.

    Filters for several people are compared with the last ones, and what is made ahead of these begins as they do.
    """
    if job.kind == RunKind.FILTER and settings.method is Method.PRINTED:
        return stages.PRINTED
    if job.kind == RunKind.FILTER and (job.about.labels or 0) < settings.labels_per_participant:
        return stages.QUICK
    return stages.REFINED if settings.refinement_steps else stages.LAST


def pool_of(context: WorkerContext, job: Job) -> Pool:
    """What the study's clips show, as whole episodes."""
    with context.database.reading() as session:
        clips = dataset.pool_clips(session, job.study_id)
    return Pool([dataset.shown(context.store, clip) for clip in clips], [clip.rollout.mode for clip in clips])


def load_draft(context: WorkerContext, artefact: str) -> FilterDraft:
    """A stored draft of a filter."""
    return FilterDraft.from_bytes(context.store.read(artefact))


def filter_config(settings: StudySettings) -> FilterConfig:
    """What a study says about the fitting of its filters."""
    return FilterConfig(
        success_tolerance=settings.success_tolerance,
        pressed_n=settings.harm_force_n,
        pressed_tolerance=round(PRESSED_SHARE * settings.harm_share, 4),
        evaluation_scenarios=settings.evaluation_scenarios,
    )


def promise_of(settings: StudySettings) -> Promise:
    """What a study promises about the harm its filters may do."""
    return Promise(
        share=settings.harm_share,
        confidence=settings.harm_confidence,
        force_n=settings.harm_force_n,
        spilled=settings.harm_spilled,
        planned=len(settings.milestones),
    )


def fitting(context: WorkerContext, run_id: int, job: Job, reward: bytes, *, shared: bool = False) -> FilterFit:
    """What fits a filter to a reward model. ``shared``: not the person's own, so the study's seed is used."""
    with context.database.reading() as session:
        study = session.get_one(Study, job.study_id)
        task, settings = study.task, study.settings
        study_seed = study.seed
        seed = study_seed if shared else session.get_one(Participant, job.participant).seed
        version = 1 if shared else records.next_version(session, job.participant)
    return FilterFit(
        task=task,
        compute=context.compute,
        beat=context.beat(run_id),
        reward=reward,
        seed=seed,
        config=filter_config(settings),
        progress=lambda stage, share: context.report(run_id, stage, share),
        references=context.references,
        promise=promise_of(settings),
        study_seed=study_seed,
        version=version,
        outcomes=context.outcomes,
        stages=stages_of(settings, job),
    )
