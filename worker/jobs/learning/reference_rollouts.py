"""What the first filter would wait for, made beforehand: the reference policy's rollouts, and the graphs of exports."""

from app.domain.choices import Method
from app.domain.study_settings import StudySettings
from worker.analysis.filters.promise import Outcome
from worker.compute import learning, simulation
from worker.compute.filter_fitting import CHUNK
from worker.compute.pools import Computing, Lane
from worker.domain.lab_modes import PolicyChoice
from worker.domain.scenarios import EVALUATION, first_of, of_promise
from worker.domain.trajectory import Trajectory
from worker.jobs.learning.fits import filter_config, promise_of
from worker.ml.filters.exported import filter_act
from worker.tasks import registry


def make_ready(
    compute: Computing,
    references: dict[tuple[str, range], list[Trajectory]],
    outcomes: dict[tuple[str, int], list[Outcome]],
    task: str,
    settings: StudySettings,
    study_seed: int,
) -> None:
    """Make what is missing behind everything else that is learning, a few episodes at a time.

    A filter that cannot wait makes its own meanwhile; the rest of them is then left out.
    Raises Interrupted when the worker stops, and ComputeLost when a process was killed.
    """
    policy = simulation.reference_policy(task)
    if settings.method is Method.STUDIO:
        filter_act.trace(registry.task(task).modes, policy)
    act = policy.mean
    for scenarios in reference_blocks(task, settings):
        key, made = (task, scenarios), list[Trajectory]()
        while key not in references and len(made) < len(scenarios):
            some = scenarios[len(made) : len(made) + CHUNK]
            made += compute.run(Lane.PATIENT, _no_beat, learning.run_scenarios, task, act, some, 0.0, 0)
        references.setdefault(key, made)
    for_promise = promise_block(settings, study_seed)
    place, met = (task, of_promise(study_seed).start), list[Outcome]()
    while len(outcomes.get(place, ())) < len(for_promise) and len(met) < len(for_promise):
        some = for_promise[len(met) : len(met) + CHUNK]
        met += compute.run(Lane.PATIENT, _no_beat, learning.outcomes, task, act, some)
    if len(outcomes.get(place, ())) < len(met):
        outcomes[place] = met


def reference_blocks(task: str, settings: StudySettings) -> list[range]:
    """The scenarios in which filters of such a study are compared with the reference policy, or it is driven alone."""
    config, description = filter_config(settings), registry.task(task)
    evaluation = first_of(EVALUATION, config.evaluation_scenarios)
    if settings.method is not Method.STUDIO:
        return [evaluation]
    is_shielded = not isinstance(description.modes, PolicyChoice)  # whoever chooses among policies gets one as it is
    home = [config.home_block(description)] if is_shielded else []
    return [config.gate_block(description), *home, evaluation]


def promise_block(settings: StudySettings, study_seed: int) -> range:
    """The scenarios that suffice for the last filter of a person in such a study, if none of them is harmed."""
    if settings.method is not Method.STUDIO:
        return range(0)
    promise = promise_of(settings)
    return of_promise(study_seed)[: promise.batches(promise.needed(promise.error_of(0, promise.planned)))]


def _no_beat() -> None:
    """No run is waiting for this."""
