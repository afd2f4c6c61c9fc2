"""The blinded evaluation: which method hides behind which letter, in which order, and what is to be shown now.

How it is drawn. As in the paper every method is met in one block of trials (three by default), and the order of the
blocks varies. The orders are the rows of a Williams design: over one cycle of participants (2, 4, 6 or 10 of them for
2, 4, 3 or 5 methods) every method comes equally often at every place and equally often right after every other one.
Which row a participant gets follows from their number, between subjects from their place in their arm, where only the
arm's methods count: each cycle goes through all rows once, in an order drawn from the study's secret, which nobody sees
before unblinding; the seed, which everybody sees, tells nothing about it. Letters are given in the order of appearance
(the first block is Robot A), so a letter says when a method was met and nothing else. The scenarios are the same for
all methods of a participant, one per repetition, and different for other participants.

Head-to-heads come when all is rated. Every two meet as often as the study says, each time in another scenario, in
films that were rated. A round has every pair once, in a drawn order. The robots stand on a drawn circle, and a robot is
left of those within half a circle after it; with every round the sides change. So in a round each robot is on the left
as often as on the right (of an even number of robots: once more or less), and every two take turns. That is drawn from
the participant's seed, for letters and sides say nothing about methods, and kept as rows.

Everything follows from the secret and the seeds, so that drawing twice is drawing once. The hash of the secret is part
of what is locked, and the secret is shown after unblinding: whoever has both can draw the letters again.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from typing import NamedTuple

from sqlalchemy import or_, select
from sqlalchemy.orm import Session, joinedload

from app.db import now
from app.domain.evaluation import Assignment, Controller, Film, HeadToHead, Rating, Trial
from app.domain.participation import Allocation
from app.domain.protocol import LETTERS, EvaluatedMethod, EvaluationMode, EvaluationSettings
from app.domain.studies import Participant, Study
from app.questionnaires.library import Instrument
from app.services.answers import form_answers
from app.services.evaluation import head_to_heads
from app.storage import ArtefactStore

TRAINED = tuple(each for each in EvaluatedMethod if each not in (EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL))
"""Methods that are made for the evaluation alone; the reference is there, and pbarl is the participant's filter."""

TRIAL_SCENARIOS = range(6_000_000, 6_800_000)
"""Scenarios of trials; nothing else uses them (worker.domain.scenarios has the others)."""
COMPARISON_SCENARIOS = range(6_800_000, 6_900_000)
"""Scenarios in which somebody's robot is shown before and after."""
COMPARED = 2
"""Scenarios of the before and after."""
_MOST_TRIALS = 20


class EvaluationState(StrEnum):
    """What a participant does now."""

    PREPARING = "preparing"
    """The robots are not ready yet."""
    WATCHING = "watching"
    """Video: a film to watch and rate."""
    COMING = "coming"
    """Physical: the operator has not started the robot yet."""
    MOVING = "moving"
    """Physical: the robot moves."""
    RATING = "rating"
    """Physical: the robot has moved, and is to be rated."""
    DESCRIBING = "describing"
    """All trials of a robot are rated, and there is a standard questionnaire about it."""
    COMPARING = "comparing"
    """Video: all is rated, and two robots are to be compared."""
    FINISHED = "finished"


@dataclass(frozen=True)
class NextTrial:
    """What a participant of the evaluation is to be shown now."""

    state: EvaluationState
    rated: int
    wanted: int
    trial: Trial | None
    """Its film loaded. None while the robots are prepared, and at the end."""
    correctable: Trial | None
    """The trial rated last, whose rating can still be changed."""
    compared: int = 0
    to_compare: int = 0
    head_to_heads: Sequence[HeadToHead] = ()
    """Those without an answer, the one to be shown now first. Empty while there is something to rate."""
    changeable: HeadToHead | None = None
    """The one answered last, whose answer can still be changed."""
    described: str | None = None
    """The letter of the robot that a questionnaire is about now."""
    instrument: Instrument | None = None
    """That questionnaire."""


class Meeting(NamedTuple):
    """Which two robots meet, on which side, in the scenario of which repetition."""

    left: str
    right: str
    repetition: int


def settings_of(study: Study) -> EvaluationSettings | None:
    """What is evaluated; None in studies without, and in those whose clips were made elsewhere."""
    return study.settings.evaluation if study.material is None else None


def settings_for(study: Study, arm: str | None) -> EvaluationSettings | None:
    """The same as it holds for somebody in this arm; None as well before they have one."""
    settings = study.settings
    if study.material is not None or (settings.arms and arm is None):
        return None
    return settings.in_arm(arm).evaluation


def williams_rows(count: int) -> Sequence[tuple[int, ...]]:
    """Orders of ``count`` treatments in which each comes equally often at each place and after each other one.

    Williams (1949), Australian Journal of Scientific Research A 2, 149-168: one square for an even number, two mirrored
    ones for an odd number.
    """
    first = [(place + 1) // 2 if place % 2 else (count - place // 2) % count for place in range(count)]
    square = [tuple((each + shift) % count for each in first) for shift in range(count)]
    return square if count % 2 == 0 else [*square, *(row[::-1] for row in square)]


def order_of_methods(secret: str, methods: Sequence[EvaluatedMethod], number: int) -> Sequence[EvaluatedMethod]:
    """The order in which the participant of this number meets the methods."""
    drawn = sorted(methods, key=lambda method: mark(secret, "method", method))
    rows = williams_rows(len(methods))
    cycle, place = divmod(number - 1, len(rows))
    row = sorted(rows, key=lambda each: mark(secret, "row", cycle, *each))[place]
    return [drawn[index] for index in row]


def meetings(seed: int, settings: EvaluationSettings) -> Sequence[Meeting]:
    """The head-to-heads of the participant with this seed, in their order."""
    letters, trials = LETTERS[: len(settings.methods)], range(1, settings.trials + 1)
    circle = sorted(letters, key=lambda each: mark(str(seed), "circle", each))
    scenarios = sorted(trials, key=lambda each: mark(str(seed), "scenarios", each))
    pairs = list(enumerate(combinations(range(len(circle)), 2)))
    found = []
    for number in range(settings.head_to_heads):
        for place, (one, other) in sorted(pairs, key=lambda each: mark(str(seed), "round", number, each)):
            ahead = 2 * (other - one) <= len(circle)
            left, right = (one, other) if ahead == (number % 2 == 0) else (other, one)
            found.append(Meeting(circle[left], circle[right], scenarios[(number + place) % len(scenarios)]))
    return found


def draw(session: Session, study: Study, participant: Participant) -> None:
    """Draw the participant's letters, trials and head-to-heads; drawing again changes nothing."""
    settings = settings_for(study, participant.arm)
    if settings is None or participant.withdrawn_at is not None:
        return
    session.scalar(select(Participant.id).where(Participant.id == participant.id).with_for_update())  # one at a time
    if session.scalar(select(Assignment.id).where(Assignment.participant_id == participant.id).limit(1)) is not None:
        return
    methods = order_of_methods(study.key_secret, settings.methods, _turn(session, participant))
    for block, (letter, method) in enumerate(zip(LETTERS, methods, strict=False)):
        session.add(Assignment(participant_id=participant.id, letter=letter, method=method))
        for repetition in range(1, settings.trials + 1):
            trial = Trial(
                participant_id=participant.id,
                ordinal=block * settings.trials + repetition,
                letter=letter,
                repetition=repetition,
                scenario=trial_scenario(participant, repetition),
            )
            session.add(trial)
    session.flush()
    known = {(trial.letter, trial.repetition): trial.id for trial in trials_of(session, participant.id)}
    for ordinal, (left, right, repetition) in enumerate(meetings(participant.seed, settings), 1):
        sides = {"left_trial_id": known[left, repetition], "right_trial_id": known[right, repetition]}
        session.add(HeadToHead(participant_id=participant.id, ordinal=ordinal, **sides))
    session.flush()


def _turn(session: Session, participant: Participant) -> int:
    """Whose turn the orders are: the place in the arm, so that they are balanced there; else the number."""
    place = session.scalar(select(Allocation.place).where(Allocation.participant_id == participant.id))
    return place or participant.number


def trial_scenario(participant: Participant, repetition: int) -> int:
    """The scenario of one repetition, whatever the method."""
    places = len(TRIAL_SCENARIOS) // _MOST_TRIALS
    return TRIAL_SCENARIOS.start + participant.seed % places * _MOST_TRIALS + repetition - 1


def comparison_scenarios(participant: Participant) -> Sequence[int]:
    """The scenarios in which the participant's robot is shown before and after."""
    first = COMPARISON_SCENARIOS.start + participant.seed % (len(COMPARISON_SCENARIOS) // COMPARED) * COMPARED
    return range(first, first + COMPARED)


def trials_of(session: Session, participant_id: int) -> Sequence[Trial]:
    """The participant's trials in their order, films loaded."""
    theirs = select(Trial).where(Trial.participant_id == participant_id).order_by(Trial.ordinal)
    return session.scalars(theirs.options(joinedload(Trial.film))).all()


def assignments_of(session: Session, participant_id: int) -> Sequence[Assignment]:
    """Which letter hides which method, by letter."""
    theirs = select(Assignment).where(Assignment.participant_id == participant_id)
    return session.scalars(theirs.order_by(Assignment.letter)).all()


def begun(session: Session, study: Study) -> set[int]:
    """Ids of participants to whom a robot has been shown."""
    shown = select(Trial.participant_id).join(Participant, Participant.id == Trial.participant_id)
    seen = or_(Trial.shown_at.is_not(None), Trial.started_at.is_not(None))
    return set(session.scalars(shown.where(Participant.study_id == study.id, seen)))


def ratings_of(session: Session, participant_id: int) -> dict[int, Rating]:
    """The rating that counts of each rated trial, by the trial's id."""
    theirs = select(Rating).join(Trial).where(Trial.participant_id == participant_id).order_by(Rating.revision)
    return {rating.trial_id: rating for rating in session.scalars(theirs)}


def next_turn(session: Session, store: ArtefactStore, participant: Participant) -> NextTrial:
    """What the participant is to be shown; the study is loaded. Marks a film, or two, as shown."""
    draw(session, participant.study, participant)
    trials, ratings = trials_of(session, participant.id), ratings_of(session, participant.id)
    rated = [trial for trial in trials if trial.id in ratings]
    open_trials = [trial for trial in trials if trial.id not in ratings]
    last = rated[-1] if rated else None
    about = _to_describe(session, participant, rated, open_trials)
    if about is not None:
        letter, instrument = about
        state = EvaluationState.DESCRIBING
        return NextTrial(state, len(rated), len(trials), None, last, described=letter, instrument=instrument)
    if trials and not open_trials:
        return _next_head_to_head(session, store, participant, len(trials), last)
    state = _state(session, store, participant, trials)
    if state is EvaluationState.PREPARING:
        return NextTrial(state, len(rated), len(trials), None, last)
    trial = open_trials[0]
    if state is EvaluationState.WATCHING and trial.shown_at is None:
        trial.shown_at = now()
    return NextTrial(state, len(rated), len(trials), trial, last)


def _to_describe(
    session: Session, participant: Participant, rated: Sequence[Trial], waiting: Sequence[Trial]
) -> tuple[str, Instrument] | None:
    """The first questionnaire that is still to be filled in about a robot all of whose trials are rated."""
    settings = settings_of(participant.study)
    unfinished = {trial.letter for trial in waiting}
    for letter in dict.fromkeys(trial.letter for trial in rated if trial.letter not in unfinished):
        found = form_answers.first_open(session, participant, settings.instruments if settings else (), letter)
        if found is not None:
            return letter, found
    return None


def _next_head_to_head(
    session: Session, store: ArtefactStore, participant: Participant, rated: int, last: Trial | None
) -> NextTrial:
    meant = head_to_heads.of_participant(session, participant.id)
    answered = head_to_heads.answers_of(session, participant.id)
    waiting = [each for each in meant if each.id not in answered]
    changeable = next((each for each in reversed(meant) if each.id in answered), None)
    state = EvaluationState.COMPARING if waiting else EvaluationState.FINISHED
    if waiting and not _can_be_compared(store, waiting[0]):
        state = EvaluationState.PREPARING
    if state is EvaluationState.COMPARING and waiting[0].shown_at is None:
        waiting[0].shown_at = now()
    last = None if changeable else last
    return NextTrial(state, rated, rated, None, last, len(meant) - len(waiting), len(meant), waiting, changeable)


def _can_be_compared(store: ArtefactStore, each: HeadToHead) -> bool:
    films = [trial.film for trial in (each.left_trial, each.right_trial)]
    return all(film is not None and store.seems_whole(film.video_sha256) for film in films)


def _state(
    session: Session, store: ArtefactStore, participant: Participant, trials: Sequence[Trial]
) -> EvaluationState:
    settings = settings_for(participant.study, participant.arm)
    ratings = ratings_of(session, participant.id)
    trial = next((each for each in trials if each.id not in ratings), None)
    if settings is None or trial is None or not is_ready(session, store, settings, participant.id, trial):
        return EvaluationState.PREPARING
    if settings.mode is EvaluationMode.VIDEO:
        return EvaluationState.WATCHING
    if trial.finished_at is not None:
        return EvaluationState.RATING
    return EvaluationState.COMING if trial.started_at is None else EvaluationState.MOVING


def is_ready(
    session: Session,
    store: ArtefactStore,
    settings: EvaluationSettings,
    participant_id: int,
    trial: Trial,
) -> bool:
    """Whether the trial's robot can be shown: its film is there (others may still be made), or all controllers."""
    if settings.mode is EvaluationMode.PHYSICAL:
        return len(controllers_of(session, participant_id)) >= len(settings.methods)
    return trial.film is not None and store.seems_whole(trial.film.video_sha256)


def controllers_of(session: Session, participant_id: int) -> dict[str, Controller]:
    """The participant's controllers, by the letter of their method."""
    rows = session.execute(
        select(Assignment.letter, Controller)
        .join(Controller, Controller.method == Assignment.method)
        .where(Assignment.participant_id == participant_id, Controller.participant_id == participant_id)
        .order_by(Assignment.letter)
    )
    return dict(rows.all())


def film_of(session: Session, participant_id: int, method: str, scenario: int, model_id: int | None) -> Film | None:
    """A film that has been made already."""
    theirs = select(Film).where(Film.participant_id == participant_id, Film.method == method, Film.scenario == scenario)
    return session.scalar(theirs.where(Film.model_id == model_id if model_id is not None else Film.model_id.is_(None)))


def mark(secret: str, *parts: object) -> str:
    """Sorts in an order that looks random and is the same on every machine."""
    return hashlib.sha256(f"{secret}/evaluation/{'/'.join(map(str, parts))}".encode()).hexdigest()
