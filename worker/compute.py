"""Processes for heavy work: simulation and training run there, the durable engine only waits for them.

Several lanes, so that a training never stands behind a queue of videos, nobody's pairs wait for a fine-tuning that
takes minutes, and a reward model, whose person is answering, never for somebody else's filter. The processes are polite
(niced), single-threaded, and die with their parent even when that is killed outright.
"""

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from enum import StrEnum
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

log = logging.getLogger("worker.compute")

HEARTBEAT_S = 5.0
_PARENT_CHECK_S = 1.0


class Lane(StrEnum):
    """Which processes do the work."""

    CLIPS = "clips"
    REWARDS = "rewards"
    """Seconds each, one at a time: somebody is answering, and the next pairs are chosen by the newest model."""
    LEARNING = "learning"
    """Filters and reports: a minute or so."""
    PATIENT = "patient"
    """Trainings of many minutes: one at a time on one core, and only with what the others leave."""


_NICENESS = {Lane.CLIPS: 5, Lane.REWARDS: 5, Lane.LEARNING: 5, Lane.PATIENT: 15}


class ComputeLost(RuntimeError):
    """A compute process died in the middle of its work, most often because the machine ran out of memory."""


class Interrupted(BaseException):
    """The worker is stopping. No Exception: the engine must not record it as an outcome, but resume the work later."""


class Compute:
    """Process pools, one per lane, started when first needed and replaced when one of their processes dies."""

    def __init__(self, processes: int) -> None:
        self._sizes = {Lane.CLIPS: processes, Lane.REWARDS: 1, Lane.LEARNING: processes, Lane.PATIENT: 1}
        self._pools: dict[Lane, ProcessPoolExecutor] = {}
        self._starting = threading.Lock()
        self._closing = threading.Event()

    def size(self, lane: Lane) -> int:
        """How many processes the lane has."""
        return self._sizes[lane]

    def is_needed_elsewhere(self, lane: Lane) -> bool:
        """Never: a lane takes its tasks as they come. Whoever is to give way goes by worker.turns."""
        return False

    def warm_up(self, lane: Lane, function: Callable[[], object]) -> None:
        """Have every process of a lane import what it will need, without waiting for it."""
        for _ in range(self._sizes[lane]):
            self._pool(lane).submit(function)

    def run(
        self, lane: Lane, beat: Callable[[], None], function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Call a top-level function in a process of the lane; ``beat`` is called every few seconds meanwhile.

        Raises what the function raises, and ComputeLost when its process was killed.
        """
        return self._await(lane, beat, [self._submit(lane, function, *args, **kwargs)])[0]

    def run_all(
        self, lane: Lane, beat: Callable[[], None], function: Callable[..., R], arguments: list[tuple[Any, ...]]
    ) -> list[R]:
        """Call the function once per tuple of arguments, spread over the lane; results in the order of the tuples."""
        return self._await(lane, beat, [self._submit(lane, function, *each) for each in arguments])

    def _submit(self, lane: Lane, function: Callable[..., R], *args: Any, **kwargs: Any) -> "Future[R]":
        if self._closing.is_set():
            raise Interrupted
        try:
            return self._pool(lane).submit(function, *args, **kwargs)
        except BrokenProcessPool:
            self._discard(lane)
            return self._pool(lane).submit(function, *args, **kwargs)

    def _await(self, lane: Lane, beat: Callable[[], None], futures: "list[Future[R]]") -> list[R]:
        try:
            pending: set[Future[R]] = set(futures)
            while pending:
                beat()
                pending = wait(pending, timeout=HEARTBEAT_S).not_done
            return [future.result() for future in futures]
        except (BrokenProcessPool, CancelledError) as broken:
            if self._closing.is_set():
                raise Interrupted from broken
            self._discard(lane)
            raise ComputeLost(" ".join((ComputeLost.__doc__ or "").split())) from broken

    def _pool(self, lane: Lane) -> ProcessPoolExecutor:
        with self._starting:  # several jobs may be the first of their lane at once
            if lane not in self._pools:
                self._pools[lane] = ProcessPoolExecutor(
                    self._sizes[lane],
                    mp_context=multiprocessing.get_context("spawn"),
                    initializer=_settle_in,
                    initargs=(os.getpid(), _NICENESS[lane]),
                )
            return self._pools[lane]

    def _discard(self, lane: Lane) -> None:
        pool = self._pools.pop(lane, None)
        if pool is not None:
            pool.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """Stop every process; whoever waits for work in hand is Interrupted, and the next worker will do it again."""
        self._closing.set()
        for pool in list(self._pools.values()):
            # Idle processes leave by themselves: terminated ones could not give back what they share with their parent.
            busy = (pool._processes or {}) if pool._pending_work_items else {}
            for process in list(busy.values()):
                process.terminate()
            pool.shutdown(wait=False, cancel_futures=True)
        self._pools.clear()


def _settle_in(parent: int, niceness: int) -> None:
    """Run once in each new process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
    threading.Thread(target=_leave_with, args=(parent,), daemon=True).start()
    os.nice(niceness)
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"


def _leave_with(parent: int) -> None:
    """End this process when its parent is gone (prctl's death signal would follow the thread that started us)."""
    while os.getppid() == parent:
        threading.Event().wait(_PARENT_CHECK_S)
    os._exit(1)
