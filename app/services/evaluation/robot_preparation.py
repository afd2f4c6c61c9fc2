"""How far the robots of one participant are, and when the first of them can be seen."""

from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.evaluation import SharedFilter
from app.domain.models import Model, ModelKind, Run, RunKind, RunStatus
from app.domain.protocol import FROM_OTHERS, EvaluatedMethod, EvaluationMode
from app.domain.run_keys import AHEAD, BEFORE_AFTER, CONTROLLERS, SHARED_FILTER, TRIALS
from app.domain.studies import Participant
from app.services.evaluation import donors, evaluation_plan
from app.services.runs import estimates


@dataclass(frozen=True)
class Preparation:
    """How far the robots of one participant are."""

    step: str
    """learning, training, filming or packing"""
    share: float
    robots_ready: int
    robots: int
    seconds_left: int | None
    """Until there is a robot to rate, if nobody else comes first; None: nothing like it was done here before."""
    others_first: bool
    trouble: bool
    """Something has failed; it is tried again by itself, or when somebody asks for it."""


@dataclass(frozen=True)
class _Part:
    """One piece of the work before the first robot."""

    usual_s: float | None
    left_s: float | None
    """0 when it is done"""
    progress: float


def preparation(session: Session, participant: Participant) -> Preparation:
    """How far the robots are, counted from what is there and what is at work; the study is loaded."""
    study = participant.study
    settings = evaluation_plan.settings_for(study, participant.arm)
    methods = settings.methods if settings else ()
    trained = {method: _is_trained(session, participant, ModelKind.METHOD, method) for method in methods}
    training = [method for method in methods if method in evaluation_plan.TRAINED]
    learning = _learning(session, participant)
    trainings = [_training(session, participant, method, trained[method]) for method in training]
    last = CONTROLLERS if settings and settings.mode is EvaluationMode.PHYSICAL else TRIALS
    showing = _showing(session, participant, last)
    ready = learning.left_s == 0 and all(part.left_s == 0 for part in trainings)
    own = 0 if learning.left_s == 0 else EvaluatedMethod.PBARL in methods
    return Preparation(
        step="learning" if learning.left_s != 0 else "training" if not ready else _WORDS[last],
        share=_share([learning, *trainings, showing]),
        robots_ready=len(methods) - own - sum(not trained[method] for method in training),
        robots=len(methods),
        seconds_left=_until_robot(learning, trainings, showing),
        others_first=estimates.are_others_first(session, participant),
        trouble=_has_failed(session, participant),
    )


def until_debrief_s(session: Session, participant: Participant) -> int | None:
    """Seconds until the participant's robot can be seen before and after; the study is loaded."""
    learning = _learning(session, participant).left_s
    usual = estimates.usual_s(session, participant.study, RunKind.FILMS, BEFORE_AFTER)
    filming = estimates.left_s(estimates.newest_run(session, participant, RunKind.FILMS, BEFORE_AFTER), usual)
    return None if learning is None or filming is None else round(learning + filming)


_WORDS = {TRIALS: "filming", CONTROLLERS: "packing"}


def _learning(session: Session, participant: Participant) -> _Part:
    """The reward model of all labels, and the filter that follows it."""
    if _is_trained(session, participant, ModelKind.FILTER):
        return _Part(estimates.usual_s(session, participant.study, RunKind.FILTER), 0.0, 1.0)
    parts = [_part(session, participant, kind) for kind in (RunKind.REWARD, RunKind.FILTER)]
    if _is_trained(session, participant, ModelKind.REWARD):
        return parts[1]
    usual = None if parts[1].usual_s is None else parts[1].usual_s + (parts[0].usual_s or 0.0)
    left = None if parts[1].left_s is None else parts[1].left_s + (parts[0].left_s or 0.0)
    return _Part(usual, left, 0.0)


def _training(session: Session, participant: Participant, method: EvaluatedMethod, trained: bool) -> _Part:
    if trained:
        return _Part(estimates.usual_s(session, participant.study, RunKind.METHOD, method), 0.0, 1.0)
    own, fitting = _part(session, participant, RunKind.METHOD, method), _fitting(session, participant, method)
    if fitting is None:
        return own
    usual = None if own.usual_s is None or fitting.usual_s is None else own.usual_s + fitting.usual_s
    left = None if own.left_s is None or fitting.left_s is None else own.left_s + fitting.left_s
    return _Part(usual, left, fitting.progress * fitting.usual_s / usual if fitting.usual_s and usual else 0.0)


def _fitting(session: Session, participant: Participant, method: EvaluatedMethod) -> _Part | None:
    """The filter of several others that the method waits for; None when there is none, or it is there."""
    shared = donors.awaited_by(session, participant, method)
    if shared is None:
        return None
    usual = estimates.usual_s(session, participant.study, RunKind.SHARED, SHARED_FILTER)
    return _as_part(_run_of(session, shared), usual)


def _run_of(session: Session, shared: SharedFilter) -> Run | None:
    return session.scalar(select(Run).where(Run.workflow_id == str(donors.key_of(shared))))


def _showing(session: Session, participant: Participant, what: str) -> _Part:
    """The first films, or all controllers: the others are made while the first robot is rated."""
    usual = estimates.usual_s(session, participant.study, RunKind.FILMS, what)
    if usual is None and what == TRIALS:  # for the first participant: about as many films, of the reference policy
        usual = estimates.usual_s(session, participant.study, RunKind.FILMS, AHEAD)
    settings = evaluation_plan.settings_for(participant.study, participant.arm)
    if what == CONTROLLERS or usual is None or settings is None:
        return _part(session, participant, RunKind.FILMS, what)
    return _Part(usual, usual * min(1.0, estimates.FILMS_AT_A_TIME / settings.trial_count), 0.0)


def _part(session: Session, participant: Participant, kind: RunKind, what: str = "") -> _Part:
    run = estimates.newest_run(session, participant, kind, what)
    return _as_part(run, estimates.usual_s(session, participant.study, kind, what))


def _as_part(run: Run | None, usual: float | None) -> _Part:
    at_work = run is not None and run.status == RunStatus.RUNNING
    return _Part(usual, estimates.left_s(run, usual), run.progress if run is not None and at_work else 0.0)


def _until_robot(learning: _Part, trainings: list[_Part], showing: _Part) -> int | None:
    """Filters and the methods they are compared with are trained side by side."""
    if learning.left_s is None or showing.left_s is None:
        return None
    lefts = [part.left_s for part in trainings]
    known = [left for left in lefts if left is not None]
    return round(max(learning.left_s, sum(known)) + showing.left_s) if len(known) == len(lefts) else None


def _share(parts: list[_Part]) -> float:
    """What is done of the usual times; parts count alike while not every one is known."""
    usual = [part.usual_s for part in parts if part.usual_s]
    weights = usual if len(usual) == len(parts) else [1.0] * len(parts)
    done = sum(weight * part.progress for weight, part in zip(weights, parts, strict=True))
    return min(done / sum(weights), 0.99)


def _is_trained(
    session: Session, participant: Participant, kind: ModelKind, method: EvaluatedMethod | None = None
) -> bool:
    labels = participant.study.settings.labels_per_participant
    models = session.scalars(
        select(Model).where(Model.participant_id == participant.id, Model.kind == kind, Model.label_count >= labels)
    )
    return any(method is None or model.metrics.get("method") == method for model in models)


def _has_failed(session: Session, participant: Participant) -> bool:
    runs = session.scalars(select(Run).where(Run.participant_id == participant.id).order_by(Run.id))
    awaited = [donors.awaited_by(session, participant, method) for method in FROM_OTHERS]
    fitting = [_run_of(session, shared) for shared in awaited if shared is not None]
    newest = [*{run.kind: run for run in runs}.values(), *fitting]
    return any(run is not None and run.status == RunStatus.FAILED for run in newest)
