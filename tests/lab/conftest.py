"""A laboratory of our own: a point that moves to a place on a plane, with a policy of one layer. Cheap, and real."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from app.installed_tasks import catalogue
from app.web.texts import wording
from tests.lab.filtered_plane import Plane
from tests.lab.policy_server import Answer, serving, to_goal
from tests.worker.traced import traced_once  # noqa: F401
from worker.compute import simulation
from worker.ml.policies import asked_policy
from worker.ml.policies.onnx_policy import mlp_to_onnx
from worker.tasks import registry

ENVIRONMENT = '''
"""A point on a plane, moved to a place by changes of its position."""

import gymnasium
import numpy as np


class Plane(gymnasium.Env):
    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode=None, size=64):
        self.render_mode, self.size = render_mode, size
        self.observation_space = gymnasium.spaces.Box(-2.0, 2.0, (4,))
        self.action_space = gymnasium.spaces.Box(-0.1, 0.1, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.goal = np.zeros(2), self.np_random.uniform(-1.0, 1.0, 2)
        return self._seen(), {}

    def step(self, action):
        self.place = self.place + action
        near = bool(np.linalg.norm(self.goal - self.place) < 0.1)
        return self._seen(), 0.0, False, False, {"is_success": near, "height": float(self.place[1])}

    def render(self):
        picture = np.full((self.size, self.size, 3), 255, np.uint8)
        for at, colour in ((self.goal, (0, 160, 0)), (self.place, (200, 0, 0))):
            x, y = ((at + 2.0) / 4.0 * (self.size - 4)).astype(int)
            picture[y : y + 4, x : x + 4] = colour
        return picture

    def _seen(self):
        return np.concatenate([self.place, self.goal]).astype(np.float32)


def effort(step):
    """How much it moves."""
    return float(np.abs(step.action).sum())
'''

DESCRIPTION = """
name = "plane"
title = "Plane"
summary = "A point moves to a place."
episode_steps = 40
usual_clip_steps = 40

[environment]
factory = "plane:Plane"
rate_hz = 10
actions = "delta"
action_names = ["x", "y"]

[policy]
file = "policy.onnx"
gain = 0.5

[success]
info = "is_success"

[fields]
tip = "[0:2]"
goal = "[2:4]"

[signals.height]
info = "height"
unit = "m"
words = { en = "height of the point (m)", de = "Höhe des Punkts (m)" }

[signals.effort]
function = "plane:effort"
unit = "m"
cost = true
words = { en = "effort (m)", de = "Aufwand (m)" }

[instructions]
en = "A point moves to a place."
de = "Ein Punkt bewegt sich an eine Stelle."
"""


def way_to_goal(gain: float = 0.4) -> bytes:
    """A policy that goes straight to the goal, in the environment's own unit, as fast as it can until it is near."""
    weight = gain * np.array([[-1, 0, 1, 0], [0, -1, 0, 1]], np.float32)
    scale = (0.1 * np.eye(2)).astype(np.float32)
    return mlp_to_onnx([(weight * 10, np.zeros(2, np.float32)), (scale, np.zeros(2, np.float32))], "Tanh", "")


def forget() -> None:
    """What was read or made before, as a new process would."""
    of_texts = (wording._resource, wording._built_in, wording._known_variables, wording._remembered)
    of_labs = (
        registry.found_out,
        simulation.lab_environment,
        simulation.reference_policy,
        simulation.reference_rollouts,
    )
    for remembered in (catalogue.installed, *of_labs, *of_texts):
        remembered.cache_clear()


@pytest.fixture
def plane(tmp_path: Path) -> Path:
    """The laboratory's folder, as its lab.toml wants it."""
    return write_plane(tmp_path / "plane_lab")


def write_plane(folder: Path) -> Path:
    """All of its files."""
    folder.mkdir()
    (folder / "plane.py").write_text(ENVIRONMENT)
    (folder / "lab.toml").write_text(DESCRIPTION)
    (folder / "policy.onnx").write_bytes(way_to_goal())
    return folder


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Path], None]]:
    """Name a laboratory's folder in LAB_TASKS."""

    def name(folder: Path) -> None:
        monkeypatch.setenv("LAB_TASKS", str(folder))
        forget()

    yield name
    monkeypatch.delenv("LAB_TASKS", raising=False)
    forget()


@pytest.fixture
def plane_of(plane: Path) -> Iterator[Callable[..., Plane]]:
    """Makes it, with a policy server that gives these answers."""
    with contextlib.ExitStack() as stack:

        def make(answer: Answer = to_goal) -> Plane:
            made = Plane(plane, stack.enter_context(serving(answer)))
            stack.callback(made.environment.close)
            return made

        yield make
    asked_policy.forget()
