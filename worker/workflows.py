"""Durable workflows: load (transaction) -> compute (no transaction) -> save (transaction).

The engine remembers which steps of a workflow are finished. A worker that is killed resumes at the first unfinished
one; every step may therefore run twice and leaves the same rows and files when it does.
"""

import logging
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
from dbos import DBOS, DBOSConfiguredInstance
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.clips import Clip
from app.domain.models import ModelKind, RunKind
from app.domain.preferences import Query
from app.domain.studies import Participant, Strategy, Study
from app.storage import ArtefactStore
from worker import dataset, laboratory, records
from worker.compute import Compute, Lane
from worker.ml import acquisition
from worker.modes import FEEDING_AXES
from worker.records import Task

log = logging.getLogger("worker")

KEPT_QUERIES = 3
"""Queries ahead that stay when a new model chooses: the page may already be loading them."""


@DBOS.dbos_class()
class Workshop(DBOSConfiguredInstance):
    """The worker's workflows, bound to one database, artefact store and set of processes."""

    def __init__(self, database: Database, store: ArtefactStore, compute: Compute) -> None:
        super().__init__("workshop")
        self.database = database
        self.store = store
        self.compute = compute

    # -- one entry for every kind of work ---------------------------------------------------------------------------

    @DBOS.workflow()
    def work(self, task: dict[str, Any]) -> None:
        """Do one task; what goes wrong is kept with the run and in the log, never raised."""
        todo = Task(**task)
        body = {RunKind.CLIPS: self._build_clips, RunKind.REWARD: self._train_reward}[RunKind(todo.kind)]
        try:
            body(todo, self._begin(task))
        except Exception as error:  # the worker's edge: one failed task must not stop the others
            log.exception("%s failed", todo.finding)
            self._fail(todo.finding, f"{type(error).__name__}: {error}")

    @DBOS.step()
    def _begin(self, task: dict[str, Any]) -> int:
        todo = Task(**task)
        with self.database.writing() as session:
            return records.begin_run(session, todo, self._seed(session, todo))

    @DBOS.step()
    def _fail(self, finding: str, error: str) -> None:
        with self.database.writing() as session:
            records.fail_run(session, finding, error)

    @DBOS.step()
    def _finish(self, run_id: int) -> None:
        with self.database.writing() as session:
            records.finish_run(session, run_id)

    def _seed(self, session: Session, task: Task) -> int:
        if task.participant_id is None:
            return session.get_one(Study, task.study_id).seed
        return session.get_one(Participant, task.participant_id).seed

    def _report(self, run_id: int, stage: str, progress: float) -> None:
        with self.database.writing() as session:
            records.report(session, run_id, stage, progress)

    def _beat(self, run_id: int) -> Callable[[], None]:
        def beat() -> None:
            with self.database.writing() as session:
                records.beat(session, run_id)

        return beat

    # -- clips ------------------------------------------------------------------------------------------------------

    def _build_clips(self, task: Task, run_id: int) -> None:
        """Every behaviour of one scenario, two at a time: two clips already make a pair that can be labelled."""
        scenario = int(task.finding.rsplit("-", 1)[1])
        with self.database.reading() as session:
            settings = session.get_one(Study, task.study_id).settings
        for first in range(0, settings.behaviours_per_scenario, 2):
            last = min(first + 2, settings.behaviours_per_scenario)
            self._report(run_id, f"filming behaviours {first + 1} to {last}", first / settings.behaviours_per_scenario)
            self._film(run_id, task.study_id, scenario, list(range(first, last)))
        self._finish(run_id)

    @DBOS.step()
    def _film(self, run_id: int, study_id: int, scenario: int, which: list[int]) -> None:
        with self.database.reading() as session:
            settings = session.get_one(Study, study_id).settings
        modes = laboratory.behaviours(scenario, settings.behaviours_per_scenario)
        shots = [(scenario, modes[index].tolist(), 0, settings.clip_steps) for index in which]
        recorded = self.compute.run_all(Lane.CLIPS, self._beat(run_id), laboratory.record_clip, shots)
        for index, each in zip(which, recorded, strict=True):
            rollout = {
                "scenario": scenario,
                "behaviour": index,
                "mode": dict(zip((axis.name for axis in FEEDING_AXES), modes[index].tolist(), strict=True)),
                "trajectory_sha256": self.store.put(each.trajectory),
                "success": each.success,
            }
            clip = {
                "first_step": 0,
                "step_count": settings.clip_steps,
                "video_sha256": self.store.put(each.clip.video),
                "poster_sha256": self.store.put(each.clip.poster),
                "width": each.clip.width,
                "height": each.clip.height,
                "fps": each.clip.fps,
                "duration_ms": each.clip.duration_ms,
                "byte_count": len(each.clip.video),
            }
            with self.database.writing() as session:
                records.save_clip(session, study_id, rollout, clip)

    # -- reward models ----------------------------------------------------------------------------------------------

    def _train_reward(self, task: Task, run_id: int) -> None:
        self._fit_reward(run_id, task.participant)
        self._choose_after_training(task.participant)
        self._finish(run_id)

    @DBOS.step()
    def _fit_reward(self, run_id: int, participant_id: int) -> None:
        with self.database.reading() as session:
            participant = session.get_one(Participant, participant_id)
            kind = session.get_one(Study, participant.study_id).settings.reward_kind
            preferences = dataset.load_preferences(session, self.store, participant_id)
        if preferences.pairs is None:
            return  # nothing but "can't tell" so far: there is nothing to learn from
        self._report(run_id, f"learning from {preferences.label_count} labels", 0.2)
        stored, metrics = self.compute.run(
            Lane.LEARNING,
            self._beat(run_id),
            laboratory.fit_reward,
            kind.value,
            preferences.pairs,
            preferences.targets,
            participant.seed,
        )
        artefact = self.store.put(stored)
        with self.database.writing() as session:
            records.set_labels(session, run_id, preferences.label_count, preferences.label_hash)
            records.save_model(session, run_id, ModelKind.REWARD, artefact, metrics)

    @DBOS.step()
    def _choose_after_training(self, participant_id: int) -> None:
        """Let the new model choose what is asked next, and predict what is already waiting."""
        with self.database.writing() as session:
            participant = session.get_one(Participant, participant_id)
            settings = session.get_one(Study, participant.study_id).settings
            if settings.strategy is not Strategy.UNIFORM:
                records.drop_unseen_queries(session, participant_id, keep=KEPT_QUERIES)
        self.refill_queries(participant_id)
        self.predict_waiting(participant_id)

    # -- queries ----------------------------------------------------------------------------------------------------

    def refill_queries(self, participant_id: int) -> None:
        """Make the queries the participant will meet next. Safe to call at any time, by any number of workers."""
        with self.database.reading() as session:
            participant = session.get_one(Participant, participant_id)
            study = session.get_one(Study, participant.study_id)
            ordinal, wanted = records.next_queries(session, participant_id, study.settings)
            pairs = _unused_pairs(session, participant)
            scores = self._scores(session, participant, pairs, study.settings.strategy) if wanted and pairs else None
        if not wanted or not pairs:
            return
        choice = acquisition.choose(
            wanted,
            len(pairs),
            np.random.default_rng([participant.seed, ordinal]),
            rule="uniform" if scores is None else study.settings.strategy.value,
            scores=scores,
            random_share=study.settings.random_share,
        )
        rows = []
        for place, index in enumerate(choice.indices):
            left, right = reversed(pairs[index]) if choice.swapped[place] else pairs[index]
            rows.append(
                {
                    "ordinal": ordinal + place,
                    "left_clip_id": left.id,
                    "right_clip_id": right.id,
                    "strategy": Strategy.UNIFORM if scores is None else study.settings.strategy,
                    "propensity": float(choice.propensities[place]),
                }
            )
        with self.database.writing() as session:
            records.save_queries(session, participant_id, ordinal, rows)
        self.predict_waiting(participant_id)

    def predict_waiting(self, participant_id: int) -> None:
        """Write the newest model's prediction to every query that has never been answered: honest by construction."""
        with self.database.reading() as session:
            model = records.newest_model(session, participant_id, ModelKind.REWARD)
            queries = records.unanswered(session, participant_id, *dataset.CLIPS_AND_ROLLOUTS)
            if model is None or all(query.predicted_by_model_id == model.id for query in queries):
                return
            pairs = dataset.segment_pairs(self.store, [(query.left_clip, query.right_clip) for query in queries])
            ids = [query.id for query in queries]
        probabilities = laboratory.probability_right(self.store.read(model.artefact_sha256), pairs)
        with self.database.writing() as session:
            records.save_predictions(session, model.id, dict(zip(ids, probabilities, strict=True)))

    def _scores(
        self, session: Session, participant: Participant, pairs: list[tuple[Clip, Clip]], strategy: Strategy
    ) -> acquisition.Floats | None:
        """Ensemble disagreement of every candidate; None when the choice is to be uniform."""
        model = records.newest_model(session, participant.id, ModelKind.REWARD)
        if strategy is Strategy.UNIFORM or model is None:
            return None
        segments = dataset.segment_pairs(self.store, pairs)
        members = laboratory.member_probabilities(self.store.read(model.artefact_sha256), segments)
        return acquisition.disagreement(members)


def _unused_pairs(session: Session, participant: Participant) -> list[tuple[Clip, Clip]]:
    """Pairs of clips of one scenario that this participant has not been given yet, on either side."""
    clips = dataset.pool_clips(session, participant.study_id)
    used = {
        frozenset(pair)
        for pair in session.execute(
            select(Query.left_clip_id, Query.right_clip_id).where(Query.participant_id == participant.id)
        ).tuples()
    }
    rows = acquisition.matched_pairs([clip.rollout.scenario for clip in clips])
    pairs = [(clips[first], clips[second]) for first, second in rows]
    return [pair for pair in pairs if frozenset(clip.id for clip in pair) not in used]


def as_arguments(task: Task) -> dict[str, Any]:
    """The task as plain values, which is what the engine stores."""
    return {name: str(value) if name == "kind" else value for name, value in asdict(task).items()}
