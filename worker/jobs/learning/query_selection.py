"""What each participant is asked next, and what the newest model expects them to say."""

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.choices import Strategy
from app.domain.clips import Clip
from app.domain.models import Model, ModelKind
from app.domain.preferences import (
    FOLLOWING,
    LEARNED_FROM,
    NO_OBVIOUS_PAIR,
    OBVIOUS,
    PRACTICE,
    REPEAT,
    Purpose,
    Query,
)
from app.domain.studies import Participant, Study
from app.storage import ArtefactStore
from worker.compute import learning
from worker.domain.task import Task
from worker.domain.type_aliases import FloatArray
from worker.jobs.learning import dataset, query_plan
from worker.jobs.learning.query_plan import Slot
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.ml import acquisition
from worker.ml.rewards.segments import Stretch
from worker.ml.teachers import OMEGA, User
from worker.sim.costs import preference_rewards
from worker.tasks import registry

log = logging.getLogger("worker.jobs.learning.query_selection")

KEPT_QUERIES = 3
"""Queries ahead that stay when others are chosen: the page may already be loading them."""
_CHOSEN_LATER = (Purpose.PREFERENCE, Purpose.REPEAT)
OTHERS_LABELS = 20
"""So many answers a participant has given before their model speaks for them to others."""
MOST_OTHERS = 12
"""More people cost time and hardly change on which pairs people differ."""


def refill_queries(context: WorkerContext, participant_id: int) -> None:
    """Make the queries the participant will meet next. Safe to call at any time, by any number of workers.

    Places are filled in their order: where one must wait, for clips to be filmed, the later ones wait as well. Pairs of
    a study of own clips that cannot be shown any more make room for others; clips of ours are made again.
    """
    lost = context.store.lost()
    with context.database.reading() as session:
        study = session.get_one(Study, session.get_one(Participant, participant_id).study_id)
    if lost and study.material is not None:
        with context.database.writing() as session:
            records.drop_lost_queries(session, participant_id, lost)
    with context.database.reading() as session:
        known = _load(session, participant_id, lost)
    rows = _Choosing(context, known).rows() if known.free else []
    if not rows:
        return
    with context.database.writing() as session:
        records.save_queries(session, participant_id, rows)
    predict_waiting(context, participant_id)


def choose_anew(context: WorkerContext, participant_id: int) -> None:
    """Choose the pairs that nobody has seen once more, now that there is a newer model, or a pair made for the person;
    the next few stay."""
    with context.database.writing() as session:
        records.drop_unseen_queries(session, participant_id, keep=KEPT_QUERIES)
    refill_queries(context, participant_id)


def predict_waiting(context: WorkerContext, participant_id: int) -> None:
    """Write the newest model's prediction to every query that has never been answered: honest by construction.

    Only to labels: a repeat was answered before, a catch pair is no question of taste, practice is none at all.
    """
    lost = context.store.lost()
    with context.database.reading() as session:
        model = _newest_whole(session, participant_id, lost)
        waiting = records.unanswered(session, participant_id, *dataset.CLIPS_AND_ROLLOUTS)
    queries = [query for query in waiting if query.purpose in LEARNED_FROM]
    if model is None or all(query.predicted_by_model_id == model.id for query in queries):
        return
    pairs = dataset.segment_pairs(context.store, [(query.left_clip, query.right_clip) for query in queries])
    probabilities = learning.probability_right(context.store.read(model.artefact_sha256), pairs)
    by_query = dict(zip((query.id for query in queries), probabilities, strict=True))
    with context.database.writing() as session:
        records.save_predictions(session, model.id, by_query)


@dataclass(frozen=True)
class _Known:
    """All that choosing a participant's next pairs asks of the database."""

    participant: Participant
    study: Study
    free: Sequence[Slot]
    """Places of the plan that are to be filled, in their order."""
    sides: Mapping[int, tuple[int, int]]
    """The clips on the left and right of every pair that has been chosen, by its place."""
    clips: Sequence[Clip]
    """Of the pool, as far as they can be shown."""
    made: Sequence[Clip]
    """For this person, after their newest model; two of each scenario."""
    whole_clips: Sequence[Clip]
    """Of whole trajectories."""
    model: Model | None
    """The participant's newest reward model whose file is whole."""
    others: Sequence[Model]
    """Newest reward models of other participants who have said enough."""
    has_unanswered: bool
    has_lost: bool
    """Whether any stored file is lost."""


def _load(session: Session, participant_id: int, lost: Collection[str]) -> _Known:
    """``lost``: files that cannot be shown."""

    def shown(clips: Sequence[Clip]) -> list[Clip]:
        return [clip for clip in clips if clip.video_sha256 not in lost and clip.poster_sha256 not in lost]

    participant = session.get_one(Participant, participant_id)
    study = session.get_one(Study, participant.study_id)
    settings, slots = study.settings, query_plan.plan(study.settings, participant.seed)
    free = [slots[ordinal - 1] for ordinal in records.free_ordinals(session, participant_id, settings)]
    wanted = {slot.purpose for slot in free}
    scored = Purpose.PREFERENCE in wanted and settings.strategy is not Strategy.UNIFORM
    follows = Purpose.PREFERENCE in wanted and settings.following_share > 0.0
    contested = scored and settings.strategy is Strategy.CONTESTED
    asked = select(Query).where(Query.participant_id == participant_id)
    model = _newest_whole(session, participant_id, lost) if scored or follows else None
    return _Known(
        participant,
        study,
        free,
        {query.ordinal: (query.left_clip_id, query.right_clip_id) for query in session.scalars(asked)},
        shown(dataset.pool_clips(session, study.id)) if free else [],
        shown(dataset.made_clips(session, participant_id, model.created_at)) if follows and model else [],
        shown(dataset.whole_clips(session, study.id)) if Purpose.INTRODUCTION in wanted else [],
        model,
        [
            model
            for model in records.models_of_others(session, participant_id, ModelKind.REWARD, OTHERS_LABELS, MOST_OTHERS)
            if model.artefact_sha256 not in lost
        ]
        if contested
        else [],
        bool(records.unanswered(session, participant_id)),
        bool(lost),
    )


def _newest_whole(session: Session, participant_id: int, lost: Collection[str]) -> Model | None:
    """An older reward model chooses and foresees until there is a newer one: worse, but nobody waits for a backup."""
    mine = records.models_of(session, participant_id, ModelKind.REWARD)
    return next((model for model in mine if model.artefact_sha256 not in lost), None)


def _scores(
    context: WorkerContext, known: _Known, pairs: Sequence[tuple[Clip, Clip]], strategy: Strategy
) -> FloatArray | None:
    """How much every candidate is worth asking; None when the choice is to be uniform."""
    if strategy is Strategy.UNIFORM:
        return None
    members = None
    if known.model is not None:
        segments = dataset.segment_pairs(context.store, pairs)
        members = learning.member_probabilities(context.store.read(known.model.artefact_sha256), segments)
    if strategy is Strategy.CONTESTED:
        return acquisition.contested(_answers_of_others(context, known, pairs), members)
    return None if members is None else acquisition.score(strategy.value, members)


def _answers_of_others(context: WorkerContext, known: _Known, pairs: Sequence[tuple[Clip, Clip]]) -> FloatArray:
    """(U, M) what other people would say about each pair: participants, or the paper's users while there are few."""
    if len(known.others) >= 2:
        segments = dataset.segment_pairs(context.store, pairs)
        models = (context.store.read(model.artefact_sha256) for model in known.others)
        return np.array([learning.probability_right(model, segments) for model in models], np.float64)
    task = registry.task(known.study.task)
    returns = {clip.id: _stand_ins(context, task, clip) for pair in pairs for clip in pair}
    return acquisition.expected_answers(np.array([returns[right.id] - returns[left.id] for left, right in pairs]).T)


def _stretches(store: ArtefactStore, pair: tuple[Clip, Clip]) -> tuple[Stretch, Stretch]:
    left, right = pair
    return dataset.stretch(store, left), dataset.stretch(store, right)


def _stand_ins(context: WorkerContext, task: Task, clip: Clip) -> FloatArray:
    """(U,) what others would feel about what a clip shows: the paper's users by their own costs, or, in a laboratory's
    task, people who each mind one of its signals."""
    shown, steps = dataset.shown(context.store, clip), slice(clip.first_step, clip.first_step + clip.step_count)
    costs, signals = shown.costs[steps], shown.signals[steps]
    if task.is_a_labs:
        minded: FloatArray = -signals.sum(axis=0, dtype=np.float64)
        return minded
    return np.array([preference_rewards(task, costs, signals, OMEGA[user]).sum() for user in User])


class _Choosing:
    """Gives places of a participant's plan their clips. No pair of clips is chosen twice, on whichever side."""

    def __init__(self, context: WorkerContext, known: _Known) -> None:
        self._context, self._known = context, known
        self._participant, self._settings, self._clips = known.participant, known.study.settings, known.clips
        self._sides = dict(known.sides)
        self._used = {frozenset(sides) for sides in self._sides.values()}

    def rows(self) -> list[dict[str, Any]]:
        """As many of the free places as can be filled now, as columns of queries."""
        slots = self._known.free
        own = {slot.ordinal: self._own(slot) for slot in slots if slot.purpose not in _CHOSEN_LATER}
        preferences = iter(self._preferences([slot.ordinal for slot in slots if slot.purpose is Purpose.PREFERENCE]))
        rows = []
        for slot in slots:
            if slot.purpose is Purpose.PREFERENCE:
                row = next(preferences, None)
            elif slot.purpose is Purpose.REPEAT:
                row = self._again(self._askable(slot), slot.swapped, REPEAT)
            else:
                row = own[slot.ordinal]
            if row is None and slot.purpose is Purpose.CATCH:
                continue  # made as soon as the pool has one
            if row is None:
                break
            rows.append({"purpose": slot.purpose, "ordinal": slot.ordinal, **row})
            self._sides[slot.ordinal] = row["left_clip_id"], row["right_clip_id"]
        return rows

    def _own(self, slot: Slot) -> dict[str, Any] | None:
        """Practice, introduction and catch pairs: few candidates, so they choose before the labels on clips do."""
        rng = np.random.default_rng([self._participant.seed, slot.ordinal])
        if slot.purpose is Purpose.PRACTICE:
            row = self._practice(rng)
        else:
            row = self._catch(slot, rng) if slot.purpose is Purpose.CATCH else self._introduction(rng)
        if row is not None:
            self._used.add(frozenset((row["left_clip_id"], row["right_clip_id"])))
        return row

    def _preferences(self, ordinals: list[int]) -> list[dict[str, Any]]:
        """Chosen together, so that the sides are balanced."""
        pairs = self._unused(self._clips) if ordinals else []
        if not pairs:
            return []
        settings = self._settings
        made = self._unused(self._known.made)
        scores = _scores(self._context, self._known, pairs, settings.strategy)
        choice = acquisition.choose(
            len(ordinals),
            len(pairs),
            np.random.default_rng([self._participant.seed, ordinals[0]]),
            rule="uniform" if scores is None else cast(acquisition.Strategy, settings.strategy.value),
            scores=scores,
            random_share=settings.random_share,
            made=len(made),
            following_share=settings.following_share,
        )
        how = np.select([choice.following, choice.at_random], [FOLLOWING, Strategy.UNIFORM.value], settings.strategy)
        drawn = zip(choice.indices, choice.swapped, choice.propensities, how, strict=True)
        return [
            _columns((*pairs, *made)[index], bool(swapped), str(strategy), float(propensity))
            for index, swapped, propensity, strategy in drawn
        ]

    def _introduction(self, rng: np.random.Generator) -> dict[str, Any] | None:
        """A pair of whole trajectories."""
        return self._one_of(self._unused(self._known.whole_clips), Strategy.UNIFORM, rng)

    def _practice(self, rng: np.random.Generator) -> dict[str, Any] | None:
        """Two very different clips: the keys are to be learned, not to be pondered over."""
        pairs = self._unused(self._clips)
        if not pairs:
            return None
        rows = query_plan.very_different(dataset.segment_pairs(self._context.store, pairs))
        return self._one_of([pairs[row] for row in rows], PRACTICE, rng)

    def _catch(self, slot: Slot, rng: np.random.Generator) -> dict[str, Any] | None:
        """A pair with an obvious answer; where the pool has none, an earlier pair again: nothing is invented.

        While the pool is growing the place stays free, unless there is nothing else to go on with.
        """
        store = self._context.store
        names = dataset.signal_names(self._known.study)
        candidates = [
            (pair, answer)
            for pair in self._unused(self._clips)
            if (answer := query_plan.obvious_answer(*_stretches(store, pair), names)) is not None
        ]
        if not candidates and self._may_yet_come():
            return None
        if not candidates:
            log.warning("participant %d: no pair with an obvious answer in the pool", self._participant.id)
            asked = self._labels_before(slot.ordinal)
            return self._again(asked[int(rng.integers(len(asked)))] if asked else None, False, NO_OBVIOUS_PAIR)
        pair, answer = candidates[int(rng.integers(len(candidates)))]
        swapped = bool(rng.integers(2))
        expected = answer if not swapped else {"left": "right", "right": "left"}[answer]
        return _columns(pair, swapped, OBVIOUS, 1.0 / len(candidates)) | {"expected": expected}

    def _may_yet_come(self) -> bool:
        wanted = self._settings.pool_scenarios * self._settings.behaviours_per_scenario
        growing = self._known.study.material is None and len(self._clips) < wanted
        return growing and self._known.has_unanswered

    def _labels_before(self, ordinal: int) -> list[int]:
        """Places of earlier labels on clips that no repeat has asked again, the newest few left out where possible."""
        slots = query_plan.plan(self._settings, self._participant.seed)
        again = {slot.repeats_ordinal for slot in slots}
        known = [slot for slot in slots[: ordinal - 1] if slot.ordinal in self._sides]
        labels = [slot.ordinal for slot in known if slot.purpose is Purpose.PREFERENCE]
        fresh = [each for each in labels if each not in again and ordinal - each >= query_plan.REPEAT_DISTANCE]
        return fresh or labels[:1]

    def _askable(self, slot: Slot) -> int | None:
        """The place of the pair that is to be asked again; of another one if that cannot be shown any more."""
        if not self._known.has_lost:
            return slot.repeats_ordinal
        known = {clip.id for clip in self._clips}
        places = (slot.repeats_ordinal, *self._labels_before(slot.ordinal))
        return next((place for place in places if place in self._sides and known.issuperset(self._sides[place])), None)

    def _again(self, ordinal: int | None, swapped: bool, strategy: str) -> dict[str, Any] | None:
        if ordinal is None or ordinal not in self._sides:
            return None
        left, right = reversed(self._sides[ordinal]) if swapped else self._sides[ordinal]
        return {
            "left_clip_id": left,
            "right_clip_id": right,
            "purpose": Purpose.REPEAT,
            "repeats_ordinal": ordinal,
            "strategy": strategy,
            "propensity": 1.0,
        }

    def _one_of(
        self, pairs: Sequence[tuple[Clip, Clip]], strategy: str, rng: np.random.Generator
    ) -> dict[str, Any] | None:
        if not pairs:
            return None
        index, swapped = int(rng.integers(len(pairs))), bool(rng.integers(2))
        return _columns(pairs[index], swapped, strategy, 1.0 / len(pairs))

    def _unused(self, clips: Sequence[Clip]) -> list[tuple[Clip, Clip]]:
        """Pairs of clips of one scenario that this participant has not been given yet."""
        return [pair for pair in dataset.matched_pairs(clips) if frozenset(clip.id for clip in pair) not in self._used]


def _columns(pair: tuple[Clip, Clip], swapped: bool, strategy: str, propensity: float) -> dict[str, Any]:
    left, right = reversed(pair) if swapped else pair
    return {
        "left_clip_id": left.id,
        "right_clip_id": right.id,
        "strategy": strategy,
        "propensity": propensity,
    }
