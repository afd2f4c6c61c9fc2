"""From a hint to the signals that it is about."""

from collections.abc import Sequence

import numpy as np

from app.installed_tasks.description import HintedAt
from worker.domain.type_aliases import FloatArray


def direction(signal_names: Sequence[str], hint: HintedAt) -> FloatArray:
    """(S,) -1 where somebody wishes for less, 1 where for more, 0 elsewhere."""
    return np.isin(signal_names, hint.more).astype(np.float64) - np.isin(signal_names, hint.less)
