"""Runs a small study to its bundles through a cluster in miniature, and kills a worker for good on the way.

Three web servers behind a proxy that gives each request to the next of them, and three workers, every one a process
with a data directory of its own; one PostgreSQL server, one S3-compatible server (moto's). All on this machine.

    python -m tests.benchmarks.cluster --labels 12
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import cycle
from pathlib import Path

import httpx2
from sqlalchemy import select, text

from app.db import Database
from app.domain.choices import ClipQuality, Strategy
from app.domain.models import Bundle, Run, RunKind, RunStatus
from app.domain.study_settings import StudySettings
from app.settings import Settings
from app.storage import ArtefactStore
from tests import on_postgresql, on_s3
from tests.waiting import free_port
from worker.experiments.benchmark_cell import PAPER_USERS
from worker.ml.teachers import Manner
from worker.rehearsal.rehearsal import Rehearsal, summary
from worker.rehearsal.server import wait_until

WEB, WORKERS = 3, 3
PATIENCE_S = 3600.0
HOP = {"connection", "transfer-encoding", "content-length", "keep-alive"}


def main() -> int:
    """Print what was simulated and what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labels", type=int, default=12, help="labels of the one participant")
    parser.add_argument("--kill", choices=[kind.value for kind in RunKind], default=RunKind.FILTER.value)
    options = parser.parse_args()
    programs = on_postgresql.find_programs()
    if programs is None:
        sys.stderr.write("This needs PostgreSQL: install your system's package 'postgresql'.\n")
        return 1
    with ExitStack() as stack:
        url = stack.enter_context(on_postgresql.serving(programs))
        bucket = stack.enter_context(on_s3.serving())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cluster-")))
        os.environ.update(bucket)
        cluster = Cluster(folder, url)
        stack.callback(cluster.stop)
        address = cluster.start()
        database = Database(cluster.settings.sqlalchemy_url)
        stack.callback(database.dispose)
        killing = threading.Thread(target=cluster.kill_worker_at, args=(database, RunKind(options.kill)), daemon=True)
        killing.start()
        studied = Rehearsal(database, ArtefactStore.of(cluster.settings), address).run(
            "feeding", list(PAPER_USERS.values())[:1], _settings(options.labels), Manner(), seed=0
        )
        killing.join(timeout=1.0)
        wait_until(PATIENCE_S, "still work to do", partial(_is_idle, database))
        _say(summary(studied))
        cluster.report(database)
    return 0


def _settings(labels: int) -> StudySettings:
    return StudySettings(
        labels_per_participant=labels,
        retrain_every_labels=labels // 2,
        filter_milestones=(),
        pool_scenarios=4,
        evaluation_scenarios=10,
        harm_share=0.5,
        clip_quality=ClipQuality.QUICK,
        strategy=Strategy.UNIFORM,
    )


@dataclass
class Cluster:
    """The processes, and what has become of the one that was killed."""

    folder: Path
    database_url: str
    web_servers: int = WEB
    worker_count: int = WORKERS
    pinned: bool = False
    """each worker has one core, and no two the same"""
    web: list[subprocess.Popen[bytes]] = field(default_factory=list)
    workers: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    served: Counter[int] = field(default_factory=Counter)
    told: list[str] = field(default_factory=list)

    @property
    def settings(self) -> Settings:
        """Of somebody who looks on."""
        url = f"s3://{on_s3.BUCKET}/cluster"
        folder = self.folder / "onlooker"
        return Settings(_env_file=None, data_dir=folder, database_url=self.database_url, storage_url=url)

    def start(self) -> str:
        """Everything, one after the other; returns the proxy's address."""
        subprocess.run([sys.executable, "-m", "app", "migrate"], check=True, env=self._environment("migrate"))
        ports = [free_port() for _ in range(self.web_servers)]
        for number, port in enumerate(ports):
            self.web.append(self._program(f"web-{number}", ["app", "web"], PORT=str(port), TRUSTED_PROXIES="127.0.0.1"))
        for port in ports:
            wait_until(PATIENCE_S, "no web server", partial(_answers, port))
        for number in range(self.worker_count):
            directory, core = f"worker-{number}", ["taskset", "-c", str(number)] if self.pinned else []
            self.workers[directory] = self._program(directory, ["worker", "run"], core, COMPUTE_PROCESSES="1")
            wait_until(PATIENCE_S, "no worker", partial(self._name_of, directory))
        proxy = ThreadingHTTPServer(("127.0.0.1", 0), _proxy_to(ports, self.served))
        threading.Thread(target=proxy.serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{proxy.server_port}"

    def stop(self) -> None:
        """All that are left."""
        for program in (*self.web, *self.workers.values()):
            program.terminate()
        for program in (*self.web, *self.workers.values()):
            with suppress(subprocess.TimeoutExpired):
                program.wait(20)
            program.kill()
            program.wait()

    def kill_worker_at(self, database: Database, kind: RunKind) -> None:
        """Wait until one of the workers is in the middle of such work, kill it, and see when another one goes on."""
        key, name = wait_until(PATIENCE_S, f"no {kind.value} at work", lambda: _at_work(database, kind))
        folder = next(each for each in self.workers if self._name_of(each) == name)
        first = _sign_of_life(database, key)
        wait_until(PATIENCE_S, f"{name} shows no life", lambda: _sign_of_life(database, key) != first or None)
        worker = self.workers.pop(folder)
        worker.kill()
        worker.wait()
        killed_at = time.monotonic()
        last = _sign_of_life(database, key)
        self.told.append(f"killed for good         {name}, in the middle of {key}")
        wait_until(PATIENCE_S, "nobody takes it over", lambda: _goes_on(database, key, last))
        self.told.append(f"taken over after        {time.monotonic() - killed_at:.0f} s")

    def report(self, database: Database) -> None:
        """What each had to do, and what is left where."""
        _say(f"requests by web server  {', '.join(str(self.served[number]) for number in range(self.web_servers))}")
        for line in self.told:
            _say(line)
        with database.reading() as session:
            runs = session.scalars(select(Run.status)).all()
            bundles = session.scalars(select(Bundle.artefact_sha256)).all()
            executors = Counter(session.execute(text("SELECT executor_id FROM dbos.workflow_status")).scalars())
        store = ArtefactStore.of(self.settings)
        _say(f"runs                    {', '.join(f'{count} {status}' for status, count in Counter(runs).items())}")
        _say(f"ended at worker         {', '.join(f'{name}: {count}' for name, count in sorted(executors.items()))}")
        _say(f"bundles                 {len(bundles)}, whole in the bucket: {sum(map(store.has, bundles))}")
        for name in sorted(each.name for each in self.folder.iterdir() if each.is_dir()):
            kept = list((self.folder / name).rglob("*.safetensors"))
            artefacts = list((self.folder / name / "artefacts").rglob("*"))
            _say(f"left in {name:<16}{len(artefacts)} artefacts, {len(kept)} checkpoints")

    def _environment(self, name: str, **more: str) -> dict[str, str]:
        ours = {each: value for each, value in os.environ.items() if each != "WORKER_NAME"}
        key = {"SIGNING_KEY_FILE": str(self.folder / "signing.key")}
        place = {"DATABASE_URL": self.database_url, "STORAGE_URL": f"s3://{on_s3.BUCKET}/cluster"}
        return {**ours, **place, **key, "DATA_DIR": str(self.folder / name), **more}

    def _program(
        self, name: str, module: list[str], before: Sequence[str] = (), **more: str
    ) -> subprocess.Popen[bytes]:
        command = ["setpriv", "--pdeathsig", "KILL", *before, sys.executable, "-m", *module]
        with (self.folder / f"{name}.log").open("wb") as log:
            return subprocess.Popen(command, env=self._environment(name, **more), stdout=log, stderr=log)

    def _name_of(self, folder: str) -> str | None:
        locks = list((self.folder / folder).glob("worker-*.lock"))
        return locks[0].stem if locks else None


def _at_work(database: Database, kind: RunKind) -> tuple[str, str] | None:
    """The key of such a run, and the name of the worker that is at it."""
    with database.reading() as session:
        running = select(Run.workflow_id, Run.attempt).where(Run.kind == kind, Run.status == RunStatus.RUNNING)
        for key, attempt in session.execute(running):
            asked = text("SELECT executor_id FROM dbos.workflow_status WHERE workflow_uuid = :name")
            name = session.scalar(asked, {"name": f"{key}#{attempt}"})
            if name is not None:
                return key, name
    return None


def _sign_of_life(database: Database, key: str) -> datetime | None:
    with database.reading() as session:
        return session.scalars(select(Run.heartbeat_at).where(Run.workflow_id == key)).one()


def _is_idle(database: Database) -> bool | None:
    with database.reading() as session:
        at_work = session.scalar(select(Run.id).where(Run.status == RunStatus.RUNNING).limit(1))
    return at_work is None or None


def _goes_on(database: Database, key: str, last: object) -> bool | None:
    with database.reading() as session:
        beaten = session.scalars(select(Run.heartbeat_at).where(Run.workflow_id == key)).one()
    return beaten != last or None


def _answers(port: int) -> bool | None:
    with suppress(httpx2.TransportError):
        return httpx2.get(f"http://127.0.0.1:{port}/health/live", timeout=20.0).is_success or None
    return None


def _proxy_to(ports: list[int], served: Counter[int]) -> type[BaseHTTPRequestHandler]:
    """Gives every request to the next web server, as a proxy does that knows nothing of sessions."""
    turns, lock = cycle(enumerate(ports)), threading.Lock()
    client = httpx2.Client(timeout=300.0)

    class Proxy(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def forward(self) -> None:
            with lock:
                number, port = next(turns)
                served[number] += 1
            body = self.rfile.read(int(self.headers.get("content-length", 0)))
            headers = [(name, value) for name, value in self.headers.items() if name.lower() not in HOP]
            headers.append(("x-forwarded-for", self.client_address[0]))
            with client.stream(
                self.command, f"http://127.0.0.1:{port}{self.path}", headers=headers, content=body
            ) as answer:
                content = b"".join(answer.iter_raw())
                self.send_response_only(answer.status_code)
                for name, value in answer.headers.multi_items():
                    if name.lower() not in HOP:
                        self.send_header(name, value)
                self.send_header("content-length", str(len(content)))
                self.end_headers()
                self.wfile.write(content)

        do_GET = do_POST = forward  # noqa: N815  (names of the standard library)

    return Proxy


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
