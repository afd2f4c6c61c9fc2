"""The plane of conftest with its policy at an address and a filter, in a loop or as a bundle that is served."""

import contextlib
import io
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from app.installed_tasks import lab
from app.installed_tasks.lab import LabDescription
from worker.compute.lab_policies import policy_of
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.experiments.lab_ranges import first_found
from worker.ml.export import bundle
from worker.ml.export.bundle import BundleContents, Provenance, RecordedSteps
from worker.ml.export.filter_loop import FilterLoop, Run
from worker.ml.export.interface import interface_of
from worker.ml.filters.exported.filter_act import FilterAct, act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.policies.policy_client import PolicyServer
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.rewards.reward_models import StructuredReward
from worker.sim.lab.environment import LabEnvironment

MODE = {"speed_far": -0.7, "smooth": 0.4, "push_y": 0.3}
PATIENT = ("--deadline-ms", "60000", "--pause-s", "0")
"""How a filter is served where the machine may be busy with other tests: nothing is late, nobody too silent."""


class Plane:
    """The plane of conftest with its policy at an address, and somebody's filter."""

    def __init__(self, folder: Path, url: str) -> None:
        text = (folder / "lab.toml").read_text()
        (folder / "lab.toml").write_text(
            text.replace('file = "policy.onnx"', f'url = "{url}"\nexecution_horizon = 4').replace(
                "gain = 0.5", "gain = 0.8"
            )
        )
        described = lab.read(folder / "lab.toml").description
        assert isinstance(described, LabDescription)
        self.environment = LabEnvironment(described, folder)
        found = first_found(described, self.environment, folder)
        self.task = found.task(described)
        self.policy = policy_of(described, folder, found)
        self.filter: FilterAct = act_of(self.task.modes, self.policy, FilterWeights(mode=MODE))
        self.url = url

    def loop(self, deadline_s: float = 5.0, pause_s: float = 60.0) -> FilterLoop:
        return FilterLoop(
            interface_of(self.task, self.policy),
            unshielded(self.filter),
            PolicyServer(self.url),
            deadline_s,
            pause_s,
        )


def unshielded(act: FilterAct) -> Run:
    """As run_filter.run() says it of a filter without a shield."""
    return lambda seen, mean: (act.exported.batch(seen, mean), np.zeros((len(seen), 1)))


def written(task: Task, policy: ReferencePolicy, episode: Trajectory, act: FilterAct, folder: Path) -> Path:
    contents = BundleContents(
        task=task,
        filter_onnx=act.exported.stored,
        weights=FilterWeights(mode=MODE if task.is_a_labs else {"speed_near": -0.5}),
        reward=StructuredReward(np.ones((8, len(task.signals)))),
        policy=policy,
        recording=RecordedSteps.of([episode]),
        metrics={},
        provenance=Provenance("demo", "P07", 1, 9, "ab" * 32, 11, "2026-01-02T03:04:05Z", "cd" * 32, "none"),
    )
    with zipfile.ZipFile(io.BytesIO(bundle.write(contents))) as archive:
        archive.extractall(folder)
    return folder


@contextlib.contextmanager
def served(folder: Path, *arguments: str) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """Its address and its process, in which nothing of this project can be imported."""
    command = [sys.executable, "-I", "run_filter.py", "--serve", "0", *arguments]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if " at ws://" in line:
                    break
            yield line.partition(" at ")[2].partition(";")[0], process
        finally:
            process.kill()


def ended(folder: Path, *arguments: str) -> str:
    command = [sys.executable, "-I", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    return done.stderr
