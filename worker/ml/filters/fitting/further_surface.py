"""What execution modes change of a learned return beyond weighted sums of signals: one person's own response surface.

The response surface that everybody shares knows what modes do to summed signals. To what a richer reward reads beside
them, worst moments for example, nobody has measured it; but the pool shows many modes, and every trial shows another.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from worker.domain.modes import ModeFamily
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.response_surface import OUTLIER_SHARE, RIDGE, monomials
from worker.ml.rewards.reward_models import RewardModel


@dataclass(frozen=True)
class FurtherSurface:
    """psi(mode) @ coefficients: change of the return less that of its weighted sums of signals, by ridge regression."""

    reward: RewardModel
    of_sums: FloatArray
    """(S,) the members' mean weights of the sums"""
    coefficients: FloatArray
    """(M,)"""
    gram: FloatArray
    """(M, M) of the rollouts behind them, ridge included"""

    @classmethod
    def of_pool(cls, reward: RewardModel, of_sums: FloatArray, pool: Pool, family: ModeFamily) -> Self:
        """From rollouts of modes, each compared with the others of its scenario; no pool: nothing is known yet."""
        modes, rollouts = pool.in_modes(family)
        features = monomials(modes)
        nothing = cls(reward, of_sums, np.zeros(features.shape[1]), RIDGE * np.eye(features.shape[1]))
        if not rollouts:
            return nothing
        further = nothing._further(rollouts)
        scenarios = np.array([each.scenario for each in rollouts])
        few = np.quantile(further, [OUTLIER_SHARE, 1 - OUTLIER_SHARE])
        return nothing._learned(_centred(scenarios, features), _centred(scenarios, np.clip(further, *few)))

    def with_observed(self, mode: FloatArray, reference: Sequence[Trajectory], driven: Sequence[Trajectory]) -> Self:
        """After rollouts of one mode, (A,), in the scenarios of the reference policy's."""
        changes = self._further(driven) - self._further(reference)
        return self._learned(np.repeat(monomials(mode)[None], len(changes), axis=0), changes)

    def _further(self, rollouts: Sequence[Trajectory]) -> FloatArray:
        """(N,) what the return has beyond weighted sums"""
        sums = np.array([each.signals.sum(axis=0, dtype=np.float64) for each in rollouts])
        return np.asarray(self.reward.returns(rollouts) - sums @ self.of_sums, np.float64)

    def _learned(self, features: FloatArray, changes: FloatArray) -> Self:
        """features (N, M), changes (N,)"""
        gram = self.gram + features.T @ features
        moments = self.gram @ self.coefficients + features.T @ changes
        return type(self)(self.reward, self.of_sums, np.asarray(np.linalg.solve(gram, moments), np.float64), gram)


def _centred(groups: npt.NDArray[np.int64], values: FloatArray) -> FloatArray:
    """(N, ...) less the mean of its group."""
    centred = values.copy()
    for group in np.unique(groups):
        centred[groups == group] -= values[groups == group].mean(axis=0)
    return centred
