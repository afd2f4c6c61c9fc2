"""Made before the first filter waits for it: rollouts that are the same for everybody, and the graphs of exports."""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import TypeAlias

from app.domain.choices import Method
from app.domain.study_settings import StudySettings
from worker.analysis.filters.promise import Outcome
from worker.compute import learning, simulation
from worker.compute.archived import Archived, everything_archived
from worker.compute.filter_fitting import CHUNK, driven_as
from worker.compute.pools import Computing, Lane
from worker.domain.lab_modes import PolicyChoice
from worker.domain.scenarios import EVALUATION, first_of, of_promise
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.jobs.learning.fits import filter_config, promise_of
from worker.ml.filters.exported import filter_act
from worker.tasks import registry

_Driven: TypeAlias = tuple[str, Callable[[], Act], range]
"""What rollouts are known as, what is driven, and where."""


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
    frozen: list[_Driven] = [(task, lambda: policy.mean, each) for each in reference_blocks(task, settings)]
    for name, act, scenarios in [*frozen[:1], *_of_archived(task, settings, references), *frozen[1:]]:
        key, made = (name, scenarios), list[Trajectory]()
        while key not in references and len(made) < len(scenarios):
            some = scenarios[len(made) : len(made) + CHUNK]
            made += compute.run(Lane.PATIENT, _no_beat, learning.run_scenarios, task, act(), some, 0.0, 0)
        references.setdefault(key, made)
    for_promise = promise_block(settings, study_seed)
    place, met = (task, of_promise(study_seed).start), list[Outcome]()
    while len(outcomes.get(place, ())) < len(for_promise) and len(met) < len(for_promise):
        some = for_promise[len(met) : len(met) + CHUNK]
        met += compute.run(Lane.PATIENT, _no_beat, learning.outcomes, task, policy.mean, some)
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
    check = [config.check_block(description)] if simulation.archived_policies(task) else []
    return [config.gate_block(description), *check, *home, evaluation]


def _of_archived(
    task: str, settings: StudySettings, references: Mapping[tuple[str, range], Sequence[Trajectory]]
) -> list[_Driven]:
    """What policies that were refined beforehand have to be driven in, for whoever may get one of them."""
    if settings.method is not Method.STUDIO:
        return []
    gate = filter_config(settings).gate_block(registry.task(task))

    def driven(each: Archived) -> _Driven:
        return driven_as(task, each.name), cache(lambda: each.exported(references[task, gate])), gate

    return [driven(each) for each in everything_archived(task)]


def promise_block(settings: StudySettings, study_seed: int) -> range:
    """The scenarios that suffice for the last filter of a person in such a study, if none of them is harmed."""
    if settings.method is not Method.STUDIO:
        return range(0)
    promise = promise_of(settings)
    return of_promise(study_seed)[: promise.batches(promise.needed(promise.error_of(0, promise.planned)))]


def _no_beat() -> None:
    """No run is waiting for this."""
