"""What the ratings of a study say: the paper's tests exactly, and beside them the right ones for repeated measures.

The input is a tidy table as it is exported (``ratings.csv``): one row per rated trial with the columns ``participant``,
the group to compare by (``method``, or ``letter`` while the study is blinded), and the two scales.

Layout of what ``rating_report`` returns, which is ``contents["ratings"]`` of a Report (worker/analysis/report.py):

    groups, participants, ratings       the groups in their order; how many people and ratings there are
    explanation                         the sentence on why two kinds of tests stand side by side
    scales.<scale>.means[]              group, ratings, participants, mean, sd, participant_mean, low, high
    scales.<scale>.people[]             participant, means {group: that person's mean}
    scales.<scale>.comparisons[]        first, second, and a result for each of TESTS
    scales.<scale>.mixed_model          the fit behind the last: converged, notes, variances, n

Every result of a test says ``planned`` and has either its numbers or ``not_computable``: the reason in words. A
difference is always second minus first. Nothing here is NaN or infinite; what is unknown is None.
"""

import warnings
from collections.abc import Collection, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from worker.analysis.effect_sizes import d_z_interval, holm, rank_biserial, rank_biserial_interval

Floats = npt.NDArray[np.float64]
Result = dict[str, Any]

SCALES = ("satisfaction", "personalisation")
TESTS = ("two_sample_t", "paired_t", "wilcoxon", "mixed_model")
"""Names as in app.domain.protocol.PlannedTest."""

STAR_BELOW = 0.01
"""The paper's star: p < .01."""
FEWEST_RATINGS = 2
"""Of each group, for the paper's test."""
FEWEST_PAIRED = 3
"""People who rated both groups; with two, one difference decides everything."""
FEWEST_FOR_MODEL = 5
"""People in a mixed model: the spread between people cannot be told from fewer."""

OPTIMISERS = ["bfgs", "lbfgs", "cg", "powell"]
"""statsmodels' own three, tried in turn until one converges, and one more that needs no gradient."""

EXPLANATION = (
    "The paper's test counts every rating as if a different person had given it, although several come from the same "
    "person and resemble each other; the paired tests and the mixed model compare each person with themselves and "
    "count people, so where the two disagree, these are the ones to trust."
)
ERROR_BARS = (
    "Bars are means of all ratings, error bars one standard deviation of all ratings (the paper does not say what its "
    "own show). Stars are the paper's two-sample t-tests, * for p < .01, not corrected for their number."
)


def rating_report(
    ratings: pd.DataFrame, groups: Sequence[str], planned: Collection[str], *, by: str = "method", compare: bool = True
) -> Result:
    """Means and tests of both scales. See the layout above.

    ``by``: the column that names the groups; ``compare``: False while letters hide methods, for then a letter is
    another method for every participant and a test between letters would say nothing about methods.
    """
    rows = ratings.dropna(subset=list(SCALES))
    rows = rows[rows[by].isin(list(groups))]
    return {
        "groups": list(groups),
        "participants": int(rows["participant"].nunique()),
        "ratings": len(rows),
        "explanation": EXPLANATION,
        "error_bars": ERROR_BARS,
        "star_below": STAR_BELOW,
        "scales": {scale: _scale_report(rows, scale, by, groups, planned, compare) for scale in SCALES},
    }


def _scale_report(
    rows: pd.DataFrame, scale: str, by: str, groups: Sequence[str], planned: Collection[str], compare: bool
) -> Result:
    means = [_mean_of(rows[rows[by] == group], scale, group) for group in groups]
    people = _people(rows, scale, by)
    if not compare:
        return {"means": means, "people": people, "comparisons": [], "mixed_model": None}
    fit = mixed_model(rows, scale, by, groups)
    comparisons: list[Result] = [
        {"first": first, "second": second, **_tests(rows, scale, by, first, second)}
        for first, second in combinations(groups, 2)
    ]
    for comparison, contrast in zip(comparisons, fit.pop("contrasts"), strict=True):
        comparison["mixed_model"] = contrast
    for test in TESTS[1:]:
        _correct([comparison[test] for comparison in comparisons])
    for comparison in comparisons:
        for test in TESTS:
            comparison[test]["planned"] = test in planned
    return {"means": means, "people": people, "comparisons": comparisons, "mixed_model": fit}


def _people(rows: pd.DataFrame, scale: str, by: str) -> list[Result]:
    means = rows.groupby(["participant", by])[scale].mean()
    found: dict[str, dict[str, float]] = {}
    for (participant, group), mean in means.items():
        found.setdefault(str(participant), {})[str(group)] = float(mean)
    return [{"participant": participant, "means": theirs} for participant, theirs in found.items()]


def _mean_of(rows: pd.DataFrame, scale: str, group: str) -> Result:
    """Of one group: all ratings as the paper has them, and the mean over people with its 95 % interval."""
    values, people = _floats(rows[scale]), _floats(rows.groupby("participant")[scale].mean())
    low, high = mean_interval(people)
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


def mean_interval(values: Floats) -> tuple[float | None, float | None]:
    """The 95 % t interval of a mean; None for fewer than three values, which can hardly say how they scatter."""
    if len(values) < FEWEST_PAIRED:
        return None, None
    margin = float(stats.t.ppf(0.975, len(values) - 1)) * float(values.std(ddof=1)) / len(values) ** 0.5
    return plain(values.mean() - margin), plain(values.mean() + margin)


def _tests(rows: pd.DataFrame, scale: str, by: str, first: str, second: str) -> dict[str, Result]:
    every = {group: _floats(rows[rows[by] == group][scale]) for group in (first, second)}
    differences = paired_differences(rows, scale, by, first, second)
    return {
        "two_sample_t": two_sample_t(every[first], every[second]),
        "paired_t": paired_t(differences),
        "wilcoxon": wilcoxon(differences),
    }


def paired_differences(rows: pd.DataFrame, scale: str, by: str, first: str, second: str) -> Floats:
    """Each person's mean rating of ``second`` minus that of ``first``, by participant; only who rated both. (P,)"""
    means = rows.pivot_table(index="participant", columns=by, values=scale, aggfunc="mean")
    if first not in means or second not in means:
        return np.empty(0)
    # Means of three ratings are thirds: without rounding, equal differences would differ in their last bit.
    return _floats((means[second] - means[first]).dropna().round(12))


def two_sample_t(first: Floats, second: Floats) -> Result:
    """The paper's test: Student's, equal variances, every rating counted as independent."""
    if min(len(first), len(second)) < FEWEST_RATINGS:
        return _not(f"there are {len(first)} and {len(second)} ratings; {FEWEST_RATINGS} of each are needed")
    if first.std() == 0 and second.std() == 0:
        return _not("all ratings of each of the two are the same, so there is no spread to compare with")
    outcome = stats.ttest_ind(second, first, equal_var=True)
    return {
        "n_first": len(first),
        "n_second": len(second),
        "difference": plain(second.mean() - first.mean()),
        "statistic": plain(outcome.statistic),
        "degrees_of_freedom": plain(outcome.df),
        "p": plain(outcome.pvalue),
        "star": bool(outcome.pvalue < STAR_BELOW),
    }


def paired_t(differences: Floats) -> Result:
    """Student's paired t-test on per-person means, with Cohen's d_z. (P,)"""
    n = len(differences)
    if n < FEWEST_PAIRED:
        return _not(_too_few(n, FEWEST_PAIRED))
    if np.ptp(differences) == 0:
        return _not(f"all {n} people have the same difference, so there is no spread to compare with")
    outcome = stats.ttest_1samp(differences, 0.0)
    interval = outcome.confidence_interval(0.95)
    low, high = d_z_interval(float(outcome.statistic), n)
    return {
        "n": n,
        "difference": plain(differences.mean()),
        "low": plain(interval.low),
        "high": plain(interval.high),
        "statistic": plain(outcome.statistic),
        "degrees_of_freedom": n - 1,
        "p": plain(outcome.pvalue),
        "d_z": plain(differences.mean() / differences.std(ddof=1)),
        "d_z_low": plain(low),
        "d_z_high": plain(high),
    }


def wilcoxon(differences: Floats) -> Result:
    """Wilcoxon's signed-rank test on per-person means, zeros dropped, with the matched-pairs rank-biserial. (P,)"""
    n, moved = len(differences), int(np.count_nonzero(differences))
    if n < FEWEST_PAIRED:
        return _not(_too_few(n, FEWEST_PAIRED))
    if moved == 0:
        return _not(f"none of {n} people rated the two differently")
    with warnings.catch_warnings():  # scipy warns of few values; ``smallest_p`` says the same in a number
        warnings.simplefilter("ignore", UserWarning)
        outcome = stats.wilcoxon(differences)
    correlation = rank_biserial(differences)
    low, high = rank_biserial_interval(correlation, moved)
    return {
        "n": n,
        "n_without_ties": moved,
        "median": plain(np.median(differences)),
        "statistic": plain(outcome.statistic),
        "p": plain(outcome.pvalue),
        "smallest_p": 2.0 ** (1 - moved),
        "rank_biserial": plain(correlation),
        "rank_biserial_low": plain(low),
        "rank_biserial_high": plain(high),
    }


def mixed_model(rows: pd.DataFrame, scale: str, by: str, groups: Sequence[str]) -> Result:
    """Linear mixed model, rating ~ group + (1 | participant), by REML; ``contrasts`` in the order of combinations()."""
    pairs = list(combinations(groups, 2))
    reason = _why_no_model(rows, scale, by, groups)
    if reason is not None:
        return {**_not(reason), "contrasts": [_not(reason) for _ in pairs]}
    try:
        fit, notes = _fit(rows, scale, by, groups)
    except np.linalg.LinAlgError as error:
        reason = f"the model cannot be solved for these ratings ({error})"
        return {**_not(reason), "contrasts": [_not(reason) for _ in pairs]}
    return {
        "n_ratings": len(rows),
        "n": int(rows["participant"].nunique()),
        "converged": bool(fit.converged),
        "notes": notes,
        "variance_between_people": plain(np.asarray(fit.cov_re)[0, 0]),
        "variance_within_people": plain(fit.scale),
        "contrasts": [_contrast(fit, groups, first, second) for first, second in pairs],
    }


def _why_no_model(rows: pd.DataFrame, scale: str, by: str, groups: Sequence[str]) -> str | None:
    people = int(rows["participant"].nunique())
    if people < FEWEST_FOR_MODEL:
        return _too_few(people, FEWEST_FOR_MODEL)
    missing = [group for group in groups if not (rows[by] == group).any()]
    if missing:
        return f"nobody has rated {' and '.join(missing)} yet"
    if _floats(rows[scale]).std() == 0:
        return "all ratings are the same"
    return None


def _fit(rows: pd.DataFrame, scale: str, by: str, groups: Sequence[str]) -> tuple[Any, list[str]]:
    """The fitted model, and in words whatever statsmodels warned of."""
    from statsmodels.regression.mixed_linear_model import MixedLM  # seconds to load, and only a report needs it

    design = np.column_stack([np.ones(len(rows)), *(_floats(rows[by] == group) for group in groups[1:])])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit = MixedLM(_floats(rows[scale]), design, groups=rows["participant"].to_numpy()).fit(
            reml=True, method=OPTIMISERS
        )
    messages = dict.fromkeys(str(each.message).split("\n")[0] for each in caught)
    notes = [message for message in messages if not message.startswith("Retrying")]
    if float(np.asarray(fit.cov_re)[0, 0]) < 1e-6:
        notes.append("The spread between people was estimated as zero: the model then is a regression on all ratings.")
    return fit, notes


def _contrast(fit: Any, groups: Sequence[str], first: str, second: str) -> Result:
    """Second minus first, from the model's fixed effects."""
    row = np.zeros((1, len(groups)))
    for group, sign in ((first, -1.0), (second, 1.0)):
        if group != groups[0]:
            row[0, groups.index(group)] = sign
    outcome = fit.t_test(row)
    error = plain(np.squeeze(outcome.sd))
    if error is None:
        return _not("the standard error of this difference could not be computed (see the notes of the model)")
    low, high = np.squeeze(outcome.conf_int(alpha=0.05))
    return {
        "difference": plain(np.squeeze(outcome.effect)),
        "standard_error": error,
        "low": plain(low),
        "high": plain(high),
        "statistic": plain(np.squeeze(outcome.tvalue)),
        "p": plain(np.squeeze(outcome.pvalue)),
        "converged": bool(fit.converged),
        "n": len(fit.model.group_labels),
    }


def _correct(results: Sequence[Result]) -> None:
    """Add Holm's p over the comparisons of one scale that could be computed."""
    computed = [result for result in results if result.get("p") is not None]
    for result, corrected in zip(computed, holm([result["p"] for result in computed]), strict=True):
        result["p_holm"], result["corrected_over"] = corrected, len(computed)


def plain(value: Any) -> float | None:
    """A number that JSON can hold; None for what is unknown or not finite."""
    if value is None or not np.isfinite(float(value)):
        return None
    return float(value)


def is_computed(result: Mapping[str, Any]) -> bool:
    """Whether a test has numbers."""
    return "not_computable" not in result


def _not(reason: str) -> Result:
    return {"not_computable": reason}


def _too_few(people: int, needed: int) -> str:
    return f"{people} {'person has' if people == 1 else 'people have'} rated what is compared; {needed} are needed"


def _floats(values: Any) -> Floats:
    return np.asarray(values, np.float64)
