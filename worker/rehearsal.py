"""Rehearsal: scripted participants walk through the real pages, from the personal link to the downloaded bundle.

They see what a browser without scripts sees, and answer as somebody of a given taste would, mistakes and indifference
included. What a robot "really" did in a clip they look up in the database, which a person does by watching.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session, joinedload
from tqdm import tqdm

from app.db import Database
from app.domain.clips import Clip
from app.domain.evaluation import Trial
from app.domain.models import Bundle, Model, Run, RunKind, RunStatus
from app.domain.preferences import LEARNED_FROM, Query
from app.domain.protocol import EvaluationMode
from app.domain.studies import Study, StudySettings, TaskName
from app.services import accounts, enrolment, studies
from app.storage import ArtefactStore
from worker import dataset, laboratory
from worker.ml.scripted_ratings import RatingManner, ScriptedRater
from worker.ml.teachers import Manner, ScriptedTeacher, Taste
from worker.own_studio import PATIENCE_S, wait_until
from worker.sim.costs import preference_rewards
from worker.trajectory import Trajectory
from worker.visitor import Visitor

CALIBRATION_PAIRS = 200


@dataclass
class Outcome:
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
    ratings: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    """satisfaction and personalisation of every trial, by method, in the order in which the methods were met"""
    waited_for_robots_seconds: float = 0.0
    """from the finished bundle to the first robot to rate"""


def summary(outcomes: Sequence[Outcome]) -> str:
    """A table of what came out, for people."""
    head = f"{'who':<4} {'user':<10} {'labels':>6} {'accuracy':>8} {'success':>14} {'preference':>10} {'gate':>5}"
    lines = [f"{head} {'save ms (p50/p95)':>18} {'bundle':>16}"]
    for each in outcomes:
        success, preference = each.evaluation["success"], each.evaluation["preference"]
        accuracy = "-" if each.prequential_accuracy is None else f"{each.prequential_accuracy:.2f}"
        middle, late = (1000 * float(np.quantile(each.save_seconds, share)) for share in (0.5, 0.95))
        lines.append(
            f"{each.code:<4} {each.taste.name:<10} {each.labels:>6} {accuracy:>8} "
            f"{success['reference']:>6.1%} {success['delta']:>+6.1%} {preference['delta']:>+7.2f} sd {each.gate:>5.2f} "
            f"{middle:>9.0f} / {late:<6.0f} {len(each.bundle) / 1024:>4.0f} kB in {each.bundle_seconds:.0f} s"
        )
    return "\n".join([*lines, *_rating_lines(outcomes)])


def _rating_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """Mean satisfaction / personalisation per method."""
    methods = sorted({method for each in outcomes for method in each.ratings})
    if not methods:
        return []
    lines = ["", "ratings (satisfaction / personalisation), in the order of the alphabet"]
    for each in outcomes:
        means = [np.mean(each.ratings[method], axis=0) for method in methods]
        shown = "  ".join(
            f"{method} {mean[0]:.1f} / {mean[1]:.1f}" for method, mean in zip(methods, means, strict=True)
        )
        lines.append(f"{each.code:<4} {each.taste.name:<10} {shown}  ({each.waited_for_robots_seconds:.0f} s waited)")
    return lines


@dataclass(frozen=True)
class Rehearsal:
    """A rehearsal in a running studio whose database and artefacts lie on this machine."""

    database: Database
    store: ArtefactStore
    base_url: str
    pace_s: float = 0.0
    """how long a scripted participant thinks about a pair"""

    def run(
        self, task: str, tastes: Sequence[Taste], settings: StudySettings, manner: Manner, seed: int
    ) -> list[Outcome]:
        """One participant per taste, one after the other; the bundles are waited for and downloaded at the end."""
        with self.database.writing() as session:
            study = studies.create_study(session, "Rehearsal", settings, seed=seed, task=TaskName(task))
            enrolled = [enrolment.add_participant(session, study) for _ in tastes]
            password = accounts.create_first_experimenter(session)
        outcomes, teachers = [], []
        for (participant, token), taste in zip(enrolled, tastes, strict=True):
            teacher = _Teacher(self.database, self.store, study, taste, manner, seed + participant.number)
            teachers.append(teacher)
            outcome = Outcome(participant.id, participant.code, taste)
            with Visitor(self.base_url, f"/p/{token}") as visitor:
                self._answer_everything(visitor, teacher, outcome, settings)
            outcome.finished_at = time.monotonic()
            outcomes.append(outcome)
        with Visitor(self.base_url, "/login") as experimenter:
            experimenter.log_in(accounts.FIRST_EXPERIMENTER, password or "")
            for outcome in outcomes:
                self._await_bundle(outcome, study, experimenter)
        for (_, token), teacher, outcome in zip(enrolled, teachers, outcomes, strict=True):
            with Visitor(self.base_url, f"/p/{token}") as visitor:
                self._rate_robots(visitor, teacher, outcome, settings)
                visitor.go_to_the_end()
        return outcomes

    def _rate_robots(self, visitor: Visitor, teacher: "_Teacher", outcome: Outcome, settings: StudySettings) -> None:
        """Everything between the last pair and the last rating; a physical robot needs an operator, who is not here."""
        evaluation = settings.evaluation
        if evaluation is None or evaluation.mode is not EvaluationMode.VIDEO:
            return
        came = time.monotonic()
        for number in range(evaluation.trial_count):
            trial_id = wait_until(PATIENCE_S, "no robot to rate", visitor.trial_id)
            if number == 0:
                outcome.waited_for_robots_seconds = time.monotonic() - came
            method, rating = teacher.rate(trial_id)
            visitor.rate(*rating)
            outcome.ratings.setdefault(method, []).append(rating)

    def _answer_everything(
        self, visitor: Visitor, teacher: "_Teacher", outcome: Outcome, settings: StudySettings
    ) -> None:
        visitor.come_in()
        pairs = settings.practice_pairs + settings.question_count
        with tqdm(total=pairs, desc=f"{outcome.code} {outcome.taste.name}", unit="pair") as bar:
            for _ in range(pairs):
                query_id = wait_until(PATIENCE_S, "no pair to label", visitor.query_id)
                time.sleep(self.pace_s)
                outcome.save_seconds.append(visitor.answer(teacher.answer(query_id)))
                bar.update()
                if not self._is_label(query_id):
                    continue
                outcome.labels += 1
                if outcome.labels % settings.retrain_every_labels == 0:
                    wait_until(PATIENCE_S, "no reward model", lambda: self._has_learned(outcome) or None)

    def _is_label(self, query_id: int) -> bool:
        with self.database.reading() as session:
            return session.get_one(Query, query_id).purpose in LEARNED_FROM

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

    def _await_bundle(self, outcome: Outcome, study: Study, experimenter: Visitor) -> None:
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

        model, bundle = wait_until(PATIENCE_S, "no bundle", finished)
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
        self, database: Database, store: ArtefactStore, study: Study, taste: Taste, manner: Manner, seed: int
    ) -> None:
        self._database, self._store, self._study_id = database, store, study.id
        self._task = laboratory.task(study.task)
        self._taste, self._manner = taste, manner
        self._rng = np.random.default_rng(seed)
        self._teacher: ScriptedTeacher | None = None
        self._rater: ScriptedRater | None = None

    def rate(self, trial_id: int) -> tuple[str, tuple[int, int]]:
        """What this user says about the robot of a trial, and which method it really was."""
        with self._database.reading() as session:
            trial = session.scalars(select(Trial).where(Trial.id == trial_id).options(joinedload(Trial.film))).one()
            if trial.film is None:
                raise ValueError(f"Trial {trial_id} has no film.")
            watched = dataset.stored_trajectory(self._store, trial.film.trajectory_sha256)
            if self._rater is None:
                episodes = [dataset.shown(self._store, clip) for clip in dataset.pool_clips(session, self._study_id)]
                seen = np.array([self._true_rewards(each).sum() for each in episodes])
                self._rater = ScriptedRater(seen, RatingManner(), self._rng)
        value = float(self._true_rewards(watched).sum())
        return trial.film.method, self._rater.rate(value, watched.success)

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
        steps = slice(clip.first_step, clip.first_step + clip.step_count)
        return self._true_rewards(dataset.shown(self._store, clip))[steps]

    def _true_rewards(self, shown: Trajectory) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        """r^H of every step."""
        taste = self._taste
        rewards = preference_rewards(
            self._task, shown.costs, shown.signals, taste.omega, "calibrated", taste.per_signal
        )
        return np.asarray(rewards, np.float64)


def _prequential_accuracy(session: Session, participant_id: int) -> float | None:
    """Share of decided labels that had been predicted before they were given."""
    scored = [
        (label.query.predicted_right > 0.5) == (dataset.target_of(label.response) == 1.0)
        for label in dataset.labels_with_clips(session, participant_id)
        if label.query.predicted_right is not None and dataset.target_of(label.response) in (0.0, 1.0)
    ]
    return float(np.mean(scored)) if scored else None
