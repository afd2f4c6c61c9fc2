"""What the worker measured, read from the metrics of its models. Anything missing is None, never a guess."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from app.domain.models import Bundle, Model

COST_SYMBOLS = ("C_d", "C_v", "C_f", "C_hf", "C_fd", "C_fdv")
"""Of the paper; a laboratory has costs of its own."""
"""The paper's six preference costs; what each is called depends on the task."""


class Verdict(StrEnum):
    """What an interval allows to be said."""

    BETTER = "better"
    WORSE = "worse"
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class Change:
    """One number with the reference policy and with the filter; the interval (95 %) belongs to the difference."""

    name: str
    """Empty for costs: their names are the task's."""
    symbol: str
    more_is_better: bool
    reference: float | None
    filtered: float | None
    delta: float
    low: float
    high: float

    @property
    def verdict(self) -> Verdict:
        """Better or worse only when the whole interval is on that side of zero."""
        if self.low > 0 or self.high < 0:
            return Verdict.BETTER if (self.low > 0) == self.more_is_better else Verdict.WORSE
        return Verdict.UNCLEAR


@dataclass(frozen=True)
class Weight:
    """What the reward model thinks of one measurable thing, with the spread over its ensemble."""

    name: str
    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class LearnedCosts:
    """What a reward model, of whatever kind, thinks of the paper's six costs in the study's clips."""

    weights: Sequence[Weight]
    """The strongest first; positive: liked."""
    explained: float
    """Share of what the model thinks of the clips that these costs account for."""


@dataclass(frozen=True)
class FilterVersion:
    """One trained filter and what was measured about it."""

    label_count: int
    created_at: datetime
    method: str | None
    gate: float | None
    mode: Sequence[tuple[str, float]]
    chances: Sequence[tuple[str, float]]
    """of each of several policies to be the best for the person, the largest first; empty: it is a filter"""
    chosen: str
    notes: Sequence[str]
    uses_reference: bool
    """It changes nothing: what was learned was not surely better, or not without a price."""
    promise: str
    """What is promised about harm, in a sentence; empty: nothing is."""
    scenarios: int | None
    success: Change | None
    preference: Change | None
    costs: Sequence[Change]
    bundle_version: int | None
    """None until the bundle is published."""
    bundle_byte_count: int | None


class _Metrics(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


_M = TypeVar("_M", bound=_Metrics)


class _Difference(_Metrics):
    reference: float | None = None
    filter: float | None = None
    delta: float
    low: float
    high: float


class _Evaluation(_Metrics):
    scenarios: int | None = None
    success: _Difference | None = None
    preference: _Difference | None = None
    costs: dict[str, _Difference] = Field(default_factory=dict)


class _Promise(_Metrics):
    sentence: str = ""


class _Choice(_Metrics):
    policy: str = ""
    chances: dict[str, float] = Field(default_factory=dict)


class _Filter(_Metrics):
    evaluation: _Evaluation = Field(default_factory=_Evaluation)
    gate: float | None = None
    mode: dict[str, float] = Field(default_factory=dict)
    method: str | None = None
    notes: list[str] = Field(default_factory=list)
    uses_reference: bool = False
    promise: _Promise = Field(default_factory=_Promise)
    choice: _Choice | None = None


class _Weight(_Metrics):
    mean: float
    low: float
    high: float


class _Costs(_Metrics):
    weights: dict[str, _Weight]
    explained: float


class _Reward(_Metrics):
    weights: dict[str, _Weight] = Field(default_factory=dict)
    costs: _Costs | None = None


def filter_version(model: Model, bundle: Bundle | None) -> FilterVersion:
    """What is known about one filter; unreadable numbers are left out."""
    metrics = _read(_Filter, model.metrics)
    evaluation = metrics.evaluation
    of_labs = [name for name in evaluation.costs if name not in COST_SYMBOLS]
    costs = [_change("", name, evaluation.costs.get(name), more_is_better=False) for name in (*COST_SYMBOLS, *of_labs)]
    return FilterVersion(
        label_count=model.label_count,
        created_at=model.created_at,
        method=metrics.method,
        gate=metrics.gate,
        mode=sorted(metrics.mode.items()) if metrics.choice is None else (),
        chances=sorted(metrics.choice.chances.items(), key=lambda each: -each[1]) if metrics.choice else (),
        chosen=metrics.choice.policy if metrics.choice else "",
        notes=metrics.notes,
        uses_reference=metrics.uses_reference,
        promise=metrics.promise.sentence,
        scenarios=evaluation.scenarios,
        success=_change("Success", "", evaluation.success, more_is_better=True),
        preference=_change("Preference, as the model sees it", "", evaluation.preference, more_is_better=True),
        costs=[cost for cost in costs if cost is not None],
        bundle_version=bundle.version if bundle else None,
        bundle_byte_count=bundle.byte_count if bundle else None,
    )


def learned_weights(model: Model | None) -> Sequence[Weight]:
    """The weights of the newest reward model, the strongest first; empty when it has none to show."""
    if model is None:
        return []
    return _strongest_first(_read(_Reward, model.metrics).weights)


def taste(model: Model | None) -> LearnedCosts | None:
    """What the newest reward model thinks of the six costs; None when it has not said."""
    costs = _read(_Reward, model.metrics).costs if model is not None else None
    return None if costs is None else LearnedCosts(_strongest_first(costs.weights), costs.explained)


def _strongest_first(weights: Mapping[str, _Weight]) -> Sequence[Weight]:
    found = [Weight(name, weight.mean, weight.low, weight.high) for name, weight in weights.items()]
    return sorted(found, key=lambda weight: -abs(weight.mean))


def _change(name: str, symbol: str, difference: _Difference | None, *, more_is_better: bool) -> Change | None:
    if difference is None:
        return None
    return Change(
        name=name,
        symbol=symbol,
        more_is_better=more_is_better,
        reference=difference.reference,
        filtered=difference.filter,
        delta=difference.delta,
        low=difference.low,
        high=difference.high,
    )


def _read(kind: "type[_M]", metrics: dict[str, Any]) -> "_M":
    try:
        return kind.model_validate(metrics)
    except ValidationError:
        return kind()
