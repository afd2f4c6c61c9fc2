"""Tests of the difference between two groups of ratings: the paper's exactly, and three that count people.

Each takes arrays and returns its numbers, or ``not_computable``: the reason in words. A difference is always second
minus first. Their measured error rates are in docs/results/error_rates.md and likert.md.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from worker.domain.type_aliases import FloatArray

Result = dict[str, Any]

TESTS = ("paired_t", "mixed_model", "cumulative_link", "wilcoxon", "equivalence", "two_sample_t")
"""Names as in app.domain.protocol.PlannedTest; what is to be relied on comes first, the paper's own last."""
UNCORRECTED = "two_sample_t"
"""The paper's, to which Holm's correction is not applied, as it was not there."""
STAR_BELOW = 0.01
"""The paper's star: p < .01."""
FEWEST_RATINGS = 2
"""Of each group, for the paper's test."""
FEWEST_PAIRED = 3
"""People who rated both groups; with two, one difference decides everything."""
FEWEST_OF_EACH = 3
"""People who rated one of the two alone."""


def two_sample_t(first: FloatArray, second: FloatArray) -> Result:
    """The paper's test: Student's, equal variances, every rating counted as independent."""
    if min(len(first), len(second)) < FEWEST_RATINGS:
        return not_computable(f"there are {len(first)} and {len(second)} ratings; {FEWEST_RATINGS} of each are needed")
    if np.ptp(first) == 0 and np.ptp(second) == 0:
        return not_computable("all ratings of each of the two are the same, so there is no spread to compare with")
    with warnings.catch_warnings():  # scipy warns of a group whose ratings are all the same: its variance is 0 exactly
        warnings.simplefilter("ignore", RuntimeWarning)
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


def paired_t(differences: FloatArray) -> Result:
    """Student's paired t-test on per-person means. (P,)"""
    n = len(differences)
    reason = _why_not(differences)
    if reason is not None:
        return not_computable(reason)
    outcome = stats.ttest_1samp(differences, 0.0)
    interval = outcome.confidence_interval(0.95)
    return {
        "n": n,
        "difference": plain(differences.mean()),
        "low": plain(interval.low),
        "high": plain(interval.high),
        "statistic": plain(outcome.statistic),
        "degrees_of_freedom": n - 1,
        "p": plain(outcome.pvalue),
    }


def equivalence(differences: FloatArray, bound: float) -> Result:
    """Two one-sided paired t-tests: is the mean difference between -bound and bound? (P,), bound in points.

    Schuirmann (1987), Journal of Pharmacokinetics and Biopharmaceutics 15, 657. ``p`` is the larger of the two, and
    below .05 just when the 90 % interval ``low_90`` to ``high_90`` lies between the bounds.
    """
    n = len(differences)
    reason = _why_not(differences)
    if reason is not None:
        return not_computable(reason)
    return {"n": n, **two_one_sided(float(differences.mean()), float(stats.sem(differences)), n - 1, bound)}


def two_one_sided(difference: float, error: float, degrees_of_freedom: float, bound: float) -> Result:
    """Schuirmann's tests of a difference with this standard error."""
    margin = float(stats.t.ppf(0.95, degrees_of_freedom)) * error
    statistic = (bound - abs(difference)) / error
    return {
        "difference": plain(difference),
        "low_90": plain(difference - margin),
        "high_90": plain(difference + margin),
        "bound": bound,
        "statistic": plain(statistic),
        "degrees_of_freedom": degrees_of_freedom,
        "p": plain(stats.t.sf(statistic, degrees_of_freedom)),
    }


def wilcoxon(differences: FloatArray) -> Result:
    """Wilcoxon's signed-rank test on per-person means, zeros dropped, exact whatever is tied. (P,)"""
    n, moved = len(differences), int(np.count_nonzero(differences))
    if n < FEWEST_PAIRED:
        return not_computable(too_few(n))
    if moved == 0:
        return not_computable(f"none of {n} people rated the two differently")
    statistic, p = signed_rank(differences)
    return {
        "n": n,
        "n_without_ties": moved,
        "median": plain(np.median(differences)),
        "statistic": statistic,
        "p": p,
        "smallest_p": 2.0 ** (1 - moved),
    }


def signed_rank(differences: FloatArray) -> tuple[float, float]:
    """The smaller sum of ranks, and its exact two-sided p given the ties: every sign is as likely as the other. (P,)

    The distribution of the sum over all 2^P signs is built up rank by rank, as polynomials are multiplied. Ranks are
    doubled, since tied ones are halves.
    """
    moved = differences[differences != 0]
    doubled = np.rint(2 * stats.rankdata(np.abs(moved))).astype(np.int64)
    chances = np.ones(1)
    for rank in doubled:
        chances = 0.5 * (np.pad(chances, (0, rank)) + np.pad(chances, (rank, 0)))
    positive, total = int(doubled[moved > 0].sum()), int(doubled.sum())
    smaller = min(positive, total - positive)
    return smaller / 2, float(min(1.0, 2 * chances[: smaller + 1].sum()))


def mixed_model(first: Sequence[FloatArray], second: Sequence[FloatArray]) -> Result:
    """Linear mixed model, rating ~ group + (group | participant), of two groups; by person: their ratings of each.

    Estimated in two stages. A person's mean difference d_i scatters by what the groups change for them and by the
    noise of their ratings, tau^2 + sigma^2 (1 / n_i1 + 1 / n_i2): sigma^2 is pooled within people and groups, tau^2
    is Paule and Mandel's, each person counts by the inverse of this variance. The scale is estimated from the people
    and t has people - 1 degrees of freedom (Hartung and Knapp 2001), as the containment rule counts them. With as many
    ratings of everybody all weights are equal: it then is the paired t-test, and no estimate of tau can fail.
    """
    differences = np.array([after.mean() - before.mean() for before, after in zip(first, second, strict=True)])
    n = len(differences)
    reason = _why_not(differences.round(12))
    if reason is not None:
        return not_computable(reason)
    from statsmodels.stats.meta_analysis import combine_effects  # seconds to load, and only a report needs it

    noise = _variance_within([*first, *second])
    per_rating = np.array([1 / len(before) + 1 / len(after) for before, after in zip(first, second, strict=True)])
    fit = combine_effects(differences, per_rating * (noise or 1.0), method_re="iterated", use_t=True)
    mean, error, between = (float(value) for value in (fit.mean_effect_re, fit.sd_eff_w_re_hksj, fit.tau2))
    if not noise:  # nothing to weigh by: people count alike
        mean, error, between = float(differences.mean()), float(stats.sem(differences)), float(differences.var(ddof=1))
    margin = float(stats.t.ppf(0.975, n - 1)) * error
    return {
        "n": n,
        "n_ratings": sum(len(values) for values in (*first, *second)),
        "difference": plain(mean),
        "standard_error": plain(error),
        "low": plain(mean - margin),
        "high": plain(mean + margin),
        "statistic": plain(mean / error),
        "degrees_of_freedom": n - 1,
        "p": plain(2 * stats.t.sf(abs(mean / error), n - 1)),
        "sd_between_people": plain(between**0.5),
        "sd_within_people": None if noise is None else plain(noise**0.5),
    }


def _variance_within(cells: Sequence[FloatArray]) -> float | None:
    """Pooled over cells; None where no cell has two ratings."""
    degrees_of_freedom = sum(len(cell) - 1 for cell in cells)
    if degrees_of_freedom == 0:
        return None
    return float(sum(((cell - cell.mean()) ** 2).sum() for cell in cells)) / degrees_of_freedom


def _why_not(differences: FloatArray) -> str | None:
    n = len(differences)
    if n < FEWEST_PAIRED:
        return too_few(n)
    if np.ptp(differences) == 0:
        return f"all {n} people have the same difference, so there is no spread to compare with"
    return None


def plain(value: Any) -> float | None:
    """A number that JSON can hold; None for what is unknown or not finite."""
    if value is None or not np.isfinite(float(value)):
        return None
    return float(value)


def not_computable(reason: str) -> Result:
    """The result of a test that cannot say anything."""
    return {"not_computable": reason}


def too_few(people: int, needed: int = FEWEST_PAIRED) -> str:
    """Why a paired test needs more people."""
    return f"{people} {'person has' if people == 1 else 'people have'} rated both; {needed} are needed"


def few_of_each(first: int, second: int) -> str:
    """Why a test between people needs more of them."""
    return f"{first} and {second} people rated one of the two alone; {FEWEST_OF_EACH} of each are needed"


def welch_freedom(variances: Sequence[float], sizes: Sequence[int]) -> float:
    """Degrees of freedom of a difference (Welch 1947) whose parts have these variances, from so many people each."""
    scatter = sum(variance**2 / (size - 1) for variance, size in zip(variances, sizes, strict=True))
    return sum(variances) ** 2 / scatter if scatter else float(np.inf)
