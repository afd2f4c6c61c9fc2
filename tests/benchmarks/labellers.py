"""Prints how long saving an answer and getting the next pair takes with many labellers, a busy worker, and dashboards.

    python -m tests.benchmarks.labellers --labellers 200 --thought 2 --dashboards 3 --seconds 60
    python -m tests.benchmarks.labellers --labellers 1000 --thought 12 8 6 4 3 --servers 3 --postgresql

The worker is the real one: it fills the study's pool of clips all the time, at its lower priority. Phases without and
with it take turns, so that the machine's mood falls out of their ratio; each is there for every time of thinking.
"""

import argparse
import asyncio
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from asyncio import StreamReader, StreamWriter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from itertools import cycle, product
from pathlib import Path
from statistics import quantiles
from typing import Any
from urllib.parse import urlencode, urlsplit
from uuid import uuid4

from app.__main__ import migrate
from app.db import Database
from app.domain.people import Experimenter
from app.programs import NICENESS, end_with_parent
from app.services.accounts import browser_sessions
from app.settings import Settings
from app.storage import ArtefactStore
from tests import on_postgresql
from tests.benchmarks import large_study
from tests.benchmarks.save_latency import _await_health, _processor_s, _say
from tests.waiting import free_port

STUDY = "/studies/feeding-at-home"
GIVEN = 3
"""Answers of each labeller before it begins."""
AT_THE_DOOR = 20
"""How many open their personal links at the same time."""
_TICK_S = 1 / os.sysconf("SC_CLK_TCK")


@dataclass
class Phase:
    """What was measured while something held."""

    name: str
    thought_s: float
    """how long everybody looks at a pair, on average"""
    times_ms: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    seconds: float = 0.0
    web_s: float = 0.0
    """processor time of the web servers"""
    ours_s: float = 0.0
    """that of this program, which plays the labellers"""
    worker_s: float = 0.0
    database_s: float = 0.0
    """that of PostgreSQL's server; SQLite's is the web servers'"""
    busy_s: float = 0.0
    """that of the whole machine, with whoever else is at work"""


def main() -> None:
    """Fill a studio, let people answer, and print the times."""
    options = _options()
    with tempfile.TemporaryDirectory() as directory, ExitStack() as stack:
        url = None
        if options.postgresql:
            programs = on_postgresql.find_programs()
            if programs is None:
                raise SystemExit("PostgreSQL is not installed.")
            url = stack.enter_context(on_postgresql.serving(programs, {"max_connections": "300"}))
        settings = Settings(_env_file=None, data_dir=Path(directory), database_url=url, port=free_port())
        migrate(settings)
        tokens, cookie = _studio(settings, options)
        ports = [settings.port, *(free_port() for _ in range(options.servers - 1))]
        servers = [stack.enter_context(_program(settings, "app", "web", PORT=str(port))) for port in ports]
        addresses = [f"http://127.0.0.1:{port}" for port in ports]
        for address in addresses:
            _await_health(address)
        asyncio.run(_race(settings, addresses, tokens, cookie, [server.pid for server in servers], options))


def _studio(settings: Settings, options: argparse.Namespace) -> tuple[list[str], str]:
    """The links of those who answer, and the cookie of an experimenter."""
    database, store = Database(settings.sqlalchemy_url), ArtefactStore(settings.data_dir / "artefacts")
    with database.writing() as session:
        study = large_study.make_study(
            session, options.labels, retrain_every_labels=100
        )  # clips are of nothing: no training
        clips = large_study.make_clips(session, store, study)
        large_study.fill(session, store, study, clips, options.people, options.labels)
        tokens = [large_study.begin(session, study, clips, GIVEN, options.labels) for _ in range(options.labellers)]
        account = Experimenter(name="ada", password_hash="-", must_change_password=False)
        session.add(account)
        session.flush()
        cookie = browser_sessions.open_for_experimenter(session, account, timedelta(hours=1))
    database.dispose()
    return tokens, cookie


async def _race(
    settings: Settings,
    addresses: Sequence[str],
    tokens: Sequence[str],
    cookie: str,
    pids: Sequence[int],
    options: argparse.Namespace,
) -> None:
    postgresql = on_postgresql.process_of(settings.database_url) if settings.database_url else None
    phases = {key: Phase(*key) for key in product(("no worker", "worker busy"), options.thought)}
    current = Phase("between phases", options.thought[0])
    door = asyncio.Semaphore(AT_THE_DOOR)
    labellers = [
        Labeller(address, token, options.clips, door) for address, token in zip(cycle(addresses), tokens, strict=False)
    ]
    answering = [asyncio.create_task(each.answer(lambda: current)) for each in labellers]
    await asyncio.gather(*(each.is_in.wait() for each in labellers))
    looking = [asyncio.create_task(_look(addresses[0], cookie)) for _ in range(options.dashboards)]
    for turn in range(options.rounds):
        for thought_s, name in product(options.thought, ("no worker", "worker busy")):
            phase, current = phases[name, thought_s], Phase("between phases", thought_s)
            with ExitStack() as stack:
                worker = None
                if name == "worker busy":
                    worker = stack.enter_context(_program(settings, "worker", "run"))
                await asyncio.sleep(max(options.settling, 1.5 * thought_s))
                current, before = phase, _Clocks(pids, worker, postgresql)
                await asyncio.sleep(options.seconds / options.rounds)
                current = Phase("between phases", thought_s)
                before.add_to(phase, _Clocks(pids, worker, postgresql))
            if turn == options.rounds - 1:
                _print(phase, options)
    for task in (*answering, *looking):
        task.cancel()
    ended = await asyncio.gather(*answering, *looking, return_exceptions=True)
    fallen = [each for each in ended if isinstance(each, Exception)]
    _say(f"labellers and dashboards that fell: {len(fallen)} {fallen[:2]}")


class _Clocks:
    """Processor time used so far."""

    def __init__(self, web: Sequence[int], worker: "subprocess.Popen[bytes] | None", postgresql: int | None) -> None:
        self.at_s = time.perf_counter()
        self.web_s = sum(map(_processor_s, web))
        self.ours_s = time.process_time()
        self.worker_s = 0.0 if worker is None else _of_group(os.getpgid(worker.pid))
        self.database_s = 0.0 if postgresql is None else _of_children(postgresql)
        fields = [int(each) for each in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]]
        self.busy_s = _TICK_S * (sum(fields[:8]) - fields[3] - fields[4])

    def add_to(self, phase: Phase, later: "_Clocks") -> None:
        """Put what has passed until then to what was measured."""
        phase.seconds += later.at_s - self.at_s
        for name in ("web_s", "ours_s", "worker_s", "database_s", "busy_s"):
            setattr(phase, name, getattr(phase, name) + getattr(later, name) - getattr(self, name))


class Labeller:
    """A browser with next to no processor time of its own, so that the server's share is what is measured."""

    def __init__(self, address: str, token: str, clips: bool, door: asyncio.Semaphore) -> None:
        self._random = random.Random(token)  # noqa: S311  (no secret)
        self._address, self._token, self._clips, self._door = address, token, clips, door
        self.is_in = asyncio.Event()
        self._cookie = ""
        self._loaded: set[str] = set()
        self._streams: tuple[StreamReader, StreamWriter] | None = None

    async def answer(self, phase: Any) -> None:
        """Compare pairs until cancelled. ``phase``: gives the phase that an answer belongs to."""
        try:
            await self._compare(phase)
        finally:
            self._hang_up()

    async def _compare(self, phase: Any) -> None:
        async with self._door:
            _, headers, _ = await self._ask("GET", f"/p/{self._token}")
            self._cookie = headers["set-cookie"]
            pair = await self._next()
        self.is_in.set()
        await asyncio.sleep(self._random.uniform(0, phase().thought_s))
        while pair:
            if self._clips:
                await self._load(pair)
            await asyncio.sleep(self._random.uniform(0.5, 1.5) * phase().thought_s)
            form = {"response": "left", "client_uuid": str(uuid4()), "response_time_ms": "4000", "watched_whole": "1"}
            during, started = phase(), time.perf_counter()
            try:
                status, _, body = await self._ask("POST", pair["label_path"], urlencode(form))
            except (OSError, asyncio.IncompleteReadError) as error:
                during.errors.append(repr(error))
                self._hang_up()
                continue
            if status == 200:
                during.times_ms.append(1000 * (time.perf_counter() - started))
                pair = json.loads(body)["pair"] or await self._next()
            else:
                during.errors.append(f"{status} {body[:200]!r}")

    async def _next(self) -> Any:
        await self._ask("POST", "/p/break")
        _, _, body = await self._ask("GET", "/p/next")
        return json.loads(body)["pair"]

    async def _load(self, pair: Mapping[str, Any]) -> None:
        """Each clip once, as a browser does."""
        for path in (path for side in ("left", "right") for path in pair[side].values()):
            if path not in self._loaded:
                self._loaded.add(path)
                await self._ask("GET", path)

    async def _ask(self, method: str, path: str, form: str = "") -> tuple[int, Mapping[str, str], bytes]:
        place = urlsplit(self._address)
        if self._streams is not None and self._streams[0].at_eof():  # the server does not wait as long as people think
            self._hang_up()
        if self._streams is None:
            self._streams = await asyncio.open_connection(place.hostname, place.port)
        reader, writer = self._streams
        lines = [f"{method} {path} HTTP/1.1", f"host: {place.netloc}", "accept: application/json"]
        if self._cookie:
            lines.append(f"cookie: {self._cookie}")
        if method == "POST":
            lines += ["content-type: application/x-www-form-urlencoded", f"content-length: {len(form)}"]
        writer.write("\r\n".join([*lines, "", form]).encode())
        head = (await reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
        headers = dict[str, str]()
        for line in head[1:]:
            name, _, value = line.partition(": ")
            if name.lower() == "set-cookie":  # there are several
                value = f"{headers.get('set-cookie', '')}{value.partition(';')[0]}; "
            headers[name.lower()] = value
        body = await reader.readexactly(int(headers.get("content-length", "0")))
        if headers.get("connection") == "close":
            self._hang_up()
        return int(head[0].split()[1]), headers, body

    def _hang_up(self) -> None:
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


async def _look(address: str, cookie: str) -> None:
    """Open the study's page, and be told what changes until cancelled."""
    place = urlsplit(address)
    for path in (STUDY, f"{STUDY}/live"):
        reader, writer = await asyncio.open_connection(place.hostname, place.port)
        lines = [f"GET {path} HTTP/1.1", f"host: {place.netloc}", f"cookie: studio_experimenter={cookie}"]
        writer.write("\r\n".join([*lines, "connection: close", "", ""]).encode())
        try:
            while await reader.read(2**16):
                pass
        finally:
            writer.close()


@contextmanager
def _program(settings: Settings, *command: str, **environment: str) -> Iterator["subprocess.Popen[bytes]"]:
    """One of the studio's programs, at the priority that it has beside the others; its log goes nowhere."""

    def begin() -> None:
        end_with_parent()
        os.nice(NICENESS.get(command[0], 0))

    program = subprocess.Popen(
        [sys.executable, "-m", *command],
        env={**os.environ, "DATA_DIR": str(settings.data_dir), "DATABASE_URL": settings.sqlalchemy_url, **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        process_group=0,
        preexec_fn=begin,
    )
    try:
        yield program
    finally:
        program.terminate()
        program.wait()


def _of_group(group: int) -> float:
    """Processor time of all processes of a group."""
    return sum(used_s for _, _, its_group, used_s in _processes() if its_group == group)


def _of_children(parent: int) -> float:
    """Processor time of a process and those it has started."""
    return sum(used_s for process, its_parent, _, used_s in _processes() if parent in (process, its_parent))


def _processes() -> Iterator[tuple[int, int, int, float]]:
    """Number, parent, group, and processor time of each, with what its ended children used."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            used_s = _TICK_S * sum(int(each) for each in fields[11:15])
            yield int(path.parent.name), int(fields[1]), int(fields[2]), used_s


def _print(phase: Phase, options: argparse.Namespace) -> None:
    thinking = f"{options.labellers} labellers who think for {phase.thought_s:g} s"
    _say(f"{phase.name}: {thinking}, {options.dashboards} dashboards")
    if len(phase.times_ms) < 2:
        _say(f"  too few answers; errors: {phase.errors[:3]}")
        return
    cuts, count = quantiles(phase.times_ms, n=100), len(phase.times_ms)
    shares = {"web": phase.web_s, "database": phase.database_s, "worker": phase.worker_s, "labellers": phase.ours_s}
    shares["others"] = phase.busy_s - sum(shares.values())
    _say(f"  save and next p50 {cuts[49]:.0f} ms, p95 {cuts[94]:.0f} ms, p99 {cuts[98]:.0f} ms")
    _say(f"  {count} answers, {count / phase.seconds:.0f} per second; errors: {len(phase.errors)} {phase.errors[:2]}")
    told = ", ".join(f"{name} {used_s / phase.seconds:.0%}" for name, used_s in shares.items())
    _say(f"  of one processor: {told}; {1000 * phase.web_s / count:.1f} ms of the web server's for each answer")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labellers", type=int, default=200)
    parser.add_argument(
        "--thought", type=float, nargs="+", default=[2.0], help="seconds per pair, on average; from half to 1.5 of it"
    )
    parser.add_argument("--dashboards", type=int, default=3)
    parser.add_argument("--people", type=int, default=20, help="others in the study, who are through with it")
    parser.add_argument("--labels", type=int, default=200, help="asked of each")
    parser.add_argument("--clips", action="store_true", help="load every clip once, as browsers do")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each phase")
    parser.add_argument("--settling", type=float, default=8.0, help="seconds before each phase that are not counted")
    parser.add_argument("--rounds", type=int, default=2, help="turns that the phases take")
    parser.add_argument("--servers", type=int, default=1, help="web servers on one database")
    parser.add_argument("--postgresql", action="store_true", help="on a PostgreSQL server that syncs every commit")
    return parser.parse_args()


if __name__ == "__main__":
    main()
