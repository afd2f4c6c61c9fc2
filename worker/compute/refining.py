"""The refinement of a filter in a compute process, with checkpoints: it pauses when it is asked to."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from worker.compute.learning import run_scenarios
from worker.domain.trajectory import Trajectory
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterProblem
from worker.ml.policies.checkpoint import Checkpoint, Paused, begin_again, go_on_from
from worker.ml.reinforcement.refinement import Beginning, Refinement, refine, refine_ahead
from worker.ml.reinforcement.refinement_gate import ArchivedDraft, begin_as
from worker.tasks import registry


@dataclass(frozen=True)
class Training:
    """What is refined, and with what; see refine() and Beginning."""

    task: str
    problem: FilterProblem
    mode: FilterDraft
    archived: Sequence[ArchivedDraft]
    known: Sequence[Trajectory]
    reference: Sequence[Trajectory]
    watched: Sequence[Trajectory]
    config: Refinement

    @property
    def start(self) -> ArchivedDraft:
        """What it begins as."""
        return begin_as(self.mode, self.archived)


def train(training: Training, begun: Path | None, folder: Path) -> tuple[FilterDraft, ...]:
    """The drafts of refine(); none: it paused at a checkpoint in the folder.

    ``begun``: the folder of what train_ahead() made, which stays as it is.
    """
    torch.set_num_threads(1)
    begin_again(folder)
    if begun and is_ahead(begun, training.config):
        go_on_from(begun, folder)
    try:
        return refine(training.problem, training.start.draft, _beginning(training), training.config, Checkpoint(folder))
    except Paused:
        return ()


def train_ahead(training: Training, folder: Path) -> bool:
    """Whether all that is made ahead is in the folder; else it paused at a checkpoint there."""
    torch.set_num_threads(1)
    begin_again(folder)
    if is_ahead(folder, training.config):
        return True
    try:
        refine_ahead(training.problem, training.start.draft, _beginning(training), training.config, Checkpoint(folder))
    except Paused:
        return False
    return True


def is_ahead(folder: Path, config: Refinement) -> bool:
    """Whether all that is made ahead is in the folder."""
    counts = Checkpoint(folder).read_counts()
    return counts is not None and counts["steps"] >= config.ahead_steps


def _beginning(training: Training) -> Beginning:
    collect = partial(run_scenarios, training.task)
    make_env = registry.environment_class(training.task)
    return Beginning(make_env, training.known, training.reference, training.watched, collect, training.start.driven)
