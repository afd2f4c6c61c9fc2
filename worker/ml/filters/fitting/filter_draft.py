"""What is known of a filter between two stages of its fit, as plain values and arrays that can be stored."""

import io
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Self

import numpy as np

from worker.domain.spaces import Space
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.shield import widened

_VALUE, _TESTED = "value/", "tested/"


@dataclass(frozen=True)
class GateTrial:
    """One setting tried on the gate's scenarios, or on the others in which what loses anything there is tried again."""

    gate: float
    residual_share: float
    preference: float
    """mean change of the learned return, not limited (RewardModel.member_returns), in standard deviations of the
    reference's returns; failures count for less than they cost there, see gate.trial_of()"""
    success_change: float
    """share of episodes"""
    p95_force_n: float
    """95 % of the episodes stay below this force on the person"""
    refined: bool = False
    """whether it was the person's refined policy, in place of mode and residual"""
    chance: float | None = None
    """that it raises the return, as the members of the reward model see it; None: of an earlier version"""
    pressed: float = 0.0
    """share of episodes in which the largest force is FilterConfig.pressed_n above the reference's; 0: or of an earlier
    version"""


@dataclass(frozen=True)
class FilterDraft:
    """A filter between two stages."""

    weights: FilterWeights
    value: Mapping[str, Float32Array] = field(default_factory=dict)
    """state of the action value, so that a later round goes on from it"""
    trials: tuple[GateTrial, ...] = ()
    """in their order, except that the chosen mode's comes after the other modes'"""
    notes: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    tested: Mapping[str, Float32Array] = field(default_factory=dict)
    """what the filter stayed within when it was tried (shield.limits_of); limits of its shield, once it has one"""
    promise: Mapping[str, Any] = field(default_factory=dict)
    """a Promise (worker.analysis.filters.promise) and the tests that earned it, as plain values; empty: none"""
    choice: Mapping[str, float] = field(default_factory=dict)
    """the chance of each of several policies to be the best; empty: it is a filter"""

    def timed(self, stage: str, started: float) -> Self:
        """The same with the seconds since ``started`` added to a stage."""
        spent = self.seconds.get(stage, 0.0) + time.perf_counter() - started
        return replace(self, seconds={**self.seconds, stage: round(spent, 3)})

    def shielded(self, observation: Space, reference: Callable[[], Sequence[Trajectory]]) -> Self:
        """The same with a shield around what was tested, and around where the reference policy alone has been.

        ``reference``: its rollouts, asked for where there is something to shield.
        """
        tested = widened(self.tested, observation, reference()) if self.tested else {}
        return replace(self, tested=tested, weights=self.weights.changed(shield=tested))

    def to_bytes(self) -> bytes:
        """One .npz file of plain arrays."""
        record = {
            "trials": [asdict(trial) for trial in self.trials],
            "notes": self.notes,
            "seconds": dict(self.seconds),
            "promise": dict(self.promise),
            "choice": dict(self.choice),
        }
        arrays: dict[str, Any] = {f"{_VALUE}{name}": array for name, array in self.value.items()}
        arrays |= {f"{_TESTED}{name}": array for name, array in self.tested.items()}
        arrays["weights"] = np.frombuffer(self.weights.to_bytes(), np.uint8)
        arrays["record"] = np.array(json.dumps(record))
        target = io.BytesIO()
        np.savez(target, **arrays)
        return target.getvalue()

    @classmethod
    def from_bytes(cls, stored: bytes) -> Self:
        """Read what to_bytes() wrote."""
        with np.load(io.BytesIO(stored), allow_pickle=False) as arrays:
            record = json.loads(str(arrays["record"]))
            value, tested = (
                {name.removeprefix(part): arrays[name] for name in arrays.files if name.startswith(part)}
                for part in (_VALUE, _TESTED)
            )
            weights = FilterWeights.from_bytes(arrays["weights"].tobytes())
        trials = tuple(GateTrial(**each) for each in record["trials"])
        promise, choice = record.get("promise", {}), record.get("choice", {})
        return cls(weights, value, trials, tuple(record["notes"]), record["seconds"], tested, promise, choice)
