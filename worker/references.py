"""What the first filter would wait for, made beforehand: the reference policy's rollouts, and the graphs of exports."""

from app.domain.studies import Method, StudySettings
from worker import laboratory, lessons
from worker.compute import Lane
from worker.ml import filter_problem
from worker.personalisation import CHUNK, reference_blocks
from worker.trajectory import Trajectory
from worker.turns import Computing


def make_ready(
    compute: Computing, references: dict[tuple[str, range], list[Trajectory]], task: str, settings: StudySettings
) -> None:
    """Make what is missing behind everything else that is learning, a few episodes at a time.

    A filter that cannot wait makes its own meanwhile; the rest of them is then left out.
    Raises Interrupted when the worker stops, and ComputeLost when a process was killed.
    """
    policy = laboratory.reference_policy(task)
    if settings.method is Method.STUDIO:
        filter_problem.trace(laboratory.task(task).modes, policy)
    act = policy.mean
    for scenarios in reference_blocks(task, settings):
        key, made = (task, scenarios), list[Trajectory]()
        while key not in references and len(made) < len(scenarios):
            some = scenarios[len(made) : len(made) + CHUNK]
            made += compute.run(Lane.PATIENT, _no_beat, lessons.run_scenarios, task, act, some, 0.0, 0)
        references.setdefault(key, made)


def _no_beat() -> None:
    """No run is waiting for this."""
