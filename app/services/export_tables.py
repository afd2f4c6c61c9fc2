"""The tables of an export: which rows they have and what every column means."""

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, aliased, joinedload

from app.domain.clips import Clip, Rollout
from app.domain.evaluation import Rating, Trial
from app.domain.models import Bundle, Model, ModelKind
from app.domain.participation import ConsentRecord, FormAnswer, ParticipantEvent, StageRecord
from app.domain.preferences import LEARNED_FROM, LabelEvent, Purpose, Query, Response, SkipReason
from app.domain.protocol import EvaluatedMethod, Stage
from app.domain.studies import Deviation, Participant, Study
from app.services import results, unblinding
from app.services.exporting import Column, Kind, Table

Rows = Iterator[Sequence[Any]]

PARTICIPANT = Column("participant", Kind.TEXT, "Code of the participant.", allowed="P01, P02, ...")
ORDINAL = Column("ordinal", Kind.INTEGER, "Place of the pair in this participant's order.", allowed="from 1")
SHA256 = "64 hexadecimal digits"


def everybody(session: Session, study: Study) -> Sequence[Participant]:
    """Everybody in the study by number, tombstones included; previews are nobody."""
    people = select(Participant).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    return session.scalars(people.order_by(Participant.number)).all()


def _present(session: Session, study: Study) -> Sequence[Participant]:
    return [each for each in everybody(session, study) if each.withdrawn_at is None]


def _participants(session: Session, study: Study) -> Rows:
    for each in everybody(session, study):
        if each.withdrawn_at is not None:
            yield (each.code, "withdrawn", *[None] * 9, each.withdrawn_at)
            continue
        status = "completed" if each.completed_at else "consented" if each.consented_at else "invited"
        yield (
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
        )


def _stages(session: Session, study: Study) -> Rows:
    for person in _present(session, study):
        theirs = select(StageRecord).where(StageRecord.participant_id == person.id).order_by(StageRecord.id)
        for each in session.scalars(theirs):
            yield person.code, each.stage, each.entered_at, each.finished_at


def _queries(session: Session, study: Study) -> Rows:
    for person in _present(session, study):
        shown = select(Query).where(Query.participant_id == person.id).order_by(Query.ordinal)
        clips = (joinedload(side).joinedload(Clip.rollout) for side in (Query.left_clip, Query.right_clip))
        queries = {query.id: query for query in session.scalars(shown.options(*clips))}
        answers = _last_events(session, person)
        theirs = select(Model.id, Model.label_count).where(Model.participant_id == person.id)
        seen = {model_id: labels for model_id, labels in session.execute(theirs)}  # noqa: C416  (typed rows)
        for query in queries.values():
            yield (
                person.code,
                *_query(query, queries, answers.get(query.id), seen.get(query.predicted_by_model_id or 0)),
            )


def _last_events(session: Session, person: Participant) -> dict[int, LabelEvent]:
    events = select(LabelEvent).join(Query).where(Query.participant_id == person.id).order_by(LabelEvent.revision)
    return {event.query_id: event for event in session.scalars(events)}


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
        answer is not None and query.purpose in LEARNED_FROM,
    )


def _labels(session: Session, study: Study) -> Rows:
    for person in _present(session, study):
        newest = {event.id for event in _last_events(session, person).values()}
        rows = session.execute(
            select(Query, LabelEvent)
            .join(LabelEvent, LabelEvent.query_id == Query.id)
            .where(Query.participant_id == person.id)
            .order_by(LabelEvent.id)
        )
        for query, event in rows:
            yield (
                person.code,
                query.ordinal,
                query.purpose,
                event.revision,
                event.response,
                event.id not in newest,
                event.reason,
                event.response_time_ms,
                event.replay_count,
                event.scrub_count,
                event.playback_rate,
                event.watched_whole,
                event.play_error_count,
                event.stall_count,
                event.stalled_ms,
                event.largest_drift_ms,
                event.created_at,
            )


def _forms(session: Session, study: Study) -> Rows:
    for person in _present(session, study):
        answers = session.scalars(
            select(FormAnswer).where(FormAnswer.participant_id == person.id).order_by(FormAnswer.id)
        ).all()
        newest = {(each.form, each.item): each.id for each in answers}
        for each in answers:
            superseded = newest[each.form, each.item] != each.id
            yield person.code, each.form, each.item, each.value, superseded, each.created_at


def _consent(session: Session, study: Study) -> Rows:
    for person in _present(session, study):
        theirs = select(ConsentRecord).where(ConsentRecord.participant_id == person.id).order_by(ConsentRecord.id)
        for each in session.scalars(theirs):
            yield person.code, each.version, each.language, each.agreed_at, each.text


def _events(session: Session, study: Study) -> Rows:
    for person in _present(session, study):
        theirs = select(ParticipantEvent).where(ParticipantEvent.participant_id == person.id)
        for each in session.scalars(theirs.order_by(ParticipantEvent.id)):
            yield person.code, each.at, each.kind, each.detail


def _ratings(session: Session, study: Study) -> Rows:
    blinded = unblinding.is_blinded(study)
    methods = {} if blinded else unblinding.methods_by_letter(session, study)
    for person in _present(session, study):
        rows = session.execute(
            select(Trial, Rating)
            .outerjoin(Rating, Rating.trial_id == Trial.id)
            .where(Trial.participant_id == person.id)
            .options(joinedload(Trial.film))
            .order_by(Trial.ordinal, Rating.revision)
        ).all()
        newest = {trial.id: rating.revision for trial, rating in rows if rating is not None}
        for trial, rating in rows:
            yield (
                person.code,
                trial.letter,
                methods.get((person.id, trial.letter)),
                trial.repetition,
                trial.ordinal,
                trial.scenario,
                rating.satisfaction if rating else None,
                rating.personalisation if rating else None,
                rating is not None and newest[trial.id] == rating.revision,
                rating.revision if rating else None,
                rating.response_time_ms if rating else None,
                rating.created_at if rating else None,
                trial.shown_at,
                trial.started_at,
                trial.finished_at,
                trial.film.success if trial.film is not None and not blinded else None,
            )


def _models(session: Session, study: Study) -> Rows:
    for person in _present(session, study):
        for each in session.scalars(select(Model).where(Model.participant_id == person.id).order_by(Model.id)):
            yield (
                person.code,
                each.kind,
                each.label_count,
                each.label_hash,
                each.seed,
                each.artefact_sha256,
                each.created_at,
                each.metrics,
            )


def _evaluations(session: Session, study: Study) -> Rows:
    for person in _present(session, study):
        rows = session.execute(
            select(Model, Bundle)
            .outerjoin(Bundle, Bundle.model_id == Model.id)
            .where(Model.participant_id == person.id, Model.kind == ModelKind.FILTER)
            .order_by(Model.label_count, Model.id)
        ).all()
        for place, (model, bundle) in enumerate(rows, 1):
            measured = results.filter_version(model, bundle)
            named = [("success", measured.success), ("preference", measured.preference)]
            named += [(cost.symbol, cost) for cost in measured.costs]
            for name, change in named:
                if change is not None:
                    yield (
                        person.code,
                        measured.label_count,
                        place == len(rows),
                        measured.bundle_version,
                        measured.scenarios,
                        name,
                        change.reference,
                        change.filtered,
                        change.delta,
                        change.low,
                        change.high,
                    )


def _clips(session: Session, study: Study) -> Rows:
    rollout = aliased(Rollout)
    rows = session.execute(
        select(Clip, rollout)
        .join(rollout, Clip.rollout_id == rollout.id)
        .where(rollout.study_id == study.id)
        .order_by(rollout.scenario, rollout.behaviour, Clip.first_step, Clip.step_count)
    )
    for clip, run in rows:
        yield (
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
        )


def _deviations(session: Session, study: Study) -> Rows:
    for each in session.scalars(select(Deviation).where(Deviation.study_id == study.id).order_by(Deviation.id)):
        yield each.at, each.actor, each.reason, each.before, each.after


def _words(values: type[Any]) -> str:
    return ", ".join(value.value for value in values)


T, I, N, B, W, J = Kind.TEXT, Kind.INTEGER, Kind.NUMBER, Kind.BOOLEAN, Kind.TIME, Kind.JSON  # noqa: E741

TABLES: Sequence[Table] = (
    Table(
        "participants",
        "One row per participant, tombstones of those who withdrew included.",
        (
            PARTICIPANT,
            Column("status", T, "How far they are.", allowed="invited, consented, completed, withdrawn"),
            Column("seed", I, "Everything drawn for this person follows from it."),
            Column("language", T, "Of the pages.", allowed="en, de"),
            Column("invited_at", W, "When the personal link was made."),
            Column("consented_at", W, "When they agreed."),
            Column("consent_version", T, "To which text."),
            Column("instructed_at", W, "When they had read the instructions."),
            Column("completed_at", W, "When they had finished everything."),
            Column("last_seen_at", W, "When their browser last asked for anything."),
            Column("panel_id", T, "Who this is at the recruitment panel, if they came through one. Personal."),
            Column("withdrawn_at", W, "When they withdrew; nothing else is kept of them."),
        ),
        _participants,
    ),
    Table(
        "stages",
        "When everybody came into each stage and was through with it.",
        (
            PARTICIPANT,
            Column("stage", T, "Part of the way.", allowed=_words(Stage)),
            Column("entered_at", W, "When it was first shown."),
            Column(
                "finished_at", W, "When it was done; empty where that is counted instead (practice, pairs, evaluation)."
            ),
        ),
        _stages,
    ),
    Table(
        "queries",
        "One row per pair that was made for a participant, with the answer that counts.",
        (
            PARTICIPANT,
            ORDINAL,
            Column(
                "purpose", T, "Why it is shown; only introduction and preference are learned from.", "", _words(Purpose)
            ),
            Column("repeats_ordinal", I, "Of a repeat: the ordinal of the pair that it asks again."),
            Column("sides_swapped", B, "Of a repeat: whether the clips have changed sides."),
            Column("expected", T, "Of a catch pair: the obvious answer.", allowed="left, right"),
            Column(
                "left_scenario", I, "Situation of the left clip; with the behaviour it names the clip (table clips)."
            ),
            Column("left_behaviour", I, "Way of doing the task on the left."),
            Column("right_scenario", I, "Situation of the right clip; usually the same."),
            Column("right_behaviour", I, "Way of doing the task on the right."),
            Column("left_steps", I, "Length of the left clip.", "control steps"),
            Column("right_steps", I, "Length of the right clip.", "control steps"),
            Column("left_video_sha256", T, "The video that was shown on the left.", allowed=SHA256),
            Column("right_video_sha256", T, "The video that was shown on the right.", allowed=SHA256),
            Column("strategy", T, "How the pair was chosen."),
            Column("propensity", N, "Probability with which it was chosen among the candidates.", allowed="0 to 1"),
            Column(
                "predicted_right",
                N,
                "P(right preferred) by the newest model that had not seen this pair's answer; empty without one.",
                allowed="0 to 1",
            ),
            Column("predicted_from_labels", I, "How many answers that model had learned from."),
            Column("served_at", W, "When it was first shown."),
            Column(
                "response", T, "The answer that counts; empty: not answered, or taken back.", allowed=_words(Response)
            ),
            Column("reason", T, "Why they could not tell (skip).", allowed=_words(SkipReason)),
            Column("response_time_ms", I, "From the first frame of both videos to the answer.", "ms"),
            Column("answered_at", W, "When that answer reached the server."),
            Column("revisions", I, "Answers and undos of this pair; table labels has them all."),
            Column("is_label", B, "Whether the answer is learned from."),
        ),
        _queries,
    ),
    Table(
        "labels",
        "Every answer and every undo as it came in, those that no longer count included.",
        (
            PARTICIPANT,
            ORDINAL,
            Column("purpose", T, "Of the pair.", allowed=_words(Purpose)),
            Column("revision", I, "First, second, ... word about this pair.", allowed="from 1"),
            Column("response", T, "What was said; empty: the answer before was taken back.", allowed=_words(Response)),
            Column("superseded", B, "Whether a later word about this pair counts instead."),
            Column("reason", T, "Why they could not tell (skip).", allowed=_words(SkipReason)),
            Column("response_time_ms", I, "From the first frame of both videos to the answer.", "ms"),
            Column("replay_count", I, "How often the clips were started again."),
            Column("scrub_count", I, "How often somebody moved through the clips by hand."),
            Column("playback_rate", N, "Speed at the moment of the answer; 1 is real time.", allowed="0.25 to 2"),
            Column("watched_whole", B, "Whether both clips had been seen from beginning to end."),
            Column("play_error_count", I, "Clips that could not be loaded or played."),
            Column("stall_count", I, "How often a clip had to wait for the network."),
            Column("stalled_ms", I, "How long altogether.", "ms"),
            Column(
                "largest_drift_ms",
                I,
                "How far the two clips were apart at worst, before they were brought together.",
                "ms",
            ),
            Column("created_at", W, "When it reached the server."),
        ),
        _labels,
    ),
    Table(
        "forms",
        "Answers to demographics and questionnaire. The study's settings have the questions.",
        (
            PARTICIPANT,
            Column("form", T, "Which form.", allowed="demographics, questionnaire"),
            Column("item", T, "Name of the question."),
            Column("value", T, "What was entered (likert: 1 to 5); empty: left out on purpose."),
            Column("superseded", B, "Whether a later answer to the same question counts instead."),
            Column("created_at", W, "When it reached the server."),
        ),
        _forms,
    ),
    Table(
        "consent",
        "What exactly everybody agreed to.",
        (
            PARTICIPANT,
            Column("version", T, "Version of the text."),
            Column("language", T, "Of the text.", allowed="en, de"),
            Column("agreed_at", W, "When they agreed."),
            Column("text", T, "The text, word for word."),
        ),
        _consent,
    ),
    Table(
        "events",
        "What happened on the way besides answers: breaks, hidden pages, clips that would not play.",
        (
            PARTICIPANT,
            Column("at", W, "When."),
            Column("kind", T, "What; app/services/participant_events.py says what each means."),
            Column("detail", J, "Numbers that belong to it."),
        ),
        _events,
    ),
    Table(
        "ratings",
        "Every trial of the blinded evaluation with what was said about it; a corrected rating has a row per revision.",
        (
            PARTICIPANT,
            Column(
                "letter",
                T,
                "Under which the participant met the method; letters go by the order of meeting.",
                "",
                "A to E",
            ),
            Column(
                "method", T, "Which method it was; empty until the study is unblinded.", allowed=_words(EvaluatedMethod)
            ),
            Column("repetition", I, "Which trial of this method.", allowed="from 1"),
            Column("order", I, "Place of the trial among all of this participant.", allowed="from 1"),
            Column("scenario", I, "Situation; the same for all methods of a participant and repetition."),
            Column("satisfaction", I, "Overall satisfaction.", allowed="1 to 5; empty: not rated"),
            Column("personalisation", I, "How personalised the robot seemed.", allowed="1 to 5; empty: not rated"),
            Column("counts", B, "Whether this rating counts: false for a corrected one, and where there is none."),
            Column("revision", I, "First, second, ... rating of this trial.", allowed="from 1"),
            Column("response_time_ms", I, "From showing the scales to sending.", "ms"),
            Column("rated_at", W, "When it reached the server."),
            Column("shown_at", W, "Video: when the film was first shown."),
            Column("started_at", W, "Physical: when the operator started the robot."),
            Column("finished_at", W, "Physical: when the operator said that it was done."),
            Column("success", B, "Video: whether the robot succeeded; empty until the study is unblinded."),
        ),
        _ratings,
    ),
    Table(
        "models",
        "Every model that was trained for a participant.",
        (
            PARTICIPANT,
            Column("kind", T, "What it is.", allowed=_words(ModelKind)),
            Column("label_count", I, "Answers it has learned from, those without a preference included."),
            Column("label_hash", T, "Fingerprint of these answers.", allowed=SHA256),
            Column("seed", I, "Of the training."),
            Column("artefact_sha256", T, "The stored file.", allowed=SHA256),
            Column("created_at", W, "When it was ready."),
            Column("metrics", J, "What was measured while training."),
        ),
        _models,
    ),
    Table(
        "evaluations",
        "What each filter changes on unseen simulated scenarios, against the reference policy; one row per measure.",
        (
            PARTICIPANT,
            Column("label_count", I, "Answers the filter has learned from."),
            Column("newest", B, "Whether it is the participant's newest filter."),
            Column("bundle_version", I, "Of the published bundle, if there is one."),
            Column("scenarios", I, "Unseen scenarios it was measured on."),
            Column(
                "measure",
                T,
                "success: share of scenarios. preference: learned return, in standard deviations of the reference's. "
                "C_*: the paper's costs, summed per episode.",
                allowed="success, preference, C_d, C_v, C_f, C_hf, C_fd, C_fdv",
            ),
            Column("reference", N, "Mean with the reference policy; empty for preference."),
            Column("filtered", N, "Mean with the filter; empty for preference."),
            Column("delta", N, "Mean difference, filtered minus reference, paired by scenario."),
            Column("low", N, "Lower end of the 95 % interval of the difference."),
            Column("high", N, "Upper end."),
        ),
        _evaluations,
    ),
    Table(
        "clips",
        "The pool of clips that pairs are made of.",
        (
            Column("video_sha256", T, "The video.", allowed=SHA256),
            Column("scenario", I, "Situation: its seed, or the number given when clips were imported."),
            Column("behaviour", I, "Way of doing the task in this situation.", allowed="from 0"),
            Column("mode", J, "What the behaviour is."),
            Column("success", B, "Whether the whole trajectory succeeded."),
            Column("first_step", I, "First control step that is shown."),
            Column("step_count", I, "How many are shown.", "control steps"),
            Column("duration_ms", I, "Length of the video.", "ms"),
            Column("fps", I, "Frames per second.", "1/s"),
            Column("trajectory_sha256", T, "The stored trajectory.", allowed=SHA256),
        ),
        _clips,
    ),
    Table(
        "deviations",
        "Changes to the study after it was locked.",
        (
            Column("at", W, "When."),
            Column("actor", T, "Whose account."),
            Column("reason", T, "Why, in their words."),
            Column("before", J, "What was changed, as it was."),
            Column("after", J, "And as it is since."),
        ),
        _deviations,
    ),
)
BY_NAME = {table.name: table for table in TABLES}
