"""Scripted people whose preference is no sum of measured signals, or who do not answer by it.

The structured reward adds up weighted signals (docs/method.md, section 2). Here are people of whom that is not true:
what they mind is the worst moment, or being served neither early nor late; their weights depend on how near the robot
is, or on how they sit; or they drift, tire, guess, or choose by whatever strikes them.

Wishes are increments over steps, so that their sum up to any step is what the episode so far is worth: a clip, which
begins where its episode does, is judged like a whole episode. A worst moment, for example, costs as it exceeds all
moments before.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from worker.domain.responses import Response
from worker.domain.spaces import CONTROL_STEP_S
from worker.domain.task import Task
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.teachers import OMEGA, Manner, ScriptedTeacher, Taste, User
from worker.sim.costs import cost_items, preference_rewards

ARRIVED_M = 0.1
"""Nearer than this the robot has arrived."""
ON_TIME_S: Mapping[str, float] = {"feeding": 3.7, "drinking": 2.4, "scratching": 1.9}
"""When it should: the median of a pool's behaviours."""
LOOKS: Mapping[str, tuple[int, float]] = {"feeding": (1, 0.0), "drinking": (1, 0.0), "scratching": (2, 0.3)}
"""How mouth or itch looks at the start: a component of its unit vector, and what half of the scenes exceed."""
NEAR_M, FAR_M = 0.05, 0.30
"""Weights change between these distances."""

Answering = Callable[[npt.NDArray[np.int64], int, np.random.Generator], Sequence[Response]]
"""(N, 2) clips of the pool, left and right, and how many answers were given before -> N answers"""
Wishes = Callable[[Task, Trajectory], FloatArray]
"""(T,) what every step adds to what the episode is worth"""


def as_type(user: User, share: float = 1.0) -> Wishes:
    """So much of what one of the paper's types wants, with calibrated costs: a sum of signals."""
    return lambda task, episode: share * preference_rewards(task, episode.costs, episode.signals, OMEGA[user])


def of_taste(taste: Taste) -> Wishes:
    """What somebody wants who is linear, by the weights of their items and signals."""
    return lambda task, seen: preference_rewards(
        task, seen.costs, seen.signals, taste.omega, per_signal=taste.per_signal
    )


def worst_moment(task: Task, episode: Trajectory) -> FloatArray:
    """The highest speed and the hardest touch of all, whatever else happens; a quarter of the neutral type."""
    speed, *forces = (_column(episode, each) for each in ("speed_m_s", "force_at_target_n", "force_away_n"))
    worst = 30.0 * np.maximum.accumulate(speed) + 0.5 * np.maximum.accumulate(forces[0] + forces[1])
    return as_type(User.NEUTRAL, 0.25)(task, episode) - np.diff(worst, prepend=0.0)


def on_time(task: Task, episode: Trajectory) -> FloatArray:
    """Four for every second that it arrives before or after ON_TIME_S; a quarter of the neutral type."""
    seconds = CONTROL_STEP_S * np.arange(1, len(episode) + 1)
    arrived = np.maximum.accumulate(_column(episode, "distance_m") < ARRIVED_M)
    arrives = arrived & ~np.concatenate([[False], arrived[:-1]])
    wished = ON_TIME_S[task.name]
    late = np.where(~arrived & (seconds > wished), CONTROL_STEP_S, 0.0)
    early = np.where(arrives, np.maximum(wished - seconds, 0.0), 0.0)
    return as_type(User.NEUTRAL, 0.25)(task, episode) - 4.0 * (late + early)


def nearer_by_nearer(task: Task, episode: Trajectory) -> FloatArray:
    """Impatient and fond of turning and of a raised tool while the robot is far; cautious and averse to both near."""
    far = np.clip((_column(episode, "distance_m") - NEAR_M) / (FAR_M - NEAR_M), 0.0, 1.0)
    liked = 3.0 * _column(episode, "turn_speed_squared_rad2_s2") + 0.5 * _column(episode, "tilt_rad")
    impatient, cautious = (as_type(each)(task, episode) for each in (User.IMPATIENT, User.CAUTIOUS))
    return far * (0.5 * impatient + liked) + (1.0 - far) * (0.5 * cautious - 2.0 * liked)


def by_pose(task: Task, episode: Trajectory) -> FloatArray:
    """Impatient when mouth or itch looks one way at the start (fed: to the robot's left), cautious otherwise."""
    outward = episode.observations[0, task.observation.slice_of("target_outward")]
    component, middle = LOOKS[task.name]
    return as_type(User.IMPATIENT if outward[component] > middle else User.CAUTIOUS)(task, episode)


def tolerant(task: Task, episode: Trajectory) -> FloatArray:
    """Minds time, motion and touch only as far as each is more than a tolerable amount of the whole."""
    amounts = {"speed_squared_m2_s2": (1.1, 8.0), "undelivered": (42.0, 0.4), "force_at_target_n": (4.0, 0.2)}
    beyond = [
        price * np.maximum(np.cumsum(_column(episode, name)) - most, 0.0) for name, (most, price) in amounts.items()
    ]
    excess: FloatArray = np.diff(np.sum(beyond, axis=0), prepend=0.0)
    return as_type(User.NEUTRAL, 0.1)(task, episode) - excess


def _column(episode: Trajectory, name: str) -> FloatArray:
    found: FloatArray = episode.signals[:, SIGNALS.index(name)].astype(np.float64)
    return found


@dataclass(frozen=True)
class Person:
    """Somebody whose wishes, or whose answers, are not what the structured reward takes them for."""

    name: str
    wishes: Wishes
    """what they truly want; if it changes, at the last answer"""
    wished_first: Wishes | None = None
    """what they wanted at the first answer; None: the same"""
    manner: Manner = field(default_factory=Manner)
    manner_last: Manner | None = None
    """how they err at the last answer; None: as at the first"""
    by_what_strikes: bool = False
    """Each pair is decided by the one of the six costs that differs most: answers then go round in circles."""

    def manner_at(self, share: float) -> Manner:
        """How they err after this share of all answers."""
        if self.manner_last is None:
            return self.manner
        first, last = self.manner.mistakes, self.manner_last.mistakes
        return Manner(mistakes=first + share * (last - first))

    def answering(
        self, task: Task, pool: Sequence[Trajectory], pairs: npt.NDArray[np.int64], clip_steps: int, answers: int
    ) -> Answering:
        """How they answer pairs of clips of this pool, ``answers`` in all; ``pairs`` (M, 2): all that may be asked."""
        if self.by_what_strikes:
            return _struck(task, pool, pairs, clip_steps)
        last = np.array([self.wishes(task, each)[:clip_steps] for each in pool])
        began = self.wished_first or self.wishes
        first = last if began is self.wishes else np.array([began(task, each)[:clip_steps] for each in pool])

        def answer(rows: npt.NDArray[np.int64], before: int, rng: np.random.Generator) -> list[Response]:
            said: list[Response] = []
            for place, (left, right) in enumerate(rows, before):
                share = place / max(1, answers - 1)
                wanted = share * last + (1.0 - share) * first
                teacher = ScriptedTeacher.calibrated(self.manner_at(share), wanted[pairs])
                said.append(teacher.answer(wanted[left], wanted[right], rng))
            return said

        return answer


def _struck(task: Task, pool: Sequence[Trajectory], pairs: npt.NDArray[np.int64], clip_steps: int) -> Answering:
    """Less of the one item that differs most is better, in units of how much each usually differs."""
    items = np.array(
        [cost_items(task, each.costs[:clip_steps], each.signals[:clip_steps]).sum(axis=0) for each in pool]
    )
    differences = items[pairs[:, 1]] - items[pairs[:, 0]]
    usual = np.maximum(np.sqrt((differences**2).mean(axis=0)), 1e-9)

    def answer(rows: npt.NDArray[np.int64], before: int, rng: np.random.Generator) -> list[Response]:
        striking = (items[rows[:, 1]] - items[rows[:, 0]]) / usual
        most = np.abs(striking).argmax(axis=1)
        better_right = striking[np.arange(len(rows)), most] < 0.0
        errs = rng.random(len(rows)) < Manner().mistakes
        return ["right" if right else "left" for right in better_right ^ errs]

    return answer


PEOPLE: Mapping[str, Person] = {
    person.name: person
    for person in (
        Person("worst_moment", worst_moment),
        Person("on_time", on_time),
        Person("nearer_by_nearer", nearer_by_nearer),
        Person("by_pose", by_pose),
        Person("tolerant", tolerant),
        Person("drifting", as_type(User.CAUTIOUS), wished_first=as_type(User.IMPATIENT)),
        Person("tiring", as_type(User.CAUTIOUS), manner_last=Manner(mistakes=0.4)),
        Person("guessing", as_type(User.CAUTIOUS), manner=Manner(mistakes=0.25)),
        Person("struck", as_type(User.NEUTRAL), by_what_strikes=True),
    )
}
"""Nobody of these is in the tables of docs/results/three_rounds."""
EVERYBODY: Mapping[str, Person] = {**PEOPLE, **{user.value: Person(user.value, as_type(user)) for user in User}}
"""and the paper's three types"""
