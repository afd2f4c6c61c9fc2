"""The structured reward, with further terms for whose answers weighted sums of signals do not explain."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from worker.ml.rewards.beyond_sums import misfit
from worker.ml.rewards.beyond_sums.terms import FurtherTerms
from worker.ml.rewards.reward_training import FitResult, fit
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_scale import SignalScale

DOUBT = 2.0
"""Evidence against weighted sums from which on further terms are learned: less than for a flag, since terms that are
not needed are no false word about anybody (docs/results/refined_for_others.md)."""


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

    The metrics have ``misfit``, and the explanation whose terms were added as ``further``: "" for none, as where what
    explains most is that weights change, which nothing measured at a step can say.
    """
    learn = partial(fit, pairs, targets, "structured", seed, scale=scale, signal_names=signal_names, **rest)
    linear = learn()
    found = misfit.look(pairs, np.asarray(targets, np.float64), scale, signal_names, scene)
    explanation = str(found.get("explanation", misfit.CHANGING))
    if found.get("evidence", 0.0) <= DOUBT or explanation == misfit.CHANGING:
        return FitResult(linear.model, {**linear.metrics, "misfit": found, "further": ""})
    richer = learn(further=FurtherTerms.of(pairs, explanation, signal_names, scene))
    return FitResult(richer.model, {**richer.metrics, "misfit": found, "further": explanation})
