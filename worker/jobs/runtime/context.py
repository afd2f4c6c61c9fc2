"""What every kind of work needs: the database, the artefacts, the processes, and a way to say how far it is."""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from sqlalchemy.exc import OperationalError

from app.db import Database
from app.files.interface import StorageUnavailable
from app.signing import SigningKey
from app.storage import ArtefactStore, hash_of_file
from worker.analysis.filters.promise import Outcome
from worker.compute.pools import Computing
from worker.domain.trajectory import Trajectory
from worker.jobs.runtime import records


class Step(Protocol):
    """Runs a function as a durable step: once it has returned, it is never run again for the same workflow.

    Its result is stored by the engine, so it is None, a string, a number, or a plain structure of them.
    """

    def __call__(self, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """The function's result, now or from an earlier life of this workflow."""
        ...


class NotingStore(ArtefactStore):
    """Remembers what is put away, so that it can be erased although nothing refers to it (yet)."""

    def __init__(self, store: ArtefactStore, noted: set[str]) -> None:
        super().__init__(store.root, store.files)
        self._noted = noted

    def put(self, content: bytes) -> str:
        """Store the bytes and return their hash, noted before the first of them is written."""
        self._noted.add(hashlib.sha256(content).hexdigest())
        return super().put(content)

    def take(self, path: Path) -> str:
        """Move the file into the store, noted before it is there."""
        self._noted.add(hash_of_file(path))
        return super().take(path)


@dataclass(frozen=True)
class WorkerContext:
    """One worker's means."""

    database: Database
    store: ArtefactStore
    compute: Computing
    key: SigningKey | None = None
    """signs bundles and archives; None: they stay unsigned"""
    references: dict[tuple[str, range], list[Trajectory]] = field(default_factory=dict)
    """rollouts of the frozen policy by scenarios: the same for everybody, so each worker makes them once"""
    outcomes: dict[tuple[str, int], list[Outcome]] = field(default_factory=dict)
    """what could harm in the frozen policy's rollouts for the promise, by task and first scenario"""

    def noting(self, noted: set[str]) -> "WorkerContext":
        """The same context, remembering the artefacts that are stored through it."""
        return replace(self, store=NotingStore(self.store, noted))

    def computing(self, compute: Computing) -> "WorkerContext":
        """The same context with another way to the compute processes."""
        return replace(self, compute=compute)

    def report(self, run_id: int, stage: str, progress: float) -> None:
        """Say in a few words, and as a share between 0 and 1, where a run is."""
        with self.database.writing() as session:
            records.report(session, run_id, stage, progress)

    def keep_unfinished(self, folder: Path) -> None:
        """Let other machines go on with a training from here. Its own machine does so whether they can or not."""
        with suppress(StorageUnavailable, FileNotFoundError):
            self.store.unfinished.keep(folder)

    def beat(self, run_id: int) -> Callable[[], None]:
        """A function that says that the run is still being worked on."""

        def beat() -> None:
            # Hours of computing shall not be lost for a sign of life: whoever saves a result will say what is wrong.
            with suppress(OperationalError), self.database.writing() as session:
                records.beat(session, run_id)

        return beat
