"""A bundle's own files between a client and a policy server, as somebody without this project runs them."""

import signal
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.lab.filtered_plane import PATIENT, Plane, ended, served, written
from tests.worker import invented
from worker.domain.trajectory import SIGNALS
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.policies.policy_client import PolicyServer, PolicyServerFailed


def test_a_bundle_stands_between_a_policy_server_and_a_client(plane_of: Callable[..., Plane], tmp_path: Path) -> None:
    made = plane_of()
    trajectory = made.environment.episode(made.filter, 3, made.policy.mean)
    folder = written(made.task, made.policy, trajectory, made.filter, tmp_path / "bundle")
    assert not (folder / "policy.onnx").exists()
    assert "--upstream ws://HOST:PORT" in (folder / "MODEL_CARD.md").read_text()
    with served(folder, "--upstream", made.url, *PATIENT) as (url, process):
        client, second = PolicyServer(url), PolicyServer(url)
        client.connect()
        assert client.metadata["interface"]["task"] == "plane"
        assert client.metadata["policy"] == {"robot": "point"}
        with pytest.raises(PolicyServerFailed, match="somebody else is connected"):
            second.connect()
        with urllib.request.urlopen(url.replace("ws://", "http://") + "/healthz") as answer:  # noqa: S310 -- our own
            assert answer.read() == b"OK\n"
        said = [client.ask({"observation": seen[:4]})["actions"][0] for seen in trajectory.observations[:-1]]
        np.testing.assert_allclose(said, 0.1 * trajectory.actions, atol=1e-6)
        with pytest.raises(PolicyServerFailed, match=r"Refused: observation has the shape \(3,\)"):
            client.ask({"observation": np.zeros(3)})
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate()
    assert process.returncode == 0
    assert "40 steps (40 ok), the shield active in 0, rate " in out
    assert out.endswith("Ended.\n")


def test_a_bundle_of_ours_is_served_with_its_own_policy(tmp_path: Path) -> None:
    policy = invented.small_policy()
    act = act_of(invented.TASK.modes, policy, FilterWeights(mode={"speed_near": -0.5}))
    episode = invented.trajectory(np.random.default_rng(0), scenario=0)
    assert invented.TASK.signals == SIGNALS
    folder = written(invented.TASK, policy, episode, act, tmp_path / "bundle")
    with served(folder) as (url, _):
        client = PolicyServer(url)
        for seen in episode.observations[:5]:
            np.testing.assert_allclose(client.ask({"observation": seen})["actions"][0], act(seen), atol=1e-5)
        client.close()


def test_what_is_missing_is_said_before_anybody_connects(plane_of: Callable[..., Plane], tmp_path: Path) -> None:
    made = plane_of()
    folder = written(
        made.task, made.policy, made.environment.episode(made.filter, 3, made.policy.mean), made.filter, tmp_path
    )
    assert "say where it is with --upstream ws://host:port or --upstream module:function" in ended(
        folder, "run_filter.py", "--serve", "0"
    )
    nobody = ("run_filter.py", "--serve", "0", "--upstream", "ws://127.0.0.1:9")
    assert "no policy server answers at ws://127.0.0.1:9" in ended(folder, *nobody)
    code = "import sys, runpy; sys.modules['websockets'] = None; sys.argv = ['run_filter.py', '--serve', '0']\n"
    code += "runpy.run_path('run_filter.py', run_name='__main__')"
    assert "python -m pip install websockets msgpack" in ended(folder, "-c", code)
