"""How far a fit is: its stages, and the share of a whole fit's time that each of them takes."""

from collections.abc import Mapping
from itertools import accumulate

from worker.ml.filters.fitting.filter_problem import ReportProgress

Stages = Mapping[str, float]
"""Seconds by name, in their order; only what they are to each other counts."""

FINISH = "finish"
"""Everybody's last stage: evaluated, packed and published."""

QUICK: Stages = {"quick": 20, "promise": 20, FINISH: 8}
LAST: Stages = {"mode": 20, "residual": 17, "gate": 14, "archived": 60, "promise": 20, FINISH: 8}
PRINTED: Stages = {"printed": 60, FINISH: 8}
REFINED: Stages = {"mode": 20, "refinement": 73, "residual": 7, "gate": 5, "promise": 20, FINISH: 8}


TRAINED = 0.9
"""How far a refinement is when it is learned; the rest is its gate."""


def so_far(stages: Stages, name: str, share: float) -> float:
    """The share of the whole that is done when this share of a stage is. Raises KeyError for a stage it has not."""
    begun = dict(zip(stages, accumulate(stages.values(), initial=0.0), strict=False))
    return (begun[name] + share * stages[name]) / sum(stages.values())


def before_finish(stages: Stages) -> tuple[str, ...]:
    """The names of those in which a draft is made better."""
    return tuple(name for name in stages if name != FINISH)


def during(stages: Stages, name: str, progress: ReportProgress) -> ReportProgress:
    """What a stage says its own progress to, for ``progress`` to hear that of the whole, which never falls."""
    furthest = 0.0

    def hear(stage: str, share: float) -> None:
        nonlocal furthest
        furthest = max(furthest, share)
        progress(stage, so_far(stages, name, furthest))

    return hear
