"""A loop tells when a robot answers to actions otherwise than in its filter's tests, and seldom when it does not."""

from collections.abc import Callable

import numpy as np
import pytest

from worker.ml.export.forward_model import FIRST_STEPS, LARGEST, DynamicsMonitor, ForwardModel

STEPS = 40
WIDTHS = np.array([4.0, 4.0, 4.0, 4.0, 20.0, 1.0])
"""of position, velocity, a force that is felt now and then, and something that never changes"""
NAMES = ["position_m", "position_m", "velocity_m_s", "velocity_m_s", "force_n", "target_m"]
Episode = tuple[np.ndarray, np.ndarray]


def episode(rng: np.random.Generator, late: int = 0, noise: float = 0.0, touches: float = 0.05) -> Episode:
    """A point that is pushed about, whose friction grows with its speed: no linear model has it quite."""
    asked = np.clip(np.cumsum(rng.normal(0.0, 0.3, (STEPS, 2)), axis=0), -1.0, 1.0)
    done = np.vstack([np.zeros((late, 2)), asked])[:STEPS]
    position, velocity, seen = rng.normal(0.0, 0.5, 2), np.zeros(2), []
    for action in [*done, np.zeros(2)]:
        force = rng.exponential(3.0) if rng.random() < touches else 0.0
        seen.append([*position, *velocity, force, 0.4])
        velocity = velocity + 0.1 * (action - 0.3 * velocity * np.linalg.norm(velocity))
        position = position + 0.1 * velocity
    observations = np.array(seen)
    return observations + noise * WIDTHS * rng.standard_normal(observations.shape), asked


def first_told(model: ForwardModel, some: Episode) -> tuple[int, set[str]]:
    """After how many steps, and what; 0: never."""
    observations, actions = some
    monitor = DynamicsMonitor(model, NAMES, STEPS)
    for step in range(len(actions)):
        monitor.step(observations[step], actions[step], observations[step + 1])
        if notes := monitor.notes():
            return step + 1, set(notes)
    return 0, set()


@pytest.mark.parametrize("count", [40, 100])
def test_one_in_a_hundred_usual_episodes_is_told(count: int) -> None:
    told = []
    for world in range(10):
        rng = np.random.default_rng([world, count])
        model = ForwardModel.learned([episode(rng) for _ in range(count)], WIDTHS)
        assert model is not None
        told += [first_told(model, episode(rng))[0] > 0 for _ in range(60)]
    assert np.mean(told) < 3.0 / count, "the largest of n is exceeded by one in n + 1, and there are two limits"


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (lambda rng: episode(rng, late=1), "late"),
        (lambda rng: episode(rng, late=2), "late"),
        (lambda rng: episode(rng, late=1, noise=0.0005), "late"),
        (lambda rng: episode(rng, noise=0.005), "dynamics"),
    ],
    ids=["late", "later", "late and noise", "noise"],
)
def test_late_actions_and_noise_are_told_soon(other: Callable[[np.random.Generator], Episode], said: str) -> None:
    rng = np.random.default_rng(0)
    model = ForwardModel.learned([episode(rng) for _ in range(100)], WIDTHS)
    assert model is not None
    model = ForwardModel.from_bytes(model.to_bytes())
    steps, told = zip(*(first_told(model, other(rng)) for _ in range(50)), strict=True)
    assert np.mean([what == {said} for what in told]) > 0.95
    assert np.median(steps) < 2 * FIRST_STEPS


@pytest.mark.parametrize("touches", [0.0, 0.2])
def test_touches_that_are_rarer_or_more_frequent_are_not_told(touches: float) -> None:
    rng = np.random.default_rng(0)
    model = ForwardModel.learned([episode(rng) for _ in range(100)], WIDTHS)
    assert model is not None
    assert np.mean([first_told(model, episode(rng, touches=touches))[0] > 0 for _ in range(50)]) < 0.05


def test_what_is_furthest_off_is_named_and_a_new_episode_begins_anew() -> None:
    rng = np.random.default_rng(0)
    model = ForwardModel.learned([episode(rng) for _ in range(100)], WIDTHS)
    assert model is not None
    monitor = DynamicsMonitor(model, NAMES, STEPS)
    observations, actions = episode(rng)
    observations[:, 5] += rng.normal(0.0, 0.5, len(observations))
    for step in range(FIRST_STEPS + 1):
        assert monitor.notes() == {}
        monitor.step(observations[step], actions[step], observations[step + 1])
    assert "most of all target_m" in monitor.notes()["dynamics"]
    monitor.begin()
    assert monitor.notes() == {}


def test_nothing_is_learned_of_pictures() -> None:
    rng = np.random.default_rng(0)
    some = [(rng.random((STEPS + 1, LARGEST)), rng.random((STEPS, 2))) for _ in range(40)]
    assert ForwardModel.learned(some, np.ones(LARGEST)) is None


def test_nothing_is_learned_from_too_few_steps() -> None:
    rng = np.random.default_rng(0)
    assert ForwardModel.learned([], WIDTHS) is None
    assert ForwardModel.learned([episode(rng)], WIDTHS) is None
    for steps in (0, 1, 3):
        some = [(seen[: steps + 1], done[:steps]) for seen, done in map(episode, [rng] * 4)]
        assert ForwardModel.learned(some, WIDTHS) is None
    some = [(seen[:2], done[:1]) for seen, done in map(episode, [rng] * 40)]
    assert ForwardModel.learned(some, WIDTHS) is None, "nothing follows in an episode of one step"
