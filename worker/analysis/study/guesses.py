"""Whether people know their own robot: which one "was made for you", against chance."""

from collections.abc import Mapping, Sequence
from typing import Any

from scipy import stats

from worker.analysis.study.hypothesis_tests import plain

CONFIDENCE = 0.95


def guess_report(guesses: Sequence[Mapping[str, Any]], robots: int) -> dict[str, Any]:
    """``guesses``: a row per person who named a robot, with ``right``, or None while letters hide the methods.

    people, chance (one of so many robots), and unless blinded: right, share with its exact 95 % interval low to high
    (Clopper & Pearson 1934), and p of the exact two-sided binomial test against chance. Unknown is None.
    """
    report: dict[str, Any] = {"people": len(guesses), "robots": robots, "chance": 1 / robots}
    right = [each["right"] for each in guesses]
    if not right or None in right:
        return report | dict.fromkeys(("right", "share", "low", "high", "p"))
    result = stats.binomtest(sum(right), len(right), 1 / robots)
    interval = result.proportion_ci(CONFIDENCE, method="exact")
    return report | {
        "right": sum(right),
        "share": sum(right) / len(right),
        "low": plain(interval.low),
        "high": plain(interval.high),
        "p": plain(result.pvalue),
    }
