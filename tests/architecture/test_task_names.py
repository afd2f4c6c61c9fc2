"""A task is named in its folder and nowhere else; what the folder says fits what its code does."""

import re
from pathlib import Path

import pytest

from app.domain.protocol import Language
from app.installed_tasks import catalogue
from app.web.texts.task_words import words_of
from worker.domain.trajectory import COSTS, SIGNALS
from worker.tasks import registry

ROOT = Path(__file__).parents[2]
NAMES = tuple(re.findall(r"^(\w+) = worker\.tasks\.", catalogue.OUR_ENTRY_POINTS.read_text(), re.MULTILINE))
ELSEWHERE = {
    "app/demo/feeding.zip": "the archive of the demo study, which is of a task",
    "app/paths.py": "its file",
    "app/installed_tasks/entry_points.txt": "declares them",
    "worker/rehearsal/demo_study.py": "makes it",
    "worker/analysis/comparison/published.py": "the numbers that the paper prints, by its names of tasks",
}


def test_only_its_folder_names_a_task() -> None:
    folders = [ROOT / "worker" / "tasks" / name for name in NAMES]
    named = set()
    for place in ("app", "worker", "templates", "static"):
        for file in (ROOT / place).rglob("*"):
            if not file.is_file() or "__pycache__" in file.parts or any(file.is_relative_to(each) for each in folders):
                continue
            said = file.relative_to(ROOT).as_posix().encode() + file.read_bytes() * (file.suffix != ".zip")
            if re.search("|".join(NAMES).encode(), said, re.IGNORECASE):
                named.add(file.relative_to(ROOT).as_posix())
    assert named == set(ELSEWHERE)


def test_our_tasks_come_first_and_in_our_order() -> None:
    assert catalogue.names()[: len(NAMES)] == NAMES
    assert catalogue.usual() == NAMES[0]


@pytest.mark.parametrize("task", NAMES)
def test_environment_and_look_of_a_task_are_as_its_description_says(task: str) -> None:
    installed = registry.installed_task(task)
    assert registry.environment_class(task).task.name == task
    assert registry.look(task).tool is not None
    assert installed.picture
    assert set(installed.description.instructions) == set(Language)
    assert (registry.demonstrator(task) is None) == (registry.coded(task).demonstrator is None)


@pytest.mark.parametrize("task", NAMES)
def test_there_are_words_for_everything_that_the_worker_stores_about_a_task(task: str) -> None:
    words = words_of(task)
    assert set(registry.task(task).modes.names) <= set(words.axes)
    assert set(words.signals) == set(SIGNALS)
    assert words.silent_signals <= set(SIGNALS)
    assert set(words.costs) <= set(COSTS)
