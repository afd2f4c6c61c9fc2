"""Every table and figure of a study's report, computed from the CSV files of its export.

    python -m pip install pandas scipy statsmodels matplotlib
    python analysis.py                      reads csv/ beside this file, writes tables and figures into analysis/
    python analysis.py some/csv some/folder

Written to be read and changed. One function per table, named as the file it becomes; empty cells are what could not be
computed (too few people, no spread). A difference is always second minus first. Data and meanings: dictionary.md.
"""

import math
import sys
import warnings
from itertools import combinations
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy import optimize, special, stats
from scipy.sparse.csgraph import connected_components
from statsmodels.genmod.families import Binomial
from statsmodels.genmod.generalized_linear_model import GLM
from statsmodels.regression.linear_model import OLS
from statsmodels.stats.meta_analysis import combine_effects

SCALES = ("satisfaction", "personalisation")
"""Of the ratings; both from 1 to 5."""
WITHIN = ("paired_t", "mixed_model", "cumulative_link", "wilcoxon", "equivalence", "two_sample_t")
BETWEEN = ("welch_t", "permutation", "cumulative_link_between", "equivalence_between")
WINDOW, FIRST_POINT = 30, 5
"""Answers in the running accuracy, and from which answer on it is drawn."""
NAMES = {
    "reference": "Pre-trained policy",
    "prefft": "PrefFT",
    "prefft_anchored": "PrefFT, anchored",
    "pbarl": "PbARL",
    "pbarl_printed": "PbARL as printed",
    "somebody_else": "Somebody else's filter",
    "average": "Average filter",
    "self_set": "Set by the person",
}
COSTS = ("C_d", "C_v", "C_f", "C_hf", "C_fd", "C_fdv")


# --- reading ---


class Study:
    """The exported tables, and what follows from them about the design."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.participants = self.read("participants")
        self.queries = self.read("queries")
        self.evaluations = self.read("evaluations")
        self.forms = self.read("forms")
        self.scores = self.read("scores")
        self.scoring_key = self.read("scoring_key")
        self.head_to_heads = self.read("headtoheads")
        ratings = self.read("ratings")
        methods = self.read("methods")
        self.methods = list(methods["method"])
        # Points; the study's smallest difference that matters.
        self.bound = float(methods["equivalence_bound"].iloc[0]) if len(methods) else None
        # Until a study is unblinded there are letters alone, and a letter is another method for everybody.
        self.blinded = bool(len(ratings)) and ratings["method"].isna().all()
        self.by = "letter" if self.blinded else "method"
        self.groups = list("ABCDE"[: len(self.methods)]) if self.blinded else self.methods
        self.between = bool(self.participants["arm"].notna().any())
        self.letters = ratings.drop_duplicates(["participant", "letter"]).set_index(["participant", "letter"])["method"]
        self.ratings = ratings[yes(ratings["counts"]) & ratings[self.by].isin(self.groups)].dropna(subset=list(SCALES))

    def read(self, name):
        path = self.folder / f"{name}.csv"
        if not path.exists():
            sys.exit(f"{path} is not there. Unpack the whole zip file of the export, and name its folder csv/.")
        return pd.read_csv(path)


def yes(column):
    return column.astype(str).str.lower() == "true"


# --- what is computed from numbers alone ---


def mean_interval(values, lowest=-np.inf, highest=np.inf):
    """95 % t interval of a mean, cut off where no mean can be; from three values on."""
    if len(values) < 3:
        return None, None
    margin = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values))
    return max(values.mean() - margin, lowest), min(values.mean() + margin, highest)


def wilson(correct, scored):
    """95 % interval of a share (Wilson 1927)."""
    z, share = 1.959964, correct / scored
    centre = (share + z * z / (2 * scored)) / (1 + z * z / scored)
    half = z * math.sqrt(share * (1 - share) / scored + z * z / (4 * scored**2)) / (1 + z * z / scored)
    return max(0.0, centre - half), min(1.0, centre + half)


def holm(p_values):
    """Holm's step-down p values; None stands for a test without a result, which still counts in the family."""
    corrected, largest = [None] * len(p_values), 0.0
    known = sorted((p, place) for place, p in enumerate(p_values) if p is not None)
    for rank, (p, place) in enumerate(known):
        largest = max(largest, min(1.0, p * (len(p_values) - rank)))
        corrected[place] = largest
    return corrected


def noncentrality(t, freedom, share_below):
    """The noncentral t distribution of which this share lies below t."""

    def excess(nc):
        return stats.nct.cdf(t, freedom, nc) - share_below

    step = 0.25 * (1 + abs(t)) * (1 if excess(t) > 0 else -1)
    inner, outer = t, t + step
    while excess(outer) * excess(inner) > 0:
        inner, outer = outer, outer + step
    return optimize.brentq(excess, *sorted((inner, outer)), xtol=1e-9)


def two_sample_t(first, second):
    """The paper's test, which counts ratings and not people: mind that several come from one person."""
    if min(len(first), len(second)) < 2 or (np.ptp(first) == 0 and np.ptp(second) == 0):
        return {}
    found = stats.ttest_ind(second, first)
    return {
        "n_first": len(first),
        "n_second": len(second),
        "difference": second.mean() - first.mean(),
        "statistic": found.statistic,
        "degrees_of_freedom": found.df,
        "p": found.pvalue,
    }


def paired_t(differences):
    """Student's paired t-test with Cohen's d_z and its exact interval (Steiger and Fouladi 1997)."""
    n = len(differences)
    if n < 3 or np.ptp(differences) == 0:
        return {}
    found = stats.ttest_1samp(differences, 0.0)
    low, high = found.confidence_interval(0.95)
    return {
        "n": n,
        "difference": differences.mean(),
        "low": low,
        "high": high,
        "statistic": found.statistic,
        "degrees_of_freedom": n - 1,
        "p": found.pvalue,
        "d_z": differences.mean() / differences.std(ddof=1),
        "d_z_low": noncentrality(found.statistic, n - 1, 0.975) / math.sqrt(n),
        "d_z_high": noncentrality(found.statistic, n - 1, 0.025) / math.sqrt(n),
    }


def wilcoxon(differences):
    """Signed-rank test, zeros dropped, exact given the ties: the sums of ranks over all signs, rank by rank."""
    moved = differences[differences != 0]
    if len(differences) < 3 or len(moved) == 0:
        return {}
    ranks = stats.rankdata(np.abs(moved))
    chances = np.ones(1)
    for rank in np.rint(2 * ranks).astype(int):
        chances = 0.5 * (np.pad(chances, (0, rank)) + np.pad(chances, (rank, 0)))
    positive, total = ranks[moved > 0].sum(), ranks.sum()
    smaller = min(positive, total - positive)
    found = {
        "n": len(differences),
        "n_without_ties": len(moved),
        "median": np.median(differences),
        "statistic": smaller,
        "p": min(1.0, 2 * chances[: round(2 * smaller) + 1].sum()),
        "smallest_p": 2.0 ** (1 - len(moved)),
        "rank_biserial": (2 * positive - total) / total,
    }
    n = len(moved)
    trials = 3 * n * (n + 1) / (2 * (2 * n + 1))  # Wilson's interval of a share of so many: as variable as these ranks
    low, high = wilson(trials * positive / total, trials)
    return found | {"rank_biserial_low": max(2 * low - 1, -1.0), "rank_biserial_high": min(2 * high - 1, 1.0)}


def mixed_model(first, second):
    """rating ~ group + (group | person), in two stages: Paule and Mandel's variance, Hartung and Knapp's error.

    ``first``, ``second``: per person the ratings of each group.
    """
    differences = np.array([b.mean() - a.mean() for a, b in zip(first, second, strict=True)])
    n, cells = len(differences), [*first, *second]
    if n < 3 or np.ptp(differences.round(12)) == 0:
        return {}
    freedom = sum(len(cell) - 1 for cell in cells)
    within = sum(((cell - cell.mean()) ** 2).sum() for cell in cells) / freedom if freedom else None
    if within:
        weights = within * np.array([1 / len(a) + 1 / len(b) for a, b in zip(first, second, strict=True)])
        fit = combine_effects(differences, weights, method_re="iterated", use_t=True)
        mean, error, between = fit.mean_effect_re, fit.sd_eff_w_re_hksj, fit.tau2
    else:
        mean, error, between = differences.mean(), stats.sem(differences), differences.var(ddof=1)
    margin = stats.t.ppf(0.975, n - 1) * error
    return {
        "n": n,
        "n_ratings": sum(map(len, cells)),
        "difference": mean,
        "standard_error": error,
        "low": mean - margin,
        "high": mean + margin,
        "statistic": mean / error,
        "degrees_of_freedom": n - 1,
        "p": 2 * stats.t.sf(abs(mean / error), n - 1),
        "sd_between_people": math.sqrt(between),
        "sd_within_people": None if within is None else math.sqrt(within),
    }


def cumulative_link(first, second):
    """Ratings as an order: proportional odds, rating ~ group + (1 | person), errors that count people (sandwich).

    In R: ordinal::clmm(rating ~ group + (1 | person), nAGQ = 10); its own errors suppose one effect for everybody.
    """
    n = len(first)
    if n < 4:
        return {}
    found, influences = fit_two(first, second, [*range(n), *range(n)])
    variance = n / (n - 1) * (influences**2).sum() if found is not None else 0.0
    return odds_of(found, variance, n - 1, {"n": n, "n_ratings": sum(map(len, [*first, *second]))})


def cumulative_link_between(first, second):
    """The same of different people: a variance for each group, and Welch's degrees of freedom."""
    sizes = len(first), len(second)
    if min(sizes) < 3:
        return {}
    found, influences = fit_two(first, second, range(sum(sizes)))
    groups = np.split(influences, [sizes[0]])
    variances = [n / (n - 1) * (each**2).sum() for n, each in zip(sizes, groups, strict=True)]
    counts = {"n_first": sizes[0], "n_second": sizes[1], "n_ratings": sum(map(len, [*first, *second]))}
    return odds_of(found, sum(variances), welch_freedom(variances, sizes), counts)


def welch_freedom(variances, sizes):
    scatter = sum(variance**2 / (n - 1) for variance, n in zip(variances, sizes, strict=True))
    return sum(variances) ** 2 / scatter if scatter else math.inf


def fit_two(first, second, people):
    """Parameters (None: no finite ones), and what each person moves the effect by; ``people``: whose each cell is."""
    cells = [*first, *second]
    ratings, x = np.concatenate(cells), np.repeat([0.0, 1.0], [sum(map(len, first)), sum(map(len, second))])
    if np.ptp(ratings) == 0:
        return None, np.zeros(max(people) + 1)
    person = np.repeat(list(people), [len(cell) for cell in cells])
    found, scores, information = OrderedRatings(ratings, x, person).fit()
    unfit = abs(found[-2]) > 12 or abs(found[-1]) > 8 or np.abs(scores.sum(axis=0)).max() > 1e-6
    return None if unfit else found, scores @ np.linalg.pinv(information)[:, -2]


def odds_of(found, variance, freedom, counts):
    error = math.sqrt(variance)
    if found is None or error < 1e-6:
        return {}
    difference = found[-2]
    margin = stats.t.ppf(0.975, freedom) * error
    low, high = difference - margin, difference + margin
    return {
        **counts,
        "difference": difference,
        "standard_error": error,
        "low": low,
        "high": high,
        "odds_ratio": math.exp(difference),
        "odds_ratio_low": math.exp(low),
        "odds_ratio_high": math.exp(high),
        "statistic": difference / error,
        "degrees_of_freedom": freedom,
        "p": 2 * stats.t.sf(abs(difference / error), freedom),
        "sd_between_people": abs(found[-1]),
    }


class OrderedRatings:
    """The marginal likelihood of thresholds, effect and the people's standard deviation, on a fine grid of levels."""

    def __init__(self, ratings, x, person):
        found, self.levels = np.unique(ratings, return_inverse=True)
        # What is the same of one person is counted: it adds to the likelihood alike.
        kinds, which = np.unique(np.column_stack([self.levels, x]), axis=0, return_inverse=True)
        self.levels, self.x, self.cuts = kinds[:, 0].astype(int), kinds[:, 1], len(found) - 1
        self.counts = np.zeros((person.max() + 1, len(kinds)))
        np.add.at(self.counts, (person, which.ravel()), 1.0)
        below = np.cumsum(np.bincount(self.levels, self.counts.sum(axis=0)))[:-1] / len(ratings)
        self.start, self.grid = special.logit(below), np.linspace(-8, 8, 161)
        self.log_weights = stats.norm.logpdf(self.grid) + math.log(self.grid[1] - self.grid[0])

    def scores(self, values):
        """Log-likelihood of everybody, and its derivatives by thresholds, effect and SD: (people, parameters)."""
        ends = np.concatenate([[-np.inf], values[: self.cuts], [np.inf]])
        shift = (values[-2] * self.x)[:, None] + values[-1] * self.grid
        lower, upper = ends[self.levels][:, None], ends[self.levels + 1][:, None]
        at_most, at_least = special.expit(upper - shift), special.expit(shift - lower)
        chance = (at_most * at_least * -np.expm1(lower - upper)).clip(1e-300)
        logs = self.counts @ np.log(chance) + self.log_weights
        likelihoods = special.logsumexp(logs, axis=1)
        weights = np.exp(logs - likelihoods[:, None])
        effect, upper, lower, sd = (
            self.counts * (weights @ slopes.T)
            for slopes in (
                at_most - at_least,
                at_most * (1 - at_most) / chance,
                at_least * (1 - at_least) / chance,
                (at_most - at_least) * self.grid,
            )
        )
        cuts = np.arange(self.cuts)
        by_cut = upper @ (self.levels[:, None] == cuts) - lower @ (self.levels[:, None] == cuts + 1)
        return likelihoods, np.column_stack([by_cut, effect @ self.x, sd.sum(axis=1)])

    def information(self, values, step=1e-5):
        def slope(at):
            return self.scores(at)[1].sum(axis=0)

        found = np.array([slope(values - each) - slope(values + each) for each in step * np.eye(len(values))]) / (
            2 * step
        )
        return (found + found.T) / 2

    def fit(self):
        """Parameters where the likelihood is largest, everybody's scores there, and the observed information."""
        cuts, start = self.cuts, self.start

        def ordered(free):  # the first threshold and the logarithms of the gaps between them, effect, SD
            return np.concatenate([np.cumsum([free[0], *np.exp(free[1:cuts])]), free[cuts:]])

        def misfit(free):
            likelihoods, scores = self.scores(ordered(free))
            gradient = scores.sum(axis=0)
            gradient[:cuts] = np.cumsum(gradient[:cuts][::-1])[::-1]
            gradient[1:cuts] *= np.exp(free[1:cuts])
            return -likelihoods.sum(), -gradient

        ends = [(-30, 30)] + [(-12, 3.5)] * (cuts - 1) + [(-13, 13)] * 2
        free = [start[0], *np.log(np.diff(start)), 0.0, 1.0]
        best = optimize.minimize(misfit, free, jac=True, method="L-BFGS-B", bounds=ends, options={"ftol": 1e-13})
        values = ordered(best.x)
        step = np.linalg.pinv(self.information(values))
        for _ in range(3):  # Newton's steps, for the last digits
            values = values + step @ self.scores(values)[1].sum(axis=0)
        return values, self.scores(values)[1], self.information(values)


def equivalence(differences, bound):
    """Two one-sided paired t-tests (Schuirmann 1987): p below .05 shows that the means are less than bound apart."""
    n = len(differences)
    if n < 3 or np.ptp(differences) == 0:
        return {}
    low, high = stats.ttest_1samp(differences, 0.0).confidence_interval(0.90)
    above = stats.ttest_1samp(differences, -bound, alternative="greater")
    below = stats.ttest_1samp(differences, bound, alternative="less")
    return {
        "n": n,
        "difference": differences.mean(),
        "low_90": low,
        "high_90": high,
        "bound": bound,
        "statistic": min(above.statistic, -below.statistic),
        "degrees_of_freedom": n - 1,
        "p": max(above.pvalue, below.pvalue),
    }


def can_be_compared(first, second):
    return min(len(first), len(second)) >= 3 and (np.ptp(first) > 0 or np.ptp(second) > 0)


def welch_t(first, second):
    """Welch's test of people who met one of the two methods, with Hedges' g."""
    if not can_be_compared(first, second):
        return {}
    with warnings.catch_warnings():  # a group that agrees has no variance, which is no error
        warnings.simplefilter("ignore", RuntimeWarning)
        found = stats.ttest_ind(second, first, equal_var=False)
    low, high = found.confidence_interval(0.95)
    freedom, scale = len(first) + len(second) - 2, math.sqrt(1 / len(first) + 1 / len(second))
    small = math.exp(math.lgamma(freedom / 2) - math.lgamma((freedom - 1) / 2)) / math.sqrt(freedom / 2)
    within = ((first - first.mean()) ** 2).sum() + ((second - second.mean()) ** 2).sum()
    g = (second.mean() - first.mean()) / math.sqrt(within / freedom)
    return {
        "n_first": len(first),
        "n_second": len(second),
        "difference": second.mean() - first.mean(),
        "low": low,
        "high": high,
        "statistic": found.statistic,
        "degrees_of_freedom": found.df,
        "p": found.pvalue,
        "g": small * g,
        "g_low": small * noncentrality(g / scale, freedom, 0.975) * scale,
        "g_high": small * noncentrality(g / scale, freedom, 0.025) * scale,
    }


def equivalence_between(first, second, bound):
    """Two one-sided Welch tests, of people who met one of the two methods."""
    if not can_be_compared(first, second):
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        whole = stats.ttest_ind(second, first, equal_var=False)
        above = stats.ttest_ind(second + bound, first, equal_var=False, alternative="greater")
        below = stats.ttest_ind(second - bound, first, equal_var=False, alternative="less")
    low, high = whole.confidence_interval(0.90)
    return {
        "n_first": len(first),
        "n_second": len(second),
        "difference": second.mean() - first.mean(),
        "low_90": low,
        "high_90": high,
        "bound": bound,
        "statistic": min(above.statistic, -below.statistic),
        "degrees_of_freedom": whole.df,
        "p": max(above.pvalue, below.pvalue),
    }


def permutation(first, second, most=20_000, seed=112):
    """Welch's statistic among all ways to divide the people, or among that many drawn ones."""
    if not can_be_compared(first, second):
        return {}
    values, n, size = np.concatenate([first, second]), len(first) + len(second), len(first)
    exact = math.comb(n, size) <= most
    if exact:
        chosen = np.array(list(combinations(range(n), size)))
        ways = np.zeros((len(chosen), n))
        ways[np.arange(len(chosen))[:, None], chosen] = 1.0
    else:
        drawn = np.random.default_rng(seed).random((most, n)).argsort(axis=1) < size
        ways = np.vstack([np.arange(n) < size, drawn]).astype(float)
    found = np.abs(welch_statistics(values, ways))
    seen = np.abs(welch_statistics(values, (np.arange(n) < size)[None].astype(float)))[0]
    return {
        "n_first": size,
        "n_second": n - size,
        "difference": second.mean() - first.mean(),
        "p": (found >= seen - 1e-9).mean(),
        "exact": exact,
        "ways": len(ways),
    }


def welch_statistics(values, ways):
    """Of every division of the people, (ways, people): 1 for who is in the first group. No spread: infinite."""
    centred, size = values - values.mean(), ways[0].sum()
    rest = len(values) - size
    sums, squares = ways @ centred, ways @ centred**2
    first = np.maximum(squares - sums**2 / size, 0) / (size - 1) / size
    second = np.maximum((centred**2).sum() - squares - sums**2 / rest, 0) / (rest - 1) / rest
    difference, error = -sums / rest - sums / size, first + second
    with np.errstate(divide="ignore", invalid="ignore"):
        t = difference / np.sqrt(np.where(error < 1e-12, 0.0, error))
    return np.where(np.abs(difference) < 1e-12, 0.0, t)


def reliability(items):
    """Cronbach's alpha with Feldt's interval, McDonald's omega, of two items Spearman-Brown. (people, items)"""
    people, count = items.shape
    found = {"people": people, "items": count}
    if count < 2 or people < 3:
        return found
    covariance = np.cov(items, rowvar=False)
    if covariance.sum() <= 0 or (np.diag(covariance) <= 0).any():
        return found
    alpha = count / (count - 1) * (1 - np.trace(covariance) / covariance.sum())
    freedom = people - 1, (people - 1) * (count - 1)
    found["alpha"] = alpha
    found["low"], found["high"] = (1 - (1 - alpha) * stats.f.ppf(tail, *freedom) for tail in (0.975, 0.025))
    if count == 2:
        r = np.corrcoef(items, rowvar=False)[0, 1]
        found["spearman_brown"] = 2 * r / (1 + r)
    else:
        found["omega"] = omega(covariance, people)
    return found


def omega(covariance, people):
    """Of one factor, by maximum likelihood over the unique variances, at least 0.005 of each item (as R's factanal).

    With few people there are several maxima: the best is sought from factanal's start and from one for every item.
    None where it cannot be fitted: too few people, or items that determine each other.
    """
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    if people <= len(covariance) or np.linalg.eigvalsh(correlation)[0] < 1e-8:
        return None

    def spectrum(unique):
        return np.linalg.eigh(correlation / np.sqrt(np.outer(unique, unique)))

    def loadings(unique):
        values, vectors = spectrum(unique)
        return np.sqrt(unique) * vectors[:, -1] * math.sqrt(max(values[-1] - 1, 0))

    def misfit(unique):
        rest, found = spectrum(unique)[0][:-1], loadings(unique)
        gradient = np.diag(np.outer(found, found) + np.diag(unique) - correlation) / unique**2
        return (rest - np.log(rest) - 1).sum(), gradient

    def fitted(start, **options):
        ends = [(0.005, 1.0)] * len(start)
        return optimize.minimize(misfit, start, jac=True, method="L-BFGS-B", bounds=ends, options=options)

    usual = (1 - 0.5 / len(covariance)) / np.diag(np.linalg.inv(correlation))
    roughly = [fitted(start, ftol=1e-7) for start in (usual, *(0.9 - 0.8 * np.eye(len(usual))))]
    best = min(roughly, key=lambda each: each.fun).x
    unique = fitted(best, ftol=1e-15, gtol=1e-10, maxiter=10_000, maxfun=100_000).x
    common = (loadings(unique) * scale).sum() ** 2
    return common / (common + (unique * scale**2).sum())


# --- ratings ---


def means_of(rows, value, by, groups, lowest=1, highest=5):
    """All ratings as the paper has them, and the mean over people."""
    found = []
    for group in groups:
        mine = rows[rows[by] == group]
        values, people = mine[value].to_numpy(float), mine.groupby("participant")[value].mean().to_numpy(float)
        low, high = mean_interval(people, lowest, highest)
        found.append(
            {
                "group": group,
                "ratings": len(values),
                "participants": len(people),
                "mean": values.mean() if len(values) else None,
                "sd": values.std(ddof=1) if len(values) > 1 else None,
                "participant_mean": people.mean() if len(people) else None,
                "low": low,
                "high": high,
            }
        )
    return found


def comparisons_of(rows, value, groups, tests=WITHIN, bound=None):
    """Every test of every two methods, with Holm's correction over the comparisons of one test."""
    cells = {key: found.to_numpy(float) for key, found in rows.groupby(["participant", "method"])[value]}
    people = list(dict.fromkeys(rows["participant"]))
    found = []
    for first, second in combinations(groups, 2):
        both = [each for each in sorted(people) if (each, first) in cells and (each, second) in cells]
        mine, theirs = [cells[each, first] for each in both], [cells[each, second] for each in both]
        differences = np.array([b.mean() - a.mean() for a, b in zip(mine, theirs, strict=True)]).round(12)
        alone = [
            [cells[each, one] for each in people if (each, one) in cells and (each, other) not in cells]
            for one, other in ((first, second), (second, first))
        ]
        apart = [np.array([each.mean() for each in group]).round(12) for group in alone]
        every = [rows[rows["method"] == group][value].to_numpy(float) for group in (first, second)]
        computed = {
            "two_sample_t": lambda every=every: two_sample_t(*every),
            "paired_t": lambda differences=differences: paired_t(differences),
            "wilcoxon": lambda differences=differences: wilcoxon(differences),
            "mixed_model": lambda mine=mine, theirs=theirs: mixed_model(mine, theirs),
            "cumulative_link": lambda mine=mine, theirs=theirs: cumulative_link(mine, theirs),
            "equivalence": lambda differences=differences: equivalence(differences, bound),
            "welch_t": lambda apart=apart: welch_t(*apart),
            "permutation": lambda apart=apart: permutation(*apart),
            "cumulative_link_between": lambda alone=alone: cumulative_link_between(*alone),
            "equivalence_between": lambda apart=apart: equivalence_between(*apart, bound),
        }
        found += [{"first": first, "second": second, "test": test, **computed[test]()} for test in tests]
    for test in tests:
        family = [each for each in found if each["test"] == test]
        corrected = holm([each.get("p") for each in family]) if test != "two_sample_t" else []
        for each, p in zip(family, corrected, strict=False):
            each["p_holm"] = p
    return found


def means(study):
    return [
        {"scale": scale, **each} for scale in SCALES for each in means_of(study.ratings, scale, study.by, study.groups)
    ]


def people(study):
    """Each person's mean rating of each robot."""
    found = study.ratings.groupby(["participant", study.by])
    return [
        {"scale": scale, "participant": person, "group": group, "mean": mean}
        for scale in SCALES
        for (person, group), mean in found[scale].mean().items()
    ]


def comparisons(study):
    if study.blinded:
        return []
    tests = WITHIN + (BETWEEN if study.between else ())
    return [
        {"scale": scale, **each}
        for scale in SCALES
        for each in comparisons_of(study.ratings, scale, study.groups, tests, study.bound)
    ]


def order_effects(study):
    """Period and carryover (Jones and Kenward 2014): person + method + period, then + the method before."""
    found = []
    for scale in () if study.blinded else SCALES:
        blocks = study.ratings.groupby(["participant", "method"], as_index=False).agg({scale: "mean", "order": "min"})
        blocks = blocks.sort_values(["participant", "order"])
        blocks["period"] = blocks.groupby("participant").cumcount() + 1
        blocks["before"] = blocks.groupby("participant")["method"].shift(1).fillna("")
        blocks = blocks[blocks.groupby("participant")["method"].transform("count") > 1]
        if blocks["participant"].nunique() < 4 or blocks["period"].max() < 2:
            continue
        base = [pd.get_dummies(blocks["participant"]), pd.get_dummies(blocks["method"], drop_first=True)]
        period = pd.get_dummies(blocks["period"], drop_first=True, prefix="period")
        before = pd.get_dummies(blocks["before"], drop_first=True, prefix="before")
        with warnings.catch_warnings():  # the first period has no method before it, so some columns follow from others
            warnings.simplefilter("ignore")
            fits = [
                OLS(blocks[scale], pd.concat(columns, axis=1).astype(float)).fit()
                for columns in (base, [*base, period], [*base, period, before])
            ]
        for name, without, whole in (("period", *fits[:2]), ("carryover", *fits[1:])):
            if whole.df_resid < 2 or whole.df_resid == without.df_resid or whole.ssr < 1e-12:
                continue
            f, p, freedom = whole.compare_f_test(without)
            found.append({"scale": scale, "effect": name, "F": f, "df": freedom, "df_error": whole.df_resid, "p": p})
        if fits[1].df_resid >= 2:
            ends = fits[1].conf_int()
            for name in period.columns:
                low, high = ends.loc[name]
                found.append(
                    {"scale": scale, "effect": name, "difference": fits[1].params[name], "low": low, "high": high}
                )
    return found


# --- head-to-heads and guesses ---


def head_to_heads(study):
    """Answers that count, with the methods on both sides."""
    rows = study.head_to_heads
    return rows[yes(rows["counts"]) & rows["left_method"].isin(study.groups) & rows["right_method"].isin(study.groups)]


def wins(study):
    """How often row was preferred to column; equal is half a win for each."""
    if study.blinded or study.head_to_heads.empty:
        return []
    table = pd.DataFrame(0.0, index=study.groups, columns=study.groups)
    for each in head_to_heads(study).itertuples():
        share = {"left": 1.0, "equal": 0.5, "right": 0.0}[each.response]
        table.loc[each.left_method, each.right_method] += share
        table.loc[each.right_method, each.left_method] += 1 - share
    return [
        {"group": row, "against": column, "wins": table.loc[row, column]}
        for row in study.groups
        for column in study.groups
    ]


def strengths(study):
    """Bradley and Terry's model as a logistic regression, with a sandwich variance over people.

    Rows with a group: its strength; rows with first and second: the difference of strengths, and how often the second
    is preferred. Where no finite strength fits or nothing scatters, the latter is the mean over people.
    """
    rows = pd.DataFrame(wins(study))
    answers, groups = head_to_heads(study), study.groups
    who = answers["participant"].unique()
    if rows.empty or len(who) < 4:
        return []
    table = rows.pivot(index="group", columns="against", values="wins").loc[groups, groups].to_numpy()
    fits = connected_components(table > 0, connection="strong")[0] == 1
    result, difference_of = strengths_of(answers, groups) if fits else ([], lambda i, j: {})
    pairs = []
    for i, j in combinations(range(len(groups)), 2):
        found = difference_of(i, j)
        if "p" not in found:
            found |= shares_of(answers, groups[i], groups[j])
        pairs.append({"first": groups[i], "second": groups[j], **found})
    for pair, p in zip(pairs, holm([each.get("p") for each in pairs]), strict=True):
        pair["p_holm"] = p
    return result + pairs


def strengths_of(answers, groups):
    """The strength of each group, and a function for the difference of two, by their numbers."""
    design = np.array(
        [[(each.left_method == g) - (each.right_method == g) for g in groups] for each in answers.itertuples()], float
    )
    won = answers["response"].map({"left": 1.0, "equal": 0.5, "right": 0.0}).to_numpy(float)
    clusters, who = pd.factorize(answers["participant"])
    fit = GLM(won, design[:, 1:], family=Binomial()).fit(tol=1e-12, maxiter=100)
    centre = (np.eye(len(groups)) - 1 / len(groups))[:, 1:]
    found = centre @ fit.params
    weights = fit.fittedvalues * (1 - fit.fittedvalues)
    people = [design[clusters == i, 1:] for i in range(len(who))]
    information = np.array([rows.T @ (weights[clusters == i, None] * rows) for i, rows in enumerate(people)])
    scores = np.array([rows.T @ (won - fit.fittedvalues)[clusters == i] for i, rows in enumerate(people)])
    result = []
    for i, group in enumerate(groups):
        error, freedom = error_of_strengths(scores, information, centre[i])
        row = {"group": group, "strength": found[i]}
        if error > 1e-9:
            margin = stats.t.ppf(0.975, freedom) * error
            row |= {"low": found[i] - margin, "high": found[i] + margin, "degrees_of_freedom": freedom}
        result.append(row)

    def difference_of(i, j):
        difference = found[j] - found[i]
        error, freedom = error_of_strengths(scores, information, centre[j] - centre[i])
        pair = {"difference": difference, "chance": special.expit(difference)}
        if error > 1e-9:
            margin = stats.t.ppf(0.975, freedom) * error
            pair["low"], pair["high"] = difference - margin, difference + margin
            pair["chance_low"], pair["chance_high"] = special.expit(pair["low"]), special.expit(pair["high"])
            pair["p"] = 2 * stats.t.sf(abs(difference / error), freedom)
            pair |= {"degrees_of_freedom": freedom, "test": "bradley_terry"}
        return pair

    return result, difference_of


def shares_of(answers, first, second):
    """How often each person who met both preferred the second: mean, Wilson's interval with people as trials, test."""
    won = answers["response"].map({"left": 0.0, "equal": 0.5, "right": 1.0})
    straight = (answers["left_method"] == first) & (answers["right_method"] == second)
    turned = (answers["left_method"] == second) & (answers["right_method"] == first)
    shares = won.where(straight, 1 - won)[straight | turned].groupby(answers["participant"]).mean().to_numpy()
    if len(shares) < 4:
        return {}
    low, high = wilson(shares.sum(), len(shares))
    found = {"chance": shares.mean(), "chance_low": low, "chance_high": high}
    beyond = (shares - 0.5).round(12)
    return found | ({"p": wilcoxon(beyond)["p"], "test": "wilcoxon"} if beyond.any() else {})


def error_of_strengths(scores, information, contrast):
    """Standard error of a difference of strengths and its degrees of freedom; nan where too few people tell.

    A sandwich over people, corrected for the people whom this difference rests on (Bell and McCaffrey 2002).
    """
    bread = np.linalg.inv(information.sum(axis=0))
    parts = information @ bread @ contrast
    alone = parts @ bread @ contrast
    tells = alone > 1e-9 * alone.sum()
    seen, parts, alone = scores[tells] @ bread @ contrast, parts[tells], alone[tells]
    shared = parts @ bread @ parts.T
    left = alone - np.diag(shared)
    if (left < 1e-9 * alone).any():
        return np.nan, np.nan
    scale = np.sqrt(alone / left)
    model = scale[:, None] * (np.diag(alone) - shared) * scale
    freedom = np.trace(model) ** 2 / (model**2).sum()
    return (np.nan, np.nan) if freedom < 2 else (math.sqrt(((scale * seen) ** 2).sum()), freedom)


def guesses(study):
    """Whether people knew which robot was made for them, against chance."""
    rows = study.forms[(study.forms["item"] == "made_for_you") & ~yes(study.forms["superseded"])].dropna(
        subset=["value"]
    )
    if rows.empty:
        return []
    found = {"people": len(rows), "robots": len(study.groups), "chance": 1 / len(study.groups)}
    if study.blinded:
        return [found]
    named = [study.letters.get((each.participant, each.value)) for each in rows.itertuples()]
    right = sum(method == "pbarl" for method in named)
    test = stats.binomtest(right, len(rows), found["chance"])
    low, high = test.proportion_ci(0.95, method="exact")
    return [{**found, "right": right, "share": right / len(rows), "low": low, "high": high, "p": test.pvalue}]


# --- questionnaires ---


def questionnaires(study):
    """(instrument, score, rows of participant, group and value, items of the same people) of every part."""
    for (instrument, score), key in study.scoring_key.groupby(["instrument", "score"], sort=False):
        rows = study.scores[(study.scores["instrument"] == instrument) & (study.scores["score"] == score)]
        letters = rows["letter"] if study.blinded else rows["method"]
        rows = rows.assign(group=letters.where(rows["letter"].notna(), ""))
        for about_robots in (False, True):
            part = rows[rows["letter"].notna() == about_robots].dropna(subset=["value"])
            if about_robots:
                part = part[part["group"].isin(study.groups)]
            if len(part):
                groups = study.groups if about_robots else [""]
                yield instrument, score, part, groups, items_of(study, part, key)


def items_of(study, part, key):
    """The items of a score as they enter it: mirrored where they are reversed, the centre where that is the rule."""
    given = study.forms[~yes(study.forms["superseded"]) & (study.forms["form"] == key["instrument"].iloc[0])]
    given = given.assign(letter=given["letter"].fillna(""), value=pd.to_numeric(given["value"], errors="coerce"))
    table = given.pivot_table(index=["participant", "letter"], columns="item", values="value", aggfunc="last")
    table = table.reindex(
        index=pd.MultiIndex.from_arrays([part["participant"], part["letter"].fillna("")]), columns=key["item"]
    )
    low, high = key["answer_lowest"].iloc[0], key["answer_highest"].iloc[0]
    table = table.fillna((low + high) / 2).to_numpy(float)
    return np.where(yes(key["reversed"]).to_numpy(), low + high - table, table)


def scale_means(study):
    return [
        {"instrument": instrument, "score": score, **each}
        for instrument, score, rows, groups, _ in questionnaires(study)
        for each in means_of(rows, "value", "group", groups, rows["lowest"].iloc[0], rows["highest"].iloc[0])
    ]


def scale_comparisons(study):
    if study.blinded:
        return []
    tests = ("paired_t", "wilcoxon", *(("welch_t", "permutation") if study.between else ()))
    return [
        {"instrument": instrument, "score": score, **each}
        for instrument, score, rows, groups, _ in questionnaires(study)
        if groups != [""]
        for each in comparisons_of(rows.assign(method=rows["group"]), "value", groups, tests)
    ]


def scale_reliability(study):
    return [
        {"instrument": instrument, "score": score, "group": group, **reliability(items[rows["group"] == group])}
        for instrument, score, rows, groups, items in questionnaires(study)
        for group in groups
    ]


# --- answers to pairs ---


def answered(study):
    """Answers that count, of everybody who has not withdrawn, practice left out."""
    rows = study.queries
    return rows[rows["response"].notna() & ~yes(rows["excluded"]) & (rows["purpose"] != "practice")]


def present(study):
    return list(study.participants.loc[study.participants["status"] != "withdrawn", "participant"])


def hits(rows):
    """1 foreseen, 0 not, 1/2 without an opinion: of labels that prefer a side, on pairs drawn at random."""
    rows = rows[yes(rows["is_label"]) & (rows["strategy"] == "uniform") & rows["predicted_right"].notna()]
    rows = rows[rows["response"].isin(["left", "right"])].sort_values("ordinal")
    right = (rows["predicted_right"] > 0.5) == (rows["response"] == "right")
    return np.where(rows["predicted_right"] == 0.5, 0.5, right.astype(float))


def foresight(found):
    """ "better": evidence of 20 to 1 against guessing, as often as one looks (Robbins 1970)."""
    correct, scored = int((found == 1).sum()), int((found != 0.5).sum())
    tail = special.betaincc(correct + 1, scored - correct + 1, 0.5)
    evidence = (
        math.log(2 * tail) + special.betaln(correct + 1, scored - correct + 1) + scored * math.log(2)
        if tail > 0
        else -math.inf
    )
    if evidence >= math.log(20):
        return "better"
    return "unknown" if len(found) < 5 or (len(found) < 20 and correct > scored - correct) else "guessing"


def same_again(rows):
    """(asked, same, share that said equal) of pairs asked twice; can't tell is left out."""
    by_ordinal = {each.ordinal: each for each in rows.itertuples()}
    asked = same = equal = 0
    for again in rows[rows["purpose"] == "repeat"].itertuples():
        before = by_ordinal.get(again.repeats_ordinal)
        if before is None or "skip" in (before.response, again.response):
            continue
        swapped = str(again.sides_swapped).lower() == "true"
        said = {"left": "right", "right": "left"}.get(again.response, again.response) if swapped else again.response
        asked, same = asked + 1, same + (said == before.response)
        equal += (before.response == "equal") + (again.response == "equal")
    return asked, same, equal / (2 * asked) if asked else 0.0


def answers(study):
    """A row per participant."""
    everything, found = answered(study), []
    for person in present(study):
        rows = everything[everything["participant"] == person]
        labels, times = rows[yes(rows["is_label"])], rows["response_time_ms"].dropna()
        foreseen = hits(rows)
        asked, same, equal = same_again(rows)
        row = {"participant": person, "labels": len(labels)}
        row |= {said: int((labels["response"] == said).sum()) for said in ("left", "right", "equal", "skip")}
        row |= {"median_response_ms": times.median() if len(times) else None}
        row |= {"working_minutes": times.sum() / 60_000 if len(times) else None}
        row |= {"foresight": foresight(foreseen), "correct": foreseen.sum(), "scored": len(foreseen)}
        if len(foreseen):
            row["accuracy"] = foreseen.mean()
            row["accuracy_low"], row["accuracy_high"] = wilson(foreseen.sum(), len(foreseen))
        row |= {"asked": asked, "same": same}
        if asked:
            row["share"] = same / asked
            row["share_low"], row["share_high"] = wilson(same, asked)
        by_chance = equal**2 + (1 - equal) ** 2 / 2
        if asked >= 5 and by_chance < 1:  # Cohen's kappa of the symmetric table
            ends = zip(("kappa", "kappa_low", "kappa_high"), ("share", "share_low", "share_high"), strict=True)
            row |= {name: (row[of] - by_chance) / (1 - by_chance) for name, of in ends}
        found.append(row)
    return found


def answers_pooled(study):
    rows = pd.DataFrame(answers(study), columns=["participant", "labels", "accuracy", "asked", "same"])
    shares = rows["accuracy"].dropna().to_numpy(float)
    low, high = mean_interval(shares, 0, 1)
    return [
        {
            "people": len(shares),
            "mean_accuracy": shares.mean() if len(shares) else None,
            "mean_low": low,
            "mean_high": high,
            "labels": rows["labels"].sum(),
            "asked": rows["asked"].sum(),
            "same": rows["same"].sum(),
        }
    ]


def catch_pairs(study):
    """Attention: obvious pairs that were answered, and those answered the wrong way; can't tell is no answer."""
    rows = answered(study)
    rows = rows[(rows["purpose"] == "catch") & rows["expected"].notna() & (rows["response"] != "skip")]
    wrong = rows["response"].isin(["left", "right"]) & (rows["response"] != rows["expected"])
    return [{"answered": len(rows), "wrong": int(wrong.sum())}]


def curves(study):
    """The running accuracy of each person's models."""
    everything, found = answered(study), []
    for person in present(study):
        foreseen = hits(everything[everything["participant"] == person])
        found += [
            {"participant": person, "scored": n, "accuracy": foreseen[max(0, n - WINDOW) : n].mean()}
            for n in range(FIRST_POINT, len(foreseen) + 1)
        ]
    return found


def recruitment(study):
    """Who came how far; sent back: screened out, no arm open, missed catch pairs."""
    rows, found = study.participants, {}
    there = rows[rows["status"] != "withdrawn"]
    consented, finished = there["consented_at"].notna(), there["status"] == "completed"
    found["invited"], found["withdrawn"], found["consented"] = len(rows), len(rows) - len(there), int(consented.sum())
    for ending in ("screened_out", "full", "inattentive"):
        found[ending] = int((consented & ~finished & (there["ended_as"] == ending)).sum())
    found["completed"] = int((consented & finished).sum())
    found["unfinished"] = int((consented & ~finished & there["ended_as"].isna()).sum())
    return [found]


# --- what the filters change ---


def change(study):
    """Of each person's newest filter, on unseen simulated scenarios, against the pre-trained policy."""
    rows = study.evaluations[yes(study.evaluations["newest"])]
    columns = ["participant", "measure", "reference", "filtered", "delta", "low", "high"]
    return rows[rows["participant"].isin(present(study))][columns].to_dict("records")


def change_pooled(study):
    rows = pd.DataFrame(change(study), columns=["participant", "measure", "reference", "delta"])
    found = []
    for measure, mine in rows.groupby("measure", sort=False):
        deltas, references = mine["delta"].dropna().to_numpy(float), mine["reference"].dropna().to_numpy(float)
        low, high = mean_interval(deltas)
        found.append(
            {
                "measure": measure,
                "people": len(deltas),
                "mean": deltas.mean() if len(deltas) else None,
                "low": low,
                "high": high,
                "reference": references.mean() if len(references) else None,
            }
        )
    return found


# --- figures ---

COLOURS = ("#d9d9d9", "#e69f00", "#0072b2", "#56b4e9", "#762a83")
INK, GREY, BLUE = "#262626", "#8a8a8a", "#0072b2"


def name_of(group):
    return NAMES.get(group, f"Robot {group}")


def ratings_figure(study):
    """Mean ratings as in the paper: bars of all ratings, one standard deviation, a star for its t-test at p < .01."""
    figure, both = plt.subplots(1, 2, figsize=(6.4, 3.3), sharey=True, layout="constrained")
    tests = pd.DataFrame(comparisons(study), columns=["scale", "first", "second", "test", "p"])
    for axes, scale in zip(both, SCALES, strict=True):
        found = means_of(study.ratings, scale, study.by, study.groups)
        heights, errors = ([np.nan if each[name] is None else each[name] for each in found] for name in ("mean", "sd"))
        axes.bar(range(len(found)), np.array(heights) - 1, 0.66, bottom=1, color=COLOURS, edgecolor=INK)
        axes.errorbar(range(len(found)), heights, errors, color=INK, capsize=3, linestyle="none")
        mine = tests[(tests["scale"] == scale) & (tests["test"] == "two_sample_t")].dropna(subset=["p"])
        for level, each in enumerate(mine.itertuples()):
            ends, height = [study.groups.index(each.first), study.groups.index(each.second)], 5.2 + 0.5 * level
            axes.plot(ends, [height, height], color=INK, linewidth=0.9)
            axes.text(np.mean(ends), height, "*" if each.p < 0.01 else "n.s.", ha="center", va="bottom")
        axes.set(title=scale.capitalize(), yticks=range(1, 6), ylim=(1, 5.7 + 0.5 * len(mine)))
        axes.set_xticks(range(len(found)), [name_of(group).replace(" ", "\n", 1) for group in study.groups])
    both[0].set_ylabel("Mean rating (1 to 5)")
    return figure if len(study.ratings) else None


def ratings_of_each_person(study):
    """Every person's mean rating of each robot as a line; beside them the mean with its interval."""
    figure, both = plt.subplots(1, 2, figsize=(6.4, 3.3), sharey=True, layout="constrained")
    for axes, scale in zip(both, SCALES, strict=True):
        table = study.ratings.pivot_table(index="participant", columns=study.by, values=scale).reindex(
            columns=study.groups
        )
        axes.plot(table.to_numpy().T, "o-", color=GREY, markerfacecolor="white", linewidth=0.9, markersize=4)
        for place, each in enumerate(means_of(study.ratings, scale, study.by, study.groups)):
            if each["participant_mean"] is not None:
                axes.plot(place + 0.22, each["participant_mean"], "D", color=BLUE)
            if each["low"] is not None:
                axes.plot([place + 0.22] * 2, [each["low"], each["high"]], color=BLUE, linewidth=2)
        axes.set(title=scale.capitalize(), yticks=range(1, 6), ylim=(0.8, 5.2))
        axes.set_xticks(range(len(study.groups)), [name_of(group).replace(" ", "\n", 1) for group in study.groups])
    both[0].set_ylabel("Mean rating of each person")
    return figure if len(study.ratings) else None


def head_to_heads_figure(study):
    """Bradley-Terry strengths, the strongest on top."""
    found = sorted((each for each in strengths(study) if "group" in each), key=lambda each: -each["strength"])
    figure, axes = plt.subplots(figsize=(5.6, 0.45 * len(found) + 1.2), layout="constrained")
    for row, each in enumerate(found):
        if "low" in each:
            axes.plot([each["low"], each["high"]], [row, row], color=GREY)
        axes.plot(each["strength"], row, "D", color=BLUE)
    axes.axvline(0, color=INK, linewidth=0.8)
    axes.set_yticks(range(len(found)), [name_of(each["group"]) for each in found])
    axes.invert_yaxis()
    axes.set_xlabel("Strength (log odds against the average robot; right: preferred)")
    return figure if found else None


def learning_curves(study):
    """Running share of answers that the model had foreseen: each person thin, the mean over all of them thick."""
    table = pd.DataFrame(curves(study), columns=["participant", "scored", "accuracy"])
    table = table.pivot(index="scored", columns="participant", values="accuracy").astype(float) * 100
    table = table.loc[:, table.notna().sum() > 1]
    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    axes.plot(table.index, table, color=GREY, linewidth=0.8, alpha=0.6)
    if table.shape[1] > 1:
        axes.plot(table.dropna().mean(axis=1), color=BLUE, linewidth=2.2, label=f"mean of {table.shape[1]} people")
        axes.legend(loc="lower right")
    axes.axhline(50, color=INK, linestyle="--", linewidth=0.8)
    axes.set(xlabel="Answers that preferred a side, on pairs drawn at random", ylim=(0, 101))
    axes.set_ylabel(f"Predicted correctly of the last {WINDOW} (%)")
    return figure if table.shape[1] else None


def success_against_preference(study):
    """What each person's filter gains and costs; hollow: the model is not shown to be better than guessing."""
    table = pd.DataFrame(change(study), columns=["participant", "measure", "delta", "low", "high"])
    proven = {each["participant"] for each in answers(study) if each["foresight"] == "better"}
    figure, axes = plt.subplots(figsize=(5.2, 3.6), layout="constrained")
    axes.axhline(0, color=INK, linewidth=0.8)
    axes.axvline(0, color=INK, linewidth=0.8)
    drawn = 0
    for person, mine in table.groupby("participant"):
        measured = mine.set_index("measure")[["delta", "low", "high"]].to_dict("index")
        if {"preference", "success"} <= measured.keys():
            x, y = measured["preference"], {name: 100 * value for name, value in measured["success"].items()}
            axes.plot([x["low"], x["high"]], [y["delta"]] * 2, color=GREY, linewidth=0.9)
            axes.plot([x["delta"]] * 2, [y["low"], y["high"]], color=GREY, linewidth=0.9)
            axes.plot(x["delta"], y["delta"], "o", color=BLUE, markerfacecolor=BLUE if person in proven else "white")
            axes.annotate(person, (x["delta"], y["delta"]), (5, 4), textcoords="offset points", fontsize=8)
            drawn += 1
    axes.set_xlabel("Change of preference (SD of the reference's return,\nas the person's own model sees it)")
    axes.set_ylabel("Change of success (percentage points)")
    return figure if drawn else None


def cost_changes(study):
    """The paper's six costs: change of each person in percent of the reference, and the mean over people."""
    table = pd.DataFrame(change(study), columns=["participant", "measure", "reference", "delta"])
    names = [name for name in COSTS if name in set(table["measure"])]
    table = table[table["measure"].isin(names) & (table["reference"] != 0)].dropna()
    figure, axes = plt.subplots(figsize=(5.6, 0.5 * len(names) + 1.2), layout="constrained")
    for row, name in enumerate(names):
        mine = table[table["measure"] == name]
        relative = 100 * mine["delta"] / mine["reference"]
        axes.plot(relative, np.full(len(relative), row), "o", color=GREY, markerfacecolor="white")
        if len(relative):
            axes.plot(relative.mean(), row, "D", color=BLUE)
    axes.axvline(0, color=INK, linewidth=0.8)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel("Change in % of the reference (left: less of the cost)")
    return figure if names else None


TABLES = (
    recruitment,
    catch_pairs,
    answers,
    answers_pooled,
    curves,
    change,
    change_pooled,
    means,
    people,
    comparisons,
    order_effects,
    wins,
    strengths,
    guesses,
    scale_means,
    scale_comparisons,
    scale_reliability,
)
FIGURES = {
    "ratings": ratings_figure,
    "ratings_of_each_person": ratings_of_each_person,
    "head_to_heads": head_to_heads_figure,
    "learning_curves": learning_curves,
    "success_against_preference": success_against_preference,
    "cost_changes": cost_changes,
}


def main(source, target):
    study, target = Study(source), Path(target)
    target.mkdir(parents=True, exist_ok=True)
    for table in TABLES:
        pd.DataFrame(table(study)).to_csv(target / f"{table.__name__}.csv", index=False)
    mpl.use("agg")
    mpl.rcParams.update({"axes.spines.top": False, "axes.spines.right": False, "font.size": 9})
    for name, draw in FIGURES.items():
        figure = draw(study)
        if figure is not None:
            figure.savefig(target / f"{name}.pdf")
    plt.close("all")
    print(f"Tables and figures of {len(present(study))} participants are in {target}/.")
    if study.blinded:
        print("The study is blinded: letters stand for methods, and nothing is compared.")


if __name__ == "__main__":
    here = Path(__file__).resolve().parent
    main(*(sys.argv[1:] + [here / "csv", here / "analysis"][len(sys.argv) - 1 :]))
