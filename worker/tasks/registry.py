"""The code of installed tasks, imported when a task is first asked for: environment, look, demonstrator."""

from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from app.installed_tasks import catalogue
from app.installed_tasks.description import InstalledTask
from worker.sim.assistive import AssistiveEnv
from worker.sim.render.clip import FilmedTask
from worker.sim.render.task_look import TaskLook
from worker.task import Task


class UnknownTask(ValueError):
    """This installation cannot simulate the task."""


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
    installed = installed_task(name)
    kind = _object(installed, "environment", installed.description.environment)
    if not (isinstance(kind, type) and issubclass(kind, AssistiveEnv)):
        raise broken(installed, "environment", "is no subclass of worker.sim.assistive.AssistiveEnv")
    described = (name, installed.description.episode_steps)
    if (kind.task.name, kind.task.episode_steps) != described:
        raise broken(
            installed,
            "environment",
            f"is of the task {kind.task.name!r} with {kind.task.episode_steps} steps an episode, not of {name!r} with "
            f"{installed.description.episode_steps}",
        )
    return kind


def task(name: str) -> Task:
    """What learning knows of a task. Raises UnknownTask and TaskBroken."""
    return environment_class(name).task


@cache
def look(name: str) -> TaskLook:
    """How a task is filmed. Raises UnknownTask and TaskBroken."""
    installed = installed_task(name)
    if installed.description.look is None:
        return TaskLook()
    found = _object(installed, "look", installed.description.look)
    if not isinstance(found, TaskLook):
        raise broken(installed, "look", "is no worker.sim.render.task_look.TaskLook")
    return found


def filmed_task(name: str) -> FilmedTask:
    """What a renderer has to know of a task. Raises UnknownTask and TaskBroken."""
    kind = environment_class(name)
    return FilmedTask(kind.robot, kind.tool, look(name))


def demonstrator(name: str) -> Any:
    """A scripted controller for a task that is not found by trial and error, or None. Raises as above."""
    installed = installed_task(name)
    if installed.description.demonstrator is None:
        return None
    return _object(installed, "demonstrator", installed.description.demonstrator)()


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
