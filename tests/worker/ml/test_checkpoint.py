"""A training that is killed goes on where it was, and one that nobody wants any more stops."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.worker import invented
from tests.worker.ml.test_methods import POLICY, REWARD, World
from worker.ml.methods import prefft
from worker.ml.methods.prefft import FineTuning
from worker.ml.policies import checkpoint
from worker.ml.policies.checkpoint import Abandoned, Checkpoint, Paused
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement import preference_rl

CONFIG = FineTuning(steps=480, warm_up_steps=120, critic_first_updates=20, cloning_steps=50, tie_weight=1.0)
DIES_AT = 300


class Killed(BaseException):
    """What happens to a process that is killed."""


class MortalWorld(World):
    """A world in which somebody pulls the plug after so many steps of all environments together."""

    left = DIES_AT

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium."""
        type(self).left -= 1
        if type(self).left < 0:
            raise Killed
        return super().step(action)


class CountedWorld(World):
    """A world that counts the steps of all environments together."""

    steps = 0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium."""
        type(self).steps += 1
        return super().step(action)


def tuned(world: type[World], kept: Checkpoint | None) -> GaussianPolicy:
    reward = preference_rl.learned(REWARD)
    return prefft.fine_tune(world, POLICY, reward, invented.TASK.observation, CONFIG, 0, kept)


def test_a_killed_training_goes_on_and_makes_only_the_missing_steps(tmp_path: Path) -> None:
    with pytest.raises(Killed):
        tuned(MortalWorld, Checkpoint(tmp_path, every_s=0.0))
    policy = tuned(CountedWorld, Checkpoint(tmp_path, every_s=0.0))
    assert CONFIG.steps - DIES_AT <= CountedWorld.steps <= CONFIG.steps - DIES_AT + 2 * CONFIG.environments
    seen = invented.observations(100, np.random.default_rng(0))
    assert np.abs(policy.mean(seen) - POLICY.mean(seen)).max() > 1e-3
    assert np.isfinite(policy.mean(seen)).all()


def test_a_training_that_is_asked_to_pause_keeps_what_it_has_and_goes_on_later(tmp_path: Path) -> None:
    checkpoint.ask_to_pause(tmp_path)
    with pytest.raises(Paused):
        tuned(World, Checkpoint(tmp_path))
    kept = Checkpoint(tmp_path).read()
    assert kept is not None
    assert kept[1]["steps"] < CONFIG.steps
    checkpoint.begin_again(tmp_path)
    CountedWorld.steps = 0
    tuned(CountedWorld, Checkpoint(tmp_path))
    assert CountedWorld.steps <= CONFIG.steps - kept[1]["steps"] + 2 * CONFIG.environments


def test_keeping_checkpoints_does_not_change_the_result(tmp_path: Path) -> None:
    seen = invented.observations(10, np.random.default_rng(0))
    kept, plain = tuned(World, Checkpoint(tmp_path, every_s=0.0)), tuned(World, None)
    np.testing.assert_array_equal(kept.mean(seen), plain.mean(seen))


def test_how_far_it_is_can_be_read_from_another_process(tmp_path: Path) -> None:
    assert checkpoint.share_done(tmp_path) == 0.0
    Checkpoint(tmp_path).note(0.25)
    assert checkpoint.share_done(tmp_path) == 0.25


def test_a_training_whose_folder_is_gone_stops(tmp_path: Path) -> None:
    folder = tmp_path / "training"
    folder.mkdir()
    kept = Checkpoint(folder, every_s=0.0)
    shutil.rmtree(folder)
    with pytest.raises(Abandoned):
        tuned(World, kept)
