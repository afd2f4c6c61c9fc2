"""A frozen policy that is only asked: a server (see policy_client), or a function of the laboratory's.

From observation to mean action in [-1, 1]. It must be a function of what it is asked: the same observation, the same
answer, whatever was asked before. Otherwise two ways of doing one scenario could not be compared. It is asked twice at
first, and later whether it still answers as when the task was explored.
"""

import atexit
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np

from worker.domain.task import Answered
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml.policies.onnx_policy import NotAPolicy
from worker.ml.policies.policy_client import PolicyFunction, PolicyServer, PolicyServerFailed, chunk_of, packed

REMEMBERED = 2000
"""Answers that are kept: a pool asks about each state twice, for the action and for the reference policy's."""
SAME_WITHIN = 1e-4
"""Largest change of an answer in [-1, 1] since the task was explored: another computer rounds otherwise."""
ASKED_AGAIN = 5
"""Observations of an episode, last first, by which a policy's memory is found."""


class Where(Protocol):
    """Where a policy answers. Plain values; nothing is connected to or imported before it is asked."""

    @property
    def who(self) -> str:
        """In words."""

    def connected(self) -> PolicyServer | PolicyFunction:
        """To be asked in this process. Raises NotAPolicy."""


@dataclass(frozen=True)
class AtAddress:
    """Behind a websocket."""

    url: str
    answer_s: float
    """how long it may take for an answer"""

    @property
    def who(self) -> str:
        """See Where."""
        return f"the policy server at {self.url}"

    def connected(self) -> PolicyServer:
        """See Where; one connection for each process."""
        return _connection(self.url, self.answer_s)


@dataclass(frozen=True)
class Asking:
    """How a policy is asked. Plain values."""

    at: Where
    inputs: tuple[tuple[str, tuple[int, ...]], ...]
    """what each part of a message is called, and its columns of the observation"""
    prompt: str | None
    execution_horizon: int
    """of every chunk so many actions are executed before the next is asked for"""
    episode_steps: int
    bounds: tuple[tuple[float, ...], tuple[float, ...]]
    """(A,), (A,) of the actions in the environment's own unit"""
    gain: tuple[float, ...]
    """(A,) by which actions in [-1, 1] are multiplied"""
    name: str = ""
    """among several policies; empty: the frozen one"""


class AskedPolicy:
    """observation (..., D) -> mean action (..., A). Travels between processes as how it is asked."""

    action_limit = 1.0

    def __init__(self, asking: Asking, observation_size: int, known: Answered | None = None) -> None:
        self.asking = asking
        self.known = known
        self._size = observation_size
        self._chunk, self._begun, self._at = np.empty((0, 0), np.float32), -1, -1

    def __reduce__(self) -> tuple[Any, ...]:
        """A connection stays where it is."""
        return type(self), (self.asking, self._size, self.known)

    @property
    def weights(self) -> dict[str, Float32Array]:
        """What is known of it, for its hash: an answer of its."""
        known = self.known or Answered((), ())
        return {"observation": np.array(known.observation, np.float32), "answer": np.array(known.actions, np.float32)}

    @property
    def offset(self) -> Float32Array:
        """(D,) What normalises observations is the server's own."""
        return np.zeros(self._size, np.float32)

    @property
    def scale(self) -> Float32Array:
        """(D,)"""
        return np.ones(self._size, np.float32)

    @property
    def action_size(self) -> int:
        """A"""
        return len(self.asking.bounds[0])

    def mean(self, observations: Float32Array) -> Float32Array:
        """(..., D) -> (..., A); rows are the steps of an episode in their order. Raises NotAPolicy."""
        rows = np.reshape(np.asarray(observations, np.float32), (-1, self._size))
        said = np.array([self._one(row) for row in rows], np.float32)
        return said.reshape(*np.shape(observations)[:-1], self.action_size)

    def first_answer(self, observation: Float32Array) -> Answered:
        """What it says of this (D,), by which it will be known again. Raises NotAPolicy when it says two things."""
        first = _ask(self.asking, observation)
        self._require_again(observation, first)
        return Answered(tuple(observation.tolist()), tuple(map(tuple, first.tolist())))

    def require_no_memory(self, observations: Float32Array) -> None:
        """Asks about some of an episode (N, D) again, last first. Raises NotAPolicy when it says something else."""
        for observation in observations[:: -max(1, len(observations) // ASKED_AGAIN)]:
            self._require_again(observation, self._asked(observation))

    def _require_again(self, observation: Float32Array, before: Float32Array) -> None:
        now = _ask(self.asking, observation)
        if not np.array_equal(before, now):
            raise NotAPolicy(
                f"{self.asking.at.who} answered the same observation in two ways, {_row(before)} and {_row(now)}. It "
                "must be a function of the observation: switch sampling off, or begin its noise from the same seed at "
                "every question, and let it remember nothing."
            )

    def _one(self, observation: Float32Array) -> Float32Array:
        """One step: from the chunk that is being executed, or from a new one."""
        steps = self.asking.episode_steps
        step = round(float(observation[-1]) * steps)
        offset = step % self.asking.execution_horizon
        follows = offset > 0 and self._begun == step - offset and self._at in (step - 1, step)
        if not follows:
            self._chunk, self._begun, offset = self._asked(observation), step, 0
        self._at = step
        if offset >= len(self._chunk):
            raise NotAPolicy(
                f"{self.asking.at.who} answers with {len(self._chunk)} actions, and policy.execution_horizon "
                f"wants {self.asking.execution_horizon} of them executed. Lower it."
            )
        action: Float32Array = self._chunk[offset]
        return action

    def _asked(self, observation: Float32Array) -> Float32Array:
        remembered = _of_process(self.asking, self.known)
        key = packed(message(self.asking.inputs, self.asking.prompt, observation))
        if key not in remembered:
            remembered[key] = _ask(self.asking, observation)
            if len(remembered) > REMEMBERED:
                remembered.popitem(last=False)
        return remembered[key]


@cache
def _connection(url: str, answer_s: float) -> PolicyServer:
    """This process' connection to a server, which is told when the process ends."""
    server = PolicyServer(url, answer_s)
    atexit.register(server.close)
    return server


@cache
def _of_process(asking: Asking, known: Answered | None) -> "OrderedDict[bytes, Float32Array]":
    """What the server has answered in this process, once it is known to be the one that was explored."""
    if known is not None:
        before = np.array(known.actions, np.float32)
        now = _ask(asking, np.array(known.observation, np.float32))
        if now.shape != before.shape or float(np.abs(now - before).max()) > SAME_WITHIN:
            raise NotAPolicy(
                f"{asking.at.who} is not the one with which the task was explored: it answers "
                f"{_row(now)} where it answered {_row(before)}. Take that one again, or explore the task anew."
            )
    return OrderedDict()


def forget() -> None:
    """Hang up and forget all answers, as a new process would begin."""
    _connection.cache_clear()
    _of_process.cache_clear()


def _ask(asking: Asking, observation: Float32Array) -> Float32Array:
    """(H, A) in [-1, 1]. A connection that was lost is made anew once, for an answer depends on its question alone."""
    server = asking.at.connected()
    asked = message(asking.inputs, asking.prompt, observation)
    try:
        try:
            answer = server.ask(asked)
        except PolicyServerFailed as error:
            if isinstance(error.__cause__, TimeoutError) or error.__cause__ is None:
                raise  # it would hang, or report its error, again
            answer = server.ask(asked)
        chunk = chunk_of(answer, len(asking.bounds[0]))
    except PolicyServerFailed as error:
        raise NotAPolicy(str(error)) from error
    low, high = (np.array(each) for each in asking.bounds)
    return in_unit(chunk, low, high, asking.gain)


def message(inputs: Sequence[tuple[str, Sequence[int]]], prompt: str | None, observation: Any) -> Mapping[str, Any]:
    """What is sent for an observation (D,)."""
    parts: dict[str, Any] = {name: observation[list(columns)] for name, columns in inputs}
    return parts if prompt is None else {**parts, "prompt": prompt}


def in_unit(actions: FloatArray, low: FloatArray, high: FloatArray, gain: Sequence[float]) -> Float32Array:
    """(..., A) in the environment's own unit -> in [-1, 1], as onnx_policy.adapted() has it."""
    unit = np.clip((actions - (high + low) / 2.0) / ((high - low) / 2.0), -1.0, 1.0)
    return (np.array(gain) * unit).astype(np.float32)


def _row(chunk: Float32Array) -> list[float]:
    return [round(float(each), 4) for each in chunk[0]]
