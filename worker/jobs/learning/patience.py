"""Trainings of many minutes: they make room for whoever waits, and go on from their checkpoint, after a kill, too."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from worker.compute.pools import Lane
from worker.jobs.runtime.context import WorkerContext
from worker.ml.policies.checkpoint import ask_to_pause, share_done

Part = TypeVar("Part")


def train(
    context: WorkerContext,
    folder: Path,
    lane: Lane,
    report: Callable[[float], None],
    is_outdated: Callable[[], bool],
    is_whole: Callable[[Part], bool],
    part: Callable[[Path], Part],
) -> list[Part]:
    """All parts of a training, the last one whole; none when nobody needs it any more.

    ``folder``: of its checkpoint, which stays for whoever goes on from there.
    ``report``: told which share is done; ``part``: called in a compute process, trains until it is done or asked to
    pause.
    """
    if is_outdated():
        return []
    folder.mkdir(parents=True, exist_ok=True)
    context.store.unfinished.bring(folder)

    def beat() -> None:
        report(share_done(folder))
        context.keep_unfinished(folder)
        if context.compute.is_needed_elsewhere(lane) or is_outdated():
            ask_to_pause(folder)

    parts: list[Part] = []
    while not is_outdated():
        parts.append(context.compute.run(lane, beat, part, folder))
        if is_whole(parts[-1]):
            return parts
    return []
