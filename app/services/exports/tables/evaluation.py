"""The blinded evaluation: ratings, head-to-heads, what people set themselves, whose filters they met."""

from sqlalchemy import select
from sqlalchemy.orm import Session, joinedload

from app.domain.evaluation import DonorDraw, DonorRule, HeadToHead, HeadToHeadAnswer, HeadToHeadResponse, Rating, Trial
from app.domain.protocol import FROM_OTHERS, EvaluatedMethod
from app.domain.self_setting import SelfSetting
from app.domain.studies import Study, code_of
from app.services.evaluation import self_setting, unblinding
from app.services.exports.export_formats import Column, Table
from app.services.exports.paging import KeyedRows, Window
from app.services.exports.tables.columns import PARTICIPANT, WITHOUT_SCRIPT, B, I, N, T, W, words
from app.services.exports.whose_rows import present


def _ratings(session: Session, study: Study, window: Window) -> KeyedRows:
    blinded = unblinding.is_blinded(study)
    methods = {} if blinded else unblinding.methods_by_letter(session, study)
    for person, wanted in present(session, study, window):
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


RATINGS = Table(
    "ratings",
    "Every trial of the blinded evaluation with its rating; a corrected rating has one row per revision.",
    (
        PARTICIPANT,
        Column(
            "letter",
            T,
            "The letter the participant knew the method by, in the order of appearance.",
            "",
            "A to E",
        ),
        Column("method", T, "Which method it was; empty until the study is unblinded.", allowed=words(EvaluatedMethod)),
        Column("repetition", I, "Which trial of this method.", allowed="from 1"),
        Column("order", I, "Place of the trial among all trials of this participant.", allowed="from 1"),
        Column("scenario", I, "Situation; the same for all methods of a participant and repetition."),
        Column("satisfaction", I, "Overall satisfaction.", allowed="1 to 5; empty: not rated"),
        Column("personalisation", I, "How personalised the robot seemed.", allowed="1 to 5; empty: not rated"),
        Column(
            "reason",
            T,
            "Why, in their own words; empty: not asked, or left empty.",
            allowed="up to 1000 characters",
        ),
        Column("counts", B, "Whether this rating counts: false if it was corrected later, or if there is none."),
        Column("revision", I, "First, second, ... rating of this trial.", allowed="from 1"),
        Column("response_time_ms", I, "From the moment the scales were shown to the moment the rating was sent.", "ms"),
        Column("by_script", B, WITHOUT_SCRIPT),
        Column("rated_at", W, "When it reached the server."),
        Column("shown_at", W, "Video: when the film was first shown."),
        Column("started_at", W, "Physical: when the operator started the robot."),
        Column("finished_at", W, "Physical: when the operator said that it was done."),
        Column("success", B, "Video: whether the robot succeeded; empty until the study is unblinded."),
    ),
    _ratings,
    (Trial, Rating),
    grows_by=Rating,
)


def _headtoheads(session: Session, study: Study, window: Window) -> KeyedRows:
    methods = {} if unblinding.is_blinded(study) else unblinding.methods_by_letter(session, study)
    for person, wanted in present(session, study, window):
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


HEADTOHEADS = Table(
    "headtoheads",
    "Every head-to-head of two rated robots with its answer; a changed answer has one row per revision.",
    (
        PARTICIPANT,
        Column("order", I, "Place among all head-to-heads of this participant.", allowed="from 1"),
        Column("left_letter", T, "Letter of the robot on the left; it was not shown.", allowed="A to E"),
        Column("right_letter", T, "Letter of the robot on the right; it was not shown.", allowed="A to E"),
        Column("left_method", T, "Method on the left; empty until the study is unblinded.", "", words(EvaluatedMethod)),
        Column(
            "right_method",
            T,
            "Method on the right; empty until the study is unblinded.",
            allowed=words(EvaluatedMethod),
        ),
        Column("repetition", I, "Whose films these are: the repetition of both rated trials.", allowed="from 1"),
        Column("scenario", I, "Situation; the same on both sides."),
        Column(
            "response",
            T,
            "Which one they would rather have; empty: not answered.",
            allowed=words(HeadToHeadResponse),
        ),
        Column(
            "reason",
            T,
            "Why, in their own words; empty: not asked, or left empty.",
            allowed="up to 1000 characters",
        ),
        Column("counts", B, "Whether this answer counts: false if it was changed later, or if there is none."),
        Column("revision", I, "First, second, ... answer to this head-to-head.", allowed="from 1"),
        Column("response_time_ms", I, "From the first frame of both films to the answer.", "ms"),
        Column("by_script", B, WITHOUT_SCRIPT),
        Column("answered_at", W, "When it reached the server."),
        Column("shown_at", W, "When both films were first shown."),
    ),
    _headtoheads,
    (HeadToHead, HeadToHeadAnswer),
    grows_by=HeadToHeadAnswer,
)


def _settings(session: Session, study: Study, window: Window) -> KeyedRows:
    sliders, through = self_setting.sliders_of(study), self_setting.who_have_set(session, study)
    for person, wanted in present(session, study, window):
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


SETTINGS = Table(
    "settings",
    "Every setting of the sliders that a participant let go of, for the method self_set; one row per axis.",
    (
        PARTICIPANT,
        Column("revision", I, "First, second, ... setting of this participant.", allowed="from 1"),
        Column("axis", T, "Axis of the task's execution modes."),
        Column(
            "place",
            I,
            "Where the slider stood; 0 is the reference policy's own way, which is where all begin.",
            allowed="-4 to 4; 0 to 4 where an axis has one direction",
        ),
        Column("value", N, "The axis' value, in its own unit."),
        Column("counts", B, "Whether this is what the robot was made of: the last one of who has gone on."),
        Column(
            "moved", T, "Whose slider was let go of; empty: several, none, or a browser without script.", allowed=""
        ),
        Column("filmed", B, "Whether exactly this setting had been filmed when it was saved."),
        Column("response_time_ms", I, "From the opening of the page, or the setting before, to this one.", "ms"),
        Column("by_script", B, WITHOUT_SCRIPT),
        Column("saved_at", W, "When it reached the server."),
    ),
    _settings,
    (SelfSetting,),
    grows_by=SelfSetting,
)


def _donors(session: Session, study: Study, window: Window) -> KeyedRows:
    """Nothing while the study is blinded."""
    if unblinding.is_blinded(study):
        return
    for person, wanted in present(session, study, window):
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


DONORS = Table(
    "donors",
    "Whose filter a participant was shown as somebody_else and average; no rows until the study is unblinded.",
    (
        PARTICIPANT,
        Column("method", T, "As what it was shown.", allowed=words(FROM_OTHERS)),
        Column(
            "rule",
            T,
            "How it was drawn. by_lot: one of the candidates, nobody much more often than others. mean_of_people: "
            "all candidates. type_of_user, mean_of_types: there were too few candidates. withdrew: whose it was "
            "has withdrawn since.",
            allowed=words(DonorRule),
        ),
        Column("people", T, "Codes of those whose filter, or whose wishes, these are; separated by spaces."),
        Column("types", T, "The paper's types of users whose wishes these are; separated by spaces."),
        Column("candidates", T, "Codes of those who could have been drawn, without who has withdrawn since."),
        Column("drawn_at", W, "When it was drawn: in the second half of the participant's answers, or later."),
    ),
    _donors,
    (DonorDraw,),
)
