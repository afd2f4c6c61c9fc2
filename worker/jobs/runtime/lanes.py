"""The way into the compute processes: each lane takes the tasks of whoever waits before those of others.

A job's tasks go in one by one, so work that began earlier gives way within one task (a few rollouts, a film); trainings
of many minutes ask is_needed_elsewhere() and pause at a checkpoint. Lanes share the processors: while work that
somebody waits for is in any lane but the patient one, no lane takes tasks that nobody is here for. Clips of a study
without participants leave a processor to what is learned for somebody.
"""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ParamSpec, TypeVar

from worker.compute.pools import HEARTBEAT_S, Compute, Lane
from worker.jobs.runtime.records import Job
from worker.jobs.runtime.urgency import Gate, Level, Urgency, WhoWaits

P = ParamSpec("P")
R = TypeVar("R")

AHEAD = 1
"""Tasks in a lane beside those at work, so that no process waits for its next."""
LINGER_S = 5.0
"""So long after work that somebody waits for its lane stays theirs: what they need next comes a few seconds later."""


@dataclass
class Lanes:
    """The gates of one worker's lanes, and who waits, as it was last seen."""

    compute: Compute
    who_waits: WhoWaits = field(default_factory=WhoWaits)

    def __post_init__(self) -> None:
        self._in_hand: list[tuple[Lane, Job]] = []
        self._lately: dict[tuple[Lane, Job], float] = {}
        """until when work that is done counts as if it were in hand"""
        self._gates = {
            lane: Gate(
                self.compute.size(lane) + (AHEAD if lane != Lane.PATIENT else 0), partial(self._holds_back, lane)
            )
            for lane in Lane
        }

    def of(self, job: Job) -> "LanesOfJob":
        """The compute processes as this job may use them."""
        return LanesOfJob(self, job)

    @contextmanager
    def working(self, lane: Lane, job: Job) -> Iterator[None]:
        """Meanwhile the job has tasks for the lane."""
        self._in_hand.append((lane, job))
        try:
            yield
        finally:
            moment = time.monotonic()
            still = {each: until for each, until in self._lately.items() if until > moment}
            self._lately = still | {(lane, job): moment + LINGER_S}
            self._in_hand.remove((lane, job))

    def _holds_back(self, lane: Lane, level: Level) -> bool:
        """In a lane whose work somebody waits for, everything else; in the others, what nobody is here for."""
        lately = [each for each, until in self._lately.items() if until > time.monotonic()]
        awaited = {
            where
            for where, job in (*tuple(self._in_hand), *lately)
            if where != Lane.PATIENT and self._level(job) == Level.WAITING
        }
        if (level > Level.WAITING and lane in awaited) or (level > Level.ASKED and awaited):
            return True
        return level >= Level.UNOPENED and self._takes_all_processors(lane)

    def _takes_all_processors(self, lane: Lane) -> bool:
        """Whether one task more in the lane would leave none to what is learned for somebody."""
        is_learned = any(
            where in (Lane.LEARNING, Lane.PATIENT) and self._level(job) < Level.UNOPENED
            for where, job in tuple(self._in_hand)
        )
        return is_learned and self._gates[lane].inside >= max(1, self.compute.size(lane) - 1)

    def _level(self, job: Job) -> Level:
        return self.who_waits.urgency(job).level

    def gate(self, lane: Lane) -> Gate:
        """The way into a lane."""
        return self._gates[lane]


@dataclass(frozen=True)
class LanesOfJob:
    """The compute processes for one job; see worker.compute.pools.Compute for what the methods raise."""

    lanes: Lanes
    job: Job

    def run(
        self, lane: Lane, beat: Callable[[], None], function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """See Compute.run."""
        return self._each(lane, beat, [partial(function, *args, **kwargs)])[0]

    def run_all(
        self, lane: Lane, beat: Callable[[], None], function: Callable[..., R], arguments: list[tuple[Any, ...]]
    ) -> list[R]:
        """See Compute.run_all."""
        return self._each(lane, beat, [partial(function, *each) for each in arguments])

    def is_needed_elsewhere(self, lane: Lane) -> bool:
        """Whether the job should leave its place in the lane to one of a more urgent level."""
        return self.lanes.gate(lane).is_awaited_above(self._urgency().level)

    def _urgency(self) -> Urgency:
        return self.lanes.who_waits.urgency(self.job)

    def _each(self, lane: Lane, beat: Callable[[], None], tasks: "list[partial[R]]") -> list[R]:
        at_once = min(self.lanes.compute.size(lane) + AHEAD, len(tasks)) or 1
        with (
            self.lanes.working(lane, self.job),
            ThreadPoolExecutor(max_workers=at_once, thread_name_prefix=f"turn-{lane}") as threads,
        ):
            futures = [threads.submit(self._in_turn, lane, task) for task in tasks]
            try:
                pending = set(futures)
                while pending:
                    beat()
                    done, pending = wait(pending, timeout=HEARTBEAT_S, return_when=FIRST_EXCEPTION)
                    for each in done:
                        each.result()  # what went wrong in one stops all
                return [future.result() for future in futures]
            finally:
                for future in futures:
                    future.cancel()

    def _in_turn(self, lane: Lane, task: "partial[R]") -> R:
        with self.lanes.gate(lane).passed(self._urgency):
            return self.lanes.compute.run(lane, _no_beat, task)


def _no_beat() -> None:
    """The job's own thread says that it is alive."""
