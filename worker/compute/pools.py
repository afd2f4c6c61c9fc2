"""Processes for heavy work: simulation and training run there, the durable engine only waits for them.

Several lanes, so that a training never stands behind a queue of videos, nobody's pairs wait for a fine-tuning that
takes minutes, and a reward model, whose person is answering, never for somebody else's filter. The processes are polite
(niced), single-threaded, and die with their parent even when that is killed outright. Each has a pipe of its own: one
that dies takes its own call with it and nobody else's.
"""

import logging
import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from enum import StrEnum
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for_any
from typing import Any, NamedTuple, ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

log = logging.getLogger("worker.compute.pools")

HEARTBEAT_S = 5.0
LEAVING_S = 2.0
"""How long processes may take to leave by themselves when all is closed."""
_LOOK_S = 0.5
_PARENT_CHECK_S = 1.0


_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(["worker.compute.fork_server"])


class Lane(StrEnum):
    """Which processes do the work."""

    CLIPS = "clips"
    REWARDS = "rewards"
    """Seconds each, one at a time: somebody is answering, and the next pairs are chosen by the newest model."""
    LEARNING = "learning"
    """Filters, their refinements, which make room for whoever waits, and reports."""
    PATIENT = "patient"
    """Trainings of many minutes, one core each, and only with what the others leave."""
    EXPERIMENTS = "experiments"
    """What no study waits for."""


_NICENESS = {Lane.CLIPS: 5, Lane.REWARDS: 5, Lane.LEARNING: 5, Lane.PATIENT: 15, Lane.EXPERIMENTS: 19}


class Computing(Protocol):
    """What runs functions in compute processes: Compute itself, or a job's turn in it (worker.jobs.runtime.lanes)."""

    def run(
        self, lane: Lane, beat: Callable[[], None], function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Call a top-level function in a process of the lane."""
        ...

    def run_all(
        self, lane: Lane, beat: Callable[[], None], function: Callable[..., R], arguments: list[tuple[Any, ...]]
    ) -> list[R]:
        """Call the function once per tuple of arguments."""
        ...

    def is_needed_elsewhere(self, lane: Lane) -> bool:
        """Whether somebody more urgent waits for the lane."""
        ...


class ComputeLost(RuntimeError):
    """A compute process died in the middle of its work, most often because the machine ran out of memory."""

    def __init__(self) -> None:
        super().__init__(" ".join((type(self).__doc__ or "").split()))


class Interrupted(BaseException):
    """The worker is stopping. No Exception: the engine must not record it as an outcome, but resume the work later."""


class _Outcome(NamedTuple):
    value: Any
    error: BaseException | None


class Compute:
    """Some processes per lane, each started when first needed and again after it has died."""

    def __init__(self, processes: int, closing: threading.Event | None = None) -> None:
        """``closing``: when this is set, nothing more is begun, and whoever waits is Interrupted."""
        self._sizes = {**dict.fromkeys(Lane, processes), Lane.REWARDS: 1}
        self._lanes: dict[Lane, ThreadPoolExecutor] = {}
        self._seats: list[_Seat] = []
        self._mine = threading.local()
        """``seat``: the process that this thread of a lane speaks for"""
        self._changing = threading.Lock()
        self._closing = closing or threading.Event()

    def size(self, lane: Lane) -> int:
        """How many processes the lane has."""
        return self._sizes[lane]

    def is_needed_elsewhere(self, lane: Lane) -> bool:
        """Never: a lane takes its tasks as they come. Whoever is to give way goes by worker.jobs.runtime.lanes."""
        return False

    def warm_up(self, lane: Lane, function: Callable[[], object]) -> None:
        """Have every process of a lane make what it will need, without waiting for it."""
        for _ in range(self._sizes[lane]):
            self._submit(lane, function)

    def run(
        self, lane: Lane, beat: Callable[[], None], function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Call a top-level function in a process of the lane; ``beat`` is called every few seconds meanwhile.

        Raises what the function raises, and ComputeLost when its process was killed.
        """
        return self._await(beat, [self._submit(lane, function, *args, **kwargs)])[0]

    def run_all(
        self, lane: Lane, beat: Callable[[], None], function: Callable[..., R], arguments: list[tuple[Any, ...]]
    ) -> list[R]:
        """Call the function once per tuple of arguments, spread over the lane; results in the order of the tuples."""
        return self._await(beat, [self._submit(lane, function, *each) for each in arguments])

    def _submit(self, lane: Lane, function: Callable[..., R], *args: Any, **kwargs: Any) -> "Future[R]":
        with self._changing:  # several jobs may be the first of their lane at once
            if self._closing.is_set():
                raise Interrupted
            if lane not in self._lanes:
                self._lanes[lane] = ThreadPoolExecutor(
                    self._sizes[lane], f"compute-{lane}", initializer=self._take_seat, initargs=(_NICENESS[lane],)
                )
            return self._lanes[lane].submit(self._call, function, args, kwargs)

    def _take_seat(self, niceness: int) -> None:
        self._mine.seat = _Seat(niceness, self._changing, self._closing)
        self._seats.append(self._mine.seat)

    def _call(self, function: Callable[..., R], args: tuple[Any, ...], kwargs: dict[str, Any]) -> R:
        result: R = self._mine.seat.call(function, args, kwargs)
        return result

    def _await(self, beat: Callable[[], None], futures: "list[Future[R]]") -> list[R]:
        pending, beaten_at = set(futures), float("-inf")
        try:
            while pending:
                if self._closing.is_set():  # what was cancelled then would never be done
                    raise Interrupted
                if time.monotonic() - beaten_at >= HEARTBEAT_S:
                    beat()
                    beaten_at = time.monotonic()
                done, pending = wait(pending, timeout=_LOOK_S)
                for future in done:
                    future.result()  # whoever has failed need not wait for the others
            return [future.result() for future in futures]
        finally:
            for future in pending:
                future.cancel()

    def close(self) -> None:
        """Stop every process; whoever waits for work in hand is Interrupted, and the next worker will do it again."""
        with self._changing:
            self._closing.set()
            lanes, seats = list(self._lanes.values()), list(self._seats)
        for lane in lanes:
            lane.shutdown(wait=False, cancel_futures=True)
        for seat in seats:
            seat.leave()
        deadline = time.monotonic() + LEAVING_S
        for seat in seats:
            seat.end(max(0.0, deadline - time.monotonic()))

    def kill(self) -> None:
        """End every process at once, without waiting for anything."""
        for seat in self._seats:
            seat.end(0.0)


class _Seat:
    """One process that does one call at a time. Only one thread calls; any may make it leave."""

    def __init__(self, niceness: int, changing: threading.Lock, closing: threading.Event) -> None:
        self._niceness = niceness
        self._changing, self._closing = changing, closing
        self._busy = threading.Event()
        self._pipe: Connection | None = None
        self._process: multiprocessing.process.BaseProcess | None = None

    def call(self, function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """What the function returns in the process. Raises what it raises, or ComputeLost."""
        request = pickle.dumps((function, args, kwargs))
        self._busy.set()
        try:
            outcome = self._ask(request)
        except (EOFError, OSError) as broken:  # it died, or there was no memory to start it
            if self._closing.is_set():
                raise Interrupted from broken
            self.end(0.0)
            self._process = None
            raise ComputeLost from broken
        finally:
            self._busy.clear()
        if outcome.error is not None:
            raise outcome.error
        return outcome.value

    def _ask(self, request: bytes) -> _Outcome:
        process, pipe = self._at_work()
        pipe.send_bytes(request)
        # Its end is watched as well: a process of its own that it left behind could hold the pipe open.
        if pipe not in wait_for_any([pipe, process.sentinel]) and not pipe.poll():
            raise EOFError
        outcome: _Outcome = pickle.loads(pipe.recv_bytes())  # noqa: S301  (from our own child)
        return outcome

    def _at_work(self) -> tuple[multiprocessing.process.BaseProcess, Connection]:
        if self._process is None or self._pipe is None or not self._process.is_alive():
            if self._closing.is_set():
                raise EOFError
            ours, theirs = _FORKS.Pipe()
            with theirs:
                # A daemon: a program that ends without closing is not kept from it by a process that waits.
                process = _FORKS.Process(target=_serve, args=(theirs, self._niceness), daemon=True)
                process.start()  # waits for seconds while the server that forks is new
            with self._changing:
                self._process, self._pipe = process, ours
                if self._closing.is_set():  # all have been told to leave meanwhile
                    process.kill()
                    raise EOFError
        return self._process, self._pipe

    def leave(self) -> None:
        """Idle processes leave by themselves: killed ones could not give back what they share with their parent."""
        process, pipe = self._process, self._pipe
        if process is None or pipe is None:
            return
        if self._busy.is_set():
            process.kill()
        else:
            pipe.close()

    def end(self, patience_s: float) -> None:
        """Wait for the process to leave, and no longer than this; SIGKILL ends stopped ones as well."""
        if self._process is not None and not wait_for_any([self._process.sentinel], patience_s):
            self._process.kill()


def _serve(pipe: Connection, niceness: int) -> None:
    """The life of a compute process: one call after the other until nobody asks any more."""
    _settle_in(niceness)
    while True:
        try:
            request = pipe.recv_bytes()
        except EOFError:
            return
        pipe.send_bytes(_answer(request))


def _answer(request: bytes) -> bytes:
    try:
        function, args, kwargs = pickle.loads(request)  # noqa: S301  (from our own parent)
        return pickle.dumps(_Outcome(function(*args, **kwargs), None))
    except BaseException as error:
        error.add_note("In a compute process:\n" + traceback.format_exc())
        return _as_bytes(error)


def _as_bytes(error: BaseException) -> bytes:
    outcome = _Outcome(None, error)
    try:
        pickle.loads(pickle.dumps(outcome))  # noqa: S301  (some errors can be written down and not read)
    except Exception:  # an error of any library, whose pickling may raise anything
        told = RuntimeError(f"{type(error).__name__}: {error}")
        told.add_note(traceback.format_exc())
        outcome = _Outcome(None, told)
    return pickle.dumps(outcome)


def _settle_in(niceness: int) -> None:
    """Run once in each new process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
    threading.Thread(target=_leave_with, args=(os.getppid(),), daemon=True).start()
    os.nice(niceness)


def _leave_with(fork_server: int) -> None:
    """End this process when the server that forked it is gone, which goes with the worker, even one that was killed."""
    while os.getppid() == fork_server:
        threading.Event().wait(_PARENT_CHECK_S)
    os._exit(1)
