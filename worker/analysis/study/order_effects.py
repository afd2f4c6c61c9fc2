"""Order and period effects where everybody meets several methods: the analysis of variance of a crossover.

One number per person and block (the mean of its ratings). Model: person + method + period, and beside it the method
that came right before (first-order carryover). F tests of the period, after person and method, and of the carryover,
after the period as well (the first period has no method before it, so the two cannot be told apart there;
Jones and Kenward 2014, Design and Analysis of Cross-Over Trials, ch. 5). What a method is to somebody may differ from
person to person: that is noise of these numbers. Measured error rates: docs/results/between.md.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from worker.analysis.study.hypothesis_tests import not_computable, plain
from worker.domain.type_aliases import FloatArray

FEWEST_PEOPLE = 4


def order_report(rows: pd.DataFrame, scale: str) -> dict[str, Any]:
    """Period and carryover of one scale. ``rows``: participant, method, order (of the trial) and the scale.

    people, periods; ``period`` and ``carryover``: F, degrees_of_freedom (two), p, or not_computable; ``by_period``:
    period, difference to the first with low and high.
    """
    cells = _cells(rows, scale)
    people = cells["participant"].nunique()
    report: dict[str, Any] = {"people": int(people), "periods": int(cells["period"].max()) if len(cells) else 0}
    reason = None
    if report["periods"] < 2:
        reason = "nobody met two methods one after the other"
    elif people < FEWEST_PEOPLE:
        reason = f"{people} {'person' if people == 1 else 'people'} met several methods; {FEWEST_PEOPLE} are needed"
    if reason is not None:
        return report | {"period": not_computable(reason), "carryover": not_computable(reason), "by_period": []}
    values = np.asarray(cells[scale], np.float64)
    base = np.hstack([_dummies(cells["participant"], whole=True), _dummies(cells["method"])])
    periods, before = _dummies(cells["period"]), _dummies(cells["before"])
    return report | {
        "period": _f_test(values, base, periods),
        "carryover": _f_test(values, np.hstack([base, periods]), before),
        "by_period": _estimates(values, base, periods),
    }


def _cells(rows: pd.DataFrame, scale: str) -> pd.DataFrame:
    """A row per person and block in the order of meeting, of people with two blocks at least; "before" "" at first."""
    blocks = rows.groupby(["participant", "method"], as_index=False).agg({scale: "mean", "order": "min"})
    blocks = blocks.sort_values(["participant", "order"])
    blocks["period"] = blocks.groupby("participant").cumcount() + 1
    blocks["before"] = blocks["method"].astype(str).groupby(blocks["participant"]).shift(1, fill_value="")
    return blocks[blocks.groupby("participant")["method"].transform("count") > 1]


def _dummies(column: "pd.Series[Any]", whole: bool = False) -> FloatArray:
    return np.asarray(pd.get_dummies(column, drop_first=not whole), np.float64)


def _f_test(values: FloatArray, without: FloatArray, added: FloatArray) -> dict[str, Any]:
    """Of what the added columns explain beyond the others."""
    whole = np.hstack([without, added])
    rank, smaller = int(np.linalg.matrix_rank(whole)), int(np.linalg.matrix_rank(without))
    freedom = len(values) - rank
    if rank == smaller or freedom < 2:
        return not_computable("too few people, or everybody met the methods in one order")
    left, left_without = _unexplained(values, whole), _unexplained(values, without)
    if left < 1e-12:
        return not_computable("the ratings do not scatter")
    statistic = (left_without - left) / (rank - smaller) / (left / freedom)
    return {
        "F": plain(statistic),
        "degrees_of_freedom": [rank - smaller, freedom],
        "p": plain(stats.f.sf(statistic, rank - smaller, freedom)),
    }


def _unexplained(values: FloatArray, columns: FloatArray) -> float:
    fitted, *_ = np.linalg.lstsq(columns, values, rcond=None)
    return float(((values - columns @ fitted) ** 2).sum())


def _estimates(values: FloatArray, base: FloatArray, periods: FloatArray) -> Sequence[dict[str, Any]]:
    """Each later period minus the first, with its 95 % interval; without carryover in the model."""
    columns = np.hstack([base, periods])
    fitted, *_ = np.linalg.lstsq(columns, values, rcond=None)
    freedom = len(values) - int(np.linalg.matrix_rank(columns))
    if freedom < 2:
        return []
    variance = _unexplained(values, columns) / freedom
    spread = variance * np.linalg.pinv(columns.T @ columns)
    t = float(stats.t.ppf(0.975, freedom))
    found = []
    for place in range(periods.shape[1]):
        column = base.shape[1] + place
        estimate, margin = float(fitted[column]), t * float(max(spread[column, column], 0.0)) ** 0.5
        found.append(
            {
                "period": place + 2,
                "difference": estimate,
                "low": plain(estimate - margin),
                "high": plain(estimate + margin),
            }
        )
    return found
