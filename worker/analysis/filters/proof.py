"""The burden of proof: a filter shows on unseen scenarios that it gains something, or that it costs nothing.

A filter is published when the interval (95 %) of its paired gain in learned preference lies above zero. Otherwise it is
published only if nothing that could harm got worse: success by more than SUCCESS_MARGIN, the largest force or speed of
the episodes (the largest and the 95th percentile) by more than their margins, or the mean of force, spills or the speed
of what enters the mouth surely (interval above zero). What does neither is the reference policy.
"""

from collections.abc import Mapping
from typing import Any

SUCCESS_MARGIN = 0.01
FORCE_MARGIN_N = 0.25
"""About the weight of a letter."""
SPEED_MARGIN_M_S = 0.02
_HARMS = {
    "C_f": "force away from the target",
    "C_hf": "high force at the target",
    "C_fd": "spills on the person",
    "C_fdv": "speed of what enters the mouth",
}
_HARMLESS = {"C_d", "C_v"}
"""Distance and speed by themselves; of a laboratory's costs each may harm."""
_LARGEST = {
    "max_force_n": ("the largest force", FORCE_MARGIN_N, "N"),
    "p95_max_force_n": ("the force that 95 % of the episodes stay below", FORCE_MARGIN_N, "N"),
    "max_speed_m_s": ("the largest speed", SPEED_MARGIN_M_S, "m/s"),
    "p95_max_speed_m_s": ("the speed that 95 % of the episodes stay below", SPEED_MARGIN_M_S, "m/s"),
}


def case_against(evaluation: Mapping[str, Any]) -> tuple[str, ...]:
    """What speaks against a filter, in words; empty when it may be published. ``evaluation``: see evaluate()."""
    if evaluation["preference"]["low"] > 0.0:
        return ()
    return (*_lost_success(evaluation["success"]), *_larger(evaluation["safety"]), *_more_harm(evaluation["costs"]))


def _lost_success(success: Mapping[str, float]) -> tuple[str, ...]:
    if success["delta"] >= -SUCCESS_MARGIN:
        return ()
    return (f"success {success['reference']:.1%} -> {success['filter']:.1%}",)


def _larger(safety: Mapping[str, Mapping[str, float]]) -> list[str]:
    before, after = safety["reference"], safety["filter"]
    return [
        f"{words} {before[name]:.2f} -> {after[name]:.2f} {unit}"
        for name, (words, margin, unit) in _LARGEST.items()
        if name in before and after[name] > before[name] + margin
    ]


def _more_harm(costs: Mapping[str, Mapping[str, float]]) -> list[str]:
    return [
        f"{_HARMS.get(name, name)} {cost['reference']:.3g} -> {cost['filter']:.3g} per episode"
        for name, cost in costs.items()
        if name not in _HARMLESS and cost["low"] > 0.0
    ]
