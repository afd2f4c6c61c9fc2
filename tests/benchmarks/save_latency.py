"""Prints how long saving an answer and getting the next pair takes, how fast the web server starts, and its memory.

python -m tests.benchmarks.save_latency 200 1 8
python -m tests.benchmarks.save_latency 200 8 --postgresql --servers 2
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import cycle
from pathlib import Path
from statistics import quantiles
from uuid import uuid4

import httpx2

from app.__main__ import migrate
from app.db import Database
from app.programs import end_with_parent
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories, on_postgresql
from tests.waiting import PATIENCE_S, free_port


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("answers", type=int, nargs="?", default=200, help="of each client")
    parser.add_argument("clients", type=int, nargs="*", default=[1, 8], help="numbers of them, one after the other")
    parser.add_argument("--servers", type=int, default=1, help="web servers on one database")
    parser.add_argument("--postgresql", action="store_true", help="on a PostgreSQL server that syncs every commit")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory, ExitStack() as stack:
        url = None
        if options.postgresql:
            programs = on_postgresql.find_programs()
            if programs is None:
                parser.error("PostgreSQL is not installed.")
            url = stack.enter_context(on_postgresql.serving(programs, {"max_connections": "300"}))
        settings = Settings(_env_file=None, data_dir=Path(directory), database_url=url, port=free_port())
        migrate(settings)
        _measure(settings, options.servers, options.clients, options.answers)


def _measure(settings: Settings, server_count: int, clients_of_runs: Sequence[int], answers: int) -> None:
    tokens = _participants(settings, sum(clients_of_runs), answers)
    started = time.perf_counter()
    ports = [settings.port, *(free_port() for _ in range(server_count - 1))]
    servers = [_start(settings, port) for port in ports]
    addresses = [f"http://127.0.0.1:{port}" for port in ports]
    try:
        for address in addresses:
            _await_health(address)
        _say(f"first answer of every web server after {time.perf_counter() - started:.2f} s")
        _say(f"memory after the start  {_rss_mb(servers[0].pid):.0f} MB")
        for clients in clients_of_runs:
            mine = [tokens.pop() for _ in range(clients)]
            before_s = [_processor_s(server.pid) for server in servers]
            times, wall_s = _race(addresses, mine, answers)
            used_s = sum(_processor_s(server.pid) for server in servers) - sum(before_s)
            cuts = quantiles(times, n=100)
            _say(
                f"{clients} client(s): save and next p50 {cuts[49]:.1f} ms, p95 {cuts[94]:.1f} ms, "
                f"p99 {cuts[98]:.1f} ms, {len(times) / wall_s:.0f} answers per second, "
                f"{1000 * used_s / len(times):.1f} ms of a web server's processor each"
            )
        _say(f"memory afterwards       {_rss_mb(servers[0].pid):.0f} MB")
    finally:
        for server in servers:
            server.terminate()
            server.wait()


def _start(settings: Settings, port: int) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "uvicorn", "app.main:create_app", "--factory", "--no-access-log"),
            *("--log-level", "warning", "--port", str(port)),
        ],
        env={**os.environ, "DATA_DIR": str(settings.data_dir), "DATABASE_URL": settings.sqlalchemy_url},
        preexec_fn=end_with_parent,
    )


def _participants(settings: Settings, count: int, answers: int) -> list[str]:
    database, store = Database(settings.sqlalchemy_url), ArtefactStore.of(settings)
    with database.writing() as session:
        study = factories.make_study(
            session, labels_per_participant=max(10, answers), pool_scenarios=500, break_every=0
        )
        clips = [factories.make_clip(session, store, study) for _ in range(20)]
        tokens = []
        for _ in range(count):
            participant, token = factories.make_participant(session, study)
            tokens.append(token)
            for number in range(answers):
                factories.make_query(session, participant, clips[number % 20], clips[(number + 1) % 20])
    database.dispose()
    return tokens


def _race(addresses: Sequence[str], tokens: list[str], answers: int) -> tuple[list[float], float]:
    """The time of every answer in milliseconds, and of all together in seconds."""
    together = threading.Barrier(len(tokens))
    with ThreadPoolExecutor(len(tokens)) as pool:
        started = time.perf_counter()
        places = zip(cycle(addresses), tokens, strict=False)
        times = list(pool.map(lambda place: _label(place[0], place[1], answers, together), places))
        return [each for theirs in times for each in theirs], time.perf_counter() - started


def _label(base_url: str, token: str, answers: int, together: threading.Barrier) -> list[float]:
    times = []
    headers = {"Accept": "application/json"}
    with httpx2.Client(base_url=base_url, headers=headers, timeout=PATIENCE_S) as browser:
        browser.get(f"/p/{token}")
        pair = browser.get("/p/next").json()["pair"]
        together.wait()
        for _ in range(answers - 1):
            form = {"response": "left", "client_uuid": str(uuid4()), "response_time_ms": "4000"}
            started = time.perf_counter()
            answer = browser.post(pair["label_path"], data=form)
            times.append(1000 * (time.perf_counter() - started))
            pair = answer.raise_for_status().json()["pair"]
    return times


def _await_health(base_url: str) -> None:
    for _ in range(int(50 * PATIENCE_S)):
        try:
            httpx2.get(f"{base_url}/health/live").raise_for_status()
        except httpx2.TransportError:
            time.sleep(0.02)
        else:
            return
    raise TimeoutError("The web server does not answer.")


def _processor_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _rss_mb(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
