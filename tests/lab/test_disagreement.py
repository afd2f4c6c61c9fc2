"""Whether people will disagree about a pool is said before anybody is invited."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from app.installed_tasks import lab
from app.installed_tasks.lab import FOUND_FILE, LabDescription
from worker.compute import simulation
from worker.domain.task import Task
from worker.domain.type_aliases import FloatArray
from worker.experiments import disagreement, lab_ranges
from worker.experiments.check_lab import checked
from worker.experiments.disagreement import ENOUGH, Differences
from worker.sim.lab.environment import LabEnvironment
from worker.tasks import registry


@pytest.fixture
def explored(plane: Path, use: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch) -> Path:
    """The plane with the widest ranges, in use."""
    installed = lab.read(plane / "lab.toml")
    assert isinstance(installed.description, LabDescription)
    environment = LabEnvironment(installed.description, plane)
    lab_ranges.first_found(installed.description, environment, plane).save(installed.checkpoint / FOUND_FILE)
    environment.close()
    use(plane)
    monkeypatch.setattr(disagreement, "SCENARIOS", 4)
    return plane


@pytest.fixture
def plane_task(explored: Path) -> Task:
    return registry.task("plane")


def differing(task: Task, names: tuple[str, ...], beyond_noise: float) -> Differences:
    """400 pairs that differ in these signals, so many times as much as a tremor changes."""
    rng = np.random.default_rng(0)
    columns = np.array([name in names for name in task.signals])
    noise: FloatArray = columns * rng.standard_normal((100, len(columns)))
    return Differences(np.arange(400.0), beyond_noise * columns * rng.standard_normal((400, len(columns))), noise)


def test_the_figure_is_how_much_more_two_people_differ_than_one_asked_twice(plane_task: Task) -> None:
    found = differing(plane_task, ("height", "distance_m"), 2.0)
    said = disagreement.answers(found, disagreement.people(plane_task, 200, np.random.default_rng(5)))
    rng = np.random.default_rng(1)
    once, again, another = (rng.random(said.shape) < each for each in (said, said, np.roll(said, 1, axis=0)))
    counted = float((once != another).mean() - (once != again).mean())
    assert disagreement.excess(found, plane_task) == pytest.approx(counted, abs=0.02)


def test_people_disagree_about_what_some_like_and_not_about_what_nobody_wants_or_sees(plane_task: Task) -> None:
    liked, minded = ("height", "distance_m", "speed_m_s"), ("undelivered", "effort")
    assert disagreement.excess(differing(plane_task, liked, 5.0), plane_task) > 0.3
    assert disagreement.excess(differing(plane_task, liked, 0.3), plane_task) < ENOUGH
    assert disagreement.excess(differing(plane_task, minded[:1], 50.0), plane_task) < 0.01
    assert disagreement.beyond_noise(differing(plane_task, liked, 0.0)).max() == 0.0


def test_check_says_it_of_an_explored_task_and_what_to_do_where_nobody_could_tell(
    explored: Path,
) -> None:
    remarks = " ".join(checked(explored / "lab.toml", explored / "sheet.png").remarks)
    assert "Of 100 pairs of clips" in remarks
    assert "too alike" not in remarks
    assert "hardly foreseen" not in remarks
    record = {"scenarios": [0, 9], "explained_share": {"height": 0.5}, "foreseen_share": {"height": 0.1}}
    (explored / "checkpoint" / "response_surface.json").write_text(json.dumps(record))
    remarks = " ".join(checked(explored / "lab.toml", explored / "sheet.png").remarks)
    assert "How ways change height (10%) is hardly foreseen" in remarks
    task, policy = registry.task("plane"), simulation.reference_policy("plane")
    environment = simulation.lab_environment("plane")
    alike = disagreement.measured(task, lambda _: policy.mean, environment.episode, 40, scenarios=4, share=0.005)
    words = " ".join(disagreement.in_words(alike, task))
    assert "do not invite people yet" in words
    (explored / "checkpoint" / "found.json").unlink()
    assert "after `explore`" in " ".join(checked(explored / "lab.toml", explored / "sheet.png").remarks)


def test_a_shifted_goal_is_reached_beside_it(plane_task: Task) -> None:
    environment, policy = simulation.lab_environment("plane"), simulation.reference_policy("plane")
    mode = np.array(plane_task.modes.vector({"shift_x": 0.1}), np.float32)

    def act(observation: np.ndarray) -> np.ndarray:
        return np.asarray(plane_task.modes.executed(observation, mode, policy.mean(observation)))

    places = [environment.episode(each, 3).observations[-1, :2] for each in (policy.mean, act)]
    beside = places[1] - places[0]
    assert beside[0] > 0.02
    assert abs(beside[1]) < 0.005
