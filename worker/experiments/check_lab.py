"""Check a lab.toml: what is missing or wrong, in words; three episodes, and a contact sheet of them."""

import contextlib
import json
import math
import re
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from tqdm import tqdm

from app.installed_tasks import lab
from app.installed_tasks.description import InstalledTask, TaskRefused
from app.installed_tasks.lab import FOUND_FILE, SURFACE_FILE, WHERE, LabDescription, whole
from app.paths import LOCKS
from worker.compute.lab_clips import SAME_WITHIN
from worker.compute.lab_policies import policy_of
from worker.domain.scenarios import POLICY_TEST
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.experiments import disagreement, fit_response_surface, lab_ranges
from worker.ml.policies.asked_policy import AskedPolicy
from worker.ml.policies.onnx_policy import NotAPolicy, OnnxPolicy
from worker.sim.lab.environment import LabEnvironment, Picture
from worker.sim.lab.errors import LabTaskBroken
from worker.sim.lab.found import Found, mark_of

EPISODES, PICTURES = 3, 6
SLOW_EPISODE_S = 5.0
"""Above this the exploration's six thousand episodes take more than four hours on two processes."""
REPEATED_WITHIN = SAME_WITHIN / 10
"""Largest difference of an episode repeated: MuJoCo's solver begins where it was, and differs in the last digits."""
SHEET_WIDTH_PX = 1440


class Checked(NamedTuple):
    """What a check found. Without ``wrong`` the task can be used."""

    wrong: tuple[str, ...]
    remarks: tuple[str, ...]
    sheet: Path | None


def check(file: Path, sheet: Path | None = None) -> int:
    """Say what is missing or wrong in a lab.toml, run three episodes and write a contact sheet (docs/your_robot.md)."""
    file = file / "lab.toml" if file.is_dir() else file
    found = checked(file, sheet or file.with_name("contact_sheet.png"))
    for each in found.remarks:
        sys.stdout.write(f"{each}\n")
    for each in found.wrong:
        sys.stderr.write(f"Wrong: {each}\n")
    if found.wrong:
        sys.stderr.write("What each key means: docs/lab_toml.md\n")
    if not found.wrong:
        installed = lab.read(file)
        name = installed.name
        explore = "" if _explored(installed) and whole(installed) else f"  python -m worker explore --task {name}\n"
        sys.stdout.write(
            f"{file} can be used. Next:\n  export LAB_TASKS={file}\n{explore}"
            f"  python -m worker rehearse --task {name} --labels 30\n  python -m app demo --task {name}\n"
        )
    return 1 if found.wrong else 0


def checked(file: Path, sheet: Path) -> Checked:
    """The same as values; the sheet is written when episodes ran."""
    try:
        installed = lab.read(file)
    except TaskRefused as error:
        return Checked((str(error),), (), None)
    described = installed.description
    assert isinstance(described, LabDescription)  # noqa: S101 -- which lab.read() reads
    environment, key = None, _key(described, "")
    try:
        environment = LabEnvironment(described, installed.folder)
        found = lab_ranges.first_found(described, environment, installed.folder)
        policies = {}
        for name in ("", *described.policies):
            key = _key(described, name)
            policies[name] = policy_of(described, installed.folder, found, name)
            lab_ranges.asked_first(policies[name], environment, POLICY_TEST[0])
        ran = _run(described, environment, policies, len(found.axes), sheet)
        return ran if ran.wrong else ran._replace(remarks=(*ran.remarks, *_disagree(installed, described, environment)))
    except LabTaskBroken as error:
        return Checked((f"{file}: {error}",), (), None)
    except NotAPolicy as error:
        return Checked((f"{file}: {key}: {error}",), (), None)
    finally:
        if environment is not None:
            environment.close()


def _key(described: LabDescription, name: str) -> str:
    """Where lab.toml names a policy."""
    said = described.policy_named(name)
    of = next(where for where in WHERE if getattr(said, where) is not None)
    return f"policies.{name}.{of}" if name else f"policy.{of}"


def _run(
    described: LabDescription,
    environment: LabEnvironment,
    policies: Mapping[str, OnnxPolicy | AskedPolicy],
    axes: int,
    sheet: Path,
) -> Checked:
    shown = set(np.linspace(0, described.episode_steps - 1, PICTURES).round().astype(int).tolist())
    rows: list[list[Picture]] = []
    trajectories, seconds, policy = [], [], policies[""]
    for scenario in POLICY_TEST[:EPISODES]:
        started, row = time.perf_counter(), list[Picture]()
        trajectories.append(environment.episode(policy.mean, scenario))
        seconds.append(time.perf_counter() - started)
        again = environment.episode(
            policy.mean,
            scenario,
            take=lambda step, row=row: row.append if step in shown else None,  # type: ignore[misc]
        )
        rows.append(row)
        if np.abs(again.observations - trajectories[-1].observations).max() > REPEATED_WITHIN:
            return Checked((_not_repeated(again, trajectories[-1], described),), (), None)
    done = {"": trajectories[0]}
    for name in described.policies:
        rows.append([])
        done[name] = environment.episode(
            policies[name].mean, POLICY_TEST[0], take=lambda step: rows[-1].append if step in shown else None
        )
    _write(sheet, rows)
    wrong = _remember(described, policies, done)
    if not any(each.success for each in trajectories):
        wrong.append(
            f"success: none of {EPISODES} episodes succeeded. Check what success says at the last step, episode_steps, "
            "policy.gain and the policy itself."
            + _lost_again(trajectories)
            + (
                " A zip of Stable-Baselines3 lacks VecNormalize's statistics; export such a policy as ONNX, with them "
                "inside."
                if (described.policy.file or "").endswith(".zip")
                else ""
            )
        )
    remarks = _remarks(described, trajectories, seconds, axes, sheet)
    if described.policies:
        failed = [name for name in described.policies if not done[name].success]
        also = f" Not done by {', '.join(failed)}." if failed else ""
        remarks = (
            *remarks,
            f"The last {len(described.policies)} rows of it are {', '.join(described.policies)}.{also}",
        )
    return Checked(tuple(wrong), remarks, sheet)


def _remember(
    described: LabDescription, policies: Mapping[str, OnnxPolicy | AskedPolicy], done: Mapping[str, Trajectory]
) -> list[str]:
    """Which servers and functions answer otherwise when they are asked in another order, in words."""
    wrong = []
    for name, policy in policies.items():
        try:
            if isinstance(policy, AskedPolicy):
                policy.require_no_memory(done[name].observations[:-1])
        except NotAPolicy as error:
            wrong.append(f"{_key(described, name)}: {error}")
    return wrong


def _disagree(installed: InstalledTask, described: LabDescription, environment: LabEnvironment) -> tuple[str, ...]:
    """Whether people will have anything to disagree about, once it is known in which ways the task can be done."""
    found = _explored(installed)
    if found is None:
        return ("Whether behaviours differ enough for people to disagree is said here after `explore`.",)
    if why := lab_ranges.changed_since(found, described, installed.folder, environment):
        return (why,)
    task = found.task(described)
    with tqdm(
        total=disagreement.SCENARIOS * (1 + disagreement.per_scenario(task)) + 1, desc="do people disagree"
    ) as bar:

        def episode(act: Act, scenario: int) -> Trajectory:
            bar.update()
            return environment.episode(act, scenario)

        def policy_named(name: str) -> Act:
            return policy_of(described, installed.folder, found, name).mean

        differences = disagreement.measured(task, cache(policy_named), episode, described.usual_clip_steps)
    return (*disagreement.in_words(differences, task), *_little_foreseen(installed, task))


def _little_foreseen(installed: InstalledTask, task: Task) -> tuple[str, ...]:
    """What filters cannot serve, once the surface is there; where one of several policies is chosen there is none."""
    record = (installed.checkpoint / SURFACE_FILE).with_suffix(".json")
    said = fit_response_surface.little_foreseen(json.loads(record.read_text()), task) if record.exists() else ""
    return (said,) if said else ()


def _explored(installed: InstalledTask) -> Found | None:
    """What was found out about a lab.toml as it is now."""
    assert isinstance(installed.description, LabDescription)  # noqa: S101 -- which lab.read() reads
    file = installed.checkpoint / FOUND_FILE
    found = Found.load(file) if file.exists() else None
    return found if found and found.mark == mark_of(installed.description, installed.folder) else None


def _not_repeated(again: Trajectory, before: Trajectory, described: LabDescription) -> str:
    difference = float(np.abs(again.observations - before.observations).max())
    advice = (
        'Set environment.reset = "rebuild".'
        if described.environment.reset == "seed"
        else "It must draw everything random from reset(seed=...), or the same scenario cannot be compared with itself."
    )
    differ = f"observations differ by {difference:.2g}"
    return f"environment: the same seed and policy gave another episode ({differ}). {advice}"


def _lost_again(trajectories: Sequence[Trajectory]) -> str:
    """In how many episodes success came and went, in words."""
    lost = sum(not each.success and not each.signals[:, 0].all() for each in trajectories)
    return (
        f" In {lost} of {len(trajectories)} episodes it had succeeded at some step, and no longer at the last, which "
        "counts: lower episode_steps, or name a success that stays."
        if lost
        else ""
    )


def _remarks(
    described: LabDescription, trajectories: list[Trajectory], seconds: list[float], axes: int, sheet: Path
) -> tuple[str, ...]:
    usual = float(np.median(seconds))
    successes = sum(each.success for each in trajectories)
    remarks = [
        f"{successes} of {len(trajectories)} episodes succeeded.{_lost_again(trajectories)}",
        f"An episode takes {usual:.2f} s{'' if described.policies else _exploring(usual, axes)}.",
        f"Contact sheet: {sheet}",
    ]
    first = trajectories[0].observations
    if all(np.abs(each.observations - first).max() <= REPEATED_WITHIN for each in trajectories[1:]):
        remarks.append(
            "Every scenario is the same situation, so nothing is shown of any other: let reset(seed=...) draw what "
            "differs (docs/lab_toml.md, The same scenario again)."
        )
    sums = np.array([each.signals.sum(axis=0) for each in trajectories])
    silent = [name for name, column in zip(described.signal_names, sums.T, strict=True) if not column.any()]
    if silent:
        remarks.append(f"Always 0 in these episodes: {', '.join(silent)}. What never varies cannot be judged by.")
    if usual > SLOW_EPISODE_S and not described.policies:
        remarks.append(
            "This is a slow environment. Lower episode_steps, use a quicker simulation, or explore fewer scenarios "
            "(--scenarios)."
        )
    if changed := replaced_packages(each.read_text() for each in LOCKS if each.is_file()):
        ours = " ".join(each.partition(" ")[0] for each in changed)
        remarks.append(
            f"An installation has replaced packages of the studio: {'; '.join(changed)}. Put them back with python -m "
            f"pip install {ours}; what needs others, such as a policy server, belongs into an environment of its own."
        )
    missing = [language for language in ("en", "de") if language not in described.instructions]
    if missing:
        remarks.append(f"instructions.{missing[0]} is missing: participants of that language read neutral words.")
    return tuple(remarks)


def _exploring(episode_s: float, axes: int) -> str:
    """Ranges are found by one process, then two drive the blocks."""

    def lasts(scenarios: int) -> str:
        episodes = lab_ranges.usual_episodes(axes) + fit_response_surface.block_episodes(scenarios) / 2
        minutes = math.ceil(episodes * episode_s / 60)
        return f"{minutes} min" if minutes < 120 else f"{minutes / 60:.0f} hours"

    few, usual = fit_response_surface.FEW_SCENARIOS, fit_response_surface.SCENARIOS
    return f", so exploring takes about {lasts(usual)} on two processes, {lasts(few)} with --scenarios {few}"


def replaced_packages(locks: Iterable[str]) -> list[str]:
    """Packages of the first lock, with which the studio runs, in a version that no lock has, each with both."""
    running, *others = (dict(re.findall(r"^([a-z0-9._-]+)==([^\s;\\]+)", lock, re.MULTILINE)) for lock in locks)
    pinned = {name: {wanted, *(other[name] for other in others if name in other)} for name, wanted in running.items()}
    found = []
    for name, wanted in pinned.items():
        with contextlib.suppress(PackageNotFoundError):
            if (there := version(name)) not in wanted:
                found.append(f"{name}=={running[name]} was replaced by {there}")
    return found


def _write(sheet: Path, rows: list[list[Picture]]) -> None:
    """Episodes below each other, time to the right."""
    width = SHEET_WIDTH_PX // PICTURES
    height = round(width * rows[0][0].shape[0] / rows[0][0].shape[1])
    whole = Image.new("RGB", (width * PICTURES, height * len(rows)))
    for row, pictures in enumerate(rows):
        for column, picture in enumerate(pictures):
            whole.paste(Image.fromarray(picture).resize((width, height)), (column * width, row * height))
    whole.save(sheet)
