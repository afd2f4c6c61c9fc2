"""A scripted participant of a rehearsal: knows what really happened in each clip, and answers and rates by taste.

What a robot "really" did they look up in the database, which a person does by watching. Of a standard questionnaire
about a robot every item is answered like a rating of it, and so is the question which robot was made for them; what
has nothing to do with robots is answered at random.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from sqlalchemy import select
from sqlalchemy.orm import Session, joinedload

from app.db import Database
from app.domain.clips import Clip
from app.domain.evaluation import HeadToHead, Trial
from app.domain.models import ModelKind
from app.domain.preferences import Purpose, Query, Response
from app.domain.protocol import MADE_FOR_YOU
from app.domain.studies import Study
from app.installed_tasks import hints, qualities
from app.questionnaires import library
from app.services.evaluation import self_setting
from app.storage import ArtefactStore
from worker.compute import simulation
from worker.compute.behaviours import Behaviour
from worker.domain.scenarios import of_preview
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.jobs.learning import dataset
from worker.jobs.runtime import records
from worker.ml.rewards.hint_directions import direction
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.scripted_ratings import RatingManner, ScriptedRater
from worker.ml.teachers import LabTaste, Manner, ScriptedTeacher, Taste, segment_returns, speaks_most, truest
from worker.rehearsal.browser import Offered
from worker.sim.costs import preference_rewards, signal_weights
from worker.tasks import registry

CALIBRATION_PAIRS, FEWEST_PAIRS = 200, 15
"""By so many pairs at most it is told which are alike, and by fewer than the second not at all."""
AGES = (18, 80)
INDIFFERENT = 0.5
"""What a questionnaire is answered by that is about no robot, as a share of its range."""
Rows = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Rated:
    """What was said about one trial, and what is true about it."""

    method: str
    satisfaction: int
    personalisation: int
    true_share: float
    """Share of the pool's episodes that suit this user less than the one shown."""
    success: bool


@dataclass(frozen=True)
class Insight:
    """How often a participant's reward model names the clip that truly suits them better, over the study's pool."""

    same_scenario: float
    """Pairs of one scenario: most of them were asked, with mistakes."""
    other_scenarios: float
    """Pairs of different scenarios, none of which was ever asked."""


class ScriptedPerson:
    """A user of one taste in one study."""

    def __init__(
        self, database: Database, store: ArtefactStore, study: Study, taste: Taste, manner: Manner, seed: int
    ) -> None:
        self._database, self._store, self._study_id = database, store, study.id
        self._task = registry.task(study.task)
        self._taste, self._manner = taste, manner
        self._rng = np.random.default_rng(seed)
        self._teacher: ScriptedTeacher | None = None
        self._calibrated_on = 0
        """clips"""
        self._rater: ScriptedRater | None = None
        self.rated: list[Rated] = []
        """every trial, in the order in which it was rated"""
        self._robots: dict[str, list[float]] = defaultdict(list)
        """by letter, how well each of its trials suits this user"""

    def answer(self, query_id: int) -> str:
        """What this user says about the query; a catch pair has an obvious answer, which is missed now and then."""
        with self._database.reading() as session:
            query = session.scalars(
                select(Query).where(Query.id == query_id).options(*dataset.CLIPS_AND_ROLLOUTS)
            ).one()
            if query.purpose == Purpose.CATCH and query.expected is not None:
                missed = self._rng.random() < self._manner.mistakes
                other = {Response.LEFT: Response.RIGHT, Response.RIGHT: Response.LEFT}
                return str((other[Response(query.expected)] if missed else Response(query.expected)).value)
            left, right = (self._rewards(clip) for clip in (query.left_clip, query.right_clip))
            teacher = self._calibrated(session)
        return teacher.answer(left, right, self._rng)

    def name_quality(self, query_id: int, answer: str) -> str:
        """What speaks most for the clip this user has chosen, by their true weights; nothing where they chose none."""
        if answer not in (Response.LEFT, Response.RIGHT):
            return ""
        with self._database.reading() as session:
            query = session.get_one(Query, query_id, options=dataset.CLIPS_AND_ROLLOUTS)
            pair = dataset.segment_pairs(self._store, [(query.left_clip, query.right_clip)])
        gains = self._weights() * pair.signal_differences()[0] * (1.0 if answer == Response.RIGHT else -1.0)
        named = qualities.of_task(self._task.name)
        columns = {name: [self._task.signals.index(each) for each in named[name]] for name in named}
        return speaks_most(gains, columns)

    def hint(self, names: Sequence[str]) -> Sequence[str]:
        """Those that say most of what this user wants, by their true weights and how much the study's clips differ."""
        known, columns = hints.of_task(self._task.name), self._task.signals
        with self._database.reading() as session:
            scale = dataset.signal_scale(session, self._store, self._study_id)
        directions = {name: direction(columns, known[name]) for name in names}
        return truest(directions, self._weights() * scale.spread, hints.MOST)

    def _weights(self) -> FloatArray:
        """(S,) of the task's signals, above 0: wanted."""
        taste, task = self._taste, self._task
        if isinstance(taste, LabTaste):
            return taste.signal_weights(task.signals)
        return signal_weights(task, taste.omega, taste.per_signal)

    def rate(self, trial_id: int) -> tuple[int, int]:
        """Satisfaction and personalisation; ``rated`` keeps which method it really was."""
        with self._database.reading() as session:
            trial = session.scalars(select(Trial).where(Trial.id == trial_id).options(joinedload(Trial.film))).one()
            if trial.film is None:
                raise ValueError(f"Trial {trial_id} has no film.")
            watched = dataset.stored_trajectory(self._store, trial.film.trajectory_sha256)
        value, rater = float(self._true_rewards(watched).sum()), self._calibrated_rater()
        given = rater.rate(value, watched.success)
        self.rated.append(Rated(trial.film.method, *given, rater.share(value), bool(watched.success)))
        self._robots[trial.letter].append(rater.share(value))
        return given

    def describe(self, instrument: str, letter: str | None) -> Mapping[str, str]:
        """A point for every item, higher for a robot that suits this user better; reversed items the other way."""
        known, rater = library.every()[instrument], self._calibrated_rater()
        points = known.answers.points
        good = INDIFFERENT if letter is None else float(np.mean(self._robots[letter]))
        places = {item.name: rater.place(good, len(points)) for item in known.items}
        return {name: points[-1 - at if name in known.reversed_items else at] for name, at in places.items()}

    def reply(self, questions: Mapping[str, Offered]) -> Mapping[str, str]:
        """Some answer to everything; which robot was made for them: the one that suits them best."""
        said = {name: self._some(offered) for name, offered in questions.items()}
        if MADE_FOR_YOU in questions:
            said[MADE_FOR_YOU] = max(self._robots, key=lambda letter: float(np.mean(self._robots[letter])))
        return said

    def _some(self, offered: Offered) -> str:
        if offered.choices:
            return offered.choices[int(self._rng.integers(len(offered.choices)))]
        return str(self._rng.integers(*AGES)) if offered.kind == "number" else "Said by a program."

    def _calibrated_rater(self) -> ScriptedRater:
        if self._rater is None:
            with self._database.reading() as session:
                episodes = [dataset.shown(self._store, clip) for clip in dataset.pool_clips(session, self._study_id)]
            seen = np.array([self._true_rewards(each).sum() for each in episodes])
            self._rater = ScriptedRater(seen, RatingManner(), self._rng)
        return self._rater

    def prefer(self, head_to_head_id: int) -> str:
        """Which of two robots this user would rather have: the one whose whole episode suits them better."""
        with self._database.reading() as session:
            asked = session.get_one(HeadToHead, head_to_head_id)
            films = [
                session.get_one(Trial, each, options=[joinedload(Trial.film)]).film
                for each in (asked.left_trial_id, asked.right_trial_id)
            ]
            values = [
                float(self._true_rewards(dataset.stored_trajectory(self._store, film.trajectory_sha256)).sum())
                for film in films
                if film is not None
            ]
        return "left" if values[0] > values[1] or (values[0] == values[1] and self._rng.random() < 0.5) else "right"

    def set_robot(self) -> dict[str, int]:
        """Where this user leaves the sliders: each is moved once, and left where the film suits them best."""
        with self._database.reading() as session:
            study = session.get_one(Study, self._study_id)
        sliders, scenario = self_setting.sliders_of(study), of_preview(study.seed)
        stops = {slider.name: 0 for slider in sliders}

        def suits(moved: dict[str, int]) -> float:
            act = simulation.act_as(study.task, Behaviour(self_setting.mode_at(sliders, moved)))
            episode = simulation.run_episode(study.task, act, scenario)
            return float(self._true_rewards(episode).sum())

        for slider in sliders:
            tried = [stops | {slider.name: stop} for stop in range(slider.lowest, slider.highest + 1, 2)]
            stops = max(tried, key=suits)
        return stops

    def insight(self, participant_id: int) -> Insight | None:
        """What the newest reward model of this participant has understood; None while there is none."""
        with self._database.reading() as session:
            newest = records.newest_model(session, participant_id, ModelKind.REWARD)
            clips = dataset.pool_clips(session, self._study_id)
            if newest is None:
                return None
            model = load_reward_model(self._store.read(newest.artefact_sha256))
        scenarios = np.array([clip.rollout.scenario for clip in clips])
        first, second = np.triu_indices(len(clips), 1)
        better = self._second_is_better(model, clips, first, second)
        same = scenarios[first] == scenarios[second]
        return Insight(_share(better[same]), _share(better[~same]))

    def _second_is_better(
        self, model: RewardModel, clips: Sequence[Clip], first: Rows, second: Rows
    ) -> npt.NDArray[np.bool_]:
        """(N, 2): whether the second clip of each pair is better, in truth and to the model."""
        values = np.array([segment_returns(self._rewards(clip), self._manner.myopia) for clip in clips])
        pairs = [(clips[left], clips[right]) for left, right in zip(first, second, strict=True)]
        foreseen = model.probability_right(dataset.segment_pairs(self._store, pairs))
        return np.stack([values[second] > values[first], foreseen > 0.5], axis=1)

    def _calibrated(self, session: Session) -> ScriptedTeacher:
        """What counts as equal by the clips there are: anew while more are filmed, and nothing while they are few."""
        clips = dataset.pool_clips(session, self._study_id)
        if self._teacher is None or len(clips) != self._calibrated_on:
            pairs = dataset.matched_pairs(clips)[:CALIBRATION_PAIRS]
            rewards = np.array([[self._rewards(clip) for clip in pair] for pair in pairs])
            manner = self._manner if len(pairs) >= FEWEST_PAIRS else replace(self._manner, equal_share=0.0)
            self._teacher, self._calibrated_on = ScriptedTeacher.calibrated(manner, rewards), len(clips)
        return self._teacher

    def _rewards(self, clip: Clip) -> FloatArray:
        steps = slice(clip.first_step, clip.first_step + clip.step_count)
        return self._true_rewards(dataset.shown(self._store, clip))[steps]

    def _true_rewards(self, shown: Trajectory) -> FloatArray:
        """r^H of every step."""
        taste = self._taste
        if isinstance(taste, LabTaste):
            return taste.step_rewards(shown.signals, self._task.signals)
        rewards = preference_rewards(
            self._task, shown.costs, shown.signals, taste.omega, "calibrated", taste.per_signal
        )
        return np.asarray(rewards, np.float64)


def _share(judged: npt.NDArray[np.bool_]) -> float:
    """Of (N, 2) judgements, how many agree; not a number when there are none."""
    return float((judged[:, 0] == judged[:, 1]).mean()) if len(judged) else float("nan")
