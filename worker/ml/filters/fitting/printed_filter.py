"""The paper's filter as a draft like any other, so that it is evaluated, exported and published in the same way."""

import time
from collections.abc import Sequence

from worker.domain.trajectory import Trajectory
from worker.ml.filters.encoders.fitted_q import Transitions
from worker.ml.filters.encoders.pbarl_printed import PrintedConfig, train
from worker.ml.filters.exported.filter_module import FilterWeights, state_of
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterProblem, ReportProgress
from worker.ml.policies.reference import looked_into
from worker.ml.rewards.action_ranking import ranker_at


def fit_printed(
    problem: FilterProblem,
    reference: Sequence[Trajectory],
    config: PrintedConfig | None = None,
    progress: ReportProgress = lambda stage, share: None,
) -> FilterDraft:
    """Train the printed method on the transitions of reference rollouts. Its gate is 1: the paper has none.

    Raises TypeError for a reward model that cannot score actions that were never executed (the structured kind reads
    signals measured after the action); fit one of the other kinds to the same labels.
    """
    ranker = ranker_at(problem.reward, reference)
    started = time.perf_counter()
    data = Transitions.joined(
        [Transitions.of(each.observations, each.actions, problem.reward.rewards_of(each)) for each in reference]
    )

    def report(share: float) -> None:
        progress("training the printed action encoder", share)

    settings = config or PrintedConfig(betas=problem.task.printed_betas)
    encoder, losses = train(looked_into(problem.policy), ranker, data, settings, problem.seed, report)
    notes = (
        f"Printed method: {settings.steps} steps (the paper: 1.5e7), n = {settings.list_length},"
        f" eps = {settings.epsilon:g}, tau = {settings.temperature:g}.",
        "Last losses: " + ", ".join(f"{name} {value:.3g}" for name, value in losses.items() if name != "seconds") + ".",
    )
    draft = FilterDraft(FilterWeights(method="printed", encoder=state_of(encoder)), notes=notes)
    return draft.timed("printed_training", started)
