"""What the first filter would wait for, made beforehand: the reference policy's rollouts, and the graphs of exports."""

from app.domain.choices import Method
from app.domain.study_settings import StudySettings
from worker.compute import learning, simulation
from worker.compute.filter_fitting import CHUNK
from worker.compute.pools import Computing, Lane
from worker.jobs.learning.filters import filter_config
from worker.ml.filters import filter_problem
from worker.scenarios import EVALUATION, first_of
from worker.tasks import registry
from worker.trajectory import Trajectory


def make_ready(
    compute: Computing, references: dict[tuple[str, range], list[Trajectory]], task: str, settings: StudySettings
) -> None:
    """Make what is missing behind everything else that is learning, a few episodes at a time.

    A filter that cannot wait makes its own meanwhile; the rest of them is then left out.
    Raises Interrupted when the worker stops, and ComputeLost when a process was killed.
    """
    policy = simulation.reference_policy(task)
    if settings.method is Method.STUDIO:
        filter_problem.trace(registry.task(task).modes, policy)
    act = policy.mean
    for scenarios in reference_blocks(task, settings):
        key, made = (task, scenarios), list[Trajectory]()
        while key not in references and len(made) < len(scenarios):
            some = scenarios[len(made) : len(made) + CHUNK]
            made += compute.run(Lane.PATIENT, _no_beat, learning.run_scenarios, task, act, some, 0.0, 0)
        references.setdefault(key, made)


def reference_blocks(task: str, settings: StudySettings) -> list[range]:
    """The scenarios in which filters of such a study are compared with the reference policy."""
    config = filter_config(settings)
    gate = [config.gate_block(registry.task(task))] if settings.method is Method.STUDIO else []
    return [*gate, first_of(EVALUATION, config.evaluation_scenarios)]


def _no_beat() -> None:
    """No run is waiting for this."""
