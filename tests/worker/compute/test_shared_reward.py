"""An average of what people want counts everybody alike, and a type of user wants what the paper says."""

import numpy as np
import pytest

from worker.compute import shared_reward
from worker.compute.simulation import reference_rollouts
from worker.domain.trajectory import SIGNALS
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import StructuredReward
from worker.ml.rewards.signal_scale import SignalScale
from worker.ml.teachers import OMEGA, User
from worker.sim.costs import preference_rewards
from worker.tasks import registry

TASK = "feeding"
SCALE = SignalScale(np.ones(len(SIGNALS)), np.full(len(SIGNALS), -1e6), np.full(len(SIGNALS), 1e6))
SPEED, DISTANCE = SIGNALS.index("speed_squared_m2_s2"), SIGNALS.index("distance_m")


def wish(signal: int, strength: float) -> bytes:
    weights = np.zeros((8, len(SIGNALS)))
    weights[:, signal] = -strength
    return StructuredReward(weights).to_bytes()


@pytest.mark.slow
def test_whoever_is_more_decided_does_not_count_for_more() -> None:
    calm, loud = (
        load_reward_model(shared_reward.of_people(TASK, [wish(SPEED, strength), wish(DISTANCE, 1.0)], SCALE))
        for strength in (1.0, 50.0)
    )
    np.testing.assert_allclose(calm.signal_weights(()), loud.signal_weights(()), rtol=1e-4, atol=1e-6)
    assert np.count_nonzero(calm.signal_weights(())) == 2


@pytest.mark.slow
@pytest.mark.parametrize("user", list(User))
def test_a_type_of_user_values_episodes_as_its_omega_does(user: User) -> None:
    model = load_reward_model(shared_reward.of_types(TASK, [user.value], SCALE))
    episodes = [each for each in reference_rollouts(TASK) if each.success]
    wanted = [preference_rewards(registry.task(TASK), each.costs, each.signals, OMEGA[user]).sum() for each in episodes]
    # Steps are cut at eight standard deviations, which the true reward is not.
    assert np.corrcoef(model.returns(episodes), wanted)[0, 1] > 0.9
