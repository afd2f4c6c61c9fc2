"""Rehearsal: scripted participants walk through the real pages, from the personal link to the downloaded bundle.

They see what a browser without scripts sees, and answer like one of the paper's users would, mistakes and indifference
included. What a robot "really" did in a clip they look up in the database, which a person does by watching.
"""

import os
import re
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, Self, TypeVar
from urllib.parse import urljoin

import httpx2
import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session
from tqdm import tqdm

from app.db import Database
from app.domain.clips import Clip
from app.domain.models import Bundle, Model, Run, RunKind, RunStatus
from app.domain.preferences import Query
from app.domain.studies import Study, StudySettings
from app.errors import AppError
from app.services import accounts, enrolment, studies
from app.settings import Settings
from app.storage import ArtefactStore
from worker import dataset
from worker.ml.teachers import OMEGA, Manner, ScriptedTeacher, User
from worker.sim.costs import preference_rewards

Found = TypeVar("Found")

PATIENCE_S = 900.0
POLL_S = 0.25
CALIBRATION_PAIRS = 200
_QUERY = re.compile(r"/p/queries/(\d+)/label")


class RehearsalFailed(AppError):
    """The rehearsal did not get to the end."""


@dataclass
class Outcome:
    """What came out for one scripted participant."""

    participant_id: int
    code: str
    user: User
    labels: int = 0
    save_seconds: list[float] = field(default_factory=list)
    """of each answer: from sending it to having the next page"""
    finished_at: float = 0.0
    prequential_accuracy: float | None = None
    evaluation: dict[str, Any] = field(default_factory=dict)
    gate: float = 0.0
    bundle: bytes = b""
    bundle_seconds: float = 0.0
    """from the last label to the finished bundle"""


def summary(outcomes: Sequence[Outcome]) -> str:
    """A table of what came out, for people."""
    head = f"{'who':<4} {'user':<10} {'labels':>6} {'accuracy':>8} {'success':>14} {'preference':>10} {'gate':>5}"
    lines = [f"{head} {'save ms (p50/p95)':>18} {'bundle':>16}"]
    for each in outcomes:
        success, preference = each.evaluation["success"], each.evaluation["preference"]
        accuracy = "-" if each.prequential_accuracy is None else f"{each.prequential_accuracy:.2f}"
        middle, late = (1000 * float(np.quantile(each.save_seconds, share)) for share in (0.5, 0.95))
        lines.append(
            f"{each.code:<4} {each.user:<10} {each.labels:>6} {accuracy:>8} "
            f"{success['reference']:>6.1%} {success['delta']:>+6.1%} {preference['delta']:>+7.2f} sd {each.gate:>5.2f} "
            f"{middle:>9.0f} / {late:<6.0f} {len(each.bundle) / 1024:>4.0f} kB in {each.bundle_seconds:.0f} s"
        )
    return "\n".join(lines)


class OwnStudio:
    """Web server and worker of a studio of our own in a directory; a context that stops both at its end."""

    def __init__(self, directory: Path) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self.settings = Settings(data_dir=directory, port=_free_port(), database_url=None)
        self.log = directory / "rehearsal.log"
        self._environment = {
            **{name: value for name, value in os.environ.items() if name != "DATABASE_URL"},
            "DATA_DIR": str(directory),
            "HOST": self.settings.host,
            "PORT": str(self.settings.port),
        }
        self._programs: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        subprocess.run([sys.executable, "-m", "app", "migrate"], check=True, env=self._environment)
        self.start_web()
        self.start_worker()
        return self

    def __exit__(self, *exception: object) -> None:
        for program in self._programs.values():
            program.terminate()
        for program in self._programs.values():
            program.wait()

    def start_web(self) -> None:
        """Start the web server and wait until it answers."""
        address = ["--host", self.settings.host, "--port", str(self.settings.port)]
        self._start("web", "uvicorn", "app.main:create_app", "--factory", "--no-access-log", *address)
        _until(PATIENCE_S, "no web server", self._answers)

    def start_worker(self) -> None:
        """Start the worker; whatever an earlier one has left undone is its to finish."""
        self._start("worker", "worker", "run")

    def kill(self, name: str) -> None:
        """SIGKILL to "web" or "worker": no chance to clean up."""
        self._programs[name].kill()
        self._programs[name].wait()

    def _answers(self) -> bool | None:
        if self._programs["web"].poll() is not None:
            raise RehearsalFailed(f"The web server stopped by itself; {self.log} says why.")
        try:
            return httpx2.get(f"{self.settings.base_url}/login", timeout=5.0).is_success or None
        except httpx2.TransportError:
            return None

    def _start(self, name: str, module: str, *arguments: str) -> None:
        with self.log.open("ab") as stream:
            self._programs[name] = subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                env=self._environment,
                stdout=stream,
                stderr=subprocess.STDOUT,
            )


@dataclass(frozen=True)
class Rehearsal:
    """A rehearsal in a running studio whose database and artefacts lie on this machine."""

    database: Database
    store: ArtefactStore
    base_url: str
    pace_s: float = 0.0
    """how long a scripted participant thinks about a pair"""

    def run(self, users: Sequence[User], settings: StudySettings, manner: Manner, seed: int) -> list[Outcome]:
        """One participant per user, one after the other; the bundles are waited for and downloaded at the end."""
        with self.database.writing() as session:
            study = studies.create_study(session, "Rehearsal", settings, seed=seed)
            enrolled = [enrolment.add_participant(session, study) for _ in users]
            password = accounts.create_first_experimenter(session)
        outcomes = []
        for (participant, token), user in zip(enrolled, users, strict=True):
            teacher = _Teacher(self.database, self.store, study.id, user, manner, seed + participant.number)
            outcome = Outcome(participant.id, participant.code, user)
            with Visitor(self.base_url, f"/p/{token}") as visitor:
                self._answer_everything(visitor, teacher, outcome, settings)
            outcome.finished_at = time.monotonic()
            outcomes.append(outcome)
        with Visitor(self.base_url, "/login") as experimenter:
            experimenter.log_in(accounts.FIRST_EXPERIMENTER, password or "")
            for outcome in outcomes:
                self._await_bundle(outcome, study, experimenter)
        return outcomes

    def _answer_everything(
        self, visitor: "Visitor", teacher: "_Teacher", outcome: Outcome, settings: StudySettings
    ) -> None:
        visitor.come_in()
        labels = settings.labels_per_participant
        with tqdm(total=labels, desc=f"{outcome.code} {outcome.user}", unit="label") as bar:
            while outcome.labels < labels:
                query_id = _until(PATIENCE_S, "no pair to label", visitor.query_id)
                time.sleep(self.pace_s)
                outcome.save_seconds.append(visitor.answer(teacher.answer(query_id)))
                outcome.labels += 1
                bar.update()
                if outcome.labels % settings.retrain_every_labels == 0:
                    _until(PATIENCE_S, "no reward model", lambda: self._has_learned(outcome) or None)

    def _has_learned(self, outcome: Outcome) -> bool:
        """People are slower than a retraining; whoever answers at once would never meet a model's prediction."""
        with self.database.reading() as session:
            trained = session.scalar(
                select(func.count(Run.id)).where(
                    Run.participant_id == outcome.participant_id,
                    Run.kind == RunKind.REWARD,
                    Run.status == RunStatus.SUCCEEDED,
                    Run.workflow_id.contains(f"labels-{outcome.labels}"),
                )
            )
        return bool(trained)

    def _await_bundle(self, outcome: Outcome, study: Study, experimenter: "Visitor") -> None:
        def finished() -> tuple[Model, Bundle] | None:
            with self.database.reading() as session:
                row = session.execute(
                    select(Model, Bundle)
                    .join(Bundle, Bundle.model_id == Model.id)
                    .where(
                        Model.participant_id == outcome.participant_id,
                        Model.label_count >= study.settings.labels_per_participant,
                    )
                    .order_by(Bundle.version.desc())
                ).first()
                return None if row is None else (row[0], row[1])

        model, bundle = _until(PATIENCE_S, "no bundle", finished)
        outcome.bundle_seconds = time.monotonic() - outcome.finished_at
        outcome.evaluation = model.metrics["evaluation"]
        outcome.gate = model.metrics["gate"]
        address = f"/studies/{study.slug}/participants/{outcome.code}/bundles/{bundle.version}.zip"
        outcome.bundle = experimenter.download(address)
        with self.database.reading() as session:
            outcome.prequential_accuracy = _prequential_accuracy(session, outcome.participant_id)


class _Teacher:
    """A scripted user who knows what happened in each clip."""

    def __init__(
        self, database: Database, store: ArtefactStore, study_id: int, user: User, manner: Manner, seed: int
    ) -> None:
        self._database, self._store, self._study_id = database, store, study_id
        self._user, self._manner = user, manner
        self._rng = np.random.default_rng(seed)
        self._teacher: ScriptedTeacher | None = None

    def answer(self, query_id: int) -> str:
        """What this user says about the query."""
        with self._database.reading() as session:
            query = session.scalars(
                select(Query).where(Query.id == query_id).options(*dataset.CLIPS_AND_ROLLOUTS)
            ).one()
            left, right = (self._rewards(clip) for clip in (query.left_clip, query.right_clip))
            if self._teacher is None:
                self._teacher = self._calibrated(session)
        return self._teacher.answer(left, right, self._rng)

    def _calibrated(self, session: Session) -> ScriptedTeacher:
        clips = dataset.pool_clips(session, self._study_id)
        pairs = dataset.matched_pairs(clips)
        rewards = [[self._rewards(clip) for clip in pair] for pair in pairs[:CALIBRATION_PAIRS]]
        return ScriptedTeacher.calibrated(self._manner, np.array(rewards))

    def _rewards(self, clip: Clip) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        shown = dataset.shown(self._store, clip)
        steps = slice(clip.first_step, clip.first_step + clip.step_count)
        rewards = preference_rewards(shown.costs, shown.signals, OMEGA[self._user], form="calibrated")
        return np.asarray(rewards, np.float64)[steps]


class Visitor:
    """A browser without scripts: follows redirects, fills in forms, presses buttons."""

    def __init__(self, base_url: str, path: str) -> None:
        self._client = httpx2.Client(
            base_url=base_url, follow_redirects=True, timeout=60.0, headers={"Origin": base_url}
        )
        self._page = _Page("", "")
        self._first = path

    def __enter__(self) -> Self:
        self._open(self._first)
        return self

    def __exit__(self, *exception: object) -> None:
        self._client.close()

    def come_in(self) -> None:
        """Go through consent and instructions to the first pair."""
        for _ in range(5):
            if self._page.address.endswith("/p/next") or self._page.form_to(_QUERY):
                return
            self._send_first({})
        raise RehearsalFailed(f"The way from the personal link to the first pair ended at {self._page.address}.")

    def log_in(self, name: str, password: str) -> None:
        """As an experimenter, choosing a new password on the way when asked to."""
        self._send_first({"name": name, "password": password})
        chosen = secrets.token_urlsafe(16)
        if "/password" in self._page.address:
            self._send_first({"current": password, "new": chosen, "again": chosen})

    def download(self, path: str) -> bytes:
        """The bytes behind an address."""
        response = self._client.get(path)
        if response.is_error:
            raise RehearsalFailed(f"GET {path} answered {response.status_code}.")
        return response.content

    def query_id(self) -> int | None:
        """The query on the page, after loading the page anew; None while there is none."""
        self._open("/p/next")
        form = self._page.form_to(_QUERY)
        return None if form is None else int(form.target.group(1))

    def answer(self, response: str) -> float:
        """Press a button; returns the seconds until the next page was there."""
        form = self._page.form_to(_QUERY)
        if form is None:
            raise RehearsalFailed(f"There is no pair on {self._page.address}.")
        started = time.perf_counter()
        self._send(form.target.group(0), {**form.fields, "response": response})
        return time.perf_counter() - started

    def _send_first(self, filled_in: dict[str, str]) -> None:
        """Send the page's first form with these fields filled in, the others as they are."""
        if not self._page.forms:
            raise RehearsalFailed(f"There is nothing to press on {self._page.address}.")
        action, fields = self._page.forms[0]
        self._send(action, {**fields, **filled_in})

    def _open(self, path: str) -> None:
        self._arrive(self._client.get(path))

    def _send(self, path: str, fields: dict[str, str]) -> None:
        self._arrive(self._client.post(urljoin(self._page.address or "/", path), data=fields))

    def _arrive(self, response: httpx2.Response) -> None:
        if response.is_error:
            raise RehearsalFailed(f"{response.request.method} {response.url.path} answered {response.status_code}.")
        self._page = _Page(str(response.url), response.text)


@dataclass(frozen=True)
class _Form:
    """A form whose address has been recognised."""

    target: re.Match[str]
    fields: dict[str, str]


class _Page(HTMLParser):
    """The forms of a page with the fields a person would leave as they are; boxes are ticked."""

    def __init__(self, address: str, text: str) -> None:
        super().__init__()
        self.address = address
        self.forms: list[tuple[str, dict[str, str]]] = []
        self.feed(text)

    def form_to(self, address: re.Pattern[str]) -> _Form | None:
        """The first form that is sent to such an address."""
        for action, fields in self.forms:
            if found := address.search(action):
                return _Form(found, fields)
        return None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect forms and their input fields."""
        named = {name: value or "" for name, value in attrs}
        if tag == "form" and named.get("method", "").lower() == "post":
            self.forms.append((named.get("action", ""), {}))
        elif tag in {"input", "button"} and self.forms and named.get("name"):
            self.forms[-1][1].setdefault(named["name"], named.get("value", "on"))


def _until(patience_s: float, missing: str, look: Callable[[], Found | None]) -> Found:
    deadline = time.monotonic() + patience_s
    while (found := look()) is None:
        if time.monotonic() > deadline:
            raise RehearsalFailed(f"There was {missing} for {patience_s:.0f} s; rehearsal.log says what went on.")
        time.sleep(POLL_S)
    return found


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _prequential_accuracy(session: Session, participant_id: int) -> float | None:
    """Share of decided labels that had been predicted before they were given."""
    scored = [
        (label.query.predicted_right > 0.5) == (dataset.target_of(label.response) == 1.0)
        for label in dataset.labels_with_clips(session, participant_id)
        if label.query.predicted_right is not None and dataset.target_of(label.response) in (0.0, 1.0)
    ]
    return float(np.mean(scored)) if scored else None
