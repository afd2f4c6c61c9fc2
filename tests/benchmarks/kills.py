"""Kills web server, workers and compute processes at random moments while people answer, and counts what was lost.

    python -m tests.benchmarks.kills --servers 100 --workers 200 --directory build/kills

A real studio on SQLite with two workers. Most participants answer as long as kills go on; some give all their labels at
once, so that filters and bundles are made meanwhile. Afterwards everything is left alone until nothing is due, and
looked at. Then a worker is killed that never comes back, and one person's work kills its process again and again.
Ctrl-C ends the killing early and goes on with looking; the same command on the same directory goes on killing.
"""

import argparse
import io
import json
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session
from tqdm import tqdm

from app.db import Database, now
from app.domain.clips import Rollout
from app.domain.models import Run, RunKind, RunStatus, WorkerPresence
from app.domain.studies import Study
from app.services.runs import publishing
from app.storage import ArtefactStore
from tests import factories
from tests.answering import Labeller
from tests.benchmarks.kills_seen import Findings, Onlooker
from tests.processes import compute_processes
from tests.waiting import free_port
from tests.worker.conftest import STEPS, make_trajectory
from worker.domain import scenarios
from worker.jobs import reconcile
from worker.jobs.runtime.records import ATTEMPTS
from worker.rehearsal.server import OwnStudio, wait_until

PATIENCE_S = 1800.0
WORKERS = ("worker", "second")
COMPUTE_SHARE = 2 / 3
"""of the kills of workers and compute processes that hit a compute process"""
PAUSE_S = 0.3
"""between two answers of one participant"""
SETTINGS: dict[str, Any] = {
    "labels_per_participant": 10,
    "retrain_every_labels": 5,
    "evaluation_scenarios": 10,
    "harm_share": 0.5,
    "evaluation": None,
    "break_every": 0,
    "practice_pairs": 0,
    "introduction_pairs": 0,
    "behaviours_per_scenario": 8,
    "clip_steps": STEPS,
}
LONG: dict[str, Any] = {"labels_per_participant": 400, "pool_scenarios": 15}
"""More than anybody gives while kills go on."""
TO_FILM = 1
"""Scenarios of the smaller study that are left to be filmed meanwhile."""


@dataclass
class Progress:
    """What is kept between two starts of the benchmark."""

    tokens: list[str] = field(default_factory=list)
    """of those who answer as long as kills go on"""
    brief: list[str] = field(default_factory=list)
    """of those with few labels who have not given them yet"""
    servers: int = 0
    workers: int = 0
    compute: int = 0
    acknowledged: list[str] = field(default_factory=list)
    seconds: float = 0.0


def main() -> int:
    """Kill, wait, look, and print what was found; 1 when something was lost."""
    options = _options()
    with ExitStack() as stack:
        directory = options.directory or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kills-")))
        os.environ["COMPUTE_PROCESSES"] = "1"
        campaign = Campaign(directory, options)
        stack.callback(campaign.database.dispose)
        stack.enter_context(campaign.studio)
        campaign.studio.start_worker(WORKERS[1])
        campaign.kill()
        campaign.settle()
        _tell(campaign, campaign.onlooker.look_back(campaign.acknowledged), [], "-")
        taken_over = [campaign.kill_for_good() for _ in range(options.takeovers)]
        poison = campaign.poison() if options.poison else "-"
        campaign.settle()
        findings = campaign.onlooker.look_back(campaign.acknowledged)
        _tell(campaign, findings, taken_over, poison)
    return 0 if findings.nothing_is_wrong else 1


class Campaign:
    """One studio, those who answer in it, and those who kill its programs."""

    def __init__(self, directory: Path, options: argparse.Namespace) -> None:
        self.options = options
        self.random = random.Random(options.seed)  # noqa: S311  (no secret)
        self.studio = OwnStudio(directory, free_port())
        self.database = Database(self.studio.settings.sqlalchemy_url)
        self.store = ArtefactStore.of(self.studio.settings)
        self.kept = directory / "kills.json"
        self.progress = Progress(**json.loads(self.kept.read_text())) if self.kept.exists() else Progress()
        self.acknowledged = Counter(self.progress.acknowledged)
        self.onlooker = Onlooker(self.database, self.store)
        self.parked: list[str] = []
        """work that was given up because its processes were killed once too often, and asked for again"""
        self.worker = WORKERS[0]
        self._answers, self._over = threading.Semaphore(0), threading.Event()

    def kill(self) -> None:
        """Until enough was killed, or somebody presses Ctrl-C."""
        brief = [] if self.progress.tokens else self._invite()
        labellers = [self._labeller(token, PAUSE_S) for token in (*self.progress.tokens, *brief)]
        for _ in labellers:
            self._answers.acquire(timeout=PATIENCE_S)
        self.onlooker.start()
        began = time.monotonic()
        killers = [threading.Thread(target=each) for each in (self._kill_servers, self._kill_workers)]
        for killer in killers:
            killer.start()
        try:
            for killer in killers:
                killer.join()
        except KeyboardInterrupt:
            _say("Interrupted: no more kills.")
            self._over.set()
            for killer in killers:
                killer.join()
        self.progress.seconds += time.monotonic() - began
        for labeller in labellers:
            labeller.enough.set()
        for labeller in labellers:
            labeller.join()
        self._keep()

    def settle(self) -> None:
        """Leave everything alone until nothing is due; what is parked is asked for again, as an experimenter would."""
        began = time.monotonic()
        wait_until(PATIENCE_S, "still work to do", self._is_settled)
        _say(f"settled after {time.monotonic() - began:.0f} s")

    def kill_for_good(self) -> float:
        """Kill a worker in the middle of a filter; seconds until another one, which was there, goes on with it."""
        other = f"worker-{time.monotonic_ns()}"
        for name in set(self.studio.running()) - {"web", self.worker}:
            self.studio.kill(name)
        self._answer_all()
        run = wait_until(PATIENCE_S, "no filter at work", lambda: self._at_work(RunKind.FILTER))
        self.studio.start_worker(other)
        wait_until(PATIENCE_S, "no other worker", lambda: self._is_present(other))
        time.sleep(self.random.uniform(0, 5))  # kills are to come at random moments
        self.studio.kill(self.worker)
        killed, last = time.monotonic(), self._row(run).heartbeat_at
        wait_until(PATIENCE_S, "nobody takes it over", lambda: self._row(run).heartbeat_at != last or None)
        self.worker = other
        return time.monotonic() - killed

    def poison(self) -> str:
        """Kill the processes at somebody's reward model until it is given up; what is then said of it."""
        self._answer_all()

        def given_up() -> Run | None:
            run = self._newest_of(RunKind.REWARD)
            if run.status == RunStatus.RUNNING:
                self._kill_compute()
            return run if run.status == RunStatus.FAILED and run.attempt > ATTEMPTS else None

        run = wait_until(PATIENCE_S, "no parked run", given_up)
        time.sleep(40)  # longer than the pauses between attempts: what is parked is not begun again
        later = self._row(run.id)
        if (later.status, later.attempt) != (run.status, run.attempt):
            return f"NOT parked but {later.status}, attempt {later.attempt}"
        return f"after {ATTEMPTS} attempts: {run.error}"

    def _invite(self) -> list[str]:
        """Make studies; the links of those who give few labels now."""
        with self.database.writing() as session:
            study = factories.make_study(session, **{**SETTINGS, **LONG})
            _make_clips(session, self.store, study, study.settings.pool_scenarios)
            self.progress.tokens = [factories.make_participant(session, study)[1] for _ in range(self.options.people)]
            brief = factories.make_study(session, "Brief", **SETTINGS)
            _make_clips(session, self.store, brief, brief.settings.pool_scenarios - TO_FILM)
            count = self.options.finishing + self.options.takeovers + self.options.poison
            people = [factories.make_participant(session, brief)[1] for _ in range(count)]
        self.progress.brief = people[self.options.finishing :]
        self._keep()
        return people[: self.options.finishing]

    def _labeller(self, token: str, pause_s: float) -> Labeller:
        labeller = Labeller(self.studio.settings.base_url, token, self.acknowledged, self._answers, pause_s)
        labeller.start()
        return labeller

    def _answer_all(self) -> None:
        """The next of those with few labels gives all of them."""
        self._labeller(self.progress.brief.pop(0), 0.0).join()

    def _kill_servers(self) -> None:
        rng = random.Random(self.options.seed + 1)  # noqa: S311  (no secret)
        with tqdm(total=self.options.servers, initial=self.progress.servers, desc="servers", mininterval=10) as bar:
            while self.progress.servers < self.options.servers and not self._over.wait(rng.uniform(0.1, 2.5)):
                self.studio.kill("web")
                self.progress.servers += 1
                bar.update()
                self.studio.start_web()
                self._keep()

    def _kill_workers(self) -> None:
        rng = random.Random(self.options.seed + 2)  # noqa: S311  (no secret)
        total, since = self.progress.workers + self.progress.compute, dict[str, datetime]()
        with tqdm(total=self.options.workers, initial=total, desc="workers", mininterval=10) as bar:
            while total < self.options.workers and not self._over.wait(rng.uniform(0.2, self.options.gap)):
                if rng.random() < COMPUTE_SHARE:
                    killed = self._kill_compute(rng)
                    self.progress.compute += killed
                else:
                    name, killed = rng.choice(WORKERS), 0
                    if self._is_present(name, since.get(name)):  # whoever is killed while starting does nothing
                        self.studio.kill(name)
                        since[name], killed = now(), 1
                        self.studio.start_worker(name)
                        self.progress.workers += 1
                total += killed
                bar.update(killed)

    def _kill_compute(self, rng: random.Random | None = None) -> int:
        """One process at random, or all; how many."""
        found = list[int]()
        for name in set(self.studio.running()) - {"web"}:
            with suppress(OSError):  # it went while we looked
                found += compute_processes(self.studio.process_id(name))
        chosen = [rng.choice(sorted(found))] if rng is not None and found else found
        for pid in chosen:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return len(chosen)

    def _is_settled(self) -> bool | None:
        with self.database.writing() as session:
            parked = session.scalars(select(Run).where(Run.status == RunStatus.FAILED, Run.attempt > ATTEMPTS)).all()
            for run in parked:
                self.parked.append(f"{run.workflow_id}: {run.error}")
                publishing.retry_run(session, session.get_one(Study, run.study_id), run.id, "the benchmark")
            busy = session.scalar(select(Run.id).where(Run.status.in_((RunStatus.RUNNING, RunStatus.RETRY))).limit(1))
            is_due = any(True for _ in reconcile.due(session))
            return None if busy or parked or is_due else True

    def _at_work(self, kind: RunKind) -> int | None:
        with self.database.reading() as session:
            return session.scalar(select(Run.id).where(Run.kind == kind, Run.status == RunStatus.RUNNING))

    def _is_present(self, worker: str, since: datetime | None = None) -> bool | None:
        """Whether the worker has given a sign of life since it was started."""
        with self.database.reading() as session:
            known = session.get(WorkerPresence, worker)
        return (known is not None and (since is None or known.last_seen_at > since)) or None

    def _newest_of(self, kind: RunKind) -> Run:
        with self.database.reading() as session:
            return session.scalars(select(Run).where(Run.kind == kind).order_by(Run.id.desc()).limit(1)).one()

    def _row(self, run_id: int) -> Run:
        with self.database.reading() as session:
            return session.get_one(Run, run_id)

    def _keep(self) -> None:
        self.progress.acknowledged = list(self.acknowledged)
        self.kept.write_text(json.dumps(asdict(self.progress)))


def _make_clips(session: Session, store: ArtefactStore, study: Study, scenarios_count: int) -> None:
    """The first scenarios of a pool, with recordings of random numbers: filming so many takes longer than killing."""
    for index in range(scenarios_count):
        scenario = scenarios.of_pool(study.seed, index)
        for behaviour in range(study.settings.behaviours_per_scenario):
            clip, recording = factories.make_clip(session, store, study), io.BytesIO()
            make_trajectory(scenario, behaviour, STEPS).save(recording)
            rollout = session.get_one(Rollout, clip.rollout_id)
            rollout.scenario, rollout.behaviour = scenario, behaviour
            rollout.trajectory_sha256, clip.step_count = store.put(recording.getvalue()), STEPS


def _tell(campaign: Campaign, findings: Findings, taken_over: Sequence[float], poison: str) -> None:
    done = campaign.progress
    rows: dict[str, object] = {
        "kills of the server": done.servers,
        "kills of workers": done.workers,
        "kills of compute processes": done.compute,
        "seconds of killing": round(done.seconds),
        "answers acknowledged": findings.answers,
        "of those lost": findings.lost,
        "of those doubled": findings.doubled,
        "people": findings.people,
        "models or bundles that are not fresh": findings.stale or 0,
        "runs": ", ".join(f"{count} {what}" for what, count in sorted(findings.runs.items())),
        "runs of one person and kind that overlap": findings.overlaps or 0,
        "stored files": findings.files,
        "of those not whole, then or now": findings.broken or 0,
        "bundles": findings.bundles,
        "given up under the kills and asked for again": len(campaign.parked),
        "taken over after, in seconds": ", ".join(f"{seconds:.0f}" for seconds in taken_over) or "-",
        "work that kills its process, parked": poison,
    }
    for name, value in rows.items():
        _say(f"| {name} | {value} |")
    for line in campaign.parked:
        _say(f"given up: {line}")


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--servers", type=int, default=100, help="kills of the web server")
    parser.add_argument("--workers", type=int, default=200, help="kills of workers and compute processes")
    parser.add_argument("--gap", type=float, default=4.0, help="longest time between two of the latter, in seconds")
    parser.add_argument("--people", type=int, default=6, help="who answer all the time")
    parser.add_argument("--finishing", type=int, default=2, help="who give few labels, so that filters are made")
    parser.add_argument("--takeovers", type=int, default=2, help="workers that never come back")
    parser.add_argument("--poison", type=int, default=1, choices=(0, 1), help="whether work kills its process")
    parser.add_argument("--seed", type=int, default=0, help="of the moments and of what is hit")
    parser.add_argument("--directory", type=Path, help="of the studio; one that is there is gone on with")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
