"""The refinement of a filter in a compute process, with checkpoints: it pauses when it is asked to."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from worker.domain.trajectory import Trajectory
from worker.ml.filters.filter_problem import FilterDraft, FilterProblem
from worker.ml.methods.refinement import Beginning, Refinement, refine
from worker.ml.policies.checkpoint import Checkpoint, Paused, begin_again
from worker.tasks import registry


@dataclass(frozen=True)
class Training:
    """What is refined, and with what; see refine()."""

    task: str
    problem: FilterProblem
    draft: FilterDraft
    known: Sequence[Trajectory]
    reference: Sequence[Trajectory]
    config: Refinement


def train(training: Training, folder: Path) -> FilterDraft | None:
    """The draft with its refined policy; None: it paused at a checkpoint in the folder."""
    torch.set_num_threads(1)
    begin_again(folder)
    make_env, checkpoint = registry.environment_class(training.task), Checkpoint(folder)
    try:
        beginning = Beginning(make_env, training.known, training.reference)
        return refine(training.problem, training.draft, beginning, training.config, checkpoint)
    except Paused:
        return None
