"""``python -m worker check lab.toml`` says in words what is missing or wrong, and what to do."""

import re
import zipfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import onnx.numpy_helper
import onnx.parser
import pytest
import torch
from PIL import Image
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm

from app.installed_tasks import lab
from app.installed_tasks.lab import LabDescription
from tests.lab.conftest import way_to_goal
from worker.__main__ import main
from worker.compute.lab_policies import policy_of
from worker.experiments import lab_ranges
from worker.experiments.check_lab import Checked, checked, replaced_packages
from worker.ml.policies import lab_policy
from worker.ml.policies.asked_policy import in_unit
from worker.ml.policies.onnx_policy import OnnxPolicy, mlp_to_onnx
from worker.sim.lab.environment import LabEnvironment
from worker.sim.lab.references import named_object


def said(folder: Path) -> str:
    """All that is wrong."""
    return " ".join(found(folder).wrong)


def found(folder: Path) -> Checked:
    return checked(folder / "lab.toml", folder / "sheet.png")


def change(folder: Path, before: str, after: str, name: str = "lab.toml") -> None:
    text = (folder / name).read_text()
    assert before in text
    (folder / name).write_text(text.replace(before, after))


def graph(body: str, opset: int = 18, weight: type[np.floating[Any]] = np.float32) -> bytes:
    """A policy in ONNX's own words, with a weight w (4, 2) of ones."""
    model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : {opset}]> policy {body}')
    if "w)" in body:
        model.graph.initializer.append(onnx.numpy_helper.from_array(np.ones((4, 2), weight), "w"))
    stored: bytes = model.SerializeToString(deterministic=True)
    return stored


def write_zip(folder: Path, state: dict[str, torch.Tensor]) -> None:
    """As Stable-Baselines3 stores weights."""
    torch.save(state, folder / "policy.pth")
    with zipfile.ZipFile(folder / "policy.zip", "w") as archive:
        archive.write(folder / "policy.pth", "policy.pth")


def renamed(folder: Path) -> None:
    """A module is imported once: what has changed in it needs another name."""
    (folder / "plane.py").rename(folder / "anew.py")
    change(folder, "plane:", "anew:")


def test_a_whole_lab_can_be_used_and_three_episodes_are_shown(plane: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(plane)]) == 0
    printed = capsys.readouterr().out
    assert "3 of 3 episodes succeeded" in printed
    assert "python -m worker explore --task plane" in printed
    with Image.open(plane / "contact_sheet.png") as sheet:
        assert sheet.size == (1440, 720), "six pictures of each of three episodes"
        assert (np.asarray(sheet) != 255).any()


def test_what_is_wrong_is_an_exit_code_too(plane: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (plane / "policy.onnx").unlink()
    assert main(["check", str(plane)]) == 1
    assert "policy.onnx, which does not exist" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ("[policy]", "[polcy]", "policy is missing; polcy is not known here"),
        ('name = "plane"', 'name = "My Plane"', "name must be at most 40 small letters"),
        ("episode_steps = 40", "episode_steps = 5", "episode_steps: Input should be greater than or equal to 20"),
        ('title = "Plane"', "title = Plane", "is not valid TOML"),
        ("rate_hz = 10", "rate_hz = 10\nspeed = 3", "environment.speed is not known here"),
        (
            'actions = "delta"',
            'actions = "torque"',
            "environment.actions must be 'delta' or 'velocity': half of a torque",
        ),
        ('actions = "delta"', 'actions = "position"', "Wrap the environment (examples/reacher does)"),
        ('factory = "plane:Plane"', "", "environment needs either id (a Gymnasium id) or factory"),
        ('info = "height"', "", "signals.height needs either info"),
        ("[signals.height]", "[signals.undelivered]", "signals.undelivered is measured by the studio already"),
        ('en = "height of the point (m)", ', "", "needs words.en"),
        ("plane:Plane", "plain:Plane", "'plain:Plane' cannot be imported (ModuleNotFoundError"),
        ("plane:Plane", "plane:Plain", "'plane:Plain' cannot be imported (AttributeError"),
        ('factory = "plane:Plane"', 'id = "PandaReech-v9"', "Name the module that registers it before a colon"),
        ('factory = "plane:Plane"', 'id = "no_such_package:Reach-v3"', "Install its package"),
        ('factory = "plane:Plane"', 'factory = "plane:Plane"\nkwargs = { colour = 1 }', "Check environment.kwargs"),
        ('factory = "plane:Plane"', 'factory = "plane:Plane"\nkwargs = { size = 16 }', "pixels are too small"),
        ('factory = "plane:Plane"', 'factory = "gymnasium:logger"', "'gymnasium:logger' is no function"),
        ('action_names = ["x", "y"]', 'action_names = ["x"]', "1 names for 2 actions"),
        ("rate_hz = 10", "rate_hz = 10\nmoving = [2]", "actions are numbered from 0 to 1"),
        ('tip = "[0:2]"', 'tip = "tip[0:2]"', "No field 'tip'"),
        ('tip = "[0:2]"', 'tip = "[0:1]"', "tip has 1 columns and goal 2"),
        ('tip = "[0:2]"', 'tip = "[7:9]"', "[7:9] has no columns; the observation has 4"),
        ('info = "is_success"', 'info = "success"', "no 'success'; it has height, is_success"),
        ("gain = 0.5", "gain = 0.001", "none of 3 episodes succeeded. Check what success says"),
        ('file = "policy.onnx"', 'file = "policy.pt"', "policy.pt, which does not exist"),
        (
            "[instructions]",
            '[modes]\nleave_out = ["wave"]\n[instructions]',
            "there is no way 'wave'; this task has speed_far",
        ),
        ('tip = "[0:2]"', 'tip = "[0,2]"', 'fields.tip must be a key of the observation, columns as in "[0:3]"'),
        ('action_names = ["x", "y"]', 'action_names = ["x", "Y"]', "action_names.1 must be at most 20 small letters"),
        ("[fields]", '[modes.groups]\nup = ["z"]\n[fields]', "modes.groups.up: z is no action that moves the robot"),
        ("[fields]", '[modes.groups]\nup = ["x", "y"]\n[fields]', "modes.groups.up: a group is some of the actions"),
        ("[fields]", '[modes.groups]\nUp = ["y"]\n[fields]', "must be at most 40 small letters"),
    ],
)
def test_a_mistake_in_the_file_is_said_with_its_key_and_what_to_do(
    plane: Path, before: str, after: str, complaint: str
) -> None:
    change(plane, before, after)
    assert complaint in said(plane)


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ("self.render_mode, self.size = render_mode, size", "self.render_mode, self.size = None, size", "rgb_array"),
        ("np.full((self.size, self.size, 3), 255, np.uint8)", "np.full((self.size, self.size, 3), 255.0)", "float64"),
        (
            "picture = np.full",
            "self.gl.context\n        picture = np.full",
            "Without a screen MuJoCo draws by EGL: install libegl1",
        ),
        ("spaces.Box(-0.1, 0.1, (2,))", "spaces.Discrete(4)", "one vector of continuous numbers"),
        (
            "spaces.Box(-0.1, 0.1, (2,))",
            "spaces.Box(0.0, 0.1, (2,))",
            "action x goes from 0 to 0.1, so its middle is no standstill",
        ),
        ("spaces.Box(-0.1, 0.1, (2,))", "spaces.Box(-np.inf, np.inf, (2,))", "its actions have no bounds"),
        ("spaces.Box(-2.0, 2.0, (4,))", "spaces.Box(0, 255, (2, 2), np.uint8)", "only numbers are known"),
        ("spaces.Box(-2.0, 2.0, (4,))", "spaces.Discrete(3)", "must be a Box or a Dict"),
        ("near = bool", "self.place[0] = np.nan\n        near = bool", "not finite (NaN)"),
        ("float(self.place[1])", "float('inf')", "signals.height: was inf"),
        ("float(self.place[1])", "[1.0, 2.0]", "signals.height: is of length 2; it must be one number"),
        (
            "float(np.abs(step.action).sum())",
            "step.no_such_thing",
            "signals.effort.function: failed with AttributeError",
        ),
        ("False, False, {", "near, False, {", "environment.ignore_terminated"),
        ("False, False, {", "False, near, {", "Lower episode_steps"),
        ("self.np_random.uniform", "np.random.uniform", 'Set environment.reset = "rebuild"'),
        ("class Plane(gymnasium.Env)", "class Plane", "which is no gymnasium.Env"),
    ],
)
def test_a_mistake_in_the_environment_is_said_with_what_to_do(
    plane: Path, before: str, after: str, complaint: str
) -> None:
    change(plane, before, after, "plane.py")
    assert complaint in said(plane)


def test_what_the_environment_says_too_little_of_is_a_remark(plane: Path) -> None:
    change(plane, "float(self.place[1])", "0.0", "plane.py")
    change(plane, 'de = "Ein Punkt bewegt sich an eine Stelle."', "")
    remarks = " ".join(found(plane).remarks)
    assert "Always 0 in these episodes: height." in remarks
    assert "instructions.de is missing" in remarks


def test_scenarios_that_are_all_alike_are_told_of(plane: Path) -> None:
    assert "same situation" not in " ".join(found(plane).remarks)
    change(plane, "self.np_random.uniform(-1.0, 1.0, 2)", "np.array([0.5, 0.5])", "plane.py")
    renamed(plane)
    assert "Every scenario is the same situation" in " ".join(found(plane).remarks)


def test_a_success_that_is_lost_before_the_end_is_told_of(plane: Path) -> None:
    assert "no longer" not in said(plane) + " ".join(found(plane).remarks)
    change(plane, "near = bool", "self.steps += 1\n        near = self.steps == 20 and bool", "plane.py")
    change(plane, "self.place, self.goal =", "self.steps = 0\n        self.place, self.goal =", "plane.py")
    renamed(plane)
    assert "In 3 of 3 episodes it had succeeded at some step, and no longer at the last" in said(plane)


def test_a_success_that_is_told_at_the_end_alone_counts_and_a_misspelt_one_is_told_of(plane: Path) -> None:
    change(plane, '{"is_success": near, "height": float(self.place[1])}', "info", "plane.py")
    change(
        plane,
        "return self._seen(), 0.0",
        'self.steps += 1\n        info = {"height": float(self.place[1])}\n'
        '        info |= {"is_success": near} if self.steps == 40 else {}\n        return self._seen(), 0.0',
        "plane.py",
    )
    change(plane, "self.place, self.goal =", "self.steps = 0\n        self.place, self.goal =", "plane.py")
    assert said(plane) == ""
    change(plane, "is_success", "is_sucess")
    assert "success.info: the environment's info has no 'is_sucess'; it has height, is_success" in said(plane)


def test_a_slow_environment_is_a_remark_with_what_it_will_cost(plane: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.experiments.check_lab.SLOW_EPISODE_S", 0.0)
    remarks = " ".join(found(plane).remarks)
    assert "This is a slow environment" in remarks
    assert re.search(r"exploring takes about \d+ min on two processes, \d+ min with --scenarios 50", remarks)


@pytest.mark.parametrize(
    ("stored", "complaint"),
    [
        (b"not a graph", "cannot be read as ONNX"),
        (mlp_to_onnx([(np.zeros((2, 5), np.float32), np.zeros(2, np.float32))], "Relu", ""), "has 5 numbers, but"),
        (mlp_to_onnx([(np.zeros((3, 4), np.float32), np.zeros(3, np.float32))], "Relu", ""), "has 3 numbers, but its"),
        (
            mlp_to_onnx([(np.full((2, 4), np.nan, np.float32), np.zeros(2, np.float32))], "Relu", ""),
            "not two rows of 2",
        ),
        (graph("(float[N, 4] seen, float[N, 2] memory) => (float[N, 2] said) { said = Identity(memory) }"), "2 inputs"),
        (
            graph("(double[N, 4] seen) => (double[N, 2] said) { said = MatMul(seen, w) }", weight=np.float64),
            "must be float32 of shape (batch, 4)",
        ),
        (
            graph("(float[N, 4] seen) => (float[N, 2] said) { said = MatMul(seen, w) }", opset=12),
            "its opset is older than 13",
        ),
    ],
)
def test_a_policy_that_is_none_for_this_environment_is_refused(plane: Path, stored: bytes, complaint: str) -> None:
    (plane / "policy.onnx").write_bytes(stored)
    assert complaint in said(plane)


@pytest.mark.parametrize("algorithm", [SAC, TD3, PPO])
def test_a_stable_baselines_zip_says_what_the_library_says(plane: Path, algorithm: type[BaseAlgorithm]) -> None:
    env = named_object(plane, "environment.factory", "plane:Plane")()
    model = algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [16, 16]}, device="cpu", seed=1)  # type: ignore[call-arg]
    model.save(plane / "policy.zip")
    low, high = env.action_space.low.astype(float), env.action_space.high.astype(float)
    policy = lab_policy.load(plane / "policy.zip", 4, 7, (low, high))
    seen = np.random.default_rng(0).uniform(-1, 1, (20, 7)).astype(np.float32)
    said_by_library, _ = model.predict(seen[:, :4], deterministic=True)
    np.testing.assert_allclose(low + (policy.mean(seen) + 1) / 2 * (high - low), said_by_library, atol=1e-6)


def test_a_graph_with_branches_says_what_it_says_alone(plane: Path) -> None:
    branches = graph(
        "(float[N, 4] seen) => (float[N, 2] said) { half = Constant <value = float {0.05}> () "
        "all = MatMul(seen, w) sum = ReduceSum <keepdims = 0> (all) least = Constant <value = float {0.0}> () "
        "over = Greater(sum, least) said = If (over) <"
        "then_branch = a () => (float[N, 2] x) { x = Mul(all, half) }, "
        "else_branch = b () => (float[N, 2] y) { y = Neg(all) }> }"
    )
    (plane / "policy.onnx").write_bytes(branches)
    policy = lab_policy.load(plane / "policy.onnx", 4, 7, (np.full(2, -1.0), np.full(2, 1.0)))
    seen = np.full((1, 7), 0.1, np.float32)
    np.testing.assert_allclose(policy.mean(seen), [[0.02, 0.02]], rtol=1e-6)
    np.testing.assert_allclose(policy.mean(-seen), [[0.4, 0.4]], rtol=1e-6)


def test_a_zip_with_layers_that_are_not_plain_is_refused(plane: Path) -> None:
    layers = {"actor.latent_pi.0": (16, 4), "actor.mu": (2, 16)}
    state = {f"{name}.weight": torch.zeros(shape) for name, shape in layers.items()}
    state |= {f"{name}.bias": torch.zeros(shape[0]) for name, shape in layers.items()}
    write_zip(plane, state)
    assert lab_policy.load(plane / "policy.zip", 4, 7, (np.full(2, -1.0), np.full(2, 1.0)))
    write_zip(plane, state | {"actor.latent_pi.1.running_mean": torch.zeros(16)})  # as CrossQ's
    change(plane, "policy.onnx", "policy.zip")
    assert "its layer actor.latent_pi.1.running_mean is not a plain one" in said(plane)


def test_a_recurrent_zip_is_refused_before_anything_else_is_said_of_it(plane: Path) -> None:
    state = {
        "mlp_extractor.policy_net.0.weight": torch.zeros(16, 256),
        "action_net.weight": torch.zeros(2, 16),
        "lstm_actor.weight_ih_l0": torch.zeros(1024, 4),
    }
    write_zip(plane, state)
    change(plane, "policy.onnx", "policy.zip")
    assert "it is recurrent, and the studio asks for a function of what is seen" in said(plane)


@pytest.mark.parametrize("url", ["", "ws://localhost:1"])
def test_actions_that_do_not_move_the_robot_are_as_the_policy_says_them_whatever_the_gain(
    plane: Path, url: str
) -> None:
    change(plane, "rate_hz = 10", "rate_hz = 10\nmoving = [0]")
    if url:
        change(plane, 'file = "policy.onnx"', f'url = "{url}"')
    described = lab.read(plane / "lab.toml").description
    assert isinstance(described, LabDescription)
    environment = LabEnvironment(described, plane)
    policy = policy_of(described, plane, lab_ranges.first_found(described, environment, plane))
    if isinstance(policy, OnnxPolicy):
        said = policy.mean(np.array([[0, 0, 1, -1, 0, 0, 0]], np.float32))
    else:
        low, high = (np.array(each) for each in policy.asking.bounds)
        said = in_unit(np.array([[0.1, -0.1]]), low, high, policy.asking.gain)
    np.testing.assert_allclose(said, [[0.5, -1.0]], atol=1e-3)


def test_a_zip_whose_weights_want_to_run_code_is_refused(plane: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple[Callable[[str], object], tuple[str]]:
            return Path.touch, (plane / "harmed",)  # type: ignore[return-value]

    torch.save({"actor.mu.weight": Harm()}, plane / "policy.pth")
    with zipfile.ZipFile(plane / "policy.zip", "w") as archive:
        archive.write(plane / "policy.pth", "policy.pth")
    change(plane, "policy.onnx", "policy.zip")
    assert "would have to be unpickled" in said(plane)
    assert not (plane / "harmed").exists()


def test_a_zip_of_something_else_is_refused(plane: Path) -> None:
    with zipfile.ZipFile(plane / "policy.zip", "w") as archive:
        archive.writestr("readme", "hello")
    change(plane, "policy.onnx", "policy.zip")
    assert "it has no policy.pth" in said(plane)


def test_a_policys_actions_are_mapped_to_the_studios_range_and_multiplied(plane: Path) -> None:
    (plane / "policy.onnx").write_bytes(way_to_goal())
    bounds = (np.full(2, -0.1), np.full(2, 0.1))
    far = np.array([0, 0, 1, -1, 0, 0, 0], np.float32)
    whole, half = (lab_policy.load(plane / "policy.onnx", 4, 7, bounds, gain).mean(far) for gain in (1.0, 0.5))
    np.testing.assert_allclose(whole, np.tanh(4.0) * np.array([1, -1]), rtol=1e-5)
    np.testing.assert_allclose(half, whole / 2, rtol=1e-6)


def test_packages_of_the_studio_that_an_installation_has_replaced_are_named() -> None:
    lock = f"numpy==0.1 \\\n    --hash=sha256:00\nonnx=={version('onnx')} \\\nnot-installed-here==1.0\n"
    assert replaced_packages([lock]) == [f"numpy==0.1 was replaced by {version('numpy')}"]
    assert replaced_packages([lock, f"numpy=={version('numpy')}\n"]) == [], "of development"
    assert replaced_packages(["", "numpy==0.1\n"]) == [], "the studio runs without what only development needs"


def test_a_repetition_that_differs_in_the_last_digits_is_the_same_episode(plane: Path) -> None:
    noisy = "np.concatenate([self.place + np.random.uniform(0.0, 1e-7),"
    change(plane, "np.concatenate([self.place,", noisy, "plane.py")
    assert said(plane) == ""
    change(plane, "1e-7", "1e-2", "plane.py")
    renamed(plane)
    assert "the same seed and policy gave another episode" in said(plane)


def test_check_tells_of_replaced_packages(plane: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "requirements.lock").write_text("numpy==0.1\n")
    monkeypatch.setattr("worker.experiments.check_lab.LOCKS", [tmp_path / "requirements.lock"])
    assert "has replaced packages of the studio: numpy==0.1 was replaced" in " ".join(found(plane).remarks)
