"""Web and worker may not import each other's tasks; here both are seen, and agree."""

import pytest

from app.domain.studies import LONGEST_CLIP_STEPS, USUAL_CLIP_STEPS, TaskName
from app.web.texts.task_words import words_of
from worker.tasks.registry import ENVIRONMENTS
from worker.trajectory import COSTS, SIGNALS


def test_the_tasks_that_studies_can_have_are_those_that_the_worker_simulates() -> None:
    assert set(ENVIRONMENTS) == set(TaskName)


@pytest.mark.parametrize("task", TaskName)
def test_the_longest_clip_is_a_whole_episode(task: TaskName) -> None:
    assert LONGEST_CLIP_STEPS[task] == ENVIRONMENTS[task].task.episode_steps
    assert USUAL_CLIP_STEPS[task] <= LONGEST_CLIP_STEPS[task]


@pytest.mark.parametrize("task", TaskName)
def test_there_are_words_for_everything_that_the_worker_stores_about_a_task(task: TaskName) -> None:
    words = words_of(task)
    assert set(ENVIRONMENTS[task].task.modes.names) <= set(words.axes)
    assert set(words.signals) == set(SIGNALS)
    assert words.silent_signals <= set(SIGNALS)
    assert set(words.costs) <= set(COSTS)
