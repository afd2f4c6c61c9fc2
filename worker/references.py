"""What the first filter would wait for, made beforehand: the reference policy's rollouts, and the graphs of exports."""

from app.domain.studies import Method, StudySettings
from worker import laboratory, lessons
from worker.compute import Computing, Lane
from worker.filter_work import filter_config
from worker.ml import filter_problem
from worker.personalisation import CHUNK
from worker.trajectory import Trajectory


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


def reference_blocks(task: str, settings: StudySettings) -> list[range]:
    """The scenarios in which filters of such a study are compared with the reference policy."""
    config = filter_config(settings)
    gate = [config.gate_block(laboratory.task(task))] if settings.method is Method.STUDIO else []
    return [*gate, filter_problem.scenarios_for("evaluation", config.evaluation_scenarios)]


def _no_beat() -> None:
    """No run is waiting for this."""
