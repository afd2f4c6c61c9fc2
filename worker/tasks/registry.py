"""The code of installed tasks, imported when a task is first asked for: environment, look, demonstrator."""

from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from app.installed_tasks import catalogue
from app.installed_tasks.description import InstalledTask, TaskDescription
from app.installed_tasks.lab import FOUND_FILE, LabDescription
from worker.domain.task import Task
from worker.sim.assistive import AssistiveEnv
from worker.sim.lab.environment import LabEnvironment
from worker.sim.lab.found import Found, mark_of
from worker.sim.render.clip import FilmedTask
from worker.sim.render.task_look import TaskLook


class UnknownTask(ValueError):
    """This installation cannot simulate the task."""


class NotExplored(ValueError):
    """The ways to do a laboratory's task have not been found yet."""


class TaskBroken(ValueError):
    """The task's description names something that its code does not have."""


def installed_task(name: str) -> InstalledTask:
    """What a task's folder says. Raises UnknownTask."""
    found = catalogue.find(name)
    if found is None:
        why = [each.why for each in catalogue.installed().broken if each.name == name]
        known = f"There is no task named {name!r}; this installation knows {', '.join(catalogue.names())}."
        raise UnknownTask(" ".join([known, *why]))
    return found


def checkpoint(name: str) -> Path:
    """The folder with a task's reference policy and what was learned with it. Raises UnknownTask."""
    return installed_task(name).checkpoint


@cache
def environment_class(name: str) -> type[AssistiveEnv]:
    """The environment of a task. Raises UnknownTask and TaskBroken."""
    installed, description = installed_task(name), coded(name)
    kind = _object(installed, "environment", description.environment)
    if not (isinstance(kind, type) and issubclass(kind, AssistiveEnv)):
        raise broken(installed, "environment", "is no subclass of worker.sim.assistive.AssistiveEnv")
    described = (name, description.episode_steps)
    if (kind.task.name, kind.task.episode_steps) != described:
        raise broken(
            installed,
            "environment",
            f"is of the task {kind.task.name!r} with {kind.task.episode_steps} steps an episode, not of {name!r} with "
            f"{description.episode_steps}",
        )
    _check_hints(installed, description, kind.task)
    return kind


def _check_hints(installed: InstalledTask, description: TaskDescription, task: Task) -> None:
    for name, hint in description.hints.items():
        unknown = sorted({*hint.less, *hint.more} - set(task.signals))
        if unknown:
            raise TaskBroken(
                f"{installed.folder / 'task.toml'}: hints.{name} is about {unknown[0]}, which is no signal of it; "
                f"there are {', '.join(task.signals)}."
            )


def task(name: str) -> Task:
    """What learning knows of a task. Raises UnknownTask, TaskBroken, and NotExplored for a laboratory's."""
    described = lab(name)
    return environment_class(name).task if described is None else found_out(name).task(described)


def lab(name: str) -> LabDescription | None:
    """What a laboratory's lab.toml says; None for a task that is a folder of code. Raises UnknownTask."""
    description = installed_task(name).description
    return description if isinstance(description, LabDescription) else None


@cache
def found_out(name: str) -> Found:
    """What the program has found out about a laboratory's task, without any code of it. Raises NotExplored."""
    file = checkpoint(name) / FOUND_FILE
    if not file.exists():
        raise NotExplored(f"Nothing is known yet of the ways to do {name}: run python -m worker explore --task {name}.")
    found, described = Found.load(file), lab(name)
    if described is None or found.mark != mark_of(described, installed_task(name).folder):
        raise NotExplored(
            f"The lab.toml or the policy of {name} has changed since its ways were found: run python -m worker explore "
            f"--task {name} again."
        )
    return found


def lab_environment(name: str) -> LabEnvironment:
    """A laboratory's environment, made anew. Raises UnknownTask, and LabTaskBroken when it is not as it must be."""
    installed, described = installed_task(name), lab(name)
    if described is None:
        raise UnknownTask(f"{name} is not described by a lab.toml.")
    return LabEnvironment(described, installed.folder)


def coded(name: str) -> TaskDescription:
    """Of a task that is a folder of code."""
    installed = installed_task(name)
    if not isinstance(installed.description, TaskDescription):
        raise TaskBroken(
            f"{name} is a laboratory's own environment: it has no robot, person and training of the studio's. Leave "
            "out what needs them: the printed method, fine-tuning, and the tools for new tasks of ours."
        )
    return installed.description


@cache
def look(name: str) -> TaskLook:
    """How a task is filmed. Raises UnknownTask and TaskBroken."""
    installed, description = installed_task(name), coded(name)
    if description.look is None:
        return TaskLook()
    found = _object(installed, "look", description.look)
    if not isinstance(found, TaskLook):
        raise broken(installed, "look", "is no worker.sim.render.task_look.TaskLook")
    return found


def filmed_task(name: str) -> FilmedTask:
    """What a renderer has to know of a task. Raises UnknownTask and TaskBroken."""
    kind = environment_class(name)
    return FilmedTask(kind.robot, kind.tool, look(name))


def demonstrator(name: str) -> Any:
    """A scripted controller for a task that is not found by trial and error, or None. Raises as above."""
    installed, description = installed_task(name), coded(name)
    return None if description.demonstrator is None else _object(installed, "demonstrator", description.demonstrator)()


def _object(installed: InstalledTask, key: str, reference: str) -> Any:
    """What a ``module:name`` of a task's description stands for."""
    module, _, name = reference.partition(":")
    try:
        return getattr(import_module(f"{installed.package}.{module}"), name)
    except Exception as error:  # whatever code from elsewhere may do when it is imported
        raise broken(installed, key, f"cannot be imported: {type(error).__name__}: {error}") from error


def broken(installed: InstalledTask, key: str, what: str) -> TaskBroken:
    """The complaint about what a task's description says there."""
    named = getattr(installed.description, key)
    return TaskBroken(f"{installed.folder / 'task.toml'}: {key} = {named!r} {what}.")
