"""Rehearsal: scripted participants walk through the real pages, from the personal link to the downloaded bundle.

They are marked as scripted wherever they appear.
They see what a browser without scripts sees, and answer as somebody of a given taste would, mistakes and indifference
included. An experimenter locks the study before they come, and unblinds it when the last of them has rated.
"""

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session
from tqdm import tqdm

from app.db import Database
from app.domain.models import Bundle, Model, ModelKind, Run, RunKind, RunStatus
from app.domain.preferences import LEARNED_FROM, Query
from app.domain.protocol import EvaluationMode
from app.domain.studies import Study
from app.domain.study_settings import StudySettings
from app.services.accounts import accounts
from app.services.monitoring import dashboard
from app.services.participants import enrolment
from app.services.studies import studies
from app.storage import ArtefactStore
from worker.jobs.runtime import records
from worker.ml.teachers import Manner, Taste
from worker.rehearsal import experimenter_steps as conclusion
from worker.rehearsal.browser import OVER, UP_TO_PAIRS, WAITING, Asked, FormBrowser
from worker.rehearsal.experimenter_steps import Conclusion
from worker.rehearsal.participant_steps import Insight, Rated, ScriptedPerson
from worker.rehearsal.server import PATIENCE_S, Answered, wait_until


@dataclass
class RehearsedPerson:
    """What came out for one scripted participant."""

    participant_id: int
    code: str
    taste: Taste
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
    answering_seconds: float = 0.0
    """from the first pair to the last answer, waiting for models and for pairs included"""
    insight: Insight | None = None
    rated: list[Rated] = field(default_factory=list)
    """every trial, in the order in which it was rated"""
    sent_back: bool = False
    """before the end: screened out, no arm open, or too many catch pairs missed"""
    waited_for_robots_seconds: float = 0.0
    """from the finished bundle to the first robot to rate"""


@dataclass(frozen=True)
class Rehearsed:
    """A whole rehearsal."""

    outcomes: list[RehearsedPerson]
    conclusion: Conclusion
    seconds: float
    """from the first personal link to the final figure"""


def write(rehearsed: Rehearsed, directory: Path) -> None:
    """Everything that came out, as files: figures, tables, bundles, and the numbers as JSON."""
    directory.mkdir(parents=True, exist_ok=True)
    for name, file in rehearsed.conclusion.files.items():
        (directory / name).write_bytes(file)
    for each in rehearsed.outcomes:
        if not each.sent_back:
            (directory / f"{each.code}-{each.taste.name}.zip").write_bytes(each.bundle)
    people = [{name: value for name, value in asdict(each).items() if name != "bundle"} for each in rehearsed.outcomes]
    numbers = {"seconds": rehearsed.seconds, "people": people, "report": rehearsed.conclusion.contents}
    (directory / "numbers.json").write_text(json.dumps(numbers, indent=2) + "\n")


def summary(rehearsed: Rehearsed) -> str:
    """A table of what came out, for people."""
    outcomes = rehearsed.outcomes
    head = f"{'who':<4} {'user':<10} {'labels':>6} {'accuracy':>8} {'success':>14} {'preference':>10} {'gate':>5}"
    lines = [f"{head} {'truth':>12} {'save ms (p50/p95)':>18} {'bundle':>16}"]
    for each in outcomes:
        if each.sent_back:
            lines.append(f"{each.code:<4} {each.taste.name:<10} {each.labels:>6} sent back before the end")
            continue
        success, preference = each.evaluation["success"], each.evaluation["preference"]
        accuracy = "-" if each.prequential_accuracy is None else f"{each.prequential_accuracy:.2f}"
        middle, late = (1000 * float(np.quantile(each.save_seconds, share)) for share in (0.5, 0.95))
        lines.append(
            f"{each.code:<4} {each.taste.name:<10} {each.labels:>6} {accuracy:>8} "
            f"{success['reference']:>6.1%} {success['delta']:>+6.1%} {preference['delta']:>+7.2f} sd {each.gate:>5.2f} "
            f"{_truth(each.insight):>12} "
            f"{middle:>9.0f} / {late:<6.0f} {len(each.bundle) / 1024:>4.0f} kB in {each.bundle_seconds:.0f} s"
        )
    answers = sum(len(each.save_seconds) for each in outcomes)
    pace = answers / max(sum(each.answering_seconds for each in outcomes), 1e-9)
    lines += ["", f"{answers} answers at {pace:.1f} a second; the final figure after {rehearsed.seconds / 60:.1f} min"]
    return "\n".join([*lines, *_rating_lines(outcomes)])


def _truth(insight: Insight | None) -> str:
    return "-" if insight is None else f"{insight.same_scenario:.2f} / {insight.other_scenarios:.2f}"


def _rating_lines(outcomes: Sequence[RehearsedPerson]) -> list[str]:
    """Mean satisfaction / personalisation per method, and in brackets how well its robot truly suits the person."""
    rated = [each for each in outcomes if each.rated]
    if not rated:
        return []
    lines = ["", "ratings: satisfaction / personalisation (true share of worse episodes)"]
    for each in rated:
        shown = "  ".join(_ratings_of(method, each.rated) for method in sorted({one.method for one in each.rated}))
        lines.append(f"{each.code:<4} {each.taste.name:<10} {shown}  waited {each.waited_for_robots_seconds:.0f} s")
    return lines


def _ratings_of(method: str, rated: Sequence[Rated]) -> str:
    columns = [(each.satisfaction, each.personalisation, each.true_share) for each in rated if each.method == method]
    satisfaction, personalisation, share = np.mean(columns, axis=0)
    return f"{method} {satisfaction:.1f} / {personalisation:.1f} ({share:.2f})"


@dataclass(frozen=True)
class Rehearsal:
    """A rehearsal in a running studio whose database and artefacts lie on this machine."""

    database: Database
    store: ArtefactStore
    base_url: str
    pace_s: float = 0.0
    """how long a scripted participant thinks about a pair"""
    name: str = "Rehearsal"
    """of the study"""
    unhurried: bool = False
    """whether all clips are waited for, and for the model's prediction of every pair: however slow the machine, who
    meets which pair then follows from the seed, and all that could be foreseen was"""

    def run(self, task: str, tastes: Sequence[Taste], settings: StudySettings, manner: Manner, seed: int) -> Rehearsed:
        """One participant per taste, one after the other; the bundles are waited for and downloaded at the end."""
        with self.database.writing() as session:
            study = studies.create_study(session, self.name, settings, seed=seed, task=task)
            study.key_secret = hashlib.sha256(f"rehearsal/{seed}".encode()).hexdigest()  # nobody rates who could cheat
            enrolled = [enrolment.add_participant(session, study, scripted_as=taste.name) for taste in tastes]
            password = accounts.create_first_experimenter(session)
        with FormBrowser(self.base_url, "/login") as experimenter:
            experimenter.log_in(accounts.FIRST_EXPERIMENTER, password or "")
            conclusion.lock(experimenter, study)
            if self.unhurried:
                self._wait_until("no whole pool", lambda: self._pool_is_whole(study) or None)
            began = time.monotonic()
            outcomes, persons = [], []
            for (participant, token), taste in zip(enrolled, tastes, strict=True):
                person = ScriptedPerson(self.database, self.store, study, taste, manner, seed + participant.number)
                persons.append(person)
                outcome = RehearsedPerson(participant.id, participant.code, taste, rated=person.rated)
                with FormBrowser(self.base_url, f"/p/{token}") as visitor:
                    self._answer_everything(visitor, person, outcome, settings)
                    outcome.sent_back = visitor.page == "ended"
                outcome.finished_at = time.monotonic()
                outcomes.append(outcome)
            for outcome, person in zip(outcomes, persons, strict=True):
                if not outcome.sent_back:
                    self._await_bundle(outcome, study, experimenter)
                    outcome.insight = person.insight(outcome.participant_id)
            for (_, token), person, outcome in zip(enrolled, persons, outcomes, strict=True):
                if not outcome.sent_back:
                    with FormBrowser(self.base_url, f"/p/{token}") as visitor:
                        self._go_to_the_end(visitor, person, outcome, settings)
            ending = conclusion.conclude(experimenter, self.database, study)
        return Rehearsed(outcomes, ending, time.monotonic() - began)

    def _go_to_the_end(
        self, visitor: FormBrowser, person: ScriptedPerson, outcome: RehearsedPerson, settings: StudySettings
    ) -> None:
        """Everything after the last pair; a physical robot needs an operator, who is not here."""
        if settings.evaluation is not None and settings.evaluation.mode is not EvaluationMode.VIDEO:
            return
        came = time.monotonic()
        while visitor.page not in OVER:
            if self._wait_until("no page to go on with", partial(_act, visitor, person)) is Asked.RATING:
                outcome.waited_for_robots_seconds = outcome.waited_for_robots_seconds or time.monotonic() - came

    def _answer_everything(
        self, visitor: FormBrowser, person: ScriptedPerson, outcome: RehearsedPerson, settings: StudySettings
    ) -> None:
        """From the personal link to the last pair, or to where somebody is sent back."""
        came = time.monotonic()
        pairs = settings.practice_pairs + settings.question_count
        with tqdm(total=pairs, desc=f"{outcome.code} {outcome.taste.name}", unit="pair") as bar:
            while visitor.page in UP_TO_PAIRS:
                query_id = visitor.query_id()
                if query_id is None:
                    self._wait_until("no pair to label", partial(_act, visitor, person))
                    continue
                self._wait_until("no prediction", partial(self._was_predicted, outcome, query_id))
                time.sleep(self.pace_s)
                sent = time.perf_counter()
                visitor.act(person)
                outcome.save_seconds.append(time.perf_counter() - sent)
                bar.update()
                if not self._is_label(query_id):
                    continue
                outcome.labels += 1
                if outcome.labels % settings.retrain_every_labels == 0 and visitor.page not in OVER:
                    self._wait_until("no reward model", lambda: self._has_learned(outcome) or None)
        outcome.answering_seconds = time.monotonic() - came

    def _wait_until(self, missing: str, look: Callable[[], Answered | None]) -> Answered:
        """As wait_until(), for as long as the worker gets on."""
        return wait_until(PATIENCE_S, missing, look, self._how_far)

    def _how_far(self) -> Sequence[object]:
        """Something else whenever the worker has got on."""
        with self.database.reading() as session:
            return session.execute(select(Run.workflow_id, Run.status, Run.stage, Run.progress)).all()

    def _is_label(self, query_id: int) -> bool:
        with self.database.reading() as session:
            return session.get_one(Query, query_id).purpose in LEARNED_FROM

    def _pool_is_whole(self, study: Study) -> bool:
        with self.database.reading() as session:
            pool = dashboard.study_overview(session, study).pool
            return pool.made >= pool.wanted

    def _was_predicted(self, outcome: RehearsedPerson, query_id: int) -> bool | None:
        """A pair is predicted right after it was made; whoever answers at once would be earlier."""
        with self.database.reading() as session:
            query = session.get_one(Query, query_id)
            learned = records.newest_model(session, outcome.participant_id, ModelKind.REWARD) is not None
            expected = self.unhurried and learned and query.purpose in LEARNED_FROM
            return (not expected or query.predicted_by_model_id is not None) or None

    def _has_learned(self, outcome: RehearsedPerson) -> bool:
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

    def _await_bundle(self, outcome: RehearsedPerson, study: Study, experimenter: FormBrowser) -> None:
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

        model, bundle = self._wait_until("no bundle", finished)
        outcome.bundle_seconds = time.monotonic() - outcome.finished_at
        outcome.evaluation = model.metrics["evaluation"]
        outcome.gate = model.metrics["gate"]
        address = f"/studies/{study.slug}/participants/{outcome.code}/bundles/{bundle.version}.zip"
        outcome.bundle = experimenter.download(address)
        with self.database.reading() as session:
            outcome.prequential_accuracy = _prequential_accuracy(session, outcome.participant_id)


def _act(visitor: FormBrowser, person: ScriptedPerson) -> Asked | str | None:
    """Do what the page asks for; None while it asks for nothing, unless there is nothing more to come."""
    return visitor.act(person) or (visitor.page if visitor.page not in WAITING else None)


def _prequential_accuracy(session: Session, participant_id: int) -> float | None:
    """As on the dashboard."""
    overall = dashboard.curve_of(session, participant_id).overall
    return overall.value if overall else None
