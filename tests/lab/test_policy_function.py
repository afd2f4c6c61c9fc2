"""A policy that is a function of the laboratory's: what it is given, and what is said when it is not as it must be."""

import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from app.domain.protocol import EvaluationMode, EvaluationSettings
from app.domain.study_settings import StudySettings
from app.installed_tasks import lab
from app.installed_tasks.lab import LabDescription
from app.services.studies import task_limits
from tests.lab.filtered_plane import MODE, PATIENT, ended, served, written
from tests.lab.test_check import change, found, said
from worker.compute import simulation
from worker.compute.lab_policies import policy_of
from worker.experiments import fit_response_surface
from worker.experiments.lab_ranges import first_found
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.policies import asked_policy
from worker.ml.policies.onnx_policy import NotAPolicy
from worker.ml.policies.policy_client import PolicyServer
from worker.sim.lab.environment import LabEnvironment
from worker.tasks import registry

TO_GOAL = """
from pathlib import Path

import numpy as np

def act(seen):
    place, goal = np.split(seen["observation"], 2)
    return 0.1 * np.tanh(4.0 * (goal - place))
"""


@pytest.fixture
def called(plane: Path) -> Iterator[Path]:
    """The plane with its policy as a function."""
    (plane / "to_goal.py").write_text(TO_GOAL)
    change(plane, 'file = "policy.onnx"', 'function = "to_goal:act"')
    yield plane
    forget()


def forget() -> None:
    """As a new process would begin."""
    asked_policy.forget()
    for name in [each for each in sys.modules if each.startswith("lab_task_")]:
        del sys.modules[name]


def test_a_function_beside_lab_toml_does_what_it_would_from_a_file(called: Path) -> None:
    checked = found(called)
    assert checked.wrong == ()
    assert checked.remarks[0].startswith("3 of 3 episodes succeeded")


def test_a_function_may_say_chunks_and_is_given_what_a_server_would_be_sent(called: Path) -> None:
    more = 'execution_horizon = 4\nprompt = "go"\ninputs = { here = "[0:2]", there = "[2:4]" }\n'
    change(called, 'function = "to_goal:act"\n', f'function = "to_goal:act"\n{more}')
    change(
        called,
        'place, goal = np.split(seen["observation"], 2)\n    return 0.1',
        'assert seen["prompt"] == "go"\n    place, goal = seen["here"], seen["there"]\n'
        "    return np.ones((4, 1)) * 0.1",
        "to_goal.py",
    )
    assert found(called).wrong == ()


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ("to_goal:act", "to_gaol:act", "policy.function: 'to_gaol:act' cannot be imported (ModuleNotFoundError"),
        ("to_goal:act", "to_goal:acts", "'to_goal:acts' cannot be imported (AttributeError"),
        ("to_goal:act", "to_goal:np", "'to_goal:np' is no function"),
        ("to_goal:act", "to_goal.act", "policy.function must be like module:name"),
        ('function = "to_goal:act"', 'function = "to_goal:act"\nfile = "policy.onnx"', "policy needs either file, url"),
        ('function = "to_goal:act"', 'function = "to_goal:act"\nanswer_s = 3', "answer_s is for policy servers (url)"),
        (
            'function = "to_goal:act"',
            'function = "to_goal:act"\nsettings = { x = 0.1 }',
            "settings are for policies in files",
        ),
    ],
)
def test_a_function_that_is_not_there_is_told_with_its_key(
    called: Path, before: str, after: str, complaint: str
) -> None:
    change(called, before, after)
    assert complaint in said(called)


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        ("return np.zeros(3)", "have the shape (3,), and (H, 2) is needed"),
        ("return None", "have the shape (), and (H, 2) is needed"),
        ("return np.full(2, np.nan)", "hold a NaN or an infinity"),
        ('return ["left", "right"]', "are no numbers; send an array (H, 2)"),
        ("return seen @ np.eye(4)", "failed with ValueError"),
        ('return seen["state"]', "failed with KeyError: 'state'. It is given a dictionary of vectors (observation)"),
        ("return np.random.uniform(-0.1, 0.1, 2)", "answered the same observation in two ways"),
        ("STEPS.append(1)\n    return np.full(2, 0.1 / (1 + len(STEPS) // 4))", "let it remember nothing"),
    ],
)
def test_a_function_that_is_no_policy_is_told_of_with_what_to_do(called: Path, body: str, complaint: str) -> None:
    (called / "to_goal.py").write_text(f"import numpy as np\n\nSTEPS = []\n\n\ndef act(seen):\n    {body}\n")
    wrong, *_ = found(called).wrong
    assert "policy.function: " in wrong
    assert complaint in wrong


def test_a_function_cannot_change_what_the_studio_has_seen(called: Path, use: Callable[[Path], None]) -> None:
    change(called, "return 0.1 *", "action = 0.1 *", "to_goal.py")
    (called / "to_goal.py").write_text(
        f'{(called / "to_goal.py").read_text()}    seen["observation"][:] = 9.0\n    return action\n'
    )
    assert found(called).wrong == ()


def test_a_changed_function_is_another_policy(called: Path, use: Callable[[Path], None]) -> None:
    change(called, "[instructions]", '[modes]\nleave_out = ["smooth", "hesitate", "push_x", "push_y"]\n[instructions]')
    (called / "weights.txt").write_text("4.0")
    change(called, "4.0 *", "float(Path(__file__).with_name('weights.txt').read_text()) *", "to_goal.py")
    use(called)
    fit_response_surface.find_ranges("plane", scenarios=1)
    assert registry.task("plane").interface is not None
    assert simulation.run_episode("plane", simulation.reference_policy("plane").mean, 1).success
    forget()
    (called / "weights.txt").write_text("3.0")  # which its file does not say
    use(called)
    with pytest.raises(NotAPolicy, match="the function to_goal:act is not the one with which the task was explored"):
        simulation.run_episode("plane", simulation.reference_policy("plane").mean, 1)
    change(called, "0.1 *", "0.2 *", "to_goal.py")
    use(called)
    with pytest.raises(registry.NotExplored, match="has changed since"):
        registry.found_out("plane")


def test_robots_of_a_function_cannot_be_packed_for_an_operator(called: Path, use: Callable[[Path], None]) -> None:
    use(called)
    physical = StudySettings(evaluation=EvaluationSettings(mode=EvaluationMode.PHYSICAL))
    assert "is no file, so a robot cannot be packed" in task_limits.complaints("plane", physical)["evaluation_mode"]


def test_a_bundle_calls_the_function_it_belongs_to_and_no_other(called: Path, tmp_path: Path) -> None:
    described = lab.read(called / "lab.toml").description
    assert isinstance(described, LabDescription)
    environment = LabEnvironment(described, called)
    explored = first_found(described, environment, called)
    task, policy = explored.task(described), policy_of(described, called, explored)
    act = act_of(task.modes, policy, FilterWeights(mode=MODE))
    trajectory = environment.episode(act, 3, policy.mean)
    folder = written(task, policy, trajectory, act, tmp_path / "bundle")
    assert not (folder / "policy.onnx").exists()
    assert "is the function `to_goal:act`" in (folder / "MODEL_CARD.md").read_text()
    loop = ("run_filter.py", "--serve", "0", "--upstream", "to_goal:act")
    assert "Put the file beside run_filter.py" in ended(folder, *loop)
    (folder / "to_goal.py").write_text(TO_GOAL.replace("4.0", "3.25"))
    assert "this is another policy than the one of this bundle" in ended(folder, *loop)
    (folder / "to_goal.py").write_text(TO_GOAL)
    with served(folder, "--upstream", "to_goal:act", *PATIENT) as (url, process):
        client = PolicyServer(url)
        actions = [client.ask({"observation": seen[:4]})["actions"][0] for seen in trajectory.observations[:-1]]
        np.testing.assert_allclose(actions, 0.1 * trajectory.actions, atol=1e-6)
        client.close()
        process.send_signal(signal.SIGTERM)
        process.communicate()
    environment.close()
