"""The structured reward, which follows what else explains answers where weighted sums of signals do not."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from worker.ml.rewards.beyond_sums import misfit
from worker.ml.rewards.beyond_sums.changing import ChangingWeights
from worker.ml.rewards.beyond_sums.terms import FurtherTerms
from worker.ml.rewards.reward_training import FitResult, fit
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale

DOUBT = 2.0
"""Evidence against weighted sums from which on something richer is learned: less than for a flag, since terms that are
not needed are no false word about anybody (docs/results/nonlinear_filters.md)."""


def fit_by_evidence(
    pairs: SegmentPairs,
    targets: npt.ArrayLike,
    seed: int,
    *,
    scale: SignalScale,
    signal_names: Sequence[str],
    scene: Sequence[int] = (),
    **rest: Any,
) -> FitResult:
    """See reward_training.fit(), whose other arguments ``rest`` are; ``scene`` as in misfit.look().

    pairs and targets in the order in which they were answered. The metrics have ``misfit``, and the explanation that is
    followed as ``further``: "" for none.
    """
    learn = partial(fit, pairs, targets, "structured", seed, scale=scale, signal_names=signal_names, **rest)
    linear = learn()
    found = misfit.look(pairs, np.asarray(targets, np.float64), scale, signal_names, scene)
    if found.get("evidence", 0.0) <= DOUBT:
        return FitResult(linear.model, {**linear.metrics, "misfit": found, "further": ""})
    explanation = str(found["explanation"])
    further: FurtherTerms | ChangingWeights
    if explanation == misfit.CHANGING:
        further = ChangingWeights(len(signal_names))
    else:
        further = FurtherTerms.of(pairs, explanation, signal_names, scene)
    richer = learn(further=further)
    return FitResult(richer.model, {**richer.metrics, "misfit": found, "further": explanation})
