"""The example of a ROS 2 node, on the message definitions of ROS 2 Jazzy; ROS itself is not installed here.

Whatever is published is written as CDR by the definitions and read again, as on the wire; topics are kept in memory.
"""

import importlib.util
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from tests.lab.filtered_plane import Plane, written
from tests.lab.policy_server import serving, to_goal
from worker.ml.policies import asked_policy

EXAMPLE = Path(__file__).parents[2] / "examples" / "ros2" / "filter_node.py"
ROS = get_typestore(Stores.ROS2_JAZZY)


def message(name: str, **usual: Any) -> Callable[[], Any]:
    """Makes messages as generated Python code does: all fields there, with their usual values."""
    return lambda: ROS.types[f"std_msgs/msg/{name}"](**usual)


LAYOUT = ROS.types["std_msgs/msg/MultiArrayLayout"]([], 0)
MESSAGES = SimpleNamespace(
    Float64MultiArray=message("Float64MultiArray", layout=LAYOUT, data=[]),
    String=message("String", data=""),
    Empty=message("Empty", structure_needs_at_least_one_member=0),
)


class Topics:
    """What a node is given by ROS: topics and a timer, whose step a test takes."""

    def __init__(self) -> None:
        self.said: dict[str, list[Any]] = {}
        self.heard: dict[str, Callable[[Any], None]] = {}

    def create_publisher(self, kind: Callable[[], Any], topic: str, _depth: int) -> Any:
        sent = self.said.setdefault(topic, [])
        return SimpleNamespace(publish=lambda each: sent.append(over_the_wire(each, kind)))

    def create_subscription(self, kind: Callable[[], Any], topic: str, hear: Callable[[Any], None], _: int) -> None:
        self.heard[topic] = lambda each: hear(over_the_wire(each, kind))

    def create_timer(self, period_s: float, step: Callable[[], None]) -> None:
        self.period_s, self.step = period_s, step

    def observe(self, values: Any) -> None:
        seen = MESSAGES.Float64MultiArray()
        seen.data = np.asarray(values, np.float64)
        self.heard["~/observation"](seen)

    def newest(self) -> tuple[list[float], str]:
        return self.said["~/action"][-1].data.tolist(), self.said["~/state"][-1].data


def over_the_wire(sent: Any, kind: Callable[[], Any]) -> Any:
    name = kind().__msgtype__
    assert sent.__msgtype__ == name
    if name.endswith("Float64MultiArray"):
        sent.data = np.asarray(sent.data, np.float64)  # rclpy takes lists of numbers, this library arrays
    return ROS.deserialize_cdr(ROS.serialize_cdr(sent, name), name)


@pytest.fixture
def example() -> Any:
    spec = importlib.util.spec_from_file_location("filter_node", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


@pytest.fixture
def made(plane: Path) -> Iterator[Plane]:
    with serving(to_goal) as url:
        lab = Plane(plane, url)
        yield lab
        lab.environment.close()
    asked_policy.forget()


def test_a_robot_behind_the_node_moves_as_it_did_when_the_filter_was_fitted_and_stops_when_nobody_sees(
    made: Plane, example: Any, tmp_path: Path
) -> None:
    episode = made.environment.episode(made.filter, 3, made.policy.mean)
    folder = written(made.task, made.policy, episode, made.filter, tmp_path / "bundle")
    between, topics = example.Between(folder, made.url, deadline_s=60.0, stale_s=60.0), Topics()
    stop = example.wire(topics, between, MESSAGES)
    assert topics.period_s == pytest.approx(0.1)
    topics.step()
    assert "~/action" in topics.said
    assert topics.said["~/action"] == [], "nothing is said before anything was seen"
    for seen, action in zip(episode.observations[:8, :4], episode.actions, strict=False):
        topics.observe(seen)
        topics.step()
        done, state = topics.newest()
        np.testing.assert_allclose(done, 0.1 * action, atol=1e-6)
        assert state == "ok"
    between._stale_s = 0.0
    time.sleep(0.001)
    topics.step()
    assert topics.newest()[0] == [0.0, 0.0]
    assert topics.newest()[1].startswith("stale: the newest observation is")
    between._stale_s = 60.0

    topics.observe([0.0, np.nan, 0.0, 0.0])
    topics.step()
    assert topics.newest() == ([0.0, 0.0], "refused: observation holds a NaN or an infinity.")
    topics.observe(episode.observations[0, :4])
    topics.step()
    assert topics.newest()[1].startswith("refused"), "until somebody says that it may go on"
    topics.heard["~/reset"](MESSAGES.Empty())
    topics.observe(episode.observations[0, :4])
    topics.step()
    np.testing.assert_allclose(topics.newest()[0], 0.1 * episode.actions[0], atol=1e-6)
    stop()
    assert topics.newest() == ([0.0, 0.0], "stop: the node ends")
    between.close()


def test_a_policy_that_is_not_there_is_a_refusal_and_a_damaged_bundle_ends_in_words(
    made: Plane, example: Any, tmp_path: Path
) -> None:
    episode = made.environment.episode(made.filter, 3, made.policy.mean)
    folder = written(made.task, made.policy, episode, made.filter, tmp_path / "bundle")
    between, topics = example.Between(folder, "ws://127.0.0.1:9", stale_s=60.0), Topics()
    example.wire(topics, between, MESSAGES)
    topics.observe(episode.observations[0, :4])
    topics.step()
    assert topics.said["~/action"] == []
    assert "no policy server answers at ws://127.0.0.1:9" in topics.said["~/state"][-1].data
    between.close()
    with pytest.raises(SystemExit, match="say where with upstream"):
        example.Between(folder)
    (folder / "filter.onnx").write_bytes(b"")
    with pytest.raises(SystemExit, match=r"filter\.onnx is not the file that was exported"):
        example.Between(folder, made.url)
