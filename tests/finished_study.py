"""A study that is over: pairs answered, filters evaluated, robots rated, forms filled in; small and invented."""

from datetime import timedelta
from hashlib import sha256
from random import Random
from uuid import NAMESPACE_URL, uuid5

from sqlalchemy.orm import Session

from app.db import now
from app.domain.clips import Clip
from app.domain.evaluation import HeadToHeadAnswer, Rating, Trial
from app.domain.hints import HintEvent
from app.domain.models import ModelKind
from app.domain.participation import Allocation, ConsentRecord, FormAnswer, ParticipantEvent, StageRecord
from app.domain.preferences import Purpose, Query, Response
from app.domain.protocol import PAPER_METHODS, EvaluatedMethod, EvaluationSettings
from app.domain.self_setting import SelfSetting
from app.domain.studies import Participant, Study
from app.questionnaires import library
from app.services.answers import form_answers
from app.services.evaluation import donors, evaluation_plan, head_to_heads
from app.storage import ArtefactStore
from tests import factories
from tests.made_once import made_once

MEANS = {"reference": 2.6, "prefft": 3.0, "pbarl": 4.1}


def make_finished_study(
    session: Session, store: ArtefactStore, people: int = 8, labels: int = 12, *, unblinded: bool = True
) -> Study:
    """The study, with participants P01, P02, ..."""
    return session.get_one(Study, made_once(_make, session, store, people, labels, unblinded))


def _make(session: Session, store: ArtefactStore, people: int, labels: int, unblinded: bool) -> int:
    study = factories.make_study(
        session,
        "Feeding, finished",
        labels_per_participant=10,
        instruments=("tia",),
        evaluation=EvaluationSettings(methods=PAPER_METHODS, head_to_heads=1, instruments=("tia",)),
    )
    study.key_secret = sha256(study.slug.encode()).hexdigest()  # else each run had other letters, so other ratings
    study.unblinded_at = now() if unblinded else None
    clips = [factories.make_clip(session, store, study) for _ in range(6)]
    for _ in range(people):
        person, _ = factories.make_participant(session, study)
        random = Random(person.number)  # noqa: S311
        _answer(session, person, clips, labels, random)
        _forms(session, person)
        _evaluate(session, study, person, random)
        _rate(session, study, person, random)
        donors.draw(session, study, person, EvaluatedMethod.SOMEBODY_ELSE, ("cautious",))
    return study.id


def _answer(session: Session, person: Participant, clips: list[Clip], labels: int, random: Random) -> None:
    first = None
    for number in range(labels):
        left, right = random.sample(clips, 2)
        predicted = None if number < 3 else random.uniform(0.05, 0.95)
        query = factories.make_query(session, person, left, right, predicted)
        says = Response.RIGHT if random.random() < (predicted or 0.5) else Response.LEFT
        factories.make_label(
            session, query, says, timedelta(minutes=labels - number), response_time_ms=3000 + 100 * number
        )
        first = first or (query, left, right, says)
    if first is None:
        return
    earlier, left, right, said = first
    query = factories.make_query(session, person, right, left)
    query.purpose, query.repeats_query_id = Purpose.REPEAT, earlier.id
    other = {Response.LEFT: Response.RIGHT, Response.RIGHT: Response.LEFT}
    factories.make_label(session, query, other[said], response_time_ms=2500)
    _change_of_mind(session, earlier)


def _change_of_mind(session: Session, query: Query) -> None:
    factories.make_label(session, query, Response.EQUAL, response_time_ms=9000)


def _forms(session: Session, person: Participant) -> None:
    session.add(ConsentRecord(participant_id=person.id, version="1", language="en", text="I agree.\nReally."))
    session.add(StageRecord(participant_id=person.id, stage="consent", finished_at=now()))
    session.add(Allocation(participant_id=person.id, place=person.number, lot=0.5, considered={}))
    session.add(FormAnswer(participant_id=person.id, form="demographics", item="age", value=str(20 + person.number)))
    text = '=HYPERLINK("http://example.com")' if person.number == 1 else 'nice, "really" nice'
    session.add(FormAnswer(participant_id=person.id, form="questionnaire", item="comments", value=text))
    _fill_in(session, person, None, 3.0)
    session.add(ParticipantEvent(participant_id=person.id, kind="break_begun", detail={"answered": 5}))


def _fill_in(session: Session, person: Participant, letter: str | None, mean: float) -> None:
    """A standard questionnaire; the second person leaves one item out."""
    known, random = library.every()["tia"], Random(f"{person.number}{letter}")  # noqa: S311
    level = mean + random.gauss(0, 0.8)
    points = {item.name: min(5, max(1, round(level + random.gauss(0, 0.6)))) for item in known.items}
    values = {item.name: str(6 - points[item.name] if item.reversed else points[item.name]) for item in known.items}
    left_out: dict[str, str | None] = {"item_09": None} if person.number == 2 else {}
    form_answers.append(session, person, "tia", values | left_out, letter)


def _evaluate(session: Session, study: Study, person: Participant, random: Random) -> None:
    metrics = factories.filter_metrics()
    gain, loss = random.uniform(0.3, 1.2), random.uniform(-0.06, 0.02)
    metrics["evaluation"]["preference"] = {"delta": gain, "low": gain - 0.2, "high": gain + 0.2}
    metrics["evaluation"]["success"] = {
        "reference": 0.95,
        "filter": 0.95 + loss,
        "delta": loss,
        "low": loss - 0.04,
        "high": loss + 0.04,
    }
    for cost in metrics["evaluation"]["costs"].values():
        cost["delta"] *= random.uniform(0.2, 1.6)
    factories.make_model(session, study, person, ModelKind.REWARD, factories.reward_metrics())
    factories.make_model(session, study, person, ModelKind.FILTER, metrics)


def _rate(session: Session, study: Study, person: Participant, random: Random) -> None:
    evaluation_plan.draw(session, study, person)
    methods = {each.letter: each.method for each in evaluation_plan.assignments_of(session, person.id)}
    level = random.gauss(0, 0.5)
    for trial in evaluation_plan.trials_of(session, person.id):
        trial.shown_at = now()
        scores = [min(5, max(1, round(MEANS[methods[trial.letter]] + level + random.gauss(0, 0.7)))) for _ in range(2)]
        session.add(_rating(trial, 1, *scores))
        if trial.ordinal == 1:
            session.add(_rating(trial, 2, scores[0], 6 - scores[1]))
    for letter, method in methods.items():
        _fill_in(session, person, letter, MEANS[method])
    session.add(
        SelfSetting(
            participant_id=person.id,
            revision=1,
            mode={"speed_far": -0.25, "press": 0.0},
            moved="speed_far",
            filmed=True,
            client_uuid=str(uuid5(NAMESPACE_URL, f"setting/{person.id}")),
            by_script=True,
        )
    )
    session.add(
        HintEvent(
            participant_id=person.id,
            revision=1,
            hints="gentler",
            offered="gentler slower_near",
            answered=3,
            client_uuid=str(uuid5(NAMESPACE_URL, f"hints/{person.id}")),
        )
    )
    for each in head_to_heads.of_participant(session, person.id):
        each.shown_at = now()
        left, right = (MEANS[methods[trial.letter]] for trial in (each.left_trial, each.right_trial))
        session.add(
            HeadToHeadAnswer(
                head_to_head_id=each.id,
                revision=1,
                response="left" if random.random() < 0.5 + (left - right) / 4 else "right",
                client_uuid=str(uuid5(NAMESPACE_URL, f"head-to-head/{each.id}")),
                by_script=True,
            )
        )
    session.flush()


def _rating(trial: Trial, revision: int, satisfaction: int, personalisation: int) -> Rating:
    return Rating(
        trial_id=trial.id,
        revision=revision,
        satisfaction=satisfaction,
        personalisation=personalisation,
        client_uuid=str(uuid5(NAMESPACE_URL, f"{trial.id}/{revision}")),
        response_time_ms=4000,
    )
