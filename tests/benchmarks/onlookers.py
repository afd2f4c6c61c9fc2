"""Prints what open dashboards cost those who answer, and how long the pages of a large study take.

    python -m tests.benchmarks.onlookers --people 100 --labels 200 --labellers 40 --dashboards 3 --seconds 20

Labellers save an answer and fetch the next pair, then think for a while. Phases without and with dashboards take
turns within one run, so that the machine's mood falls out of the ratio.
"""

import argparse
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from statistics import median, quantiles
from uuid import uuid4

import httpx2
from sqlalchemy import insert
from sqlalchemy.orm import Session

from app.__main__ import migrate
from app.db import Database, now
from app.domain.models import ModelKind
from app.domain.people import Experimenter
from app.domain.preferences import LabelEvent, Query
from app.domain.studies import Study
from app.services.accounts import browser_sessions
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.benchmarks.save_latency import _await_health, _rss_mb, _say
from tests.waiting import free_port

OPENING = -1
"""A phase that is not counted: dashboards open or close."""
STUDY = "/studies/feeding-at-home"


def main() -> None:
    options = _options()
    with tempfile.TemporaryDirectory() as directory:
        settings = Settings(_env_file=None, data_dir=Path(directory), port=free_port())
        migrate(settings)
        tokens, cookie = _study(settings, options)
        server = subprocess.Popen(
            [
                *(sys.executable, "-m", "uvicorn", "app.main:create_app", "--factory", "--no-access-log"),
                *("--log-level", "warning", "--port", str(settings.port), "--timeout-keep-alive", "60"),
            ],
            env={**os.environ, "DATA_DIR": directory},
        )
        try:
            _await_health(settings.base_url)
            _pages(settings.base_url, cookie, server.pid)
            _labelling(settings.base_url, cookie, tokens, server.pid, options)
            _say(f"memory of the web server {_rss_mb(server.pid):.0f} MB")
        finally:
            server.terminate()
            server.wait()


def _study(settings: Settings, options: argparse.Namespace) -> tuple[list[str], str]:
    """People with all their answers, and labellers with pairs waiting; the links of these, a cookie."""
    database, store = Database(settings.sqlalchemy_url), ArtefactStore.of(settings)
    rng = random.Random(1)  # noqa: S311
    with database.writing() as session:
        study = factories.make_study(
            session,
            labels_per_participant=max(10, options.labels),
            pool_scenarios=500,
            retrain_every_labels=10,
            break_every=0,
        )
        clips = [factories.make_clip(session, store, study).id for _ in range(20)]
        for _ in range(options.people):
            person, _ = factories.make_participant(session, study)
            queries = [
                {
                    "participant_id": person.id,
                    "ordinal": 1 + place,
                    "left_clip_id": left,
                    "right_clip_id": right,
                    "strategy": "uniform",
                    "propensity": 1.0,
                    "predicted_right": rng.random(),
                }
                for place in range(options.labels)
                for left, right in [rng.sample(clips, 2)]
            ]
            ids = session.scalars(insert(Query).returning(Query.id, sort_by_parameter_order=True), queries).all()
            begun = now() - timedelta(hours=3)
            session.execute(
                insert(LabelEvent),
                [
                    {
                        "query_id": query,
                        "revision": 1,
                        "response": rng.choice(("left", "right", "right", "equal")),
                        "client_uuid": str(uuid4()),
                        "response_time_ms": rng.randrange(1500, 9000),
                        "created_at": begun + timedelta(seconds=8 * place),
                    }
                    for place, query in enumerate(ids)
                ],
            )
            for labels in range(10, options.labels + 1, 10):
                factories.make_model(session, study, person, ModelKind.REWARD, factories.reward_metrics(), labels)
            metrics = factories.filter_metrics()
            model = factories.make_model(session, study, person, ModelKind.FILTER, metrics, options.labels)
            factories.make_bundle(session, store, model)
        tokens = [_labeller(session, study, clips, options.labels) for _ in range(options.labellers)]
        account = Experimenter(name="experimenter", password_hash="-", must_change_password=False)
        session.add(account)
        session.flush()
        cookie = browser_sessions.open_for_experimenter(session, account, timedelta(hours=1))
    database.dispose()
    return tokens, cookie


def _labeller(session: Session, study: Study, clips: list[int], labels: int) -> str:
    person, token = factories.make_participant(session, study)
    session.execute(
        insert(Query),
        [
            {
                "participant_id": person.id,
                "ordinal": 1 + place,
                "left_clip_id": clips[place % 20],
                "right_clip_id": clips[(place + 1) % 20],
                "strategy": "uniform",
                "propensity": 1.0,
            }
            for place in range(labels)
        ],
    )
    return token


def _pages(base_url: str, cookie: str, pid: int) -> None:
    for path in ("/studies", STUDY, f"{STUDY}/participants/P01", f"{STUDY}/results", f"{STUDY}/export"):
        times, used_s, size = [], list[float](), 0
        with httpx2.Client(base_url=base_url, cookies={"studio_experimenter": cookie}, timeout=120) as browser:
            for _ in range(4):
                started, before_s = time.perf_counter(), _cpu_s(pid)
                with browser.stream("GET", path) as answer:
                    answer.raise_for_status()
                    pieces = answer.iter_raw()
                    next(pieces)
                    times.append(1000 * (time.perf_counter() - started))
                    used_s.append(_cpu_s(pid) - before_s)
                    size = len(answer.headers.get("content-length", "")) and int(answer.headers["content-length"])
        _say(
            f"{path}: first byte after {times[0]:.0f} ms at first ({1000 * used_s[0]:.0f} ms of a processor), "
            f"then {median(times[1:]):.0f} ms ({1000 * median(used_s[1:]):.0f} ms); {size / 1000:.0f} kB"
        )


def _labelling(base_url: str, cookie: str, tokens: list[str], pid: int, options: argparse.Namespace) -> None:
    phase_s, onlookers = options.seconds, options.dashboards
    times: dict[int, list[float]] = {0: [], onlookers: [], OPENING: []}
    phase, done = [0], threading.Event()
    ready = threading.Barrier(len(tokens) + 1)
    labellers = [
        threading.Thread(target=_label, args=(base_url, token, options.thought, times, phase, ready, done))
        for token in tokens
    ]
    for labeller in labellers:
        labeller.start()
    ready.wait()
    received, used_s = [0], {0: 0.0, onlookers: 0.0}
    for _ in range(2):
        used_s[0] -= _cpu_s(pid)
        phase[0] = 0
        time.sleep(phase_s)
        phase[0] = OPENING
        used_s[0] += _cpu_s(pid)
        with _dashboards(base_url, cookie, onlookers, received):
            used_s[onlookers] -= _cpu_s(pid)
            phase[0] = onlookers
            time.sleep(phase_s)
            phase[0] = OPENING
            used_s[onlookers] += _cpu_s(pid)
    done.set()
    for labeller in labellers:
        labeller.join()
    p95 = {}
    for count in (0, onlookers):
        if len(times[count]) < 2:
            _say(f"{count} dashboards: too few answers in {2 * phase_s:g} s")
            return
        cuts = quantiles(times[count], n=100)
        p95[count] = cuts[94]
        _say(
            f"{len(tokens)} labellers, {count} dashboards: save and next p50 {cuts[49]:.0f} ms, p95 {cuts[94]:.0f} ms, "
            f"{len(times[count]) / (2 * phase_s):.1f} answers per second, {used_s[count] / (2 * phase_s):.0%} of a core"
        )
    _say(f"p95 with {onlookers} dashboards: {p95[onlookers] / p95[0]:.2f} times that without")
    _say(f"a dashboard received {received[0] / 1000 / onlookers / (2 * phase_s):.1f} kB per second")


def _label(
    base_url: str,
    token: str,
    thought_s: float,
    times: dict[int, list[float]],
    phase: list[int],
    ready: threading.Barrier,
    done: threading.Event,
) -> None:
    rng = random.Random(token)  # noqa: S311
    with httpx2.Client(base_url=base_url, headers={"Accept": "application/json"}, timeout=120) as browser:
        browser.get(f"/p/{token}")
        pair = browser.get("/p/next").json()["pair"]
        ready.wait()
        while pair and not done.wait(rng.uniform(thought_s / 3, thought_s)):
            form = {"response": "left", "client_uuid": str(uuid4()), "response_time_ms": "4000"}
            during, started = phase[0], time.perf_counter()
            answer = browser.post(pair["label_path"], data=form)
            times[during].append(1000 * (time.perf_counter() - started))
            pair = answer.raise_for_status().json()["pair"]


@contextmanager
def _dashboards(base_url: str, cookie: str, count: int, received: list[int]) -> Iterator[None]:
    """Open pages of the study that are told what changes; their page and first drawing have arrived."""
    done = threading.Event()
    opened = threading.Barrier(count + 1)

    def watch() -> None:
        with httpx2.Client(base_url=base_url, cookies={"studio_experimenter": cookie}, timeout=120) as browser:
            browser.get(STUDY).raise_for_status()
            with browser.stream("GET", f"{STUDY}/live") as stream:
                pieces = stream.iter_raw()
                next(pieces)
                opened.wait()
                while not done.is_set():
                    received[0] += len(next(pieces))

    watchers = [threading.Thread(target=watch) for _ in range(count)]
    for watcher in watchers:
        watcher.start()
    opened.wait()
    yield
    done.set()
    for watcher in watchers:
        watcher.join()


def _cpu_s(pid: int) -> float:
    """Processor time that the server has used so far; unlike waiting times, it does not depend on who else computes."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=100, help="who have given all their answers")
    parser.add_argument("--labels", type=int, default=200, help="of each")
    parser.add_argument("--labellers", type=int, default=40)
    parser.add_argument("--dashboards", type=int, default=3)
    parser.add_argument("--thought", type=float, default=3.0, help="most seconds per pair; at least a third")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each of the four phases")
    return parser.parse_args()


if __name__ == "__main__":
    main()
