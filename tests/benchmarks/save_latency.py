"""Prints how long saving an answer and getting the next pair takes, how fast the web server starts, and its memory.

python -m tests.benchmarks.save_latency 200 1 8
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import quantiles
from uuid import uuid4

import httpx2

from app.__main__ import migrate
from app.db import Database
from app.programs import end_with_parent
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.waiting import PATIENCE_S, free_port


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("answers", type=int, nargs="?", default=200, help="of each client")
    parser.add_argument("clients", type=int, nargs="*", default=[1, 8], help="numbers of them, one after the other")
    options = parser.parse_args()
    answers = options.answers
    with tempfile.TemporaryDirectory() as directory:
        settings = Settings(_env_file=None, data_dir=Path(directory), port=free_port())
        migrate(settings)
        tokens = _participants(settings, sum(options.clients), answers)
        started = time.perf_counter()
        server = subprocess.Popen(
            [
                *(sys.executable, "-m", "uvicorn", "app.main:create_app", "--factory", "--no-access-log"),
                *("--log-level", "warning", "--port", str(settings.port)),
            ],
            env={**os.environ, "DATA_DIR": directory},
            preexec_fn=end_with_parent,
        )
        try:
            _await_health(settings.base_url)
            _say(f"first answer of the web server after {time.perf_counter() - started:.2f} s")
            _say(f"memory after the start  {_rss_mb(server.pid):.0f} MB")
            for clients in options.clients:
                mine = [tokens.pop() for _ in range(clients)]
                times, wall_s = _race(settings.base_url, mine, answers)
                cuts = quantiles(times, n=100)
                _say(
                    f"{clients} client(s): save and next p50 {cuts[49]:.1f} ms, p95 {cuts[94]:.1f} ms, "
                    f"p99 {cuts[98]:.1f} ms, {len(times) / wall_s:.0f} answers per second"
                )
            _say(f"memory afterwards       {_rss_mb(server.pid):.0f} MB")
        finally:
            server.terminate()
            server.wait()


def _participants(settings: Settings, count: int, answers: int) -> list[str]:
    database, store = Database(settings.sqlalchemy_url), ArtefactStore(settings.data_dir / "artefacts")
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


def _race(base_url: str, tokens: list[str], answers: int) -> tuple[list[float], float]:
    """The time of every answer in milliseconds, and of all together in seconds."""
    together = threading.Barrier(len(tokens))
    with ThreadPoolExecutor(len(tokens)) as pool:
        started = time.perf_counter()
        times = list(pool.map(lambda token: _label(base_url, token, answers, together), tokens))
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


def _rss_mb(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
