"""The rows of an export's tables: what is read from the database, in the order of the columns in export_tables.

Every row comes with its key, by which keys ascend; ``window`` says which rows are wanted (see paging).
"""

from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from sqlalchemy import select
from sqlalchemy.orm import Session, aliased, joinedload

from app.domain.clips import Clip, Rollout
from app.domain.evaluation import DonorDraw, HeadToHead, HeadToHeadAnswer, Rating, Trial
from app.domain.hints import HintEvent
from app.domain.models import Bundle, Model, ModelKind
from app.domain.participation import Allocation, ConsentRecord, FormAnswer, ParticipantEvent, StageRecord
from app.domain.preferences import LEARNED_FROM, Exclusion, LabelEvent, Query
from app.domain.protocol import LETTERS, EvaluatedMethod
from app.domain.self_setting import SelfSetting
from app.domain.studies import Deviation, Participant, Study, code_of
from app.questionnaires import library
from app.questionnaires.library import Score
from app.services.answers import form_answers
from app.services.answers.form_answers import FilledIn
from app.services.evaluation import self_setting, unblinding
from app.services.exports.paging import EVERYTHING, KeyedRows, Window
from app.services.runs import model_metrics

_OfPerson = TypeVar("_OfPerson", Allocation, ConsentRecord, ParticipantEvent, StageRecord)
AT_ONCE = 200
"""Clips: there may be tens of thousands, and a page wants a hundred."""


def everybody(session: Session, study: Study, window: Window = EVERYTHING) -> Sequence[Participant]:
    """Everybody in the study by number, tombstones included; previews are nobody."""
    people = select(Participant).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    people = people.where(window.reaches(Participant.number), window.known(Participant))
    return session.scalars(people.order_by(Participant.number)).all()


def _present(session: Session, study: Study, window: Window) -> Iterator[tuple[Participant, Window]]:
    """Everybody who has not withdrawn, each with what is wanted of their rows; their number begins their keys."""
    for person in everybody(session, study, window):
        if person.withdrawn_at is None:
            yield person, window.within(person.number)


def _theirs(
    session: Session, study: Study, window: Window, table: type[_OfPerson]
) -> Iterator[tuple[Participant, _OfPerson]]:
    """The wanted rows of a table whose rows belong to one person each, in the order in which they came."""
    for person, wanted in _present(session, study, window):
        rows = select(table).where(table.participant_id == person.id, wanted.beyond(table.id), wanted.known(table))
        for row in session.scalars(rows.order_by(table.id)):
            yield person, row


def participants(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    for each in everybody(session, study, window):
        if (each.number,) > window.after:
            earlier = None if each.earlier_id is None else session.get_one(Participant, each.earlier_id)
            yield (each.number,), _participant(study, each, earlier)


def _participant(study: Study, each: Participant, earlier: Participant | None) -> Sequence[Any]:
    if each.withdrawn_at is not None:
        return (each.code, "withdrawn", *[None] * 9, each.withdrawn_at, each.scripted_as, *[None] * 4)
    status = "completed" if each.completed_at else "consented" if each.consented_at else "invited"
    return (
        each.code,
        status,
        each.seed,
        each.language or study.settings.language.value,
        each.created_at,
        each.consented_at,
        each.consent_version,
        each.instructed_at,
        each.completed_at,
        each.last_seen_at,
        each.panel_id,
        None,
        each.scripted_as,
        None if unblinding.is_blinded(study) else each.arm,
        each.ended_as,
        each.visit,
        None if earlier is None else earlier.code,
    )


def allocations(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    if unblinding.is_blinded(study):
        return
    for person, each in _theirs(session, study, window, Allocation):
        values = (person.arm, each.place, each.lot, each.considered, each.created_at)
        yield (person.number, each.id), (person.code, *values)


def stages(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    for person, each in _theirs(session, study, window, StageRecord):
        yield (person.number, each.id), (person.code, each.stage, each.entered_at, each.finished_at)


def queries(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    for person, wanted in _present(session, study, window):
        shown = select(Query).where(Query.participant_id == person.id, wanted.known(Query)).order_by(Query.ordinal)
        clips = (joinedload(side).joinedload(Clip.rollout) for side in (Query.left_clip, Query.right_clip))
        queries = {query.id: query for query in session.scalars(shown.options(*clips))}
        answers, exclusions = _last_events(session, person, wanted), _exclusions(session, person, wanted)
        theirs = select(Model.id, Model.label_count).where(Model.participant_id == person.id)
        seen = dict(session.execute(theirs).all())
        for query in queries.values():
            if (query.ordinal,) > wanted.after:
                answer = answers.get(query.id)
                values = _query(query, queries, answer, seen.get(query.predicted_by_model_id or 0))
                learned = _learned_from(query, answer, exclusions.get(answer.id) if answer is not None else None)
                yield (person.number, query.ordinal), (person.code, *values, *learned)


def _last_events(session: Session, person: Participant, wanted: Window) -> dict[int, LabelEvent]:
    events = select(LabelEvent).join(Query).where(Query.participant_id == person.id, wanted.known(LabelEvent))
    return {event.query_id: event for event in session.scalars(events.order_by(LabelEvent.revision))}


def _exclusions(session: Session, person: Participant, wanted: Window) -> dict[int, Exclusion]:
    """The newest word about every answer that is left out, by the answer's id."""
    words = select(Exclusion).join(LabelEvent).join(Query)
    words = words.where(Query.participant_id == person.id, wanted.known(Exclusion))
    newest = {word.label_event_id: word for word in session.scalars(words.order_by(Exclusion.id))}
    return {event_id: word for event_id, word in newest.items() if word.excluded}


def _query(query: Query, queries: dict[int, Query], last: LabelEvent | None, model_labels: int | None) -> Sequence[Any]:
    earlier = queries.get(query.repeats_query_id or 0)
    left, right = query.left_clip, query.right_clip
    answer = last if last is not None and last.response is not None else None
    return (
        query.ordinal,
        query.purpose,
        earlier.ordinal if earlier else None,
        earlier.left_clip_id != query.left_clip_id if earlier else None,
        query.expected,
        left.rollout.scenario,
        left.rollout.behaviour,
        right.rollout.scenario,
        right.rollout.behaviour,
        left.step_count,
        right.step_count,
        left.video_sha256,
        right.video_sha256,
        query.strategy,
        query.propensity,
        query.predicted_right,
        model_labels,
        query.served_at,
        answer.response if answer else None,
        answer.reason if answer else None,
        answer.response_time_ms if answer else None,
        answer.created_at if answer else None,
        last.revision if last else 0,
    )


def _learned_from(query: Query, last: LabelEvent | None, exclusion: Exclusion | None) -> Sequence[Any]:
    """Whether the answer is a label, whether it is excluded, and why."""
    answered = last is not None and last.response is not None
    excluded = answered and exclusion is not None
    reason = exclusion.reason if excluded and exclusion is not None else None
    return answered and not excluded and query.purpose in LEARNED_FROM, excluded, reason


def labels(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    for person, wanted in _present(session, study, window):
        newest = {event.id for event in _last_events(session, person, wanted).values()}
        exclusions = _exclusions(session, person, wanted)
        rows = session.execute(
            select(Query, LabelEvent)
            .join(LabelEvent, LabelEvent.query_id == Query.id)
            .where(Query.participant_id == person.id)
            .where(wanted.beyond(LabelEvent.id), wanted.known(LabelEvent))
            .order_by(LabelEvent.id)
        )
        for query, event in rows:
            yield (
                (person.number, event.id),
                (
                    person.code,
                    query.ordinal,
                    query.purpose,
                    event.revision,
                    event.response,
                    event.id not in newest,
                    event.reason,
                    event.mattered,
                    event.response_time_ms,
                    event.replay_count,
                    event.scrub_count,
                    event.playback_rate,
                    event.watched_whole,
                    event.left_watched_ms,
                    event.right_watched_ms,
                    event.play_error_count,
                    event.stall_count,
                    event.stalled_ms,
                    event.largest_drift_ms,
                    event.by_script,
                    event.created_at,
                    event.id in exclusions,
                ),
            )


def forms(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    methods = {} if unblinding.is_blinded(study) else unblinding.methods_by_letter(session, study)
    for person, wanted in _present(session, study, window):
        theirs = select(FormAnswer).where(FormAnswer.participant_id == person.id, wanted.known(FormAnswer))
        answers = session.scalars(theirs.order_by(FormAnswer.id)).all()
        newest = {(each.form, each.letter, each.item): each.id for each in answers}
        for each in answers:
            superseded = newest[each.form, each.letter, each.item] != each.id
            if (each.id,) > wanted.after:
                method = methods.get((person.id, each.letter or ""))
                about = (person.code, each.form, each.letter, method)
                yield (person.number, each.id), (*about, each.item, each.value, superseded, each.created_at)


def scores(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    """Of every standard questionnaire that was sent; the key is the place among all that somebody could have."""
    methods = {} if unblinding.is_blinded(study) else unblinding.methods_by_letter(session, study)
    places = {
        (letter, form, score.name): place
        for place, (letter, form, score) in enumerate(
            (letter, form, score)
            for letter in (None, *LETTERS)
            for form, instrument in library.every().items()
            for score in instrument.scores
        )
    }
    for person, wanted in _present(session, study, window):
        for each in form_answers.filled_in(session, person.id, wanted.known(FormAnswer)):
            for score in each.instrument.scores:
                key = (places[each.letter, each.instrument.name, score.name],)
                if key > wanted.after:
                    yield (
                        (person.number, *key),
                        (person.code, *_score(each, score, methods.get((person.id, each.letter or "")))),
                    )


def _score(each: FilledIn, score: Score, method: str | None) -> Sequence[Any]:
    answered = sum(each.answers.get(name) is not None for name in score.items)
    low, high = each.instrument.range_of(score)
    value = each.scores[score.name]
    return (each.instrument.name, each.letter, method, score.name, value, low, high, len(score.items), answered)


def consent(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    for person, each in _theirs(session, study, window, ConsentRecord):
        yield (person.number, each.id), (person.code, each.version, each.language, each.agreed_at, each.text)


def events(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    for person, each in _theirs(session, study, window, ParticipantEvent):
        yield (person.number, each.id), (person.code, each.at, each.kind, each.detail)


def ratings(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    blinded = unblinding.is_blinded(study)
    methods = {} if blinded else unblinding.methods_by_letter(session, study)
    for person, wanted in _present(session, study, window):
        rows = session.execute(
            select(Trial, Rating)
            .outerjoin(Rating, (Rating.trial_id == Trial.id) & wanted.known(Rating))
            .where(Trial.participant_id == person.id, wanted.known(Trial))
            .options(joinedload(Trial.film))
            .order_by(Trial.ordinal, Rating.revision)
        ).all()
        newest = {trial.id: rating.revision for trial, rating in rows if rating is not None}
        for trial, rating in rows:
            key = trial.ordinal, *((rating.revision, rating.id) if rating else (0, 0))
            if key <= wanted.after:
                continue
            yield (
                (person.number, *key),
                (
                    person.code,
                    trial.letter,
                    methods.get((person.id, trial.letter)),
                    trial.repetition,
                    trial.ordinal,
                    trial.scenario,
                    rating.satisfaction if rating else None,
                    rating.personalisation if rating else None,
                    rating.reason if rating else None,
                    rating is not None and newest[trial.id] == rating.revision,
                    rating.revision if rating else None,
                    rating.response_time_ms if rating else None,
                    rating.by_script if rating else None,
                    rating.created_at if rating else None,
                    trial.shown_at,
                    trial.started_at,
                    trial.finished_at,
                    trial.film.success if trial.film is not None and not blinded else None,
                ),
            )


def headtoheads(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    methods = {} if unblinding.is_blinded(study) else unblinding.methods_by_letter(session, study)
    for person, wanted in _present(session, study, window):
        rows = session.execute(
            select(HeadToHead, HeadToHeadAnswer)
            .outerjoin(
                HeadToHeadAnswer, (HeadToHeadAnswer.head_to_head_id == HeadToHead.id) & wanted.known(HeadToHeadAnswer)
            )
            .where(HeadToHead.participant_id == person.id, wanted.known(HeadToHead))
            .options(joinedload(HeadToHead.left_trial), joinedload(HeadToHead.right_trial))
            .order_by(HeadToHead.ordinal, HeadToHeadAnswer.revision)
        ).all()
        newest = {each.id: given.revision for each, given in rows if given is not None}
        for each, given in rows:
            key = each.ordinal, *((given.revision, given.id) if given else (0, 0))
            if key <= wanted.after:
                continue
            left, right = each.left_trial, each.right_trial
            yield (
                (person.number, *key),
                (
                    person.code,
                    each.ordinal,
                    left.letter,
                    right.letter,
                    methods.get((person.id, left.letter)),
                    methods.get((person.id, right.letter)),
                    left.repetition,
                    left.scenario,
                    given.response if given else None,
                    given.reason if given else None,
                    given is not None and newest[each.id] == given.revision,
                    given.revision if given else None,
                    given.response_time_ms if given else None,
                    given.by_script if given else None,
                    given.created_at if given else None,
                    each.shown_at,
                ),
            )


def hints(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    for person, wanted in _present(session, study, window):
        rows = select(HintEvent).where(HintEvent.participant_id == person.id, wanted.known(HintEvent))
        given = session.scalars(rows.order_by(HintEvent.revision)).all()
        for each in given:
            if (each.revision, each.id) > wanted.after:
                said = each.hints, each is not given[-1], each.answered, each.offered, each.created_at
                yield (person.number, each.revision, each.id), (person.code, each.revision, *said)


def settings(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    sliders, through = self_setting.sliders_of(study), self_setting.who_have_set(session, study)
    for person, wanted in _present(session, study, window):
        rows = select(SelfSetting).where(SelfSetting.participant_id == person.id, wanted.known(SelfSetting))
        given = session.scalars(rows.order_by(SelfSetting.revision)).all()
        for each in given:
            stops = self_setting.stops_of(sliders, each.mode)
            counts = each is given[-1] and person.id in through
            saved = counts, each.moved, each.filmed, each.response_time_ms, each.by_script, each.created_at
            for place, (axis, value) in enumerate(each.mode.items(), 1):
                key = each.revision, place, each.id
                if key > wanted.after:
                    yield (person.number, *key), (person.code, each.revision, axis, stops.get(axis), value, *saved)


def donors(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    """Nothing while the study is blinded."""
    if unblinding.is_blinded(study):
        return
    for person, wanted in _present(session, study, window):
        theirs = select(DonorDraw).where(DonorDraw.participant_id == person.id)
        theirs = theirs.where(wanted.beyond(DonorDraw.id), wanted.known(DonorDraw)).order_by(DonorDraw.id)
        for each in session.scalars(theirs):
            yield (
                (person.number, each.id),
                (
                    person.code,
                    each.method,
                    each.rule,
                    " ".join(code_of(number) for number in each.donors.people),
                    " ".join(each.donors.types),
                    " ".join(code_of(number) for number in each.donors.candidates),
                    each.created_at,
                ),
            )


def models(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    """While the study is blinded, without the hashes of methods: those are files of letters as well."""
    blinded = unblinding.is_blinded(study)
    for person, wanted in _present(session, study, window):
        theirs = select(Model).where(Model.participant_id == person.id, wanted.beyond(Model.id), wanted.known(Model))
        for each in session.scalars(theirs.order_by(Model.id)):
            yield (
                (person.number, each.id),
                (
                    person.code,
                    each.kind,
                    each.label_count,
                    each.label_hash,
                    each.seed,
                    None if blinded and each.kind == ModelKind.METHOD else each.artefact_sha256,
                    each.created_at,
                    _while_training(each),
                ),
            )


def evaluations(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    """Of filters and of the methods that they are compared with, by name: letters say nothing of these numbers."""
    for person, wanted in _present(session, study, window):
        rows = session.execute(
            select(Model, Bundle)
            .outerjoin(Bundle, Bundle.model_id == Model.id)
            .where(Model.participant_id == person.id, Model.kind.in_(_MEASURED), wanted.known(Model))
            .order_by(Model.label_count, Model.id)
        ).all()
        newest = {_method_of(model): model.id for model, _ in rows}
        for model, bundle in rows:
            measured = model_metrics.filter_version(model, bundle)
            named = [("success", measured.success), ("preference", measured.preference)]
            named += [(cost.symbol, cost) for cost in measured.costs]
            for number, (name, change) in enumerate(named):
                key = model.label_count, model.id, number
                if change is not None and key > wanted.after:
                    yield (
                        (person.number, *key),
                        (
                            person.code,
                            _method_of(model),
                            measured.label_count,
                            newest[_method_of(model)] == model.id,
                            measured.bundle_version,
                            measured.scenarios,
                            name,
                            change.reference,
                            change.filtered,
                            change.delta,
                            change.low,
                            change.high,
                        ),
                    )


_MEASURED = (ModelKind.FILTER, ModelKind.METHOD)


def _method_of(model: Model) -> str:
    return EvaluatedMethod.PBARL.value if model.kind == ModelKind.FILTER else str(model.metrics.get("method"))


def _while_training(model: Model) -> dict[str, Any]:
    """Methods are measured after they have been kept: that is in evaluations(), for here no row changes."""
    if model.kind != ModelKind.METHOD:
        return model.metrics
    return {name: value for name, value in model.metrics.items() if name not in ("evaluation", "seconds")}


def clips(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    rollout = aliased(Rollout)
    place = (rollout.scenario, rollout.behaviour, Clip.first_step, Clip.step_count, Clip.id)
    wanted = (
        select(Clip, rollout, Participant)
        .join(rollout, Clip.rollout_id == rollout.id)
        .outerjoin(Participant, Participant.id == rollout.participant_id)
        .where(rollout.study_id == study.id, window.beyond(*place), window.known(Clip))
        .order_by(*place)
        .execution_options(yield_per=AT_ONCE)
    )
    with session.execute(wanted) as rows:  # whoever wants a page only stops in the middle
        for clip, run, person in rows:
            yield (
                (run.scenario, run.behaviour, clip.first_step, clip.step_count, clip.id),
                (
                    clip.video_sha256,
                    run.scenario,
                    run.behaviour,
                    run.mode,
                    run.success,
                    clip.first_step,
                    clip.step_count,
                    clip.duration_ms,
                    clip.fps,
                    run.trajectory_sha256,
                    None if person is None else person.code,
                ),
            )


def deviations(session: Session, study: Study, window: Window = EVERYTHING) -> KeyedRows:
    known = select(Deviation).where(
        Deviation.study_id == study.id, window.beyond(Deviation.id), window.known(Deviation)
    )
    for each in session.scalars(known.order_by(Deviation.id)):
        yield (each.id,), (each.at, each.actor, each.reason, each.before, each.after)
