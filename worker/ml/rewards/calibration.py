"""Probabilities that mean what they say: one temperature per model, fitted to answers the model has not learned from.

Models that separate their few labels become too sure of themselves; ones held back by a prior or by early stopping too
hesitant. Dividing all log odds by one number repairs most of both and changes no ranking (Guo et al. 2017).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.ml.rewards.bradley_terry import probability_of_answer, probability_right

FEWEST_ANSWERS = 10
"""Below, nothing is fitted: the temperature stays 1."""
_LOG_TEMPERATURES = np.linspace(-2.0, 2.0, 161)
_LOG_SPREAD = 0.5
"""Standard deviation of the prior of log temperature about 0: ten answers alone move it little."""
_BINS = 5


@dataclass(frozen=True)
class HeldOut:
    """Log odds of labelled pairs under members none of which has learned from them.

    What only one of several networks has not seen will not do: the mean of fewer members is surer of itself, and a
    temperature fitted to it made the whole ensemble too hesitant.
    """

    logits: FloatArray
    """(E, N)"""
    answers: FloatArray
    """(N,) in {0, 1/2, 1}"""
    allows_for_lapses: bool = False
    """Whether the model was fitted for people who answer at random now and then. Slips then say nothing about how sure
    it should be of what is preferred."""

    def probabilities(self, temperature: float) -> FloatArray:
        """P(right), the mean over members, (N,)."""
        mean: FloatArray = probability_right(self.logits / temperature).mean(axis=0)
        return mean

    def surprise(self, temperature: float) -> float:
        """Summed cross-entropy of the answers, in nats."""
        preferred = self.probabilities(temperature)
        said = probability_of_answer(preferred) if self.allows_for_lapses else preferred
        return cross_entropy(said, self.answers) * len(self.answers)


def fit_temperature(held_out: HeldOut) -> float:
    """The temperature under which the held-out answers are most probable, drawn a little towards 1."""
    if len(held_out.answers) < FEWEST_ANSWERS:
        return 1.0
    losses = [held_out.surprise(float(np.exp(log))) + 0.5 * (log / _LOG_SPREAD) ** 2 for log in _LOG_TEMPERATURES]
    return float(np.exp(_LOG_TEMPERATURES[int(np.argmin(losses))]))


def cross_entropy(probabilities: FloatArray, answers: FloatArray) -> float:
    """Mean of the right form of Eq. (2), in nats."""
    sure = np.clip(probabilities, 1e-6, 1.0 - 1e-6)
    return -float((answers * np.log(sure) + (1.0 - answers) * np.log(1.0 - sure)).mean())


def expected_calibration_error(probabilities: FloatArray, answers: FloatArray) -> float:
    """How far confidence and accuracy lie apart, in the mean over answers.

    Confidence is P of the more probable side, in five equal bins from 1/2 to 1; an answer "equal" is half right.
    """
    confidence = np.maximum(probabilities, 1.0 - probabilities)
    right = np.where(probabilities > 0.5, answers, 1.0 - answers)
    right[probabilities == 0.5] = 0.5  # no opinion: half right
    place = np.minimum(((confidence - 0.5) * 2 * _BINS).astype(int), _BINS - 1)
    gaps = [abs(float((confidence - right)[place == each].sum())) for each in range(_BINS)]
    return sum(gaps) / len(answers)


def report(held_out: HeldOut, temperature: float) -> dict[str, Any]:
    """For a model's metrics. The errors are None while there are too few held-out answers to speak of."""
    answers = held_out.answers
    enough = len(answers) >= FEWEST_ANSWERS
    errors = [
        expected_calibration_error(held_out.probabilities(each), answers) if enough else None
        for each in (1.0, temperature)
    ]
    return {
        "temperature": temperature,
        "held_out_answers": len(answers),
        "expected_error_before": errors[0],
        "expected_error": errors[1],
    }
