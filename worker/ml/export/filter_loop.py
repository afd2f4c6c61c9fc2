"""What a robot gets for an observation: a bundle's filter around any policy, step by step, with a watchdog.

A client's message goes to the policy server as it came; a policy that is a function is called in this process instead.
Of the chunk that comes back, the actions are filtered one at a time, each with a fresh observation, and the client gets
one action (1, A) in the policy's own units, with ``filter``: in which state the loop is and why, how active the shield
was, and what is other than in the filter's tests. The first message of a connection begins an episode, and so does one
that says ``"reset": true``.

The watchdog: an answer later than the deadline gives the last action at half, a quarter, an eighth of it ("slow"), then
zero ("stop"), until the policy is in time again; actions that do not move the robot, a gripper's, stay as they were. A
policy server that hangs up, reports an error, or says what is no action: "stop" at once. A client that is silent for
longer than the pause after an answer is taken to have stopped: it goes on from standstill with a new chunk. The robot's
own watchdog must stop it when this loop says nothing at all.
"""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as Late
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

if __package__:
    from worker.ml.export.forward_model import DynamicsMonitor, ForwardModel
    from worker.ml.export.run_filter import strong_share, unusual_activity, usual_strong_share
    from worker.ml.policies.policy_client import (
        PolicyFunction,
        PolicyServer,
        PolicyServerFailed,
        chunk_of,
        packed,
        unpacked,
    )
else:  # in a bundle they lie beside this file
    from forward_model import (  # type: ignore[import-not-found, no-redef]  # in bundles
        DynamicsMonitor,
        ForwardModel,
    )
    from policy_client import (  # type: ignore[import-not-found, no-redef]  # in bundles
        PolicyFunction,
        PolicyServer,
        PolicyServerFailed,
        chunk_of,
        packed,
        unpacked,
    )
    from run_filter import (  # type: ignore[import-not-found, no-redef]  # in bundles
        strong_share,
        unusual_activity,
        usual_strong_share,
    )

Run = Callable[[Any, Any], Sequence[Any]]
"""(N, D), (N, A) -> (N, A), (N, 1): the filter, in the studio's units, and the activity of its shield"""
Means = Callable[[Any], Any]
"""(N, D) -> (N, A): the policy in the bundle"""
FAR_OUTSIDE = 10.0
"""Times half of a field's range beyond it: other units, or another frame."""
SLOW_STEPS = 3
"""Late answers in a row for which the robot is slowed down before it is stopped."""
TOLERATED_RATE = 0.2
ASKED_FOR_RATE = 20
"""Steps after which the client's rate is known."""
OURS = {"reset", "interface"}
"""What a client says to the filter, not to the policy."""


class Refused(Exception):
    """A client or a policy server that this bundle does not belong to; the message says why."""


@dataclass
class Counted:
    """What happened on one connection."""

    began: float = field(default_factory=time.perf_counter)
    steps: int = 0
    states: dict[str, int] = field(default_factory=dict)
    pauses: int = 0
    shielded: int = 0
    unlike_tests: dict[str, int] = field(default_factory=dict)
    """In how many steps what was told"""
    whole_ms: list[float] = field(default_factory=list)
    policy_ms: list[float] = field(default_factory=list)
    filter_ms: list[float] = field(default_factory=list)
    intervals_s: list[float] = field(default_factory=list)

    @property
    def rate_hz(self) -> float | None:
        """How often the client asks; None while that is not known."""
        if len(self.intervals_s) < ASKED_FOR_RATE:
            return None
        return 1.0 / max(float(np.median(self.intervals_s)), 1e-9)

    def __str__(self) -> str:
        rate = "unknown" if self.rate_hz is None else f"{self.rate_hz:.1f} Hz"
        states = ", ".join(f"{count} {state}" for state, count in sorted(self.states.items())) or "none"
        told = ", ".join(f"{what} in {steps}" for what, steps in self.unlike_tests.items())
        unlike = f"; unlike the tests: {told}" if told else ""
        return (
            f"{self.steps} steps ({states}), the shield active in {self.shielded}, rate {rate}, {self.pauses} pauses; "
            f"whole {_spread(self.whole_ms)}, policy {_spread(self.policy_ms)}, filter {_spread(self.filter_ms)}"
            f"{unlike}"
        )


class FilterLoop:
    """One robot's filter: what is between two messages is kept here. Raises Refused for messages of others."""

    usual_strong_share: float | None = None
    """of an episode's steps, in which its shield was strongly active in tests, at most; None: not known"""
    monitor: DynamicsMonitor | None = None
    """None: what followed from actions in tests is not known"""

    def __init__(
        self,
        interface: Mapping[str, Any],
        run: Run,
        policy: PolicyServer | PolicyFunction | Means,
        deadline_s: float,
        pause_s: float,
    ) -> None:
        self.interface, self._run, self._policy = interface, run, policy
        self._deadline_s, self._pause_s = deadline_s, pause_s
        action = interface["action"]
        self._low, self._high = np.array(action["low"], np.float64), np.array(action["high"], np.float64)
        self._moving = np.isin(np.arange(len(self._low)), action["moving"])
        self._thread = ThreadPoolExecutor(1, "policy")
        self._asked: Future[Any] | None = None
        self.counted = Counted()
        self._activities = deque[float](maxlen=interface["episode_steps"])
        self._step, self._late = 0, 0
        self._asked_s: float | None = None  # the client, last
        self._answered_s = 0.0
        self._seen: Any = None  # before the last action, while nothing else has moved the robot since
        self._previous: Any = None
        self._chunk: Any = None
        self._begin()

    def compare_with_tests(self, manifest: Mapping[str, Any], bundle: Path) -> None:
        """Tell when the world is another than in the tests of this bundle; those of earlier versions know less."""
        self.usual_strong_share = usual_strong_share(manifest)
        model = ForwardModel.of_bundle(bundle)
        if model is not None:
            names = [each["name"] for each in self.interface["observation"] for _ in range(each["size"])]
            self.monitor = DynamicsMonitor(model, names, self.interface["episode_steps"])

    def begin_connection(self) -> None:
        """Somebody else is there."""
        self.counted = Counted()
        self._activities.clear()
        self._begin()

    def answer(self, stored: bytes) -> dict[str, Any]:
        """What a client's message is answered with."""
        now = time.perf_counter()
        message = _read(stored)
        if isinstance(message.get("interface"), dict):
            require_same("the client", message["interface"], self.interface)
        observation = self._observation(message)
        self._look_at_the_clock(now, bool(message.get("reset")))
        if self.monitor and self._seen is not None:
            self.monitor.step(self._seen, self._previous, observation)
        state, why, shield, others = "ok", "", 0.0, dict[str, Any]()
        try:
            mean = self._mean(observation, stored, others)
        except Late:
            self._late += 1
            state = "slow" if self._late <= SLOW_STEPS and self._step else "stop"
            why = f"the policy has not answered within {1000 * self._deadline_s:g} ms"
        except PolicyServerFailed as error:
            if not self._step:
                raise Refused(str(error)) from error
            self._chunk, state, why = self._chunk[:0], "stop", str(error)
        if state == "ok":
            self._late = 0
            began = time.perf_counter()
            actions, activity = self._run(self._whole(observation), mean[None])
            action, shield = np.asarray(actions[0], np.float32), float(activity[0, 0])
            self.counted.filter_ms.append(1000 * (time.perf_counter() - began))
            self.counted.shielded += shield > 0.0
            self._activities.append(shield)
        else:
            action = self._slower(0.5 if state == "slow" else 0.0)
        self._seen, self._previous, self._step = observation, action, self._step + 1
        self.counted.steps += 1
        self.counted.states[state] = self.counted.states.get(state, 0) + 1
        self._answered_s = time.perf_counter()
        self.counted.whole_ms.append(1000 * (self._answered_s - now))
        unlike = self._unlike_tests()
        for what in unlike:
            self.counted.unlike_tests[what] = self.counted.unlike_tests.get(what, 0) + 1
        said = {
            "state": state,
            "why": why or "; ".join(unlike.values()),
            "unlike_tests": list(unlike),
            "shield": shield,
        }
        return {**others, "actions": self._outside(action)[None], "filter": said}

    def first_said(self, observation: Any) -> Any:
        """(own size,) -> (A,): the policy's action in [-1, 1] at the beginning of an episode, asked alone."""
        return self._next_chunk(observation, packed({}), {})[0]

    def close(self) -> None:
        """Let go of the policy server."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        if isinstance(self._policy, PolicyServer):
            self._policy.close()

    # Private

    def _begin(self) -> None:
        """An episode: from standstill, with nothing of the one before."""
        self._step, self._late, self._asked_s = 0, 0, None
        self._seen, self._previous = None, np.zeros(len(self._low), np.float32)
        self._chunk = np.empty((0, len(self._low)), np.float32)
        if self.monitor:
            self.monitor.begin()

    def _stand_still(self) -> None:
        """The robot has stopped meanwhile, and a chunk is of the past."""
        self._seen, self._previous, self._chunk = None, self._slower(0.0), self._chunk[:0]
        if self.monitor:
            self.monitor.go_on()

    def _look_at_the_clock(self, now: float, reset: bool) -> None:
        if reset:
            self._begin()
        elif self._asked_s is not None:
            # from the answer on: while a slow policy is asked, the client waits and is not silent
            if self._pause_s and now - self._answered_s > self._pause_s:
                self.counted.pauses += 1
                self._stand_still()
            else:
                self.counted.intervals_s.append(now - self._asked_s)
        self._asked_s = now

    def _observation(self, message: Mapping[str, Any]) -> Any:
        """(own size,) from the fields by their names, the whole as "observation", or what the policy is sent."""
        fields, inputs = self.interface["observation"], self.interface["policy"]["inputs"]
        size = sum(each["size"] for each in fields)
        found = np.full(size, np.nan, np.float32)
        there = np.zeros(size, bool)
        places, first = [*inputs.items()], 0
        for each in fields:
            places.append((each["name"], list(range(first, first + each["size"]))))
            first += each["size"]
        if "observation" not in dict(places) or np.size(message.get("observation", ())) == size:
            # environments with goals call one of their fields so: which is meant, its length says
            places = [("observation", list(range(size))), *(place for place in places if place[0] != "observation")]
        for name, columns in places:
            if name in message:
                found[columns] = _numbers(name, message[name], len(columns))
                there[columns] = True
        if not there.all():
            wanted = ", ".join(f"{each['name']} ({each['size']} x {each['unit']})" for each in fields)
            raise Refused(f"the message has {', '.join(message) or 'nothing'}; this filter needs {wanted}.")
        _require_in_range(fields, found)
        return found

    def _whole(self, own: Any) -> Any:
        """(1, D) with what filters of laboratories' policies need at the end."""
        if not self.interface["adds_previous_action_and_share"]:
            return own[None]
        share = np.float32(min(1.0, self._step / self.interface["episode_steps"]))
        return np.concatenate([own, self._previous, [share]]).astype(np.float32)[None]

    def _mean(self, observation: Any, stored: bytes, others: dict[str, Any]) -> Any:
        """(A,) of the policy, in [-1, 1]; what else it said goes into ``others``. Raises Late, PolicyServerFailed."""
        if len(self._chunk) == 0:
            began = time.perf_counter()
            self._chunk = self._next_chunk(observation, stored, others)
            self.counted.policy_ms.append(1000 * (time.perf_counter() - began))
        mean, self._chunk = self._chunk[0], self._chunk[1:]
        return mean

    def _next_chunk(self, observation: Any, stored: bytes, others: dict[str, Any]) -> Any:
        if not isinstance(self._policy, PolicyServer | PolicyFunction):
            return np.asarray(self._policy(self._whole(observation)), np.float32)
        until = time.perf_counter() + self._deadline_s
        if self._asked is not None:  # an answer that was late: what it says is of the past
            with contextlib.suppress(PolicyServerFailed):
                self._asked.result(self._deadline_s)
        self._asked = self._thread.submit(self._policy.ask_packed, self._passed_on(observation, stored))
        answer = self._asked.result(max(0.0, until - time.perf_counter()) if self._step else None)
        self._asked = None
        others.update({name: said for name, said in answer.items() if name not in ("actions", "filter")})
        said = self.interface["policy"]
        chunk = chunk_of(answer, len(self._low))[: said["execution_horizon"]]
        return (np.where(self._moving, said["gain"], 1.0) * self._in_unit(chunk)).astype(np.float32)

    def _passed_on(self, observation: Any, stored: bytes) -> bytes:
        """A client's message as it came, without what is said to the filter alone and with what the policy needs."""
        message, said = unpacked(stored), self.interface["policy"]
        needed = {name: observation[columns] for name, columns in said["inputs"].items() if name not in message}
        if said["prompt"] is not None and "prompt" not in message:
            needed["prompt"] = said["prompt"]
        if not needed and not message.keys() & OURS:
            return stored
        return packed({name: part for name, part in message.items() if name not in OURS} | needed)

    def _in_unit(self, actions: Any) -> Any:
        return np.clip((actions - (self._high + self._low) / 2.0) / ((self._high - self._low) / 2.0), -1.0, 1.0)

    def _outside(self, action: Any) -> Any:
        """(A,) in the policy's own units."""
        return ((self._high + self._low) / 2.0 + action * (self._high - self._low) / 2.0).astype(np.float32)

    def _slower(self, factor: float) -> Any:
        """The last action with its motion multiplied."""
        slower = self._in_unit(factor * self._outside(self._previous))
        return np.where(self._moving, slower, self._previous).astype(np.float32)

    def _unlike_tests(self) -> dict[str, str]:
        """What is not as it was in tests, and in words."""
        dynamics = self.monitor.notes() if self.monitor else {}
        every = {"rate": self._rate_note(), **dynamics, "shield": self._shield_note()}
        return {what: note for what, note in every.items() if note}

    def _shield_note(self) -> str:
        """Of the last as many steps as an episode has: how active a shield is differs within it."""
        if len(self._activities) < self.interface["episode_steps"]:
            return ""
        return unusual_activity(strong_share(np.array(self._activities)), self.usual_strong_share)

    def _rate_note(self) -> str:
        rate, belongs = self.counted.rate_hz, self.interface["control_rate_hz"]
        if rate is None or abs(rate / belongs - 1.0) <= TOLERATED_RATE:
            return ""
        return f"asked {rate:.1f} times a second, and the filter belongs to {belongs:g} Hz"


def require_same(who: str, said: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """Refuse what says that it is of another task, frame, rate, or of other units. Silence is no refusal."""
    units = {each["name"]: each["unit"] for each in own["observation"]} | {"action": own["action"]["unit"]}
    mine = {name: own[name] for name in ("fingerprint", "task", "frame", "control_rate_hz")} | {"units": units}
    for name, value in mine.items():
        if name == "units" and isinstance(said.get(name), dict):
            for part, unit in said[name].items():
                if part in units and unit != units[part]:
                    raise Refused(f"{who} says {part} in {unit}; this bundle belongs to {units[part]}.")
        elif name in said and said[name] != value:
            raise Refused(f"{who} is of {name} {said[name]}; this bundle belongs to {value}.")


def _read(stored: bytes) -> dict[str, Any]:
    try:
        return unpacked(stored)
    except ValueError as error:
        raise Refused(f"the message cannot be read: {error}.") from error


def _numbers(name: str, value: Any, size: int) -> Any:
    try:
        array = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        raise Refused(f"{name} is no array of numbers.") from None
    if array.size != size:  # a table is flattened, as the studio has it
        raise Refused(f"{name} has the shape {array.shape}; this filter needs ({size},).")
    if not np.isfinite(array).all():
        raise Refused(f"{name} holds a NaN or an infinity.")
    return array.reshape(size)


def _require_in_range(fields: list[dict[str, Any]], own: Any) -> None:
    first = 0
    for each in fields:
        values = own[first : first + each["size"]]
        first += each["size"]
        margin = FAR_OUTSIDE * (each["high"] - each["low"]) / 2.0
        if ((values < each["low"] - margin) | (values > each["high"] + margin)).any():
            raise Refused(
                f"{each['name']} is {values.tolist()}, far outside [{each['low']:g}, {each['high']:g}]. This bundle "
                f"belongs to the unit {each['unit']}; look at units and frame."
            )


def _spread(durations_ms: list[float]) -> str:
    if not durations_ms:
        return "-"
    middle, late, most = np.percentile(durations_ms, (50, 95, 100))
    return f"{middle:.2f}/{late:.2f}/{most:.2f} ms (median/95 %/most)"
