"""Whether more labels would still change what a person's robot does: the expected regret of stopping now.

The members of a reward model are what the person may want, as far as the labels say. Each would have its own best way
of doing the task; the filter is given one for all of them. How much worse that one is for the average member than the
member's own best is what perfect knowledge of the person could still gain. More labels bring the members together and
the regret to zero; a regret that is small already is not worth anybody's time.
"""

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.ml.filters.fitting.mode_worth import price_of_failures
from worker.ml.filters.fitting.response_surface import CAUTION, ResponseSurface

CANDIDATES = 4_000
"""Modes that are tried, the same for every member and at every retraining."""
_NOTHING = 1e-9
"""Standard deviations of return."""


def relative_regret(surface: ResponseSurface, members: FloatArray) -> float:
    """What knowing the person for certain could gain, as a share of what it would gain over the reference policy.

    ``members`` (E, S): the weights of the reward model's members per unit of each signal. The mode for all is chosen
    as response_surface.best_mode does, the one for each member by that member alone. 0: nothing, also
    where the reference policy is everybody's best; above 1: the mode for all is worse than the reference policy.
    Shares are alike in all tasks, standard deviations over all modes are not: some tasks have many modes that nobody
    wants (docs/results/advice_to_stop.md).
    """
    rng = np.random.default_rng(0)
    drawn = rng.uniform(surface.low, surface.high, (CANDIDATES, len(surface.low)))
    modes = np.concatenate([np.zeros((1, drawn.shape[1])), drawn])  # the first is the reference policy, worth 0
    signals, success = surface.predict(modes, CAUTION)
    lost = price_of_failures(success)
    unit = max(float((signals @ members.mean(axis=0)).std()), 1e-9)
    returns = signals @ members.T / unit  # (modes, E)
    worth = returns - lost[:, None]
    chosen = int(np.argmax(worth.mean(axis=1)))
    attainable = float(worth.max(axis=0).mean())
    return 1.0 - float(worth[chosen].mean()) / attainable if attainable > _NOTHING else 0.0
