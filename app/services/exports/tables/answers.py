"""What people answered to pairs, and the hints that they gave."""

from collections.abc import Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, joinedload

from app.domain.choices import Strategy
from app.domain.clips import Clip
from app.domain.hints import HintEvent
from app.domain.models import Model
from app.domain.preferences import (
    FOLLOWING,
    LEARNED_FROM,
    NO_LABELS,
    Exclusion,
    LabelEvent,
    Purpose,
    Query,
    Response,
    SkipReason,
)
from app.domain.studies import Participant, Study
from app.services.exports.export_formats import Column, Table
from app.services.exports.paging import KeyedRows, Window
from app.services.exports.tables.columns import ORDINAL, PARTICIPANT, SHA256, WITHOUT_SCRIPT, B, I, N, T, W, words
from app.services.exports.whose_rows import present


def _queries(session: Session, study: Study, window: Window) -> KeyedRows:
    for person, wanted in present(session, study, window):
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


QUERIES = Table(
    "queries",
    "One row per pair that was made for a participant, with the answer that counts.",
    (
        PARTICIPANT,
        ORDINAL,
        Column("purpose", T, "Why it is shown; only introduction and preference are learned from.", "", words(Purpose)),
        Column("repeats_ordinal", I, "Of a repeat: the ordinal of the pair that it asks again."),
        Column("sides_swapped", B, "Of a repeat: whether the clips have exchanged sides."),
        Column("expected", T, "Of a catch pair: the obvious answer.", allowed="left, right"),
        Column("left_scenario", I, "Situation of the left clip; with the behaviour it names the clip (table clips)."),
        Column("left_behaviour", I, "Way of doing the task on the left."),
        Column("right_scenario", I, "Situation of the right clip; usually the same."),
        Column("right_behaviour", I, "Way of doing the task on the right."),
        Column("left_steps", I, "Length of the left clip.", "control steps"),
        Column("right_steps", I, "Length of the right clip.", "control steps"),
        Column("left_video_sha256", T, "The video that was shown on the left.", allowed=SHA256),
        Column("right_video_sha256", T, "The video that was shown on the right.", allowed=SHA256),
        Column(
            "strategy",
            T,
            "How the pair was chosen: at random (uniform), by a rule, or following the person: their robot as it "
            "would have been then, beside a variation of it, made for them alone. The last four are no pairs for "
            "labels.",
            allowed=", ".join((*Strategy, FOLLOWING, *NO_LABELS)),
        ),
        Column(
            "propensity",
            N,
            "Probability with which it was chosen from the candidates: over all ways in which a label's pair could "
            "be chosen at that moment, not only the one that it was.",
            allowed="0 to 1",
        ),
        Column(
            "predicted_right",
            N,
            "P(right preferred) by the newest model that had not seen this pair's answer; empty without one.",
            allowed="0 to 1",
        ),
        Column("predicted_from_labels", I, "How many answers that model had learned from."),
        Column("served_at", W, "When it was first shown."),
        Column("response", T, "The answer that counts; empty: not answered, or taken back.", allowed=words(Response)),
        Column("reason", T, "Why they could not tell (skip).", allowed=words(SkipReason)),
        Column("response_time_ms", I, "From the first frame of both videos to the answer.", "ms"),
        Column("answered_at", W, "When that answer reached the server."),
        Column("revisions", I, "Number of answers and undos of this pair; the table labels has them all."),
        Column("is_label", B, "Whether the answer is learned from."),
        Column("excluded", B, "Whether an experimenter has left the answer out of learning and statistics."),
        Column("exclusion_reason", T, "Why, in their words."),
    ),
    _queries,
    (Query, LabelEvent),
)


def _labels(session: Session, study: Study, window: Window) -> KeyedRows:
    for person, wanted in present(session, study, window):
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


LABELS = Table(
    "labels",
    "Every answer and every undo as it came in, including those that no longer count.",
    (
        PARTICIPANT,
        ORDINAL,
        Column("purpose", T, "Purpose of the pair.", allowed=words(Purpose)),
        Column("revision", I, "First, second, ... answer or undo of this pair.", allowed="from 1"),
        Column("response", T, "What was said; empty: the previous answer was taken back.", allowed=words(Response)),
        Column("superseded", B, "Whether a later answer or undo of this pair counts instead."),
        Column("reason", T, "Why they could not tell (skip).", allowed=words(SkipReason)),
        Column("mattered", T, "What they said made the difference; empty: nothing, or nobody asked."),
        Column("response_time_ms", I, "From the first frame of both videos to the answer.", "ms"),
        Column("replay_count", I, "How often the clips were started again."),
        Column("scrub_count", I, "How often somebody moved through the clips by hand."),
        Column("playback_rate", N, "Speed at the moment of the answer; 1 is real time.", allowed="0.25 to 2"),
        Column("watched_whole", B, "Whether both clips had been seen from beginning to end."),
        Column("left_watched_ms", I, "How much of the left clip had been played, in its own time.", "ms"),
        Column("right_watched_ms", I, "How much of the right clip had been played, in its own time.", "ms"),
        Column("play_error_count", I, "Clips that could not be loaded or played."),
        Column("stall_count", I, "How often a clip had to wait for the network."),
        Column("stalled_ms", I, "How long it waited altogether.", "ms"),
        Column(
            "largest_drift_ms",
            I,
            "How far the two clips were apart at most, before they were synchronised.",
            "ms",
        ),
        Column("by_script", B, WITHOUT_SCRIPT),
        Column("created_at", W, "When it reached the server."),
        Column("excluded", B, "Whether an experimenter has left this answer out of learning and statistics."),
    ),
    _labels,
    (LabelEvent,),
    grows_by=LabelEvent,
)


def _hints(session: Session, study: Study, window: Window) -> KeyedRows:
    for person, wanted in present(session, study, window):
        rows = select(HintEvent).where(HintEvent.participant_id == person.id, wanted.known(HintEvent))
        given = session.scalars(rows.order_by(HintEvent.revision)).all()
        for each in given:
            if (each.revision, each.id) > wanted.after:
                said = each.hints, each is not given[-1], each.answered, each.offered, each.created_at
                yield (person.number, each.revision, each.id), (person.code, each.revision, *said)


HINTS = Table(
    "hints",
    "Every set of hints that a participant gave beside their answers; the last one counts.",
    (
        PARTICIPANT,
        Column("revision", I, "First, second, ... set of this participant.", allowed="from 1"),
        Column("hints", T, "Names of the hints, as the task calls them; empty: nothing special."),
        Column("superseded", B, "Whether a later set counts instead."),
        Column("answered", I, "How many answers this participant had given, practice not counted."),
        Column("offered", T, "Everything that could be ticked, in the order of this participant's page."),
        Column("created_at", W, "When it reached the server."),
    ),
    _hints,
    (HintEvent,),
    grows_by=HintEvent,
)
