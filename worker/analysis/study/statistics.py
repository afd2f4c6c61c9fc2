"""What the ratings of a study say: the paper's tests exactly, and beside them the right ones for repeated measures.

The input is a tidy table as it is exported (``ratings.csv``): one row per rated trial with the columns ``participant``,
the group to compare by (``method``, or ``letter`` while the study is blinded), and the two scales.

Layout of what ``rating_report`` returns, which is ``contents["ratings"]`` of a Report (see report.py):

    groups, participants, ratings       the groups in their order; how many people and ratings there are
    explanation                         the sentence on why two kinds of tests stand side by side
    recommended                         which of TESTS to rely on
    measured_error_percent[]            people, and per test how often it errs where nothing differs: percent, low, high
    scales.<scale>.means[]              group, ratings, participants, mean, sd, participant_mean, low, high
    scales.<scale>.people[]             participant, means {group: that person's mean}
    scales.<scale>.comparisons[]        first, second, and a result for each of TESTS; between subjects also of
                                        between.BETWEEN_TESTS
    scales.<scale>.order                order and period effects, see order_effects; None while letters hide methods

Every result of a test has either its numbers or ``not_computable``: the reason in words. A difference is always second
minus first. Nothing here is NaN or infinite; what is unknown is None.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from worker.analysis.study.between import (
    BETWEEN_TESTS,
    equivalence_between,
    hedges_g,
    means_of,
    only_one_of,
    permutation,
    welch_t,
)
from worker.analysis.study.cumulative_link import cumulative_link, cumulative_link_between
from worker.analysis.study.effect_sizes import d_z_interval, holm, rank_biserial, rank_biserial_interval
from worker.analysis.study.hypothesis_tests import (
    FEWEST_PAIRED,
    STAR_BELOW,
    TESTS,
    UNCORRECTED,
    equivalence,
    mixed_model,
    paired_t,
    plain,
    two_sample_t,
    wilcoxon,
)
from worker.analysis.study.order_effects import order_report
from worker.domain.type_aliases import FloatArray

Result = dict[str, Any]

SCALES = ("satisfaction", "personalisation")
POINTS = (1, 5)
"""The lowest and the highest rating."""

BOUND = 0.5
"""Points; differences below it count as none that matters, unless the study says otherwise.

Half a standard deviation of ratings that scatter by about one point: what people notice as a difference of how they
fare (Norman, Sloan and Wyrwich 2003, Medical Care 41, 582).
"""
RECOMMENDED = "paired_t"
MEASURED_ERROR_PERCENT: Sequence[Result] = (
    {
        "people": 8,
        "paired_t": {"percent": 6.8, "low": 4.7, "high": 9.6},
        "mixed_model": {"percent": 6.8, "low": 4.7, "high": 9.6},
        "cumulative_link": {"percent": 6.0, "low": 4.1, "high": 8.8},
        "wilcoxon": {"percent": 3.8, "low": 2.3, "high": 6.1},
        "two_sample_t": {"percent": 7.0, "low": 4.9, "high": 9.9},
    },
    {
        "people": 16,
        "paired_t": {"percent": 3.8, "low": 2.3, "high": 6.1},
        "mixed_model": {"percent": 3.8, "low": 2.3, "high": 6.1},
        "cumulative_link": {"percent": 4.2, "low": 2.7, "high": 6.7},
        "wilcoxon": {"percent": 3.2, "low": 1.9, "high": 5.5},
        "two_sample_t": {"percent": 6.5, "low": 4.5, "high": 9.4},
    },
    {
        "people": 24,
        "paired_t": {"percent": 5.5, "low": 3.7, "high": 8.2},
        "mixed_model": {"percent": 5.5, "low": 3.7, "high": 8.2},
        "cumulative_link": {"percent": 5.0, "low": 3.3, "high": 7.6},
        "wilcoxon": {"percent": 5.8, "low": 3.9, "high": 8.5},
        "two_sample_t": {"percent": 6.2, "low": 4.3, "high": 9.1},
    },
)
"""From docs/results/likert.csv (a test compares), with Wilson's interval: 5 % is what every test promises."""

EXPLANATION = (
    "The paper's test counts every rating as if a different person had given it, although several come from the same "
    "person and resemble each other. The paired tests and the mixed models compare each person with themselves and "
    "count people."
)
ERROR_BARS = (
    "Bars are means of all ratings, error bars one standard deviation of all ratings (the paper does not say what its "
    "own show). Stars are the paper's two-sample t-tests, * for p < .01, not corrected for their number."
)


def rating_report(
    ratings: pd.DataFrame,
    groups: Sequence[str],
    *,
    by: str = "method",
    compare: bool = True,
    between: bool = False,
    bound: float = BOUND,
) -> Result:
    """Means and tests of both scales. See the layout above.

    ``by``: the column that names the groups; ``compare``: False while letters hide methods, for then a letter is
    another method for every participant and a test between letters would say nothing about methods. ``between``: with
    the tests of people who met different methods. ``bound``: of equivalence, in points of the scale.
    """
    rows = ratings.dropna(subset=list(SCALES))
    rows = rows[rows[by].isin(list(groups))]
    return {
        "groups": list(groups),
        "participants": int(rows["participant"].nunique()),
        "ratings": len(rows),
        "explanation": EXPLANATION,
        "recommended": RECOMMENDED,
        "measured_error_percent": list(MEASURED_ERROR_PERCENT),
        "error_bars": ERROR_BARS,
        "star_below": STAR_BELOW,
        "scales": {
            scale: scale_report(rows, scale, by, groups, compare, between=BETWEEN_TESTS if between else (), bound=bound)
            for scale in SCALES
        },
    }


def scale_report(
    rows: pd.DataFrame,
    scale: str,
    by: str,
    groups: Sequence[str],
    compare: bool,
    possible: tuple[float, float] = POINTS,
    between: Sequence[str] = (),
    tests: Sequence[str] = TESTS,
    bound: float = BOUND,
) -> Result:
    """Means, people and comparisons of one scale, a column of ``rows``; ``possible``: its lowest and highest value.

    ``between``: tests of people who met different groups. ``bound``: of equivalence, in points of the scale.
    """
    comparisons: list[Result] = [
        {"first": first, "second": second, **_tests(rows, scale, by, first, second, tests, bound)}
        for first, second in (combinations(groups, 2) if compare else ())
    ]
    for comparison in comparisons if between else ():
        comparison |= _between(_cells(rows, scale, by), comparison["first"], comparison["second"], between, bound)
    for test in (*(each for each in tests if each != UNCORRECTED), *between):
        _correct([comparison[test] for comparison in comparisons])
    return {
        "means": [_mean_of(rows[rows[by] == group], scale, group, possible) for group in groups],
        "people": _people(rows, scale, by),
        "comparisons": comparisons,
        "order": order_report(rows, scale) if compare and "order" in rows else None,
    }


def _between(
    cells: Mapping[tuple[str, str], FloatArray], first: str, second: str, tests: Sequence[str], bound: float
) -> dict[str, Result]:
    ratings = only_one_of(cells, first, second)
    means = means_of(ratings[0]), means_of(ratings[1])
    computed: dict[str, Callable[[], Result]] = {
        "welch_t": lambda: _hedges_g(welch_t(*means), *means),
        "permutation": lambda: permutation(*means),
        "cumulative_link_between": lambda: cumulative_link_between(*ratings),
        "equivalence_between": lambda: equivalence_between(*means, bound),
    }
    return {test: computed[test]() for test in tests}


def _hedges_g(test: Result, first: FloatArray, second: FloatArray) -> Result:
    return test | hedges_g(first, second) if "p" in test else test


def _cells(rows: pd.DataFrame, scale: str, by: str) -> dict[tuple[str, str], FloatArray]:
    """Ratings by person and group."""
    return {name: _floats(values) for name, values in rows.groupby(["participant", by])[scale]}


def _people(rows: pd.DataFrame, scale: str, by: str) -> list[Result]:
    means = rows.groupby(["participant", by])[scale].mean()
    found: dict[str, dict[str, float]] = {}
    for (participant, group), mean in means.items():
        found.setdefault(str(participant), {})[str(group)] = float(mean)
    return [{"participant": participant, "means": theirs} for participant, theirs in found.items()]


def _mean_of(rows: pd.DataFrame, scale: str, group: str, possible: tuple[float, float]) -> Result:
    """Of one group: all ratings as the paper has them, and the mean over people with its 95 % interval."""
    values, people = _floats(rows[scale]), _floats(rows.groupby("participant")[scale].mean())
    low, high = mean_interval(people, possible)
    return {
        "group": group,
        "ratings": len(values),
        "participants": len(people),
        "mean": plain(values.mean()) if len(values) else None,
        "sd": plain(values.std(ddof=1)) if len(values) > 1 else None,
        "participant_mean": plain(people.mean()) if len(people) else None,
        "low": low,
        "high": high,
    }


def mean_interval(
    values: FloatArray, possible: tuple[float, float] = (-np.inf, np.inf)
) -> tuple[float | None, float | None]:
    """The 95 % t interval of a mean; None for fewer than three values, which can hardly say how they scatter.

    ``possible``: the values that a mean can have; what lies beyond is cut off, which misses no true mean.
    """
    if len(values) < FEWEST_PAIRED:
        return None, None
    margin = float(stats.t.ppf(0.975, len(values) - 1)) * float(values.std(ddof=1)) / len(values) ** 0.5
    return plain(max(values.mean() - margin, possible[0])), plain(min(values.mean() + margin, possible[1]))


def _tests(
    rows: pd.DataFrame, scale: str, by: str, first: str, second: str, tests: Sequence[str], bound: float
) -> dict[str, Result]:
    every = [_floats(rows[rows[by] == group][scale]) for group in (first, second)]
    differences = paired_differences(rows, scale, by, first, second)
    of_each = ratings_of_each(rows, scale, by, first, second)
    computed: dict[str, Callable[[], Result]] = {
        "paired_t": lambda: _cohens_d_z(paired_t(differences), differences),
        "mixed_model": lambda: mixed_model(*of_each),
        "cumulative_link": lambda: cumulative_link(*of_each),
        "wilcoxon": lambda: _rank_biserial(wilcoxon(differences), differences),
        "equivalence": lambda: equivalence(differences, bound),
        "two_sample_t": lambda: two_sample_t(*every),
    }
    return {test: computed[test]() for test in tests}


def _cohens_d_z(test: Result, differences: FloatArray) -> Result:
    if "p" not in test:
        return test
    low, high = d_z_interval(test["statistic"], len(differences))
    d_z = differences.mean() / differences.std(ddof=1)
    return test | {"d_z": plain(d_z), "d_z_low": plain(low), "d_z_high": plain(high)}


def _rank_biserial(test: Result, differences: FloatArray) -> Result:
    if "p" not in test:
        return test
    correlation = rank_biserial(differences)
    low, high = rank_biserial_interval(correlation, int(np.count_nonzero(differences)))
    ends = {"rank_biserial_low": plain(low), "rank_biserial_high": plain(high)}
    return test | {"rank_biserial": plain(correlation), **ends}


def ratings_of_each(
    rows: pd.DataFrame, scale: str, by: str, first: str, second: str
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Everybody's ratings of ``first`` and of ``second``, by participant; only who rated both."""
    cells = _cells(rows, scale, by)
    people = [
        person for person in dict.fromkeys(rows["participant"]) if {(person, first), (person, second)} <= set(cells)
    ]
    return [cells[person, first] for person in people], [cells[person, second] for person in people]


def paired_differences(rows: pd.DataFrame, scale: str, by: str, first: str, second: str) -> FloatArray:
    """Each person's mean rating of ``second`` minus that of ``first``, by participant; only who rated both. (P,)"""
    means = rows.pivot_table(index="participant", columns=by, values=scale, aggfunc="mean")
    if first not in means or second not in means:
        return np.empty(0)
    # Means of three ratings are thirds: without rounding, equal differences would differ in their last bit.
    return _floats((means[second] - means[first]).dropna().round(12))


def _correct(results: Sequence[Result]) -> None:
    """Add Holm's p over all comparisons of one scale; one that could not be computed still counts in the family."""
    for result, corrected in zip(results, holm([result.get("p") for result in results]), strict=True):
        if corrected is not None:
            result["p_holm"], result["corrected_over"] = corrected, len(results)


def _floats(values: Any) -> FloatArray:
    return np.asarray(values, np.float64)
