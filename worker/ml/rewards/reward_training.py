"""Fitting a reward model to labelled pairs. Deterministic: the same pairs, targets and seed give the same model."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import softmax

from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.rewards import calibration
from worker.ml.rewards.beyond_sums.changing import ChangingWeights
from worker.ml.rewards.beyond_sums.misfit import RICHER_DEVIATION
from worker.ml.rewards.beyond_sums.terms import FurtherTerms
from worker.ml.rewards.calibration import HeldOut
from worker.ml.rewards.laplace import Laplace, laplace
from worker.ml.rewards.network_training import MlpTraining, TransformerTraining, fit_mlp, fit_transformer
from worker.ml.rewards.predicted_reward import PredictedReward
from worker.ml.rewards.prior import Population, Prior
from worker.ml.rewards.reward_models import NEVER_WANTED, UNDONE, Normalisation, RewardModel, StructuredReward
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.rewards.signal_predictor import SignalPredictor
from worker.ml.rewards.signal_scale import SignalScale

RewardKind = Literal["structured", "predicted", "mlp", "preference_transformer"]

MEMBERS = 8
CALIBRATION_FOLDS = 5
HINT_STRENGTH = 1.0
"""Standard deviations of a pair by which the clips of a hint differ (docs/results/hints.md)."""
_PINNED = 1e6
"""Prior precision of a weight that is held at 0."""


@dataclass(frozen=True)
class FitResult:
    """A reward model and what is worth knowing about it, as plain values for a JSON column."""

    model: RewardModel
    metrics: dict[str, Any]


def fit(
    pairs: SegmentPairs,
    targets: npt.ArrayLike,
    kind: RewardKind,
    seed: int,
    *,
    scale: SignalScale | None = None,
    reference: Sequence[Trajectory] = (),
    prior: Prior | None = None,
    mlp: MlpTraining | None = None,
    transformer: TransformerTraining | None = None,
    signal_names: Sequence[str] = SIGNALS,
    costs: Sequence[str] = NEVER_WANTED,
    predictor: SignalPredictor | None = None,
    mattered: npt.ArrayLike | None = None,
    hints: npt.ArrayLike | None = None,
    further: FurtherTerms | ChangingWeights | None = None,
) -> FitResult:
    """Fit an ensemble to N pairs and their targets P(right preferred) in {0, 1/2, 1}.

    ``scale``: of the signals in the pool the pairs come from; from the labelled pairs themselves when missing, which
    is shaky below about 30 labels.
    ``reference``: rollouts of the reference policy to normalise over; the labelled segments when missing.
    ``prior``: of the structured kind's weights, Prior.standard() when missing.
    ``signal_names``: what the columns of the pairs' signals are called.
    ``costs``: the signals of which nobody wants more.
    ``predictor``: of the signals, which the kind "predicted" needs.
    ``mattered``: (N, S) bool, the signals that somebody named as what made the difference, for the kinds that are
    linear in signals. The answer is then heard once more, about these signals alone.
    ``hints``: (H, S) which way somebody wishes the signals, for the same kinds: -1 less, 1 more, 0 neither. Each is
    heard as one more answer, between clips that differ in these signals alone.
    ``further``: what is read beside the signals, for the structured kind.
    Raises ValueError for targets outside {0, 1/2, 1}, a count that differs from the pairs', or a missing predictor.
    """
    started = time.perf_counter()
    answers = _checked(pairs, targets)
    metrics: dict[str, Any] = {"kind": kind, "trained_on": len(pairs), "seed": seed}
    known = prior or Prior.standard(len(signal_names))
    extra = _Extra.of(len(pairs), len(signal_names), mattered, hints)
    unwanted = _columns(signal_names, costs)
    model: RewardModel
    if kind == "structured":
        spread = scale or SignalScale.of(pairs)
        linear, found = _fit_structured(pairs, answers, seed, spread, known, signal_names, unwanted, extra)
        model = linear
        if further is not None:
            completed = further.completed(pairs)
            more = completed.signals.shape[-1] - len(signal_names)
            unwanted += [len(signal_names) + column for column in _columns(further.amounts, costs)]
            spread, known = further.scale_of(spread, completed), known.with_further(more, RICHER_DEVIATION)
            richer, found = _fit_structured(
                completed, answers, seed, spread, known, signal_names, unwanted, extra.widened(more)
            )
            model = further.reward(richer, linear)
    elif kind == "predicted":
        if predictor is None:
            raise ValueError("The kind 'predicted' needs a predictor of the signals.")
        foreseen = predictor.completed(pairs.signals, pairs.observations, pairs.actions).astype(np.float32)
        completed = replace(pairs, signals=foreseen)
        wider = _wider(scale or SignalScale.of(completed), completed)
        linear, found = _fit_structured(completed, answers, seed, wider, known, signal_names, unwanted, extra)
        model = PredictedReward.with_predictor(linear, predictor)
    elif kind == "mlp":
        model, found = fit_mlp(pairs, answers, seed, mlp or MlpTraining())
    else:
        model, found = fit_transformer(pairs, answers, seed, transformer or TransformerTraining())
    held_out: HeldOut = found.pop("held_out")
    temperature = calibration.fit_temperature(held_out)
    undone = signal_names.index(UNDONE) if UNDONE in signal_names else None
    model = replace(model, temperature=temperature, undone_column=undone)
    model = model.normalised_over(reference) if reference else _normalised_over_segments(model, pairs)
    metrics.update(found, calibration=calibration.report(held_out, temperature))
    metrics["training_accuracy"] = _accuracy(model, pairs, answers)
    metrics["fit_seconds"] = round(time.perf_counter() - started, 4)
    return FitResult(model, metrics)


def _columns(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    return [column for column, name in enumerate(names) if name in wanted]


def _wider(measured: SignalScale, foreseen: SegmentPairs) -> SignalScale:
    """What hardly ever differs in a pool may be foreseen to differ: errors must not be blown up to standard size."""
    differences = np.sqrt((foreseen.signal_differences() ** 2).mean(axis=0))
    return replace(measured, spread=np.maximum(measured.spread, differences))


def _checked(pairs: SegmentPairs, targets: npt.ArrayLike) -> FloatArray:
    answers = np.asarray(targets, np.float64)
    if answers.shape != (len(pairs),):
        raise ValueError(f"{len(pairs)} pairs need as many targets, got shape {answers.shape}.")
    if not np.isin(answers, (0.0, 0.5, 1.0)).all():
        raise ValueError("Targets must be 0, 1/2 or 1; leave out answers of the kind 'can't tell'.")
    return answers


def _accuracy(model: RewardModel, pairs: SegmentPairs, answers: FloatArray) -> float | None:
    decided = answers != 0.5
    if not decided.any():
        return None
    right = model.probability_right(pairs)
    hits = np.where(right == 0.5, 0.5, (right > 0.5) == (answers > 0.5))  # no opinion: half right
    return float(hits[decided].mean())


def _normalised_over_segments(model: RewardModel, pairs: SegmentPairs) -> RewardModel:
    raw = model.raw_rewards(pairs.signals, pairs.observations, pairs.actions)
    return replace(model, normalisation=Normalisation.over(raw[:, pairs.shown]))


# -- structured: Bayesian logistic regression --------------------------------------------------------------------------


@dataclass(frozen=True)
class _Extra:
    """What somebody said beside the answers."""

    named: npt.NDArray[np.bool_]
    """(N, S) the signals that made the difference"""
    hints: FloatArray
    """(H, S) in {-1, 0, 1}"""

    @classmethod
    def of(cls, count: int, width: int, mattered: npt.ArrayLike | None, hints: npt.ArrayLike | None) -> "_Extra":
        named = np.zeros((count, width), bool) if mattered is None else np.asarray(mattered, bool)
        return cls(named, np.zeros((0, width)) if hints is None else np.asarray(hints, np.float64))

    def widened(self, more: int) -> "_Extra":
        """Beside so many further terms, of which nothing was said."""
        return _Extra(np.pad(self.named, ((0, 0), (0, more))), np.pad(self.hints, ((0, 0), (0, more))))

    def without(self, left_out: npt.NDArray[np.bool_]) -> "_Extra":
        """Without some of the answers."""
        return replace(self, named=self.named[~left_out])

    def heard(self, features: FloatArray, answers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The answers, those of which somebody said what mattered once more, as if nothing else differed, and hints."""
        said = self.named.any(axis=1)
        return (
            np.concatenate([features, (features * self.named)[said], HINT_STRENGTH * self.hints]),
            np.concatenate([answers, answers[said], np.ones(len(self.hints))]),
        )


def _fit_structured(
    pairs: SegmentPairs,
    answers: FloatArray,
    seed: int,
    scale: SignalScale,
    prior: Prior,
    signal_names: Sequence[str],
    costs: Sequence[int],
    extra: _Extra,
) -> tuple[StructuredReward, dict[str, Any]]:
    features = pairs.signal_differences() / scale.spread
    mean, covariance, shares = posterior(*extra.heard(features, answers), prior, costs)
    members = antithetic(mean, covariance, np.random.default_rng(seed)) / scale.spread
    deviation = 1.96 * np.sqrt(np.diag(covariance))
    weights = {
        name: {"mean": float(value), "low": float(value - margin), "high": float(value + margin)}
        for name, value, margin in zip(signal_names, mean, deviation, strict=False)  # of the signals alone
    }
    return StructuredReward(members, least_per_step=scale.least_per_step, most_per_step=scale.most_per_step), {
        "weights": weights,
        "weights_unit": "log odds per standard deviation of a pair",
        "population_shares": prior.by_name(shares),
        "held_out": _held_out(features, answers, extra, seed, prior, costs),
    }


def _held_out(
    features: FloatArray,
    answers: FloatArray,
    extra: _Extra,
    seed: int,
    prior: Prior,
    costs: Sequence[int],
) -> HeldOut:
    """Log odds of every pair under members fitted without its fold."""
    rng = np.random.default_rng(seed)
    fold = rng.permutation(len(answers)) % CALIBRATION_FOLDS
    logits = np.zeros((MEMBERS, len(answers)))
    for each in range(min(CALIBRATION_FOLDS, len(answers))):
        inside = fold == each
        heard = extra.without(inside).heard(features[~inside], answers[~inside])
        mean, covariance, _ = posterior(*heard, prior, costs)
        logits[:, inside] = antithetic(mean, covariance, rng) @ features[inside].T
    return HeldOut(logits, answers, allows_for_lapses=True)


class Posterior(NamedTuple):
    """What is known of the weights, as one Gaussian."""

    mean: FloatArray
    """(S,)"""
    covariance: FloatArray
    """(S, S)"""
    shares: FloatArray
    """(P,) how likely the person is of each of the prior's populations"""


def posterior(
    features: FloatArray, answers: FloatArray, prior: Prior | None = None, costs: Sequence[int] = ()
) -> Posterior:
    """p(w | labels) by Laplace approximations, one for each population of the prior (Prior.standard() when missing).

    Their mixture, each population weighed by its evidence, is given by its mean and its covariance.
    features (N, S) standardised differences right minus left; answers (N,) in {0, 1/2, 1}; ``costs``: columns whose
    mean weight must not be positive. Those that would be are held at 0, and the others fitted anew.
    """
    known = prior or Prior.standard(features.shape[1])
    found = [_in_population(features, answers, each, costs) for each in known.populations]
    shares = softmax([each.evidence for each in found] + known.log_chances)
    mean = shares @ np.array([each.mean for each in found])
    apart = np.array([each.mean for each in found]) - mean
    within = np.tensordot(shares, np.linalg.inv([each.information for each in found]), 1)
    return Posterior(mean, within + (apart.T * shares) @ apart, shares)


def _in_population(features: FloatArray, answers: FloatArray, population: Population, costs: Sequence[int]) -> Laplace:
    pinned: set[int] = set()
    while True:
        held = sorted(pinned)
        mean, precision = population.mean.copy(), np.array(np.linalg.inv(population.covariance), np.float64)
        mean[held] = 0.0
        precision[held, held] += _PINNED
        found = laplace(features, answers, mean, precision)
        found.mean[held] = 0.0
        wrong = {column for column in costs if found.mean[column] > 0.0}
        if not wrong:
            return found
        pinned |= wrong


def antithetic(mean: FloatArray, covariance: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(E, S) posterior samples in mirrored pairs: their mean is the posterior's mean exactly."""
    half = rng.standard_normal((MEMBERS // 2, len(mean))) @ np.linalg.cholesky(covariance).T
    samples: FloatArray = mean + np.concatenate([half, -half])
    return samples
