"""A ROS 2 node that stands between a policy and a robot with somebody's filter bundle.

    source /opt/ros/jazzy/setup.bash
    python -m pip install numpy onnxruntime websockets msgpack
    python filter_node.py --ros-args -p bundle:=/path/to/bundle -p upstream:=ws://localhost:8000

The bundle is unzipped; without ``upstream`` the policy is its own. Topics, all of std_msgs:

    ~/observation  in   Float64MultiArray  the observation: order, units and frame of the manifest's ``interface``
    ~/reset        in   Empty              an episode begins; also goes on after "refused"
    ~/action       out  Float64MultiArray  at the manifest's rate, in the policy's unit (as ros2_control's
                                           forward_command_controller takes its commands)
    ~/state        out  String             ok, slow, stop, stale, refused, and why; or what is unlike the tests

The loop is the bundle's own, so watchdog and shield are those of ``run_filter.py --serve``: a policy
that is late slows the robot and then stops it. Beside that, an observation older than ``stale_s`` stops it, and so does
one that the bundle does not belong to, until ~/reset. When this node is gone nothing is said: the robot's own watchdog
must stop it then.
"""

import importlib
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np


class Between:
    """What the node does, without ROS: newest observation in, one action per control step out."""

    def __init__(self, bundle: Path, upstream: str = "", deadline_s: float = 0.0, stale_s: float = 0.0) -> None:
        """``deadline_s``, ``stale_s``: 0 for one and three control steps. Exits in words when the bundle is damaged."""
        sys.path.insert(0, str(bundle))
        try:
            runner, serving = (importlib.import_module(name) for name in ("run_filter", "serve_filter"))
        finally:
            sys.path.remove(str(bundle))
        self._packed, self._refused = serving.packed, serving.Refused
        try:
            manifest = runner.verified_manifest(bundle)
            runner.check_signature(bundle, None)
            session, own = runner.load(bundle / "filter.onnx"), runner.policy_of(manifest, bundle)
        except runner.Problem as problem:
            raise SystemExit(f"FAILED: {problem}") from problem
        if not upstream and own is None:
            raise SystemExit("FAILED: this bundle's policy answers from a server: say where with upstream.")
        self.interface = manifest["interface"]
        self.step_s = 1.0 / self.interface["control_rate_hz"]
        self._stale_s = stale_s or 3.0 * self.step_s
        policy = serving.PolicyServer(upstream) if upstream else lambda seen: runner.means_of(own, seen)
        self._loop = serving.FilterLoop(
            self.interface,
            lambda seen, said: runner.run(session, seen, said),
            policy,
            deadline_s or self.step_s,
            self._stale_s,
        )
        self._loop.compare_with_tests(manifest, bundle)
        self._loop.begin_connection()
        self._moving = np.isin(np.arange(len(self.interface["action"]["names"])), self.interface["action"]["moving"])
        self._observation: Any = None
        self._seen_s, self._reset, self._why_refused = 0.0, True, ""
        self._last: Any = None

    def observe(self, observation: Sequence[float]) -> None:
        """The newest observation."""
        self._observation, self._seen_s = np.asarray(observation, np.float32), time.monotonic()

    def reset(self) -> None:
        """An episode begins with the next observation; what was seen before is not of it."""
        self._observation, self._reset, self._why_refused = None, True, ""

    def act(self) -> tuple[list[float] | None, str]:
        """One action, None before anything was seen or done; and the state, with why."""
        if self._why_refused:
            return self.standstill(), f"refused: {self._why_refused}"
        if self._observation is None:
            return self.standstill(), "stale: no observation yet"
        old = time.monotonic() - self._seen_s
        if old > self._stale_s:
            return self.standstill(), f"stale: the newest observation is {old:.2f} s old"
        message = {"observation": self._observation} | ({"reset": True} if self._reset else {})
        try:
            answer = self._loop.answer(self._packed(message))
        except self._refused as error:
            self._why_refused = str(error)
            return self.standstill(), f"refused: {error}"
        self._reset, self._last = False, np.asarray(answer["actions"][0], np.float64)
        said = answer["filter"]
        return self._last.tolist(), f"{said['state']}: {said['why']}" if said["why"] else str(said["state"])

    def standstill(self) -> list[float] | None:
        """No motion; actions that do not move the robot stay. None while nothing was done."""
        if self._last is None:
            return None
        self._last = np.where(self._moving, 0.0, self._last)
        still: list[float] = self._last.tolist()
        return still

    def close(self) -> None:
        """Let go of the policy server."""
        self._loop.close()


def wire(node: Any, between: Between, messages: Any) -> Callable[[], None]:
    """Topics and timer of a node, with the types of std_msgs.msg; returns what stops the robot once more."""
    actions = node.create_publisher(messages.Float64MultiArray, "~/action", 1)
    states = node.create_publisher(messages.String, "~/state", 1)

    def publish(action: list[float] | None, state: str) -> None:
        if action is not None:
            said = messages.Float64MultiArray()
            said.data = action
            actions.publish(said)
        told = messages.String()
        told.data = state
        states.publish(told)

    node.create_subscription(
        messages.Float64MultiArray, "~/observation", lambda message: between.observe(message.data), 1
    )
    node.create_subscription(messages.Empty, "~/reset", lambda _: between.reset(), 1)
    node.create_timer(between.step_s, lambda: publish(*between.act()))
    return lambda: publish(between.standstill(), "stop: the node ends")


def main() -> None:
    """The node, until it is interrupted."""
    import rclpy
    import std_msgs.msg
    from rclpy.executors import ExternalShutdownException
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # or nothing could be published at the end
    node = rclpy.create_node("pbarl_filter")
    usual = {"bundle": "", "upstream": "", "deadline_s": 0.0, "stale_s": 0.0}
    said = {name: node.declare_parameter(name, value).value for name, value in usual.items()}
    if not said["bundle"]:
        raise SystemExit("FAILED: say where the unzipped bundle is: --ros-args -p bundle:=/path/to/bundle")
    between = Between(Path(said.pop("bundle")).resolve(), **said)
    stop = wire(node, between, std_msgs.msg)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        stop()
        between.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
