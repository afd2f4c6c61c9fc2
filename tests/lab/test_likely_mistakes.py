"""What strangers with a robot of their own did wrong, or the studio did wrong for them, is said with what to do."""

import re
import subprocess
import sys
import threading
from argparse import ArgumentTypeError
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from starlette.testclient import TestClient
from websockets.sync.server import ServerConnection, serve

from app import __main__ as studio
from app.db import Database
from app.domain.protocol import Language
from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue
from app.services.studies import studies
from app.settings import Settings
from app.web.texts.wording import Wording
from tests.lab.test_check import change, found, said
from worker.__main__ import main
from worker.commands.options import taste
from worker.experiments import fit_response_surface
from worker.ml.policies import lab_policy
from worker.ml.policies.onnx_policy import NotAPolicy
from worker.ml.policies.policy_client import packed
from worker.sim.lab.references import named_object
from worker.tasks import registry

ROOT = Path(__file__).parents[2]
BOUNDS = (np.full(2, -0.1), np.full(2, 0.1))


def test_the_page_tells_of_twenty_mistakes_and_each_is_tested() -> None:
    page = (ROOT / "docs" / "lab_toml.md").read_text().split("## The likeliest mistakes")[1].split("\n## ")[0]
    tests = "".join(file.read_text() for file in Path(__file__).parent.glob("test_*.py"))
    rows = re.findall(r"^\| `([^`]+)` \| (.+) \|$", page, re.MULTILINE)
    assert len(rows) >= 20
    assert not [message for message, _ in rows if message not in tests], "no test asserts this message"


def test_a_task_that_lab_tasks_does_not_name_is_told_of(plane: Path, use: Callable[[Path], None]) -> None:
    with pytest.raises(ArgumentTypeError, match=r"there is no task 'plane'.*export LAB_TASKS=path/to/lab\.toml"):
        catalogue.as_argument("plane")
    change(plane, 'title = "Plane"', "")
    use(plane)
    with pytest.raises(ArgumentTypeError, match="title is missing"):
        catalogue.as_argument("plane")


def test_a_demo_of_an_unexplored_task_says_what_its_clips_wait_for(
    plane: Path, use: Callable[[Path], None], settings: Settings, capsys: pytest.CaptureFixture[str]
) -> None:
    use(plane)
    assert studio.demo_study(settings, "plane") == 0
    assert "so its clips wait: python -m worker explore --task plane" in capsys.readouterr().out


def test_participants_of_a_lab_without_instructions_read_nothing_untrue(
    plane: Path, use: Callable[[Path], None]
) -> None:
    text = (plane / "lab.toml").read_text()
    (plane / "lab.toml").write_text(text.split("[instructions]")[0])
    use(plane)
    for language in Language:
        told = Wording(language)("task-plane")
        assert told == Wording(language)("task-lab") != Wording(language)("task-other"), "nobody is fed here"


def test_seconds_are_those_of_the_labs_own_rate(
    plane: Path, use: Callable[[Path], None], database: Database, experimenter: TestClient
) -> None:
    change(plane, "rate_hz = 10", "rate_hz = 80")
    use(plane)
    with database.writing() as session:
        study = studies.create_study(session, "Points", StudySettings(clip_steps=40), task="plane")
        assert study.clip_s == 0.5
        slug = study.slug
    page = experimenter.get(f"/studies/{slug}").text
    assert "<dt>Length of a clip</dt><dd>0.5 s</dd>" in page


def test_what_draws_is_told_that_there_is_no_screen(plane: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    change(
        plane,
        "import gymnasium\n",
        "import os\nimport gymnasium\nassert os.environ['MUJOCO_GL'] == 'egl'\n",
        "plane.py",
    )
    assert said(plane) == ""


def test_a_policy_that_was_trained_with_other_activations_says_what_the_library_says(plane: Path) -> None:
    env = named_object(plane, "environment.factory", "plane:Plane")()
    kwargs = {"net_arch": [16, 16], "activation_fn": torch.nn.ReLU}
    model = PPO("MlpPolicy", env, policy_kwargs=kwargs, device="cpu", seed=1)
    model.save(plane / "policy.zip")
    policy = lab_policy.load(plane / "policy.zip", 4, 7, BOUNDS)
    seen = np.random.default_rng(0).uniform(-1, 1, (20, 7)).astype(np.float32)
    of_library, _ = model.predict(seen[:, :4], deterministic=True)
    np.testing.assert_allclose(0.1 * policy.mean(seen), of_library, atol=1e-6)


@pytest.mark.parametrize(
    ("algorithm", "how", "complaint"),
    [
        (SAC, {"use_sde": True}, "whose mean is bounded; export it as ONNX"),
        (PPO, {"use_sde": True, "policy_kwargs": {"squash_output": True}}, "its actions are squashed"),
        (SAC, {"policy_kwargs": {"activation_fn": torch.nn.SiLU}}, "its activation function is SiLU"),
    ],
)
def test_a_network_that_is_not_known_is_refused(
    plane: Path, algorithm: type[BaseAlgorithm], how: dict[str, object], complaint: str
) -> None:
    env = named_object(plane, "environment.factory", "plane:Plane")()
    # The base class wants what each of its algorithms has a default for.
    algorithm("MlpPolicy", env, device="cpu", **how).save(plane / "policy.zip")  # type: ignore[arg-type]
    with pytest.raises(NotAPolicy, match=complaint):
        lab_policy.load(plane / "policy.zip", 4, 7, BOUNDS)


def test_a_zip_that_never_succeeds_may_lack_its_normalisation(plane: Path) -> None:
    env = named_object(plane, "environment.factory", "plane:Plane")()
    PPO("MlpPolicy", env, device="cpu", seed=1).save(plane / "policy.zip")
    change(plane, "policy.onnx", "policy.zip")
    assert "none of 3 episodes succeeded" in said(plane)
    assert "lacks VecNormalize's statistics" in said(plane)


def test_a_function_that_changed_since_the_exploration_is_noticed_and_the_ways_are_found_anew(
    plane: Path, use: Callable[[Path], None]
) -> None:
    use(plane)
    fit_response_surface.find_ranges("plane", scenarios=2)
    before = (plane / "checkpoint" / "found.json").read_bytes()
    fit_response_surface.find_ranges("plane", scenarios=2)
    assert (plane / "checkpoint" / "found.json").read_bytes() == before, "nothing has changed"
    change(plane, "np.abs(step.action).sum()", "3 * np.abs(step.action).sum()", "plane.py")
    for name in [each for each in sys.modules if each.startswith("lab_task_")]:
        del sys.modules[name]
    assert "has changed since the task was explored" in " ".join(found(plane).remarks)
    fit_response_surface.find_ranges("plane", scenarios=2)
    assert (plane / "checkpoint" / "found.json").read_bytes() != before
    assert registry.found_out("plane").witness[-1] > 0


def test_scripted_people_mind_a_labs_own_signals(
    plane: Path, use: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    use(plane)
    assert main(["rehearse", "--task", "plane"]) == 1
    assert "run python -m worker explore --task plane" in capsys.readouterr().err
    fit_response_surface.find_ranges("plane", scenarios=2)
    for users, complaint in (
        ("neutral", "neutral is nobody who knows plane. Say what they mind of its signals"),
        ("high=hight:-1", "No signal is called hight; there are undelivered"),
    ):
        assert main(["rehearse", "--task", "plane", "--users", users]) == 1
        assert complaint in capsys.readouterr().err
    assert main(["rehearse", "--task", "plane", "--users", "high=height:-1"]) == 1, "its ranges alone are found"
    assert "half explored: python -m worker explore --task plane goes on" in capsys.readouterr().err
    gentle = taste("gentle=height:-2,effort:1")
    names = registry.task("plane").signals
    rewards = gentle.step_rewards(np.eye(len(names)), names)  # type: ignore[attr-defined]
    assert dict(zip(names, rewards.tolist(), strict=True)) == dict.fromkeys(names, 0.0) | {
        "height": 2.0,
        "effort": -1.0,
    }


def test_a_policy_server_is_told_that_nobody_asks_any_more() -> None:
    closed: list[int | None] = []

    def handle(connection: ServerConnection) -> None:
        connection.send(packed({}))
        for _ in connection:
            connection.send(packed({"actions": np.zeros((1, 2))}))
        closed.append(connection.close_code)

    with serve(handle, "127.0.0.1", 0, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        program = f"from worker.ml.policies.asked_policy import _connection; _connection({url!r}, 5.0).ask({{}})"
        subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)
        server.shutdown()
        thread.join()
    assert closed == [1000], "a goodbye, and no traceback in the server's log"


def test_an_observation_of_tables_under_any_name_is_flattened(plane: Path) -> None:
    """As dm_control's are: one row, and slashes in the names."""
    change(plane, "spaces.Box(-2.0, 2.0, (4,))", 'spaces.Dict({"arm/at": TABLE, "to": TABLE})', "plane.py")
    change(plane, "class Plane", "TABLE = gymnasium.spaces.Box(-2.0, 2.0, (1, 2))\n\n\nclass Plane", "plane.py")
    seen = '{"arm/at": self.place[None].astype(np.float32), "to": self.goal[None].astype(np.float32)}'
    change(plane, "np.concatenate([self.place, self.goal]).astype(np.float32)", seen, "plane.py")
    change(plane, 'tip = "[0:2]"', 'tip = "arm/at"')
    change(plane, 'goal = "[2:4]"', 'goal = "to[0:2]"')
    checked = found(plane)
    assert checked.wrong == ()
    assert checked.remarks[0].startswith("3 of 3 episodes succeeded")


def test_a_package_that_does_not_fit_another_is_told_of_as_such(plane: Path) -> None:
    change(
        plane,
        "self.render_mode, self.size =",
        "gymnasium.flex_vertedge\n        self.render_mode, self.size =",
        "plane.py",
    )
    assert "has no attribute 'flex_vertedge'). Make it without the studio first" in said(plane)


def test_a_library_that_warns_at_every_reset_is_heard_a_few_times_and_its_errors_always(plane: Path) -> None:
    change(
        plane,
        "import numpy as np\n",
        'import logging\nimport numpy as np\nlog = logging.getLogger("a_lab")\n',
        "plane.py",
    )
    said_each_time = 'log.warning("no convergence: error %g", self.goal[0])\n        log.error("no contact")\n'
    change(
        plane,
        "        return self._seen(), {}",
        f"        {said_each_time}        return self._seen(), {{}}",
        "plane.py",
    )
    checking = [sys.executable, "-m", "worker", "check", str(plane)]
    printed = subprocess.run(checking, cwd=ROOT, capture_output=True, text=True, check=True).stderr
    assert printed.count("no convergence: error") == 3
    assert printed.count("said again and again") == 1
    assert printed.count("no contact") > 3
