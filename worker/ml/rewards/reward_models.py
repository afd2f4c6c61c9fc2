"""Reward models: an ensemble of functions from a control step to how much this person likes it.

Four kinds behind one interface: linear in measured signals, the same where some have to be predicted
(predicted_reward), a network on (state, action), and the Preference Transformer of preference_transformer, whose reward
also depends on what came before. Training lives in reward_training.
A learned reward has no natural zero or unit (pairs of equal length cannot identify an offset, and the scale grows with
the labels), so every model is normalised to mean 0 and standard deviation 1 per step over rollouts of the reference
policy. Probabilities do have a unit: they are calibrated with a temperature (see calibration).
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
from safetensors.numpy import save

from worker.domain.trajectory import Recorded, Trajectory
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml import dense_network
from worker.ml.rewards.bradley_terry import preference_logits, probability_right
from worker.ml.rewards.segments import LEFT, RIGHT, SegmentPairs
from worker.ml.rewards.signal_scale import usual

UNDONE = "undelivered"
NEVER_WANTED = (UNDONE, "spilled", "spilled_on_person", "high_force_n", "force_away_n", "action_change_squared")
"""Signals that nobody wants more of. Their weights are never positive: that the task gets done takes longer than a
clip, and slow clips, which show less of it done, must not be read as a wish that it is not done. What is rare in clips
or about the same in all, like jerks and touches in passing, would else be liked by chance, and then sought."""
CLIP = 8.0
"""Normalised step rewards are cut here: one broken step must not decide an episode."""
_SMALLEST_SCALE = 1e-6


@dataclass(frozen=True)
class Normalisation:
    """r = (raw - offset) / scale; the same for all members, so that their disagreement survives."""

    offset: float = 0.0
    scale: float = 1.0

    @classmethod
    def over(cls, raw_rewards: npt.NDArray[np.floating]) -> Self:
        """From raw step rewards of reference rollouts, (E, ...)."""
        mean = raw_rewards.mean(axis=0, dtype=np.float64)
        return cls(float(mean.mean()), max(float(mean.std()), _SMALLEST_SCALE))


RAW = Normalisation()
"""Not normalised yet."""


@dataclass(frozen=True, kw_only=True)
class RewardModel(ABC):
    """E members, each a function of a step and, for one kind, of the steps before it.

    Arrays have any leading axes, the same for all arguments; the axis before the last is time, from an episode's start.
    """

    kind: ClassVar[str]
    is_linear: ClassVar[bool] = False
    """whether weights of the summed signals say all that it wants, and so what it wants of modes never tried"""
    normalisation: Normalisation = RAW
    temperature: float = 1.0
    """Log odds are divided by it before they are read as probabilities."""
    undone_column: int | None = None
    """the signal that is above 0 for as long as the task is not done; None: no signal says so"""

    @abstractmethod
    def raw_rewards(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """Unnormalised rewards. (..., S), (..., D), (..., 7) -> (E, ...)"""

    @abstractmethod
    def tensors(self) -> dict[str, Float32Array]:
        """Everything learned, by name."""

    def step_rewards(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """Normalised and clipped rewards. (..., S), (..., D), (..., 7) -> (E, ...)"""
        return self.normalised(self.raw_rewards(signals, observations, actions))

    def normalised(self, raw_rewards: FloatArray) -> FloatArray:
        """In units of the reference policy's steps, and clipped. Any shape."""
        return np.clip(self._scaled(raw_rewards), -CLIP, CLIP)

    def _scaled(self, raw_rewards: FloatArray) -> FloatArray:
        rewards: FloatArray = (raw_rewards - self.normalisation.offset) / self.normalisation.scale
        return rewards

    def episode_rewards(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """Normalised and clipped rewards of one whole episode. (T, S), (T, D), (T, 7) -> (E, T)

        No step of an episode that ends with the task undone is worth more than a usual step of the reference policy:
        clips end before tasks do, so labels hardly say how much more anybody minds not being served at all.
        """
        return self._if_done(self._earned(signals, observations, actions), signals)

    def reaching(self, shown: Sequence[Trajectory]) -> Self:
        """The same, where what these trajectories do counts in episode_rewards(), too; for models with limits."""
        return self

    def _if_done(self, rewards: FloatArray, signals: Float32Array) -> FloatArray:
        undone = self.undone_column is not None and signals[-1, self.undone_column] > 0.0
        return np.minimum(rewards, 0.0) if undone else rewards

    def _earned(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """What the episode is worth whether or not the task gets done, as episode_rewards()."""
        return self.step_rewards(signals, observations, actions)

    def member_rewards(self, trajectory: Trajectory) -> FloatArray:
        """What each step is worth to every member, (E, T): as episode_rewards(), but not clipped nor limited.

        Clipping and limits keep a policy that may do anything from what nobody has seen. What stays near a mode, and
        what is judged, goes by these: else nothing is better for a person than the most of what they like that a clip
        ever showed.
        """
        steps = len(trajectory)
        raw = self.raw_rewards(trajectory.signals, trajectory.observations[:steps], trajectory.actions)
        return self._if_done(self._scaled(raw), trajectory.signals)

    def member_returns(self, trajectories: Sequence[Trajectory]) -> FloatArray:
        """The summed member_rewards() of each trajectory, (E, N)."""
        returns = [self.member_rewards(trajectory).sum(axis=-1) for trajectory in trajectories]
        return np.array(returns).reshape(len(returns), self.size).T

    def returns(self, trajectories: Sequence[Trajectory]) -> FloatArray:
        """Mean over members of what each trajectory is worth, (N,): by what is judged and shown."""
        mean: FloatArray = self.member_returns(trajectories).mean(axis=0)
        return mean

    def rewards_of(self, trajectory: Trajectory) -> FloatArray:
        """Mean over members of episode_rewards(), (T,): what a policy is trained on."""
        steps = len(trajectory)
        rewards = self.episode_rewards(trajectory.signals, trajectory.observations[:steps], trajectory.actions)
        mean: FloatArray = rewards.mean(axis=0)
        return mean

    def logits(self, pairs: SegmentPairs) -> FloatArray:
        """Every member's log odds that right is preferred, (E, N). Not normalised, not clipped, not calibrated."""
        rewards = self.raw_rewards(pairs.signals, pairs.observations, pairs.actions)
        returns = rewards.sum(axis=-1, where=pairs.shown)
        difference: FloatArray = preference_logits(returns[..., LEFT], returns[..., RIGHT])
        return difference

    def member_probabilities(self, pairs: SegmentPairs) -> FloatArray:
        """Calibrated P(right preferred) under every member, (E, N)."""
        return probability_right(self.logits(pairs) / self.temperature)

    def probability_right(self, pairs: SegmentPairs) -> FloatArray:
        """P(right preferred), the mean over members, (N,)."""
        mean: FloatArray = self.member_probabilities(pairs).mean(axis=0)
        return mean

    def normalised_over(self, reference: Sequence[Trajectory]) -> Self:
        """The same model with mean 0 and standard deviation 1 per step over these rollouts."""
        raw = [
            self.raw_rewards(each.signals, each.observations[: len(each)], each.actions).reshape(self.size, -1)
            for each in reference
        ]
        return replace(self, normalisation=Normalisation.over(np.concatenate(raw, axis=1)))

    def signal_weights(self, reference: Sequence[Recorded]) -> FloatArray:
        """(E, S) every member's reward per unit of each signal: what the response surface of modes is searched with.

        For a model that is not linear in the signals: the ridge regression of each member's episode returns on the
        episodes' summed signals.
        """
        sums = np.array([each.signals.sum(axis=0, dtype=np.float64) for each in reference])
        scale = np.maximum(sums.std(axis=0), 1e-9)
        features = (sums - sums.mean(axis=0)) / scale
        returns = np.array([self._returns_of(each) for each in reference])
        gram = features.T @ features + np.eye(features.shape[1])
        weights: FloatArray = np.linalg.solve(gram, features.T @ (returns - returns.mean(axis=0))).T / scale
        return np.where(sums.std(axis=0) > 1e-9, weights, 0.0)

    def _returns_of(self, trajectory: Recorded) -> FloatArray:
        """(E,)"""
        steps = len(trajectory)
        rewards = self.step_rewards(trajectory.signals, trajectory.observations[:steps], trajectory.actions)
        returns: FloatArray = rewards.sum(axis=-1)
        return returns

    @property
    @abstractmethod
    def size(self) -> int:
        """E, the number of members."""

    def to_bytes(self) -> bytes:
        """One safetensors file; its metadata says what it is."""
        # A single metadata key: with several, safetensors writes them in an order that changes from run to run.
        return save(self.tensors(), metadata={"config": json.dumps(self.config(), sort_keys=True)})

    def config(self) -> dict[str, Any]:
        """What the file says beside the tensors."""
        return {
            "kind": self.kind,
            "offset": self.normalisation.offset,
            "scale": self.normalisation.scale,
            "temperature": self.temperature,
            "undone_column": self.undone_column,
        }

    @classmethod
    @abstractmethod
    def from_tensors(cls, tensors: Mapping[str, Float32Array], config: Mapping[str, Any]) -> Self:
        """What tensors() and config() describe, in raw units."""


@dataclass(frozen=True)
class StructuredReward(RewardModel):
    """Linear in the measured signals: r = w . signals. Members are samples of the weights' posterior.

    Within an episode nobody is rewarded for more of a signal than was ever shown, nor for less, while costs go on
    counting: a policy trained on such a reward would otherwise leave everything that people have judged (one pressed on
    the person with 227 N, another stayed far away and did nothing; docs/method.md, section 2).
    """

    kind: ClassVar[str] = "structured"
    is_linear: ClassVar[bool] = True
    weights: FloatArray
    """(E, S), reward per unit of each signal"""
    least_per_step: FloatArray | None = None
    most_per_step: FloatArray | None = None
    """(S,) the smallest and the largest mean of each signal over the steps of what was shown; None: not known, and not
    limited"""

    def raw_rewards(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """See RewardModel."""
        return self._linear(self.known_signals(signals, observations, actions))

    def known_signals(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """What the weights are multiplied with, (..., S): here the signals as measured."""
        return np.asarray(signals, np.float64)

    def _linear(self, known: FloatArray) -> FloatArray:
        """(..., S) -> (E, ...)"""
        rewards: FloatArray = np.moveaxis(known @ self.weights.T, -1, 0)
        return rewards

    def _earned(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """See RewardModel; what is beyond the limits over the whole episode is worth nothing more."""
        known = self.known_signals(signals, observations, actions)
        undeserved = self._undeserved(np.cumsum(known, axis=0))
        each_step = np.diff(undeserved, axis=0, prepend=np.zeros((1, self.size)))
        return self.normalised(self._linear(known) - each_step.T)

    def reaching(self, shown: Sequence[Trajectory]) -> Self:
        """See RewardModel; outliers excepted, as in what was shown to people."""
        if self.least_per_step is None or self.most_per_step is None or not shown:
            return self
        known = [self.known_signals(each.signals, each.observations[: len(each)], each.actions) for each in shown]
        low, high = usual(np.array([each.mean(axis=0) for each in known]))
        least, most = np.minimum(self.least_per_step, low), np.maximum(self.most_per_step, high)
        return replace(self, least_per_step=least, most_per_step=most)

    def _undeserved(self, totals: FloatArray) -> FloatArray:
        """What linear rewards pay for being beyond the limits, from the beginning to each step. totals (T, S) -> (T, E)

        More than an episode's most is beyond the limit as soon as it is reached; less than the least at any time, and
        made good again by what comes later.
        """
        paid = np.zeros((len(totals), self.size))
        steps = np.arange(1, len(totals) + 1)[:, None]
        if self.most_per_step is not None:
            beyond = np.maximum(totals - self.most_per_step * len(totals), 0.0)
            paid += beyond @ np.maximum(self.weights, 0.0).T
        if self.least_per_step is not None:
            missing = np.maximum(self.least_per_step * steps - totals, 0.0)
            paid += missing @ np.maximum(-self.weights, 0.0).T
        return paid

    def tensors(self) -> dict[str, Float32Array]:
        """See RewardModel."""
        limits = {"least_per_step": self.least_per_step, "most_per_step": self.most_per_step}
        known = {name: limit.astype(np.float32) for name, limit in limits.items() if limit is not None}
        return {"weights": self.weights.astype(np.float32)} | known

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Float32Array], config: Mapping[str, Any]) -> Self:
        """See RewardModel."""
        least, most = (
            None if limit is None else limit.astype(np.float64)
            for limit in (tensors.get("least_per_step"), tensors.get("most_per_step"))
        )
        return cls(tensors["weights"].astype(np.float64), least_per_step=least, most_per_step=most)

    @property
    def weights_of_signals(self) -> FloatArray:
        """(E, S), without those of anything else that a subclass reads."""
        return self.weights

    def signal_weights(self, reference: Sequence[Recorded] = ()) -> FloatArray:
        """(E, S) normalised reward per unit of each signal; exact for this kind."""
        return self.weights_of_signals / self.normalisation.scale

    @property
    def size(self) -> int:
        """See RewardModel."""
        return len(self.weights)


@dataclass(frozen=True)
class MlpReward(RewardModel):
    """An ensemble of small networks on (observation, action), each output in (-1, 1) as in B-Pref (Lee et al. 2021).

    ``layers``: per layer a matrix (E, in, out) and a bias (E, 1, out). Inputs are standardised with ``offset`` and
    ``scale`` (D + 7,) and clipped at 6 standard deviations.
    """

    kind: ClassVar[str] = "mlp"
    layers: dense_network.Layers
    offset: Float32Array
    scale: Float32Array

    def raw_rewards(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """See RewardModel; the signals are not used."""
        leading = np.shape(actions)[:-1]
        inputs = np.concatenate([observations, actions], axis=-1).reshape(-1, len(self.offset))
        standard = np.clip((inputs - self.offset) / self.scale, -6.0, 6.0)[None]
        rewards: FloatArray = np.tanh(dense_network.run(self.layers, standard))[..., 0].astype(np.float64)
        return rewards.reshape(self.size, *leading)

    def tensors(self) -> dict[str, Float32Array]:
        """See RewardModel."""
        whole = {"offset": self.offset, "scale": self.scale} | dense_network.named(self.layers)
        return {name: np.ascontiguousarray(array, np.float32) for name, array in whole.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Float32Array], config: Mapping[str, Any]) -> Self:
        """See RewardModel."""
        return cls(dense_network.of_named(tensors), tensors["offset"], tensors["scale"])

    @property
    def size(self) -> int:
        """See RewardModel."""
        return len(self.layers[0][0])


def stored_config(stored: bytes) -> dict[str, Any]:
    """The 'config' in the metadata of a safetensors file held in memory. Raises ValueError when there is none."""
    header_size = int.from_bytes(stored[:8], "little")
    if len(stored) < 8 + header_size:
        raise ValueError("Not a safetensors file: it ends within its own header.")
    header: dict[str, Any] = json.loads(stored[8 : 8 + header_size])
    if "config" not in header.get("__metadata__", {}):
        raise ValueError("This safetensors file does not say what it is (no config in its metadata).")
    config: dict[str, Any] = json.loads(header["__metadata__"]["config"])
    return config
