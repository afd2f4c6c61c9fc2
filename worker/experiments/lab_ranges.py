"""Finds out, once for everybody, in which ways a laboratory's task can be done otherwise: ranges of its modes.

Every axis is tried at both ends in the same scenarios as the frozen policy. An end is halved, and in the end left out,
while it costs success or makes a signal a disaster; an axis that changes nothing is dropped, for people cannot judge by
what they cannot see.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.installed_tasks.lab import LabDescription
from worker.compute.lab_policies import policy_of
from worker.domain.lab_modes import policy_axes, widest_axes
from worker.domain.modes import Axis
from worker.domain.scenarios import RESPONSE_SURFACE
from worker.domain.task import Answered
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml.policies.asked_policy import AskedPolicy
from worker.ml.policies.onnx_policy import OnnxPolicy
from worker.sim.lab.environment import LabEnvironment
from worker.sim.lab.errors import LabTaskBroken
from worker.sim.lab.found import Found, mark_of

SCENARIOS = 15
HALVINGS = 3
USUAL_TRIALS = 1.5
"""How often an end of an axis is tried in the mean, of at most HALVINGS + 1."""
LOST_SUCCESS = 0.10
DISASTER = 3.0
"""Times the frozen policy's: a signal that grows so much would swamp labels and surface."""
SEEN = 0.05
"""Share of a signal's mean that an end has to change on average, in one signal at least."""
AT_LIMIT = 0.98
USUALLY_AT_LIMIT = 0.2
"""Share of the actions that move the robot; above it nobody can be quicker."""
WITNESS = RESPONSE_SURFACE[-1]
"""The scenario by which an environment is known again."""
CHANGES_NOTHING = "changes nothing that is measured"
_MAY_GROW = ("undelivered", "distance_m")
"""Being slower is no disaster: success says whether it is too slow."""


def usual_episodes(axes: int) -> int:
    """About how many find() drives, one after the other, where there are so many axes to try."""
    return round(SCENARIOS * (1 + 2 * USUAL_TRIALS * axes))


def first_found(described: LabDescription, environment: LabEnvironment, folder: Path) -> Found:
    """What is known from the environment's spaces alone, with the widest ranges. Raises NotAPolicy, LabTaskBroken."""
    low, high = environment.action_bounds
    names = environment.action_names
    moving = described.environment.moving or tuple(range(len(names)))
    by_distance = bool(environment.tip and environment.goal)
    others = tuple(described.policies)
    groups = _groups(described, names, moving)
    axes = (
        policy_axes(others)
        if others
        else widest_axes(by_distance, tuple(names[index] for index in moving), tuple(name for name, _ in groups))
    )
    unknown = sorted(set(described.modes.leave_out) - {axis.name for axis in axes})
    if unknown:
        known = ", ".join(axis.name for axis in axes)
        raise LabTaskBroken("modes.leave_out", f"there is no way {unknown[0]!r}; this task has {known}.")
    return Found(
        mark=mark_of(described, folder),
        observation=environment.observation.fields,
        action=environment.action.fields,
        own_size=environment.own_size,
        bounds=(tuple(low.tolist()), tuple(high.tolist())),
        moving=moving,
        tip=environment.tip,
        goal=environment.goal,
        start_distance_m=1.0,
        axes=tuple(axis for axis in axes if axis.name not in described.modes.leave_out),
        dropped=dict.fromkeys(described.modes.leave_out, "left out by modes.leave_out"),
        notes=(),
        reference={},
        chooses=bool(others),
        groups=groups,
    )


def _groups(
    described: LabDescription, names: Sequence[str], moving: Sequence[int]
) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """The groups of actions that lab.toml names, by place. Raises LabTaskBroken."""
    places = {names[index]: index for index in moving}
    for name, members in described.modes.groups.items():
        key = f"modes.groups.{name}"
        if unknown := [each for each in members if each not in places]:
            raise LabTaskBroken(key, f"{unknown[0]} is no action that moves the robot; there are {', '.join(places)}.")
        if not 0 < len(set(members)) < len(places):
            raise LabTaskBroken(
                key, "a group is some of the actions, not all and not none: all are quicker and slower together anyway."
            )
    return tuple((name, tuple(places[each] for each in members)) for name, members in described.modes.groups.items())


def asked_first(policy: OnnxPolicy | AskedPolicy, environment: LabEnvironment, scenario: int) -> Answered | None:
    """What a policy server says at the beginning of a scenario; None of a policy in a file. Raises NotAPolicy."""
    return policy.first_answer(environment.first_observation(scenario)) if isinstance(policy, AskedPolicy) else None


def changed_since(found: Found, described: LabDescription, folder: Path, environment: LabEnvironment) -> str:
    """Whether the frozen policy's episode is another than when the task was explored, in words; empty: it is the same.

    What was found before there was a witness is taken as it is. Raises NotAPolicy, LabTaskBroken.
    """
    if not found.witness:
        return ""
    now = _witness(environment.episode(policy_of(described, folder, found).mean, WITNESS))
    other = [
        f"{name} {after:.4g} instead of {before:.4g}"
        for name, before, after in zip(described.signal_names, found.witness, now, strict=True)
        if not np.isclose(after, before, rtol=SEEN, atol=1e-6)
    ]
    return (
        "The environment, a function of yours or an installed package has changed since the task was explored: in one "
        f"and the same episode it now measures {', '.join(other)}. It begins anew with "
        f"python -m worker explore --task {described.name}."
        if other
        else ""
    )


def _witness(episode: Trajectory) -> tuple[float, ...]:
    return tuple(episode.signals.sum(axis=0, dtype=np.float64).tolist())


def find(
    described: LabDescription,
    folder: Path,
    environment: LabEnvironment,
    progress: Callable[[str, float], None] = lambda what, share: None,
    scenarios: int = SCENARIOS,
) -> Found:
    """Ranges of every axis. Raises LabTaskBroken when the frozen policy never succeeds or no axis changes anything."""
    found = first_found(described, environment, folder)
    policy = policy_of(described, folder, found)
    numbers = RESPONSE_SURFACE[-scenarios:]
    found = replace(found, answered=asked_first(policy, environment, numbers[0]))
    reference = [environment.episode(policy.mean, scenario) for scenario in numbers]
    success = float(np.mean([each.success for each in reference]))
    if success == 0.0:
        raise LabTaskBroken(
            "success",
            f"the policy succeeded in none of {scenarios} episodes, so there is nothing to do otherwise. "
            "Check what success says at the last step, episode_steps, policy.gain and the policy itself.",
        )
    found = replace(found, start_distance_m=_start_distance_m(found, reference))
    kept, dropped = [], dict(found.dropped)
    if found.chooses:
        found = _told_apart(found, described, folder, environment, reference, progress)
        kept = list(found.axes)
    for number, axis in enumerate(found.axes if not found.chooses else ()):
        progress(f"trying {axis.name}", number / len(found.axes))
        ends = []
        for end in (axis.low, axis.high):
            value, why = _usable_end(found, axis, end, described, environment, policy, reference)
            ends.append(value)
            if why:
                dropped[f"{axis.name} {'below' if end < 0 else 'above'} 0"] = why
        if any(ends):
            kept.append(replace(axis, low=ends[0], high=ends[1]))
    if not kept:
        raise LabTaskBroken(
            "modes", f"no way to do it otherwise is left: {dropped}. There is nothing people could choose."
        )
    at_limit = _share_at_limit(found, policy, reference)
    return replace(
        found,
        axes=tuple(kept),
        dropped=dropped,
        notes=(*found.notes, *_notes(success, at_limit, described)),
        witness=_witness(reference[-1]),
        reference={"episodes": float(scenarios), "success": success, "actions_at_limit": round(at_limit, 3)},
    )


def _told_apart(
    found: Found,
    described: LabDescription,
    folder: Path,
    environment: LabEnvironment,
    reference: Sequence[Trajectory],
    progress: Callable[[str, float], None],
) -> Found:
    """What servers answer, and which policies lose success or do nothing else that is measured.

    They stay, for studies count on them: the choice guards the task for every person anyway.
    """
    notes, answered = [], {}
    for number, axis in enumerate(found.axes):
        progress(f"trying the policy {axis.name}", number / len(found.axes))
        policy = policy_of(described, folder, found, axis.name)
        if said := asked_first(policy, environment, reference[0].scenario):
            answered[axis.name] = said
        changed = [environment.episode(policy.mean, each.scenario) for each in reference]
        if why := _lost(reference, changed) or ("" if _seen(reference, changed) else CHANGES_NOTHING):
            notes.append(f"The policy {axis.name}: {why}. Better take it out of policies.")
    return replace(found, notes=tuple(notes), answered_others=answered)


def _usable_end(
    found: Found,
    axis: Axis,
    end: float,
    described: LabDescription,
    environment: LabEnvironment,
    policy: OnnxPolicy | AskedPolicy,
    reference: Sequence[Trajectory],
) -> tuple[float, str]:
    """The end of an axis that can be used, 0.0 for none; and why it is not all of it."""
    if end == 0.0:
        return 0.0, ""
    family, value, why = found.modes((axis,)), end, ""
    for _ in range(HALVINGS + 1):
        mode = np.array([value], np.float32)

        def act(observation: Float32Array, mode: Float32Array = mode) -> Float32Array:
            action: Float32Array = family.executed(observation, mode, policy.mean(observation))
            return action

        changed = [environment.episode(act, each.scenario) for each in reference]
        wrong = _disaster(described, reference, changed)
        if not wrong:
            return (
                (value, f"narrowed to {value:g}: {why}" if why else "")
                if _seen(reference, changed)
                else (0.0, CHANGES_NOTHING)
            )
        why, value = wrong, value / 2.0
    return 0.0, why


def _disaster(described: LabDescription, reference: Sequence[Trajectory], changed: Sequence[Trajectory]) -> str:
    if lost := _lost(reference, changed):
        return lost
    before, after = _sums(reference), _sums(changed)
    for column, name in enumerate(described.signal_names):
        most = DISASTER * np.abs(before[:, column]).mean()
        if name not in _MAY_GROW and most > 1e-9 and np.abs(after[:, column]).mean() > most:
            return f"{name} grows more than {DISASTER:g} times"
    return ""


def _lost(reference: Sequence[Trajectory], changed: Sequence[Trajectory]) -> str:
    lost = np.mean([each.success for each in reference]) - np.mean([each.success for each in changed])
    return f"success falls by {100 * lost:.0f} points" if lost > LOST_SUCCESS else ""


def _seen(reference: Sequence[Trajectory], changed: Sequence[Trajectory]) -> bool:
    before, after = _sums(reference), _sums(changed)
    usual = np.abs(before).mean(axis=0)
    change = np.abs(after - before).mean(axis=0)
    return bool((change[usual > 1e-9] / usual[usual > 1e-9] > SEEN).any())


def _sums(trajectories: Sequence[Trajectory]) -> FloatArray:
    return np.array([each.signals.sum(axis=0, dtype=np.float64) for each in trajectories])


def _start_distance_m(found: Found, reference: Sequence[Trajectory]) -> float:
    if not (found.tip and found.goal):
        return 1.0
    starts = np.array([each.observations[0] for each in reference])
    return max(float(np.median(np.linalg.norm(starts[:, found.goal] - starts[:, found.tip], axis=1))), 1e-3)


def _share_at_limit(found: Found, policy: OnnxPolicy | AskedPolicy, reference: Sequence[Trajectory]) -> float:
    actions = np.concatenate([each.actions for each in reference])[:, found.moving]
    return float((np.abs(actions).max(axis=1) >= AT_LIMIT).mean())


def _notes(success: float, at_limit: float, described: LabDescription) -> tuple[str, ...]:
    notes = []
    if success < 0.8:
        notes.append(f"The policy succeeds in {success:.0%} of its episodes; differences in success will hide others.")
    if at_limit > USUALLY_AT_LIMIT:
        notes.append(
            f"{at_limit:.0%} of the policy's actions are at their limit, so nobody can have it quicker. Set "
            f"policy.gain below {described.policy.gain:g}, such as {0.5 * described.policy.gain:g}."
        )
    return tuple(notes)
