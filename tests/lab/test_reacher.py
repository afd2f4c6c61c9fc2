"""The example of MuJoCo with its policy behind a websocket can be used as it is committed."""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import onnx.parser
import onnxruntime
import pytest

from worker.compute import simulation
from worker.experiments.check_lab import checked
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.policies import asked_policy
from worker.sim.lab.errors import LabTaskBroken
from worker.tasks import registry

EXAMPLE = Path(__file__).parents[2] / "examples" / "reacher"


@pytest.fixture
def reacher(tmp_path: Path) -> Iterator[Path]:
    """The example, with its own server at a free port."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: python -m pip install mujoco")
    folder = Path(shutil.copytree(EXAMPLE, tmp_path / "reacher"))
    command = [sys.executable, str(EXAMPLE / "serve_policy.py"), "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            url = server.stdout.readline().strip()
            text = (folder / "lab.toml").read_text()
            (folder / "lab.toml").write_text(re.sub(r"ws://localhost:\d+", url, text))
            yield folder
        finally:
            server.kill()
            asked_policy.forget()


def test_it_passes_its_own_check(reacher: Path) -> None:
    found = checked(reacher / "lab.toml", reacher / "sheet.png")
    if any("render() failed" in each for each in found.wrong):
        pytest.skip(f"MuJoCo cannot draw on this machine: {found.wrong[0]}")
    assert found.wrong == ()
    assert found.remarks[0].startswith("3 of 3 episodes succeeded")


def test_what_was_found_of_it_is_of_it_as_it_is(reacher: Path, use: Callable[[Path], None]) -> None:
    use(reacher)
    task = registry.task("reacher")
    assert ResponseSurface.load(simulation.surface_file("reacher"), task.modes, task.signals).axes == task.modes.names
    try:
        quick, slow = (
            simulation.run_episode("reacher", simulation.act_in_mode("reacher", task.modes.vector(mode)), 5)
            for mode in ({}, {"speed_far": next(each.low for each in task.modes.axes if each.name == "speed_far")})
        )
    except LabTaskBroken as error:
        pytest.skip(f"MuJoCo cannot be used on this machine: {error}")
    assert quick.success
    undelivered = task.signals.index("undelivered")
    assert slow.signals[:, undelivered].sum() > quick.signals[:, undelivered].sum()


def test_the_policy_is_what_its_script_writes() -> None:
    text = (EXAMPLE / "make_policy.py").read_text().split('"""')[3]
    written = onnx.parser.parse_model(text).SerializeToString(deterministic=True)
    seen = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 10)).astype(np.float32)
    said = [
        onnxruntime.InferenceSession(each).run(["action"], {"observation": seen})[0]
        for each in (written, (EXAMPLE / "policy.onnx").read_bytes())
    ]
    np.testing.assert_array_equal(*said)
