"""What one person's answers say, for reports: the figures of the dashboard as plain values."""

from collections import Counter
from typing import Any

from sqlalchemy.orm import Session, joinedload

from app.domain.choices import Strategy
from app.domain.preferences import LEARNED_FROM, Label, Query, Response, current_answers
from app.domain.studies import Participant
from app.services.answers import accuracy
from app.services.answers.accuracy import Curve, Predicted, Share
from app.services.answers.consistency import Estimate, answers_of, consistency


def figures_of(session: Session, participant: Participant) -> dict[str, Any]:
    """Of one person; unknown is None.

    participant, labels, left, right, equal, skip, median_response_ms, working_minutes, foresight (accuracy.Foresight),
    accuracy {correct, scored, accuracy, low, high}, curve [[scored, accuracy], ...], test_retest {asked, same, share,
    low, high, kappa, kappa_low, kappa_high}.
    """
    answers = current_answers(session, participant.id, joinedload(Query.left_clip), joinedload(Query.right_clip))
    labels = [each for each in answers if each.query.purpose in LEARNED_FROM]
    judged, foreseen = consistency(answers_of(answers)), curve_of(labels)
    counts = Counter(each.response for each in labels)
    return {
        "participant": participant.code,
        "labels": len(labels),
        **{response.value: counts[response] for response in Response},
        "median_response_ms": judged.median_response_ms,
        "working_minutes": None if judged.working_ms is None else judged.working_ms / 60_000,
        "foresight": foreseen.foresight.value,
        "accuracy": _share(foreseen.overall, ("correct", "scored", "accuracy")),
        "curve": [[point.scored, point.recent.value] for point in foreseen.points],
        "test_retest": {
            **_share(judged.repeats.agreement, ("same", "asked", "share")),
            **_interval(judged.repeats.kappa, "kappa"),
        },
    }


def curve_of(labels: list[Label]) -> Curve:
    """How well the models foresaw these labels."""
    return accuracy.curve(
        accuracy.hits(
            Predicted(each.response, each.query.predicted_right, each.query.strategy == Strategy.UNIFORM)
            for each in labels
        )
    )


def _share(share: Share | None, names: tuple[str, str, str]) -> dict[str, Any]:
    values: tuple[float | None, ...] = (0, 0, None, None, None)
    if share is not None:
        values = (share.correct, share.scored, share.value, share.low, share.high)
    return dict(zip((*names, "low", "high"), values, strict=True))


def _interval(interval: Estimate | None, name: str) -> dict[str, Any]:
    values = (None, None, None) if interval is None else (interval.value, interval.low, interval.high)
    return dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))
