"""The refinement of a filter, which takes minutes: whose it is, where its checkpoints lie, how far it is."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from app.domain.study_settings import StudySettings
from app.files.unfinished import REFINEMENT
from worker.compute.filter_fitting import TrainPatiently
from worker.jobs.learning import patience
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.filters.filter_problem import FilterDraft

BEFORE, AFTER = 0.25, 0.9
"""How far a fit is before its refinement and after it."""
_GATED = 0.85
"""How far a fit without one is before its promise."""


def is_refined(settings: StudySettings, job: Job, shared: bool) -> bool:
    """Filters of all answers are, and those for several people (``shared``), which others are compared with."""
    return settings.refinement_steps > 0 and (shared or (job.about.labels or 0) >= settings.labels_per_participant)


def beside(share: float) -> float:
    """What is done of a fit with a refinement, when this share of it would be done without one."""
    if share <= _GATED:
        return BEFORE * share / _GATED
    return AFTER + (1.0 - AFTER) * (share - _GATED) / (1.0 - _GATED)


def trainer(context: WorkerContext, run_id: int, folder: Path, is_outdated: Callable[[], bool]) -> TrainPatiently:
    """What trains part by part, and makes room for whoever waits."""

    def report(share: float) -> None:
        context.report(run_id, f"refining the filter, {share:.0%} done", BEFORE + (AFTER - BEFORE) * share)

    def train(part: Callable[[Path], FilterDraft | None]) -> FilterDraft | None:
        parts = patience.train(context, folder, report, is_outdated, part, lambda draft: draft is not None)
        return parts[-1] if parts else None

    return train


@contextmanager
def folder(context: WorkerContext, run_id: int, job: Job, shared: bool) -> Iterator[Path]:
    """For checkpoints: the participant's own; of what several people said nothing is kept for another process."""
    unfinished = context.store.unfinished
    if not shared:
        yield unfinished.folder(job.participant) / f"refinement-{run_id}"
        return
    unfinished.root.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=unfinished.root, prefix=f"{REFINEMENT}-", ignore_cleanup_errors=True) as name:
        yield Path(name)
