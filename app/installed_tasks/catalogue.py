"""Which tasks there are: the entry points ``pbarl_studio.tasks``, and the folder of the package each of them names.

The studio runs from its checkout, so its own are read from the file beside this one that declares them: an
installation that is older than the checkout, or was never made, changes nothing. Those of other packages come from
what is installed. Those of laboratories come from the files that ``LAB_TASKS`` names.
"""

import os
import re
import sys
from argparse import ArgumentTypeError
from collections.abc import Iterator, Mapping, Sequence
from configparser import ConfigParser
from dataclasses import dataclass
from functools import cache
from importlib.machinery import ModuleSpec
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple

from pydantic_settings import BaseSettings, SettingsConfigDict

from app.installed_tasks import lab
from app.installed_tasks.description import NAME, InstalledTask, TaskRefused, read

GROUP = "pbarl_studio.tasks"
OURS, OUR_ENTRY_POINTS = "pbarl-studio", Path(__file__).with_name("entry_points.txt")
_PACKAGE = r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*"
_RESERVED = {"other", "own_clips"}
"""What is said of tasks that are not installed goes by one of these, studies of imported clips by the other."""


class _LabSettings(BaseSettings):
    model_config = SettingsConfigDict(env_file=".env", extra="ignore")

    lab_tasks: str = ""


class Declared(NamedTuple):
    """An entry point."""

    name: str
    package: str
    distribution: str


class BrokenTask(NamedTuple):
    """A task that was declared and cannot be used."""

    name: str
    why: str
    """in sentences, with what to do"""


@dataclass(frozen=True)
class Catalogue:
    """What is installed: our own tasks first, in our order, then others by name."""

    tasks: Mapping[str, InstalledTask]
    broken: Sequence[BrokenTask]


@cache
def installed() -> Catalogue:
    """Read once per process: a package that is added or corrected is seen by the next one."""
    tasks: dict[str, InstalledTask] = {}
    broken = []
    for declared in _declared():
        try:
            if declared.name in tasks:
                raise TaskRefused(f"{tasks[declared.name].package} is a task of the same name.")
            tasks[declared.name] = _read(declared)
        except TaskRefused as error:
            advice = f"Correct it or uninstall {declared.distribution}, and start the studio again."
            broken.append(BrokenTask(declared.name, f"The task {declared.name} cannot be used. {error} {advice}"))
    for file in lab_files():
        try:
            found = lab.read(file)
            if found.name in tasks or found.name in _RESERVED:
                raise TaskRefused(f"{file}: the name {found.name} is not free.")
            tasks[found.name] = found
        except TaskRefused as error:
            advice = "Correct it or take it out of LAB_TASKS, and start the studio again."
            broken.append(BrokenTask(file.parent.name, f"The task of {file} cannot be used. {error} {advice}"))
    return Catalogue(tasks, broken)


def lab_files() -> list[Path]:
    """The files that LAB_TASKS names, separated as in PATH; a folder stands for the lab.toml in it."""
    named = [Path(each) for each in _LabSettings().lab_tasks.split(os.pathsep) if each.strip()]
    return [each / "lab.toml" if each.is_dir() else each for each in named]


def names() -> tuple[str, ...]:
    """Of every task that can be used."""
    return tuple(installed().tasks)


def as_argument(name: str) -> str:
    """The name of a task where somebody types it. Raises ArgumentTypeError, which says what to do."""
    if name in names():
        return name
    left_out = "".join(f" {each.why}" for each in installed().broken)
    raise ArgumentTypeError(
        f"there is no task {name!r}; there are {', '.join(names())}.{left_out} A task of your own is known where "
        "LAB_TASKS names its lab.toml: export LAB_TASKS=path/to/lab.toml, in this shell or in .env."
    )


def usual() -> str:
    """The task that is taken where nobody says which."""
    return names()[0]


def find(name: str) -> InstalledTask | None:
    """A task by its name; None when it is not installed here."""
    return installed().tasks.get(name)


def _declared() -> Iterator[Declared]:
    ours = ConfigParser()
    ours.read(OUR_ENTRY_POINTS, encoding="utf-8")
    yield from (Declared(name, package, OURS) for name, package in ours[GROUP].items())
    for point in sorted(entry_points(group=GROUP)):
        distribution = point.dist.name if point.dist else point.module
        if distribution != OURS:
            yield Declared(point.name, point.value, distribution)


def _read(declared: Declared) -> InstalledTask:
    if not re.fullmatch(NAME, declared.name):
        raise TaskRefused("Its name must be at most 40 small letters, digits and underscores, and begin with a letter.")
    if declared.name in _RESERVED:
        raise TaskRefused("This name is not free.")
    if not re.fullmatch(_PACKAGE, declared.package):
        raise TaskRefused(f"Its entry point must name a package, and is {declared.package!r}.")
    return read(declared.name, declared.package, folder_of(declared.package))


def folder_of(package: str) -> Path:
    """Where a package lies. It is found as an import would find it, and neither it nor a parent is imported."""
    places: list[str] | None = None
    parts = package.split(".")
    for count in range(1, len(parts) + 1):
        name = ".".join(parts[:count])
        spec = _spec(name, places)
        if spec is None or spec.origin is None or spec.submodule_search_locations is None:
            raise TaskRefused(f"There is no package {name} with an __init__.py; its entry point is {package!r}.")
        places = list(spec.submodule_search_locations)
    return Path(places[0] if places else "")


def _spec(name: str, places: list[str] | None) -> ModuleSpec | None:
    found = (finder.find_spec(name, places) for finder in sys.meta_path)
    return next((spec for spec in found if spec is not None), None)
